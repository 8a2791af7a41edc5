"""Every number the software is steered by: one tree of frozen dataclasses, each field with its source.

A field's docstring is its help text (``mvdyn config``) and ends with where its value comes from: "paper"
is Sun et al., Dense Dynamic Scene Reconstruction and Camera Pose Estimation from Multi-View Videos.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from mvdyn_gtsam.config_tree import (
    ConfigKey,
    build,
    check,
    describe_tree,
    flatten,
    nest,
    parse_override,
    read_file,
    to_plain,
)
from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.dense_flow import FlowConfig
from mvdyn_gtsam.frontend.start.settings import WideBaselineConfig
from mvdyn_gtsam.refinement.settings import RefinementConfig


def require(condition: bool, message: str) -> None:
    """Raise ConfigError with ``message`` unless ``condition``; for ``__post_init__`` of sections."""
    if not condition:
        raise ConfigError(message)


@dataclass(frozen=True)
class CaptureConfig:
    """Reading the input."""

    truncate: bool = False
    """Cut every camera to the shortest instead of refusing cameras of different length. Source: choice."""


@dataclass(frozen=True)
class FrontendConfig:
    """Measuring: flow, depth priors, the wide-baseline start."""

    flow: FlowConfig = field(default_factory=FlowConfig)
    wide_baseline: WideBaselineConfig = field(default_factory=WideBaselineConfig)


@dataclass(frozen=True)
class GraphConfig:
    """Connecting: which frames get an edge."""

    spatial_overlap: float = 0.75
    """Share of the projected grid that must land in the other image for a spatial edge. Source: paper."""
    temporal_offsets: tuple[int, ...] = (1, 2, 4, 8)
    """Frame distances of temporal edges, both directions. Source: measured, DIS flow at 512x384."""
    temporal_overlap: float = 0.4
    """Visible share of the grid that a temporal edge beyond the last keyframe needs. Source: measured, fast
    hand-held motion (hololens_office_2seg): below it flow finds next to nothing, and the poses came out alike
    with 0, 0.2 and 0.4."""
    inter_camera: bool = True
    """Connect frames of different cameras; without, each video is tracked alone and cameras stay where the
    start's poses hold them. Source: paper; false is its ablation "w/o ST-Graph"."""
    max_active_edges: int = 96
    """Inter-camera edges kept in the active window; the oldest go first. Source: paper supplement, edge
    ablation."""
    st_overlap: float = 0.2
    """Visible share of the grid that a spatio-temporal edge needs. Source: choice; cameras of the rendered
    scenes share 0.25 to 0.44."""
    st_per_frame: int = 1
    """New inter-camera edges per keyframe and other camera, at most. Source: max_active_edges over the
    window."""
    st_separation: int = 4
    """Frames between two spatio-temporal edges of one keyframe, at least. Source: choice, half an offset-8
    edge."""
    long_range_per_frame: int = 2
    """Long-range edges of the polish per keyframe to its own camera. Source: choice, not swept."""
    long_range_separation: int = 12
    """Keyframes between the ends of a long-range edge, at least. Source: DESIGN 5 (+-16, +-24 worked)."""
    polish_per_frame: int = 2
    """Edges of the polish per keyframe to each other camera. Source: choice, not swept."""
    occlusion_tolerance: float = 0.15
    """Relative depth difference up to which two frames are taken to see one surface. Source: choice."""
    max_parallax_deg: float = 60.0
    """Viewing angle at which flow between two frames is no longer tried. Source: choice."""

    def __post_init__(self) -> None:
        require(
            0.0 < self.spatial_overlap <= 1.0,
            f"graph.spatial_overlap is {self.spatial_overlap}; it must be above 0 and at most 1",
        )
        require(
            len(self.temporal_offsets) > 0 and all(offset >= 1 for offset in self.temporal_offsets),
            f"graph.temporal_offsets is {list(self.temporal_offsets)}; it must hold frame distances >= 1",
        )
        require(self.max_active_edges >= 1, f"graph.max_active_edges is {self.max_active_edges}; at least 1")


@dataclass(frozen=True)
class TrackingConfig:
    """Stage 1: poses and depth scales in a sliding window, then the polish."""

    window: int = 25
    """Frames in the sliding window, per camera. Source: paper supplement, parameters."""
    free: int = 10
    """Latest frames of the window that are optimised. Source: paper supplement, parameters."""
    depth_model: Literal["structureless", "fixed_shape", "carried_shape"] = "structureless"
    """What poses are solved with: every grid point's depth, eliminated inside the factor; or only a scale of
    the depth map, whose shape is solved anew between solves of the poses (fixed_shape) or stays as carried
    over from the start (carried_shape). Source: DESIGN 5; the others are for experiments/ablations."""
    depth_prior_lambda: float = 0.005
    """Weight of the depth prior, if there is one, against the flow; 0: it only fills in what no flow carried.
    In Eq. 4 flow residuals are at 1/8 resolution and depth is inverse, of median 1; in pixels and log depth,
    against noise_px, that is a standard deviation of noise_px / (8 sqrt(lambda)), 0.35 by default, over
    the root of the prior's confidence. Source: paper supplement, parameters (Eq. 4)."""
    grid_points: int = 768
    """Grid points per frame, about. Source: DESIGN 5."""
    keyframe_px: float = 2.0
    """Mean flow since the last keyframe that makes a new one, px. Source: choice for accuracy, not swept
    (DROID and MegaSAM take 16 to 19 px at full resolution)."""
    guided_px: float = 16.0
    """Mean predicted flow beyond which temporal flow is guided by depth and poses, px. Source:
    choice, not swept."""
    robust_px: float = 0.2
    """Scale of the Cauchy loss on flow residuals in the polish, px. Source: experiments/tracking_sweep.py."""
    window_robust_px: float = 0.5
    """The same in the sliding window, whose poses are rougher, px. Source: choice, not swept."""
    noise_px: float = 0.2
    """Standard deviation of flow of weight one, px. Source: measured against the true flow of the rendered
    scenes (median 0.11 to 0.22 px); too large a value lets the depth prior bias the poses."""
    noise_per_residual: float = 2.0
    """Noise of a keyframe's flow over the median of its residuals. Source: experiments/tracking_sweep.py."""
    max_noise_px: float = 1.0
    """Largest noise a keyframe's flow is taken to have, px. Source: DESIGN 5 (Cauchy, ~1 px)."""
    carried_sigma: float = 0.5
    """Standard deviation of the prior on log depth where the depth was carried over. Source:
    experiments/tracking_sweep.py."""
    scale_sigma: float = 0.3
    """Standard deviation of a keyframe's log depth scale. Source: choice."""
    start_rotation_deg: float = 0.02
    """Standard deviation of the start's rotations. Source: what the start reaches on the rendered scenes
    (experiments/wide_baseline.py); single runs gave dynamic_human 9.7 mm with 0.5, 5.4 with 0.05 and 2.6
    with 0.02."""
    start_translation: float = 0.0005
    """Standard deviation of the start's positions, in median depths. Source: as above."""
    step_iterations: int = 2
    """iSAM2 updates per time step. Source: choice, not swept."""
    polish_rounds: int = 1
    """Times the polish measures long-range edges and solves. Source: DESIGN 5; a second round took
    robodog_overlap from 0.37 to 0.30 mm and doubled the polish."""
    polish_iterations: int = 12
    """Levenberg-Marquardt iterations per solve of the polish. Source: experiments/tracking_sweep.py."""
    remeasure_px: float = 0.5
    """Median change of a guided flow's prediction beyond which the polish measures it again, px. Source:
    measured: 0.3, 0.5 and 1.0 gave 25.2, 25.2 and 25.1 mm on hololens_office_2seg; on dynamic_human
    0.3 gave 2.4 mm and 1.0 gave 2.6."""
    polish_tolerance: float = 1e-5
    """Relative decrease of the cost at which a solve of the polish ends. Source: choice; 1e-4 ended
    far from the minimum, and 1e-6 iterated on without moving the poses."""
    image_cache_mb: int = 128
    """Memory for frames held or read again. Source: choice, 200 frames of 512x384."""

    def __post_init__(self) -> None:
        require(self.window >= 2, f"tracking.window is {self.window}; it must be at least 2")
        require(
            1 <= self.free <= self.window,
            f"tracking.free is {self.free}; it must be between 1 and tracking.window ({self.window})",
        )
        require(
            self.depth_prior_lambda >= 0.0,
            f"tracking.depth_prior_lambda is {self.depth_prior_lambda}; it must not be negative",
        )


@dataclass(frozen=True)
class Config:
    """The whole configuration; sections follow the rooms."""

    capture: CaptureConfig = field(default_factory=CaptureConfig)
    frontend: FrontendConfig = field(default_factory=FrontendConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)


def load_config(file: Path | str | None = None, overrides: Sequence[str] = ()) -> Config:
    """The defaults, changed as ``load_settings`` says; raises ConfigError as that does."""
    return build(Config, load_settings(file, overrides))


def load_settings(
    file: Path | str | None = None, overrides: Sequence[str] = (), *, alone: bool = True
) -> dict[str, Any]:
    """Nested values of ``file`` (TOML or JSON, sections as tables), changed by ``overrides``.

    An override is ``"section.key=value"`` with the value in TOML syntax, quotes around strings optional.
    Raises ConfigError, one line, for an unknown key (naming the closest one), a value of the wrong type and a
    file that cannot be read; where they stand ``alone``, beside defaults, also for a value out of range.
    """
    values: dict[str, Any] = {} if file is None else read_file(Path(file))
    examine: Callable[[type[Any], Mapping[str, Any]], Any] = build if alone else check
    # The file alone first, so that its mistakes are reported as the file's.
    _named(lambda: examine(Config, values), str(file))
    for override in overrides:
        parse_override(Config, override, values)
    _named(lambda: examine(Config, values), "--set" if overrides else str(file))
    return values


def config_from_dict(values: Mapping[str, Any]) -> Config:
    """The inverse of ``to_dict``; checks as ``load_config`` does."""
    return build(Config, values)


def to_dict(config: Config) -> dict[str, Any]:
    """``config`` as plain JSON and TOML values: dicts, lists, numbers, strings, booleans."""
    return to_plain(config)


def given_settings(config: Config | Mapping[str, Any] | None) -> dict[str, Any]:
    """What ``config`` asks for, as nested plain values.

    A mapping (``{"tracking": {"window": 20}}``) asks for what it holds; a ``Config``, which has a value for
    every key, for what differs from the defaults. Raises ConfigError for an unknown key or a value of the
    wrong type.
    """
    if not isinstance(config, Config):
        return to_plain(check(Config, config or {}))
    defaults = flatten(to_dict(Config()))
    return nest({key: value for key, value in flatten(to_dict(config)).items() if value != defaults[key]})


def describe() -> list[ConfigKey]:
    """Every key with its default and its help text, in order."""
    return describe_tree(Config())


def _named(examine: Callable[[], object], origin: str) -> None:
    try:
        examine()
    except ConfigError as error:
        raise ConfigError(f"{origin}: {error}; `mvdyn config` lists every key") from error
