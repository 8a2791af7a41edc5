"""What steers the dense refinement."""

from __future__ import annotations

from dataclasses import dataclass, field

from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.plane_sweep import SweepConfig


@dataclass(frozen=True)
class PlainConfig:
    """Depth of regions without texture, from planes on which the rims of many frames agree. Choices marked
    "compared" were tried beside others on robodog_overlap, three_cameras, dynamic_human and roboarm; no sweep
    of them is kept. Lengths in px are of the view that is solved."""

    fill: bool = True
    """Whether it is done. Source: choice; for the ablation."""
    contrast: float = 1.5
    """Grey levels per px, of luminance and colour together, from which an image has texture. Source:
    compared, 1.25 to 2: from 1.75 on it joins walls of robodog_overlap that meet in the dark. Of luminance
    alone 1.5 joined those of dynamic_human; 1.25 was its best, a tenth worse there."""
    smallest: float = 0.003
    """Smallest region, as a share of the image. Source: choice."""
    rim: int = 3
    """Width of the rim, px. Source: compared, 2 and 3; a wide one is mostly of the neighbouring surface."""
    tolerance: float = 0.03
    """Relative error of inverse depth up to which a point lies on a plane. Source: compared, 0.02 to 0.05."""
    rim_share: float = 0.35
    """Share of its rim that a region's plane must fit. Source: compared, 0.25 to 0.65."""
    spread: float = 0.015
    """How far the points of a plane must be from lying on one line, focal lengths. Source: compared, 0.005 to
    0.03."""
    agreement: float = 0.05
    """Mean relative difference of depth up to which two planes are alike on a region. Source: compared, 0.03
    and 0.05."""
    witnesses: int = 8
    """Frames that must agree; half of the frames around where there are fewer. Source: compared, 3 to 25."""
    reach: float = 0.7
    """A region lies no nearer than this share of its rim's nearest depth, nor farther than the farthest over
    it. Source: compared, 0.3 to 0.7."""
    window: int = 24
    """Time steps before and after whose planes are asked. Source: compared, 12 to all; bounds the time."""

    def __post_init__(self) -> None:
        if self.rim < 1 or self.window < 0:
            raise ConfigError(
                f"refinement.plain.rim is {self.rim} and refinement.plain.window {self.window}; they must be"
                " at least 1 and 0"
            )
        for name in ("contrast", "tolerance", "agreement"):
            if not getattr(self, name) > 0.0:
                raise ConfigError(f"refinement.plain.{name} is {getattr(self, name)}; it must be above 0")
        if not 0.0 < self.reach <= 1.0:
            raise ConfigError(f"refinement.plain.reach is {self.reach}; it must be above 0 and at most 1")


@dataclass(frozen=True)
class RefinementConfig:
    """Stage 2: dense per-pixel refinement. Lengths in px are of the input resolution. ``refinement_sweep.md``
    lies in experiments/results."""

    stride: int = 2
    """Depth is solved for every pixel (1) or every second (2), and brought up along the image's edges.
    Source: choice; 1 takes four times the time and disk."""
    workers: int = 0
    """Processes; 0 takes as many as there are processors. The result does not depend on it. Source:
    choice."""
    temporal_offsets: tuple[int, ...] = (1, 2, 4, 8)
    """Frame distances of dense temporal edges. Source: paper, "Dense correspondence estimation", for 2, 4 and
    8. With these alone every second frame may be tied to the others by little: RTE of three_cameras rose by
    a quarter in the refinement, with 1 it does not rise."""
    flow_finest_scale: int = 0
    """Stands for frontend.flow.finest_scale in the refinement, whose every pixel needs what tracking averages
    over thousands. Source: refinement_sweep.md: 1 is worse by 14 % and saves a tenth of the time."""
    sweep_reach: float = 0.02
    """Motion of the image, as a share of its width, up to which a frame takes the swept depth of another of
    its camera. Source: 0, 0.01, 0.02 and 0.04 compared on robodog_overlap, dynamic_human and HoloLens: the
    same to 1 % but for 0.04 on HoloLens, worse by 6 %; 0 takes a tenth more time."""
    guided_px: float = 16.0
    """Mean predicted flow beyond which flow within a camera is guided by depth and poses. Source: as
    tracking.guided_px."""
    plain_weight: float = 0.05
    """Weight of flow within a camera that both directions confirm and no texture does. Source: choice."""
    window: int = 8
    """Time steps whose depth is solved together at most, over all cameras. Source: choice; bounds the
    memory, and gives every processor work."""
    overlap: int = 1
    """Time steps by which windows overlap on each side. Source: choice."""
    rounds: int = 1
    """Times phase 2 solves poses, then depth, after a first depth. Source: 1 and 2 in refinement_sweep.md:
    the second lowers ATE by 2 % and nothing else."""
    affine_iterations: int = 5
    """Gauss-Newton iterations of phase 1. Source: choice."""
    edges_per_frame: int = 6
    """Edges of a frame that its depth is solved from, those with most parallax. Source: 4, 6 and 8 in
    refinement_sweep.md: 4 are worse by 2 %, 8 no better."""
    depth_iterations: int = 3
    """Gauss-Newton iterations per depth solve, each with new confidences. Source: 2, 3 and 4 in
    refinement_sweep.md: a fourth lowers Abs.Rel by 1 %, and M_d not at all."""
    pose_iterations: int = 3
    """Gauss-Newton iterations per pose solve. Source: choice."""
    phase1: bool = True
    """Whether scale and offset of every frame are solved first. Source: paper."""
    phase2: bool = True
    """Whether per-pixel depth and poses are solved. Source: paper."""
    joint: bool = False
    """Solve poses and depth of phase 2 in one system instead of in turn, for the ablation. Source: paper
    supplement: it degrades the poses."""
    flow_weight: float = 1.0
    """``w_f`` of L_flow, per px. Source: choice of unit."""
    disparity_weight: float = 5.0
    """``w_d`` of L_disp, per unit of relative depth: 5 makes 1 % of depth cost as much as 0.05 px. Source:
    2.5 to 10 in refinement_sweep.md, all within 1.5 %."""
    flow_lambda: float = 1.0
    """``lambda`` of the flow's confidence: residual at which it begins to fall, px. Source: 0.5 to 2 in
    refinement_sweep.md: 0.5 is worse by 2 %, 2 no better."""
    disparity_lambda: float = 0.05
    """The same for L_disp, relative depth. Source: choice."""
    smoothness: float = 1.0
    """Weight of a change of log depth by ``smoothness_scale`` between neighbours, where the image is flat.
    Source: 0.5 to 2 in refinement_sweep.md: 2 is worse by 2 %."""
    smoothness_scale: float = 0.01
    """Relative change beyond which it counts as an edge of the depth and costs no more. Source: 0.005 to 0.02
    in refinement_sweep.md: half is worse by 4 %; twice lowers Abs.Rel by 2 % and raises M_d by 1 %."""
    edge_contrast: float = 5.0
    """Grey levels, of luminance and colour together, between neighbours at which smoothness has fallen to
    1/e. Source: 3.5 to 7 of luminance alone in refinement_sweep.md, all alike; 5 and 6 compared on
    dynamic_human, robodog_overlap and three_cameras, within 2 %."""
    prior_sigma: float = 0.3
    """Standard deviation of the log depth that a solve begins with: holds what no edge sees. Source: 0.15 to
    0.6 in refinement_sweep.md: 0.15 is worse by 2 %, 0.6 no better."""
    held_sigma: float = 0.22
    """The same on plain surfaces whose depth images of other times decided: no flow will, and smoothness
    makes slanting ones flat. Source: none, 0.22 and 0.1 compared on HoloLens and KITTI."""
    prior_rotation_deg: float = 0.02
    """Standard deviation in L_prior of tracked rotations whose covariance is unknown. Source: as
    tracking.start_rotation_deg."""
    prior_translation: float = 0.0005
    """The same of positions, in median depths. Source: as tracking.start_translation."""
    smooth_rotation: float = 1e-3
    """Weight of L_smooth(rot) against L_prior. Source: choice; it pulls on motion itself."""
    smooth_translation: float = 1e-3
    """Weight of L_smooth(trans) against L_prior. Source: choice."""
    moving_px: float = 0.8
    """Residual of the static model beyond which a pixel may move, px. Source: choice, between what static and
    moving pixels showed on a dozen frames of two rendered scenes, in a trial that is not kept."""
    still_px: float = 0.4
    """Residual of the static model below which flow of two frames proves a pixel still, whatever is found
    around it. Source: on six rendered scenes, two of them crowded, in a trial that is not kept, such pixels
    were 10 to 54 % of what stood still and was called moving, and 0 to 2 % of what moved; with ``moving_px``
    17 to 57 and 0 to 8 %."""
    moving_area: float = 0.003
    """Smallest region that may move, as a share of the image. Source: choice."""
    moving_gap: float = 0.06
    """Gaps in a moving region up to this share of the image's width are closed. Source: choice."""
    moving_share: float = 0.4
    """Share of the frames around that must see the static model fail. Source: choice."""
    match_offsets: tuple[int, ...] = (4, 8, 12, 16, 24, 32)
    """Distances in frames, both ways, of the images that a frame's depth is checked in. Source: (6, 12), (5,
    15) and those up to 16 compared on five rendered scenes; fewer images call more static regions moving,
    and without the farthest what enters an image is missed: a tenth of dynamic_human's moving error."""
    match_likeness: float = 0.7
    """Correlation from which a region that flow calls moving looks alike there and stands still. Source: of
    about 170 such regions of five rendered scenes moving ones had 0.1 to 0.4, two up to 0.7; still ones 0.5
    to 0.9."""
    unlike_likeness: float = 0.3
    """Correlation below which a region without flow moves. Source: 0.3 to 0.5 compared there: more finds
    little more that moves and much that does not."""
    carried_share: float = 0.8
    """Share of the frames before, or of those after, that must call a pixel moving for it to move too.
    Source: 0.6 and 0.8 compared on five rendered scenes."""
    witness_offsets: tuple[int, ...] = (12, 24, 40)
    """Distances in frames, both ways, of the views, of all cameras, that are asked whether they see through
    what passes for still. Source: choice; beyond the reach of the flow."""
    moving_reach: float = 0.06
    """How far outside such a region its outline is looked for, as a share of the image's width. Source:
    compared on three_cameras and dynamic_human, 0.02 to 0.1; no sweep is kept."""
    moving_contrast: float = 11.0
    """Grey levels by which the colour of a moving pixel differs at least from what stands behind it. Source:
    11 to 15 compared on six rendered scenes: above noise and what an error of pose or depth makes of texture.
    Of luminance alone 9 and 11: up to twice as much of what moves was missed."""
    background_offsets: tuple[int, ...] = (8, 12, 16, 24, 32, 40)
    """Distances in frames, both ways, at which what stands behind is looked for. Source: choice."""
    background_margin: float = 0.02
    """How near to what moves at such a time nothing passes for what stands behind, as a share of the image's
    width. Source: 0.01 to 0.06 compared on robodog_overlap, dynamic_human and roboarm; no sweep is kept."""
    behind_sigma: float = 0.1
    """Standard deviation of the log depth that other times know of what stands behind what moves: between
    legs no flow tells it. Source: none, 0.05, 0.1 and 0.2 compared on robodog_overlap and dynamic_human:
    without, what stands still is worse by 2 to 4 %; the rest within 1.5 %."""
    moving_evidence: float = 0.2
    """How far the images of this or near instants must support a moving region's depth before it is believed.
    Source: choice."""
    moving_sigma: float = 0.1
    """Standard deviation of that depth, relative. Source: 0.05 to 0.2 compared on three rendered scenes, all
    within 2 %."""
    sweep: SweepConfig = field(default_factory=SweepConfig)
    plain: PlainConfig = field(default_factory=PlainConfig)

    def __post_init__(self) -> None:
        for name, low in (
            ("stride", 1), ("workers", 0), ("window", 1), ("overlap", 0), ("rounds", 1),
            ("affine_iterations", 1), ("edges_per_frame", 1), ("depth_iterations", 1), ("pose_iterations", 1),
            ("flow_finest_scale", 0),
        ):  # fmt: skip
            if getattr(self, name) < low:
                raise ConfigError(f"refinement.{name} is {getattr(self, name)}; it must be at least {low}")
        for name in (
            "flow_lambda", "disparity_lambda", "smoothness_scale", "edge_contrast", "prior_rotation_deg",
            "prior_translation", "prior_sigma", "held_sigma", "behind_sigma", "moving_sigma", "moving_px",
            "still_px",
        ):  # fmt: skip
            if not getattr(self, name) > 0.0:
                raise ConfigError(f"refinement.{name} is {getattr(self, name)}; it must be above 0")
        if any(offset < 1 for offset in self.temporal_offsets):
            raise ConfigError(
                f"refinement.temporal_offsets is {list(self.temporal_offsets)}; it must hold distances >= 1"
            )
