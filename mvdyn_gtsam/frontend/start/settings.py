"""Settings of the wide-baseline start."""

from __future__ import annotations

from dataclasses import dataclass, field

from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.start.dense_map import DenseMapConfig
from mvdyn_gtsam.frontend.start.joint_adjustment import AdjustmentConfig
from mvdyn_gtsam.frontend.start.lifted_points import LiftConfig
from mvdyn_gtsam.frontend.start.placement import PlacementConfig
from mvdyn_gtsam.frontend.start.still_cameras import StillConfig
from mvdyn_gtsam.frontend.start.trial import TrialConfig
from mvdyn_gtsam.frontend.start.verification import VerificationConfig


@dataclass(frozen=True)
class WideBaselineConfig:
    """The start without weights."""

    frame_step: float = 0.03
    """Image motion between a map's frames, in image widths. Source: experiments/wide_baseline.py."""
    maximum_frames: int = 40
    """Frames per camera at most; the step widens for longer videos. Source: choice, time."""
    minimum_frames: int = 10
    """Frames per camera at least, where the video has them; the step narrows for slow or short ones. Source:
    experiments/start_variants.py; maps of three to seven frames were bent too far to be placed."""
    features: int = 3000
    """Keypoints per frame. Source: experiments/wide_baseline.py."""
    contrast: float = 0.01
    """SIFT contrast threshold; below the usual 0.04 for plain walls. Source: as above."""
    neighbours: int = 4
    """Frames ahead matched within a camera. Source: choice, time."""
    ratio: float = 0.8
    """Lowe's ratio within a camera. Source: Lowe 2004."""
    minimum_parallax_deg: float = 1.0
    """Median triangulation angle below which a camera counts as standing still. Source: choice."""
    minimum_rigidity: float = 0.92
    """Share of a camera's flow that its map should explain; below, keypoints are followed along the flow, and
    the map that explains more is kept. Source: experiments/start_variants.py; maps within 3 % of the truth
    had 0.94 and more, but for one with 0.87, those beyond 10 % had 0.26 to 0.87."""
    minimum_known: float = 0.1
    """Share of its dense frames for which a map must know depth to be placed. Source: experiments/
    start_variants.py; maps with 0.07 to 0.09 were 7 % off and more, and one was placed wrong; others had 0.22
    and more."""
    clear_trust: float = 0.8
    """Share of favourable testimony, in haste, that a placement needs to be believed as it is. Source:
    experiments/start_variants.py."""
    minimum_trust: float = 0.75
    """And the careful share that a mended one needs. Source: experiments/placement_trust.py; true ones had
    0.77 and more, but for those of maps that were bent too far, false ones up to 0.73 where no true one beat
    them."""
    minimum_agreement: float = 0.01
    """Agreeing share of the image per frame pair it needs. Source: as above; true ones had 0.017 and more."""
    lift: LiftConfig = field(default_factory=LiftConfig)
    placement: PlacementConfig = field(default_factory=PlacementConfig)
    dense_map: DenseMapConfig = field(default_factory=DenseMapConfig)
    verification: VerificationConfig = field(default_factory=VerificationConfig)
    adjustment: AdjustmentConfig = field(default_factory=AdjustmentConfig)
    still: StillConfig = field(default_factory=StillConfig)
    trial: TrialConfig = field(default_factory=TrialConfig)

    def __post_init__(self) -> None:
        if min(self.maximum_frames, self.neighbours) < 2 or self.features < 100:
            raise ConfigError("frontend.wide_baseline: at least 2 frames, 2 neighbours and 100 features")
        if not 0.0 < self.frame_step < 0.5:
            raise ConfigError(f"frontend.wide_baseline.frame_step is {self.frame_step}; between 0 and 0.5")
