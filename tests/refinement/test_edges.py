"""Flow as the solves use it, read back from the disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.frontend.dense_flow import FlowPair
from mvdyn_gtsam.frontend.guided_flow import predicted_flow
from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.edges import LEAST_WEIGHT, Edge, load_edges
from mvdyn_gtsam.refinement.views import DenseView
from mvdyn_gtsam.refinement.workspace import STEPS_PER_PX, Workspace

Array = npt.NDArray[np.float64]

LARGE = Camera("large", 64, 48, 60.0, 62.0, 30.0, 24.0)
SMALL = Camera("small", 40, 32, 35.0, 34.0, 20.5, 15.0)
DEPTH = 3.0
HERE, THERE = (0, 2), (1, 2)
"""The lower camera of an instant is kept first."""


def poses() -> Array:
    """``(2, 4, 4, 4)``: wTc, both cameras in motion."""
    wTc = np.tile(np.eye(4), (2, 4, 1, 1))
    for camera in range(2):
        for time in range(4):
            # a turn about the optical axis: a plane at one depth in one camera is at one in all
            wTc[camera, time, :3, :3] = Rotation.from_rotvec([0.0, 0.0, 0.05 * camera]).as_matrix()
            wTc[camera, time, :3, 3] = [0.3 * camera + 0.05 * time, 0.02 * time, 0.1 * camera]
    return wTc


def measured(i: Frame, j: Frame, wTc: Array) -> FlowPair:
    """Exact flow of a wall at ``DEPTH`` before the first camera; no weight where it leaves the image."""
    cameras = (LARGE, SMALL)
    flows: list[npt.NDArray[np.float32]] = []
    weights: list[npt.NDArray[np.float32]] = []
    for own, other in ((i, j), (j, i)):
        this, that = cameras[own[0]], cameras[other[0]]
        depth = np.full((this.height, this.width), DEPTH - wTc[own][2, 3])
        jTi = invert_pose(wTc[other]) @ wTc[own]
        flow = predicted_flow(depth, this.intrinsics, that.intrinsics, jTi, (that.height, that.width))
        weights.append(np.asarray(np.isfinite(flow).all(axis=-1), np.float32))
        flows.append(np.nan_to_num(flow))
    return FlowPair(flows[0], flows[1], weights[0], weights[1])


def kept(folder: Path, i: Frame, j: Frame, pair: FlowPair, scale: float = 0.5) -> Workspace:
    workspace = Workspace(folder, tuple(DenseView.of(camera, scale) for camera in (LARGE, SMALL)), 4)
    workspace.prepare("settings")
    workspace.write_flow(i, j, pair)
    return workspace


@pytest.mark.parametrize("scale", [1.0, 0.5])
@pytest.mark.parametrize(("i", "j"), [(HERE, THERE), ((0, 0), (0, 2)), ((1, 1), (0, 3))])
def test_both_directions_reproject_the_true_depth(tmp_path: Path, i: Frame, j: Frame, scale: float) -> None:
    """Rays, targets, intrinsics and poses fit together whichever frame is asked for."""
    wTc = poses()
    workspace = kept(tmp_path / "work", i, j, measured(i, j, wTc), scale)
    for own, other in ((i, j), (j, i)):
        (edge,) = load_edges(workspace, own, [other], wTc)
        assert (edge.i, edge.j) == (own, other)
        # the average over a pixel at the border of what is seen holds what is not
        whole = edge.weight > 0.99
        assert whole.sum() > 100
        rho = np.full(len(edge.pixels), 1.0 / (DEPTH - wTc[own][2, 3]), np.float32)
        residual = edge.terms(rho).residual[whole]
        assert np.abs(residual).max() < 0.6 / (STEPS_PER_PX * scale)
        # the nearest pixel of the other view is within half a pixel of the target, either way
        height, width = workspace.views[other[0]].shape
        size = np.array([(LARGE, SMALL)[other[0]].width, (LARGE, SMALL)[other[0]].height])
        small = (edge.target[whole] + 0.5) * ([width, height] / size) - 0.5
        row, col = np.divmod(edge.nearest[whole], width)
        within = edge.nearest[whole] >= 0
        assert within.mean() > 0.9
        assert np.abs(np.stack([col, row], axis=1) - small)[within].max() < 0.5 + 1e-3


def test_only_measured_neighbours_give_edges(tmp_path: Path) -> None:
    wTc = poses()
    workspace = kept(tmp_path / "work", HERE, THERE, measured(HERE, THERE, wTc))
    edges = load_edges(workspace, HERE, [(0, 0), THERE, (1, 3)], wTc)
    assert [edge.j for edge in edges] == [THERE]
    assert load_edges(workspace, (0, 0), [HERE], wTc) == []


def test_an_edge_knows_whether_it_joins_one_instant(tmp_path: Path) -> None:
    wTc = poses()
    workspace = kept(tmp_path / "work", HERE, THERE, measured(HERE, THERE, wTc))
    workspace.write_flow((0, 1), HERE, measured((0, 1), HERE, wTc))
    edges = load_edges(workspace, HERE, [(0, 1), THERE], wTc)
    assert [edge.same_instant for edge in edges] == [False, True]


def shifted(shift: tuple[float, float]) -> FlowPair:
    """All pixels of the large camera to frame 3 of it by ``shift`` px, with weights that rise by column."""
    flow = np.tile(np.array(shift, np.float32), (48, 64, 1))
    weight = np.tile(np.linspace(0.0, 1.0, 64, dtype=np.float32), (48, 1))
    return FlowPair(flow, -flow, weight, weight)


def shifted_edge(folder: Path, shift: tuple[float, float]) -> Edge:
    workspace = kept(folder / "work", (0, 1), (0, 3), shifted(shift))
    (edge,) = load_edges(workspace, (0, 1), [(0, 3)], poses())
    return edge


def test_targets_are_in_pixels_of_the_input(tmp_path: Path) -> None:
    """Small pixel (10, 5) stands for (20.5, 10.5) of the input."""
    edge = shifted_edge(tmp_path, (6.0, -4.0))
    at = int(np.flatnonzero(edge.pixels == 5 * 32 + 10)[0])
    np.testing.assert_allclose(edge.target[at], [26.5, 6.5])
    np.testing.assert_array_equal(edge.intrinsics_j, LARGE.intrinsics)


def test_the_nearest_pixel_of_the_other_view(tmp_path: Path) -> None:
    edge = shifted_edge(tmp_path, (6.5, -4.0))
    nearest = dict(zip(edge.pixels.tolist(), edge.nearest.tolist(), strict=True))
    # 6.5 px are 3.25 of the small view
    assert nearest[5 * 32 + 10] == 3 * 32 + 13
    assert nearest[2 * 32 + 28] == 0 * 32 + 31
    # beyond the right and the upper border: no pixel, not one of the next row
    assert nearest[5 * 32 + 29] == -1 and nearest[1 * 32 + 10] == -1
    row, col = np.divmod(edge.pixels, 32)
    np.testing.assert_array_equal(edge.nearest >= 0, (row >= 2) & (col <= 28))


def test_flow_trusted_too_little_is_left_out(tmp_path: Path) -> None:
    edge = shifted_edge(tmp_path, (2.0, 0.0))
    small = shifted((0.0, 0.0)).forward_weight.reshape(24, 2, 32, 2).mean(axis=(1, 3)).ravel()
    # weights are kept in steps of 1/255
    assert set(np.flatnonzero(small > LEAST_WEIGHT + 0.005)) <= set(edge.pixels)
    assert not set(np.flatnonzero(small < LEAST_WEIGHT - 0.005)) & set(edge.pixels)
    np.testing.assert_allclose(edge.weight, small[edge.pixels], atol=0.51 / 255.0)


def test_without_leaves_out_pixels_and_all_that_belongs_to_them(tmp_path: Path) -> None:
    edge = shifted_edge(tmp_path, (6.0, -4.0))
    excluded = np.zeros(24 * 32, bool)
    excluded[200:500] = True
    rest = edge.without(excluded)
    wanted = [k for k, pixel in enumerate(edge.pixels) if not 200 <= pixel < 500]
    assert 0 < len(wanted) < len(edge.pixels)
    for name in ("pixels", "rays", "target", "weight", "nearest"):
        np.testing.assert_array_equal(getattr(rest, name), getattr(edge, name)[wanted])
    assert (rest.i, rest.j) == (edge.i, edge.j) and rest.jTi is edge.jTi
