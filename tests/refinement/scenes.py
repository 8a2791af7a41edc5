"""An analytic scene for the refinement: a room with a box in it, and what samples of it would hold."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.geometry import invert_pose, pixel_rays, project, transform_points
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.solve.samples import FrameSample

Array = npt.NDArray[np.float64]
DepthOf = Callable[[Frame, Array], Array]
"""What is held for the depth of a frame, given the true depth ``(M,)``."""

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0
INTRINSICS = np.array([[FOCAL, 0.0, (WIDTH - 1) / 2], [0.0, FOCAL, (HEIGHT - 1) / 2], [0.0, 0.0, 1.0]])
ROOM = (np.array([-4.0, -2.5, -6.0]), np.array([4.0, 2.5, 6.0]))
BOX = (np.array([-0.9, -0.6, 1.5]), np.array([0.4, 2.5, 2.6]))


@dataclass(frozen=True)
class Scene:
    """Cameras in the room."""

    wTc: Array
    """``(N, T, 4, 4)`` true poses."""

    @property
    def frames(self) -> tuple[Frame, ...]:
        cameras, times = self.wTc.shape[:2]
        return tuple((camera, time) for camera in range(cameras) for time in range(times))

    def depth(self, frame: Frame, pixels: Array) -> Array:
        """True z-depth ``(M,)`` at pixels ``(M, 2)``, by casting rays."""
        wTc = self.wTc[frame]
        w_rays = pixel_rays(pixels, INTRINSICS) @ wTc[:3, :3].T
        near, far = _slab(ROOM, wTc[:3, 3], w_rays)
        enters, leaves = _slab(BOX, wTc[:3, 3], w_rays)
        hit = (enters < leaves) & (enters > 0.0)
        return np.where(hit, enters, far)

    def pairs(self, offsets: Sequence[int] = (1, 2)) -> dict[Frame, tuple[Frame, ...]]:
        """Neighbours of every frame: ``offsets`` away in its camera, and the others at its instant."""
        cameras, times = self.wTc.shape[:2]
        found: dict[Frame, tuple[Frame, ...]] = {}
        for camera, time in self.frames:
            temporal = [(camera, time + sign * offset) for offset in offsets for sign in (-1, 1)]
            spatial = [(other, time) for other in range(cameras) if other != camera]
            found[camera, time] = tuple(j for j in temporal + spatial if 0 <= j[1] < times)
        return found

    def sample(
        self, frame: Frame, neighbours: Sequence[Frame], spacing: int = 8, depth_of: DepthOf | None = None
    ) -> FrameSample:
        """Every ``spacing``-th pixel with exact flow; no weight where it leaves the image or is hidden.

        ``depth_of`` makes the depth that is held from the true one, by default the true one.
        """
        held = depth_of or _as_it_is
        x, y = np.meshgrid(np.arange(2, WIDTH, spacing), np.arange(2, HEIGHT, spacing))
        pixels = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
        rays, depth = pixel_rays(pixels, INTRINSICS), self.depth(frame, pixels)
        targets, weights, there = [], [], []
        for j in neighbours:
            jTi = invert_pose(self.wTc[j]) @ self.wTc[frame]
            target, expected = project(transform_points(jTi, rays * depth[:, None]), INTRINSICS)
            inside = np.all((target >= 0.0) & (target <= [WIDTH - 1, HEIGHT - 1]), axis=1)
            target = np.where(inside[:, None], target, 0.0)
            found = self.depth(j, target)
            targets.append(target)
            weights.append((inside & (np.abs(found / expected - 1.0) < 1e-6)).astype(np.float64))
            there.append(np.where(inside, 1.0 / held(j, found), np.nan))
        count = len(neighbours)
        return FrameSample(
            i=frame,
            neighbours=tuple(neighbours),
            rays=rays,
            inverse_depth=1.0 / held(frame, depth),
            intrinsics=np.broadcast_to(INTRINSICS, (count, 3, 3)),
            target=np.array(targets),
            weight=np.array(weights),
            inverse_depth_there=np.array(there),
        )

    def samples(self, spacing: int = 8, depth_of: DepthOf | None = None) -> list[FrameSample]:
        """A sample of every frame towards all its neighbours."""
        return [self.sample(i, neighbours, spacing, depth_of) for i, neighbours in self.pairs().items()]


def two_cameras(times: int = 3, still: bool = False) -> Scene:
    """Two cameras side by side that look at the box and swing apart, half a metre of baseline."""
    wTc = np.tile(np.eye(4), (2, times, 1, 1))
    for camera in range(2):
        for time in range(times):
            moved = 0 if still else time
            turn = Rotation.from_rotvec([0.01 * moved, 0.06 - 0.12 * camera - 0.015 * moved, 0.02 * camera])
            wTc[camera, time, :3, :3] = turn.as_matrix()
            wTc[camera, time, :3, 3] = [
                -0.3 + 0.6 * camera + 0.12 * moved,
                0.05 * moved,
                -2.0 + 0.1 * camera + 0.08 * moved,
            ]
    return Scene(wTc)


def stream(samples: Sequence[FrameSample]) -> Callable[[], Iterable[FrameSample]]:
    """What the solves take."""
    return lambda: iter(samples)


def with_noise(samples: Sequence[FrameSample], sigma_px: float, seed: int = 0) -> list[FrameSample]:
    """Gaussian noise on all flow."""
    rng = np.random.default_rng(seed)
    return [replace(s, target=s.target + rng.normal(0.0, sigma_px, s.target.shape)) for s in samples]


def with_outliers(samples: Sequence[FrameSample], share: float, seed: int = 0) -> list[FrameSample]:
    """Flow to anywhere in the image for a share of the pixels."""
    rng = np.random.default_rng(seed)
    changed = []
    for sample in samples:
        wrong = rng.random(sample.weight.shape) < share
        anywhere = rng.uniform(0.0, [WIDTH, HEIGHT], sample.target.shape)
        changed.append(replace(sample, target=np.where(wrong[..., None], anywhere, sample.target)))
    return changed


def _as_it_is(frame: Frame, depth: Array) -> Array:
    return depth


def _slab(box: tuple[Array, Array], origin: Array, rays: Array) -> tuple[Array, Array]:
    """Where rays enter and leave an axis-aligned box, in multiples of the ray."""
    safe = np.where(np.abs(rays) < 1e-12, 1e-12, rays)
    low, high = (box[0] - origin) / safe, (box[1] - origin) / safe
    return np.minimum(low, high).max(axis=1), np.maximum(low, high).min(axis=1)
