"""A placement tried out: two maps are bent to fit each other before dense warping says what it thinks.

A map of little parallax is off by more than what verification tolerates, and refining one similarity on a
few matches cannot mend that: true placements then looked worse than false ones. A short joint adjustment lets
both maps give way where the images want it, and their dense depth follows. What is true fits better
afterwards; what is false has nothing to gain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.start.dense_map import DenseMap, DenseMapConfig, move_map
from mvdyn_gtsam.frontend.start.joint_adjustment import AdjustmentConfig, adjust_maps
from mvdyn_gtsam.geometry import Similarity

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


@dataclass(frozen=True)
class TrialConfig:
    """How placements are tried out."""

    trials: int = 3
    """Placements tried per pair of cameras, those with most in their favour first. Source: choice, time."""
    minimum_trust: float = 0.25
    """Favourable share of testimony that a placement needs to be tried. Source:
    experiments/start_variants.py; true ones of maps that were yet to be mended had 0.27 and more."""
    minimum_inliers: int = 12
    """Matches that must support it: as many as a still camera's pose needs. Source: StillConfig; of a hundred
    false matches, up to 9 agreed by chance (experiments/start_variants.py)."""
    points_per_camera: int = 250
    """Points of one camera alone that enter. Source: choice, time."""
    search_px: tuple[float, ...] = (40.0, 12.0)
    """Radius of each round of looking for points in frames that should see them. Source: choice, time."""

    def __post_init__(self) -> None:
        if self.trials < 1 or not 0.0 <= self.minimum_trust < 1.0:
            raise ConfigError(
                "frontend.wide_baseline.trial: at least 1 trial, minimum_trust from 0 to below 1"
            )


def mend_placement(
    cameras: tuple[Camera, Camera],
    maps: tuple[DenseMap, DenseMap],
    aSb: Similarity,
    same_point: Index,
    adjustment: AdjustmentConfig,
    trial: TrialConfig,
    dense_map: DenseMapConfig,
) -> tuple[Similarity, tuple[DenseMap, DenseMap]]:
    """The placement ``aSb`` as a short joint adjustment mends it, and both maps in one world after that.

    ``same_point``: ``(M, 2)`` rows of the maps' points that are one.
    """
    short = replace(adjustment, points_per_camera=trial.points_per_camera, search_px=trial.search_px)
    sparse = [dense.sparse for dense in maps]
    # with the focal lengths found so far: the dense maps, which are moved along, are made with them
    held = [replace(camera, focal_known=True) for camera in cameras]
    adjusted = adjust_maps(held, sparse, {0: Similarity.identity(), 1: aSb}, [(0, 1, same_point)], short)
    wTc = {index: np.stack([frame.wTc for frame in own]) for index, own in adjusted.frames.items()}
    wSa, wSb = (similarity_of(sparse[i].mTc, wTc[i]) for i in (0, 1))
    first, second = (move_map(cameras[i], maps[i], wTc[i], dense_map) for i in (0, 1))
    return wSa.inverse().compose(wSb), (first, second)


def similarity_of(mTc: Array, wTc: Array) -> Similarity:
    """The ``wSm`` that comes nearest to taking frames ``(K, 4, 4)`` of a map to where they are in the world.

    The rotation is that of the frames, not of their centres, which may lie on a line.
    """
    wRm = Rotation.from_matrix(wTc[:, :3, :3] @ np.swapaxes(mTc[:, :3, :3], 1, 2)).mean().as_matrix()
    before, after = mTc[:, :3, 3], wTc[:, :3, 3]
    spread = [float(np.linalg.norm(centres - centres.mean(0))) for centres in (before, after)]
    scale = max(spread[1], 1e-12) / max(spread[0], 1e-12)
    return Similarity(scale, wRm, after.mean(0) - scale * wRm @ before.mean(0))
