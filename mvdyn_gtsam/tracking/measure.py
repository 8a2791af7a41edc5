"""Measuring the flow of connections: plain between close frames, guided by depth and poses otherwise."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import chain

import numpy as np
import numpy.typing as npt

from factors.projection import reproject
from mvdyn_gtsam.config import TrackingConfig
from mvdyn_gtsam.frontend.dense_flow import DenseFlow, FlowConfig, GridFlow, sample_pair
from mvdyn_gtsam.frontend.grid import Grid
from mvdyn_gtsam.frontend.grid_flow import GridView, OneWayFlow, guide_grid, measure_grid
from mvdyn_gtsam.frontend.guided_flow import guided_flow
from mvdyn_gtsam.frontend.threads import flow_threads
from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.tracking.depth import smoothed_log_depth
from mvdyn_gtsam.tracking.images import ImageStore
from mvdyn_gtsam.tracking.kept_flow import KeptFlow
from mvdyn_gtsam.tracking.model import Guide, Keyframe, View

Array = npt.NDArray[np.float64]
GridFlows = tuple[GridFlow, GridFlow]
"""i -> j at the grid of i, and j -> i at that of j."""
SMOOTH_DEPTHS = 200
"""Smooth depths kept, of the frames measured last."""


@dataclass(frozen=True)
class _Job:
    """One connection to measure; ``run`` touches nothing that is shared."""

    i: Keyframe
    j: Keyframe
    guides: tuple[Guide, Guide] | None
    run: Callable[[], GridFlows]


@dataclass(frozen=True)
class _Running:
    """A job begun, and what waits for its result."""

    job: _Job
    result: Callable[[], GridFlows]


class EdgeMeasurer:
    """Measures connections between frames whose images the store can deliver.

    A flow that can measure one direction alone (``OneWayFlow``) is evaluated at the grid, for several
    connections side by side; any other ``DenseFlow`` is asked for whole images, one connection at a time.
    """

    def __init__(
        self,
        views: tuple[View, ...],
        flow: DenseFlow,
        flow_config: FlowConfig,
        images: ImageStore,
        config: TrackingConfig,
    ) -> None:
        self._views, self._flow, self._flow_config = views, flow, flow_config
        self._images, self._config = images, config
        self._smooth: OrderedDict[int, tuple[Array, Array]] = OrderedDict()
        self._workers = flow_threads() if isinstance(flow, OneWayFlow) else 1
        self._pool = ThreadPoolExecutor(self._workers) if self._workers > 1 else None

    def temporal(self, i: Keyframe, j: Keyframe) -> None:
        """Measure two frames of one camera: guided where the prediction says that the flow is long."""
        self.temporal_all([(i, j)])

    def guided(self, i: Keyframe, j: Keyframe) -> None:
        """Measure any two frames around what their depths and poses predict."""
        self.guided_all([(i, j)])

    def temporal_all(self, pairs: Iterable[tuple[Keyframe, Keyframe]]) -> None:
        """``temporal`` for each pair, side by side; no pair may appear twice."""
        self.measure_all(pairs, ())

    def guided_all(self, pairs: Iterable[tuple[Keyframe, Keyframe]]) -> None:
        """``guided`` for each pair, side by side; no pair may appear twice."""
        self.measure_all((), pairs)

    def measure_all(
        self,
        temporal: Iterable[tuple[Keyframe, Keyframe]],
        guided: Iterable[tuple[Keyframe, Keyframe]],
    ) -> None:
        """``temporal`` and ``guided`` for each of their pairs; those are asked for while others are measured.

        What is found is stored in their order, few at a time, for jobs hold images.
        """
        running: deque[_Running] = deque()
        jobs = chain(
            (self._temporal_job(i, j) for i, j in temporal), (self._guided_job(i, j) for i, j in guided)
        )
        for job in jobs:
            running.append(self._begin(job))
            if len(running) > 2 * self._workers:
                self._store(running.popleft())
        for one in running:
            self._store(one)

    def _temporal_job(self, i: Keyframe, j: Keyframe) -> _Job:
        long = self.predicted_length(i, j) > self._config.guided_px
        return self._guided_job(i, j) if long else self._plain_job(i, j)

    def _begin(self, job: _Job) -> _Running:
        if self._pool is not None:
            return _Running(job, self._pool.submit(job.run).result)
        flows = job.run()
        return _Running(job, lambda: flows)

    def _store(self, running: _Running) -> None:
        job, flows = running.job, running.result()
        i, j = job.i, job.j
        i.flows[j.frame], j.flows[i.frame] = self._kept(flows[0], j), self._kept(flows[1], i)
        if job.guides is None:
            i.guides.pop(j.frame, None)
            j.guides.pop(i.frame, None)
        else:
            i.guides[j.frame], j.guides[i.frame] = job.guides

    def _kept(self, flow: GridFlow, into: Keyframe) -> KeptFlow:
        camera = self._views[into.camera].camera
        return KeptFlow.of(flow, camera.width, camera.height)

    def _plain_job(self, i: Keyframe, j: Keyframe) -> _Job:
        grid_i, grid_j = self._views[i.camera].grid, self._views[j.camera].grid
        images = self._images.get(i.frame), self._images.get(j.frame)
        if isinstance(self._flow, OneWayFlow):
            return _Job(i, j, None, partial(measure_grid, self._flow, *images, grid_i, grid_j))
        return _Job(i, j, None, partial(_measure_dense, self._flow, *images, grid_i, grid_j))

    def _guided_job(self, i: Keyframe, j: Keyframe) -> _Job:
        jTi = invert_pose(j.wTc) @ i.wTc
        guides = Guide(i.log_depth, jTi), Guide(j.log_depth, invert_pose(jTi))
        views = self._grid_view(i), self._grid_view(j)
        images = self._images.get(i.frame), self._images.get(j.frame)
        if isinstance(self._flow, OneWayFlow):
            run = partial(guide_grid, self._flow, *images, *views, jTi, self._flow_config)
        else:
            run = partial(_guide_dense, self._flow, *images, *views, jTi, self._flow_config)
        return _Job(i, j, guides, run)

    def outdated(self, i: Keyframe, j: Keyframe, limit_px: float | None = None) -> bool:
        """Whether depth and poses now predict another flow than the one it was guided by, by more than
        ``limit_px`` (default: ``remeasure_px``) in the median."""
        limit = self._config.remeasure_px if limit_px is None else limit_px
        return max(self._change(i, j), self._change(j, i)) > limit

    def _change(self, i: Keyframe, j: Keyframe) -> float:
        guide = i.guides[j.frame]
        view_i, intrinsics = self._views[i.camera], self._views[j.camera].intrinsics[None]
        used = i.flows[j.frame].weight_steps > 0
        if not used.any():
            used = np.ones_like(used)
        identity = np.eye(4)
        before = reproject(view_i.rays[used], guide.log_depth[used], guide.jTi, identity[None], intrinsics)
        jTi = invert_pose(j.wTc) @ i.wTc
        now = reproject(view_i.rays[used], i.log_depth[used], jTi, identity[None], intrinsics)
        return float(np.median(np.linalg.norm(now.pixels[0] - before.pixels[0], axis=1)))

    def predicted_length(self, i: Keyframe, j: Keyframe) -> float:
        """Mean predicted flow between two frames of one camera, px; points behind count as the width."""
        view = self._views[i.camera]
        seen = reproject(view.rays, i.log_depth, i.wTc, j.wTc[None], view.intrinsics[None])
        length = np.linalg.norm(seen.pixels[0] - view.grid.pixels, axis=1)
        return float(
            np.mean(np.where(seen.valid[0], np.minimum(length, view.camera.width), view.camera.width))
        )

    def predicted_overlap(self, i: Keyframe, j: Keyframe) -> float:
        """Share of the grid of i that depth and poses put inside image j."""
        view_i, view_j = self._views[i.camera], self._views[j.camera]
        seen = reproject(view_i.rays, i.log_depth, i.wTc, j.wTc[None], view_j.intrinsics[None])
        last = [view_j.camera.width - 1, view_j.camera.height - 1]
        inside = ((seen.pixels[0] >= 0.0) & (seen.pixels[0] <= last)).all(axis=1)
        return float(np.mean(inside & seen.valid[0]))

    def _grid_view(self, keyframe: Keyframe) -> GridView:
        """Smooth depth at the grid; kept while the keyframe's depth stays the same."""
        view = self._views[keyframe.camera]
        kept = self._smooth.get(id(keyframe))
        if kept is not None and kept[0] is keyframe.log_depth:
            self._smooth.move_to_end(id(keyframe))
            depth = kept[1]
        else:
            depth = np.exp(smoothed_log_depth(keyframe.log_depth, keyframe.information, view.grid))
            self._smooth[id(keyframe)] = (keyframe.log_depth, depth)
            while len(self._smooth) > SMOOTH_DEPTHS:
                self._smooth.popitem(last=False)
        size = view.camera.width, view.camera.height
        return GridView(view.grid, size, view.camera.intrinsics, depth)


def _measure_dense(
    flow: DenseFlow,
    image_i: npt.NDArray[np.uint8],
    image_j: npt.NDArray[np.uint8],
    grid_i: Grid,
    grid_j: Grid,
) -> GridFlows:
    return sample_pair(flow.measure(image_i, image_j), grid_i, grid_j)


def _guide_dense(
    flow: DenseFlow,
    image_i: npt.NDArray[np.uint8],
    image_j: npt.NDArray[np.uint8],
    view_i: GridView,
    view_j: GridView,
    jTi: Array,
    config: FlowConfig,
) -> GridFlows:
    depth_i, depth_j = (np.exp(view.grid.expand(np.log(view.depth), *view.size)) for view in (view_i, view_j))
    intrinsics = view_i.intrinsics, view_j.intrinsics
    pair = guided_flow(flow, image_i, image_j, depth_i, depth_j, *intrinsics, jTi, config)
    return sample_pair(pair, view_i.grid, view_j.grid)


def mean_flow(keyframe: Keyframe, to: Frame, view: View) -> float:
    """Weighted mean length of a measured flow, px; NaN where nothing was measured."""
    flow = keyframe.flows[to]
    length = np.linalg.norm(flow.target - view.grid.pixels, axis=1)
    weight = flow.weight.sum()
    return float((length * flow.weight).sum() / weight) if weight > 0 else float("nan")
