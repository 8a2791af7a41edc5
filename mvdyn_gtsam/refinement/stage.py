"""The dense refinement from start to end: the paper's "Multiple-view scene consistency refinement".

Plane sweeps propose depth where a network would; phase 1 aligns every frame's depth by scale and offset
with the poses held fixed; phase 2 solves poses and per-pixel depth in turn. Everything dense lies on disk.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from types import TracebackType

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.frontend.dense_flow import DenseFlow, Float32, FlowConfig, to_grey
from mvdyn_gtsam.progress import Progress
from mvdyn_gtsam.refinement.connections import Pair, neighbours_of, refinement_pairs
from mvdyn_gtsam.refinement.context import COLOUR, LABELS, Context, smooth_colour
from mvdyn_gtsam.refinement.finish import FinishedFrame
from mvdyn_gtsam.refinement.moving.free_space import SIGHT
from mvdyn_gtsam.refinement.moving.growth import Growth
from mvdyn_gtsam.refinement.moving.over_time import depth_of_regions
from mvdyn_gtsam.refinement.moving.region_depth import RegionDepth
from mvdyn_gtsam.refinement.moving.relief import RELIEF
from mvdyn_gtsam.refinement.moving.shape import FITTED
from mvdyn_gtsam.refinement.neighbours import swept_times
from mvdyn_gtsam.refinement.plain.axes import main_axes
from mvdyn_gtsam.refinement.plain.filling import AXES, PLANES
from mvdyn_gtsam.refinement.pool import TaskPool, worker_count
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.solve.poses import solve_poses
from mvdyn_gtsam.refinement.solve.samples import FrameSample, SampleStore
from mvdyn_gtsam.refinement.solve.scale import solve_scales
from mvdyn_gtsam.refinement.tasks import FIRST_DEPTH, GUIDE_STEPS, windows
from mvdyn_gtsam.refinement.views import DenseView
from mvdyn_gtsam.refinement.workspace import Workspace

logger = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]

BYTES_PER_PIXEL_AND_PAIR = 10.0
"""Both directions of a flow on disk: two 16-bit numbers and a weight each."""
BYTES_PER_PIXEL = 113.0
"""Of a view on disk besides its flow: eighteen arrays of 32 bits, nine of 8, and where flow leads at about
eight other times."""
WORKSPACE_FORMAT = 4
"""Raised when what lies on disk changes: a refinement that an earlier version began is begun anew."""
FAILS, CARRIED = "fails", "carried"
"""The arrays of where the static model fails that ``carry`` reads and writes in turn."""
CARRY_ROUNDS = 4
"""An even number, so that the last writes ``FAILS``. Each reaches as far as the flow. Source: 1 to 5 compared
on five rendered scenes."""
SECONDS_PER_MEGAPIXEL = 0.25
"""One flow pair on one processor, per million pixels of the input. Source: the six captures of
experiments/results/refinement_phases.json, 0.24 to 0.27."""


@dataclass(frozen=True)
class Tracked:
    """What tracking hands to the refinement."""

    cameras: tuple[Camera, ...]
    groups: tuple[tuple[int, ...], ...]
    """Cameras that share a world frame."""
    wTc: Array
    """``(N, T, 4, 4)``"""
    covariance: Array
    """``(N, T, 6, 6)`` of the poses, tangent ``[omega, v]``; NaN where unknown."""
    omega: tuple[Pair, ...]
    """Connections of the tracking's graph."""
    read: Callable[[int, int], npt.NDArray[np.uint8]]
    """Image ``(H, W, 3)`` of a camera and time."""
    depth: Callable[[int, int], tuple[Float32, Float32]]
    """Depth and confidence ``(H, W)`` of a camera and time."""


@dataclass(frozen=True)
class Refined:
    """What comes out besides the frames."""

    wTc: Array
    """``(N, T, 4, 4)``"""
    scale: Array
    """``(N, T)`` of phase 1."""
    offset: Array
    """``(N, T)`` of phase 1, in the unit of the result."""
    seconds: dict[str, float]
    """Time per part, of this run."""


def required(tracked: Tracked, config: RefinementConfig) -> tuple[float, float]:
    """Bytes of disk the workspace takes, and seconds its flows take, about."""
    frame_count = tracked.wTc.shape[1]
    pairs = refinement_pairs(tracked.omega, tracked.groups, frame_count, config.temporal_offsets)
    pixels = [camera.width * camera.height for camera in tracked.cameras]
    small = [value / config.stride**2 for value in pixels]
    disk = sum(BYTES_PER_PIXEL_AND_PAIR * (small[i[0]] + small[j[0]]) / 2 for i, j in pairs)
    disk += frame_count * sum(BYTES_PER_PIXEL * s + p for s, p in zip(small, pixels, strict=True))
    seconds = SECONDS_PER_MEGAPIXEL * sum((pixels[i[0]] + pixels[j[0]]) / 2e6 for i, j in pairs)
    return disk, seconds / worker_count(config.workers)


class Refinement:
    """One refinement, to be entered: its processes live as long. ``run`` does it, ``frames`` hands out its
    frames, ``remove`` cleans up."""

    def __init__(
        self,
        tracked: Tracked,
        folder: Path,
        config: RefinementConfig,
        flow: DenseFlow,
        flow_config: FlowConfig,
        progress: Progress,
    ) -> None:
        self._tracked, self._config, self._progress = tracked, config, progress
        views = tuple(DenseView.of(camera, 1.0 / config.stride) for camera in tracked.cameras)
        self._frame_count = tracked.wTc.shape[1]
        self._workspace = Workspace(folder, views, self._frame_count)
        pairs = refinement_pairs(tracked.omega, tracked.groups, self._frame_count, config.temporal_offsets)
        self._within = [pair for pair in pairs if pair[0][0] == pair[1][0]]
        self._across = [pair for pair in pairs if pair[0][0] != pair[1][0]]
        self._context = Context(
            self._workspace, tracked.groups, neighbours_of(pairs), config, flow, flow_config
        )
        self._frames = [
            (camera, time) for time in range(self._frame_count) for camera in range(len(tracked.cameras))
        ]
        self._pool = TaskPool(self._context, config.workers)
        self._depth = "aligned"
        self.seconds: dict[str, float] = {}

    def __enter__(self) -> Refinement:
        self._pool.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.__exit__(kind, error, trace)

    def run(self) -> Refined:
        """Everything but handing out the frames; what an earlier run finished is not done again."""
        config = self._config
        # the number of processes decides nothing
        settings = (WORKSPACE_FORMAT, replace(config, workers=0), self._context.flow_config)
        self._workspace.prepare(repr(settings))
        self._step("images", self._store_images)
        self._step("sweep", self._sweep)
        self._step("temporal flow", lambda: self._map("temporal flow", self._within))
        if config.phase1:
            self._step("phase 1", self._align)
        if config.phase2:
            self._step("begin", lambda: self._map("begin", self._frames))
            self._step("free space", lambda: self._map("free space", self._frames))
            for number in range(1, CARRY_ROUNDS + 1):
                source, target = (FAILS, CARRIED) if number % 2 else (CARRIED, FAILS)
                self._step(f"carry {number}", partial(self._carry, source, target))
            self._step("settle", self._settle)
            self._depth = "begun"
            self._solve_depth(FIRST_DEPTH, min(GUIDE_STEPS, config.depth_iterations))
            self._step("wide flow", lambda: self._map("wide flow", self._across))
            for number in range(1, config.rounds + 1):
                self._step(f"poses {number}", self._solve_poses)
                self._solve_depth(f"depth {number}", config.depth_iterations)
            if config.plain.fill:
                self._fill_plain("filled")
        scales = self._workspace.read_array("scales")
        return Refined(self._context.poses(), scales[0], scales[1], self.seconds)

    def frames(self) -> Iterator[FinishedFrame]:
        """Every frame at the input resolution, in time order."""
        jobs = [(self._depth, frame) for frame in self._frames]
        for done, frame in enumerate(self._pool.map("finish", jobs)):
            assert isinstance(frame, FinishedFrame)
            yield frame
            self._progress.update("refined depth", done + 1, len(jobs))

    def remove(self) -> None:
        """Remove the workspace."""
        self._workspace.remove()

    def _step(self, name: str, work: Callable[[], None]) -> None:
        """Do ``work`` unless an earlier run finished it."""
        if name in self._workspace.finished():
            return
        began = perf_counter()
        work()
        self.seconds[name] = perf_counter() - began
        self._workspace.finish(name)

    def _map(self, task: str, jobs: Sequence[object], label: str = "") -> None:
        for done, _ in enumerate(self._pool.map(task, jobs)):
            self._progress.update(f"refine: {label or task}", done + 1, len(jobs))

    def _store_images(self) -> None:
        workspace, tracked = self._workspace, self._tracked
        workspace.create("grey", np.uint8, full_size=True)
        workspace.create(COLOUR, np.uint8, channels=(3,))
        workspace.create("moving", np.uint8)
        for name in (FAILS, CARRIED, SIGHT, "held"):
            workspace.create(name, np.uint8)
        workspace.create(LABELS, np.uint8)
        workspace.create(FITTED, channels=(4,))
        for name in (
            "tracked", "tracked_confidence", "aligned", "swept", "instant", "prior", "prior_weight", "first",
            "begun", "information", RELIEF,
        ):  # fmt: skip
            workspace.create(name)
        for done, frame in enumerate(self._frames):
            view = workspace.views[frame[0]]
            image = tracked.read(*frame)
            workspace.write("grey", frame, to_grey(image))
            workspace.write(COLOUR, frame, smooth_colour(image, view))
            depth, confidence = tracked.depth(*frame)
            inverse = np.asarray(view.shrink(1.0 / _without_holes(depth)), np.float32)
            trust = np.asarray(view.shrink(np.where(np.isfinite(depth), confidence, 0.0)), np.float32)
            workspace.write("tracked", frame, inverse)
            workspace.write("aligned", frame, inverse)
            workspace.write("tracked_confidence", frame, trust)
            # until flow says more: what tracking knew, confidence 1/2 at 5 % error
            workspace.write("information", frame, trust / np.maximum(1.0 - trust, 1e-3) / 0.05**2)
            self._progress.update("refine: images", done + 1, len(self._frames))
        workspace.write_array("poses", tracked.wTc)
        workspace.write_array("tracked_poses", tracked.wTc)
        ones, zeros = np.ones(tracked.wTc.shape[:2]), np.zeros(tracked.wTc.shape[:2])
        workspace.write_array("scales", np.stack([ones, zeros]))

    def _sweep(self) -> None:
        """Depth by plane sweep; while the image hardly moves, of one frame for those around."""
        wTc, reach = self._context.poses(), self._config.sweep_reach
        times = [swept_times(self._workspace, c, wTc, reach) for c in range(len(self._tracked.cameras))]
        source = {frame: (frame[0], times[frame[0]][frame[1]]) for frame in self._frames}
        self._map("sweep", [frame for frame in self._frames if source[frame] == frame])
        others = [(frame, source[frame]) for frame in self._frames if source[frame] != frame]
        self._map("carry sweep", others)

    def _carry(self, source: str, target: str) -> None:
        self._map("carry", [(source, target, frame) for frame in self._frames])

    def _settle(self) -> None:
        """What moves, and the depth that phase 2 begins with."""
        self._map("settle", self._frames)
        self._map("instant", self._frames)
        found: list[list[RegionDepth]] = []
        for done, regions in enumerate(self._pool.map("observe", self._frames)):
            assert isinstance(regions, list)
            found.append(regions)
            self._progress.update("refine: observe", done + 1, len(self._frames))
        grown: list[list[Growth]] = []
        for growths in self._pool.map("growth", self._frames):
            assert isinstance(growths, list)
            grown.append(growths)
        depths = depth_of_regions(self._context, self._frames, found, grown)
        self._map("moving depth", list(zip(self._frames, depths, strict=True)))
        for task in ("fit", "shape", "relief"):
            self._map(task, self._frames)

    def _sample(self) -> Callable[[], Iterable[FrameSample]]:
        """Sample every frame once; what is returned reads them back, as often as a solve asks."""
        store = SampleStore(self._workspace.folder / "samples.bin")
        jobs = [(self._depth, frame) for frame in self._frames]
        store.write(sample for sample in self._pool.map("sample", jobs) if isinstance(sample, FrameSample))
        return store.read

    def _align(self) -> None:
        """Phase 1: scale and offset of every frame's depth."""
        scales = solve_scales(self._sample(), self._context.poses(), self._config)
        self._workspace.write_array("scales", np.stack([scales.scale, scales.offset]))
        for frame in self._frames:
            depth = 1.0 / self._context.image("tracked", frame)
            moved = scales.scale[frame] * depth + scales.offset[frame]
            # an offset must not turn the nearest pixels inside out
            self._workspace.write("aligned", frame, 1.0 / np.maximum(moved, 0.1 * depth))

    def _solve_depth(self, target: str, steps: int) -> None:
        """Phase 2, depth: every window from what all windows had before, so that their order does not
        matter."""
        jobs = windows(self._depth, target, self._frame_count, self._config.window, steps)

        def solve() -> None:
            self._workspace.create(target)
            self._map("window", jobs, label=target)

        self._step(target, solve)
        self._depth = target

    def _fill_plain(self, target: str) -> None:
        """Planes for the regions without texture, agreed between frames."""
        source = self._depth

        def fill() -> None:
            self._find_axes(source)
            planes = self._pool.map("planes", [(source, frame) for frame in self._frames])
            rows = [
                np.insert(np.asarray(found), 0, np.array([frame]).T, axis=1)
                for frame, found in zip(self._frames, planes, strict=True)
            ]
            self._workspace.write_array(PLANES, np.concatenate(rows))
            self._workspace.create(target)
            self._map("plain regions", [(source, target, frame) for frame in self._frames])

        self._step("plain regions", fill)
        self._depth = target

    def _find_axes(self, source: str) -> None:
        """The directions in which the scene of each group of cameras is built."""
        found = self._pool.map("surfaces", [(source, frame) for frame in self._frames])
        normals = [np.asarray(each).reshape(-1, 4) for each in found]
        axes = [np.zeros((0, 4))]
        for group in self._tracked.groups:
            of_frame = [k for k, frame in enumerate(self._frames) if frame[0] in group]
            rows = np.concatenate([normals[k] for k in of_frame])
            frames = np.repeat(of_frame, [len(normals[k]) for k in of_frame])
            found_axes = main_axes(rows[:, :3], rows[:, 3], frames)
            axes.append(np.insert(found_axes, 0, group[0], axis=1))
        self._workspace.write_array(AXES, np.concatenate(axes))

    def _solve_poses(self) -> None:
        """Phase 2, poses."""
        tracked = self._tracked
        wTc = solve_poses(
            self._sample(),
            self._context.poses(),
            tracked.wTc,
            tracked.groups,
            self._config,
            prior_covariance=tracked.covariance,
        )
        self._workspace.write_array("poses", wTc)


def _without_holes(depth: Float32) -> Float32:
    """``depth`` with NaN replaced by the median of the rest, 1 without any."""
    known = np.isfinite(depth) & (depth > 0.0)
    return np.where(known, depth, np.median(depth[known]) if known.any() else 1.0).astype(np.float32)
