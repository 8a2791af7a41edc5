"""Measuring the flow of connections: plain between close frames, guided by depth and poses otherwise."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
import numpy.typing as npt

from factors.projection import reproject
from mvdyn_gtsam.config import TrackingConfig
from mvdyn_gtsam.frontend.dense_flow import DenseFlow, FlowConfig, FlowPair, sample_pair
from mvdyn_gtsam.frontend.guided_flow import guided_flow
from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.tracking.depth import smoothed_log_depth
from mvdyn_gtsam.tracking.images import ImageStore
from mvdyn_gtsam.tracking.model import Guide, Keyframe, View

Array = npt.NDArray[np.float64]


class EdgeMeasurer:
    """Measures connections between frames whose images the store can deliver."""

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
        self._dense: OrderedDict[int, tuple[Array, npt.NDArray[np.float32]]] = OrderedDict()

    def temporal(self, i: Keyframe, j: Keyframe) -> None:
        """Measure two frames of one camera: guided where the prediction says that the flow is long."""
        if self.predicted_length(i, j) > self._config.guided_px:
            self.guided(i, j)
            return
        image_i, image_j = self._images.get(i.frame), self._images.get(j.frame)
        pair = self._flow.measure(image_i, image_j)
        self._store(i, j, pair)
        for a, b in ((i, j), (j, i)):
            a.guides.pop(b.frame, None)

    def guided(self, i: Keyframe, j: Keyframe) -> None:
        """Measure any two frames around what their depths and poses predict."""
        view_i, view_j = self._views[i.camera], self._views[j.camera]
        jTi = invert_pose(j.wTc) @ i.wTc
        pair = guided_flow(
            self._flow,
            self._images.get(i.frame),
            self._images.get(j.frame),
            self._dense_depth(i),
            self._dense_depth(j),
            view_i.camera.intrinsics,
            view_j.camera.intrinsics,
            jTi,
            self._flow_config,
        )
        self._store(i, j, pair)
        i.guides[j.frame] = Guide(i.log_depth, jTi)
        j.guides[i.frame] = Guide(j.log_depth, invert_pose(jTi))

    def outdated(self, i: Keyframe, j: Keyframe) -> bool:
        """Whether depth and poses now predict another flow than the one it was guided by."""
        return max(self._change(i, j), self._change(j, i)) > self._config.remeasure_px

    def _change(self, i: Keyframe, j: Keyframe) -> float:
        guide = i.guides[j.frame]
        view_i, intrinsics = self._views[i.camera], self._views[j.camera].intrinsics[None]
        used = i.flows[j.frame].weight > 0.0
        if not used.any():
            return float("inf")
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

    def _store(self, i: Keyframe, j: Keyframe, pair: FlowPair) -> None:
        forward, backward = sample_pair(pair, self._views[i.camera].grid, self._views[j.camera].grid)
        i.flows[j.frame], j.flows[i.frame] = forward, backward

    def _dense_depth(self, keyframe: Keyframe) -> npt.NDArray[np.float32]:
        """``(H, W)`` smooth depth between the grid points; kept while the keyframe's depth stays the same."""
        kept = self._dense.get(id(keyframe))
        if kept is not None and kept[0] is keyframe.log_depth:
            self._dense.move_to_end(id(keyframe))
            return kept[1]
        view = self._views[keyframe.camera]
        smooth = smoothed_log_depth(keyframe.log_depth, keyframe.information, view.grid)
        dense = np.exp(view.grid.expand(smooth, view.camera.width, view.camera.height))
        self._dense[id(keyframe)] = (keyframe.log_depth, dense)
        while len(self._dense) > 40:
            self._dense.popitem(last=False)
        return dense


def mean_flow(keyframe: Keyframe, to: Frame, view: View) -> float:
    """Weighted mean length of a measured flow, px; NaN where nothing was measured."""
    flow = keyframe.flows[to]
    length = np.linalg.norm(flow.target - view.grid.pixels, axis=1)
    weight = flow.weight.sum()
    return float((length * flow.weight).sum() / weight) if weight > 0 else float("nan")
