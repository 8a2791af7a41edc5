"""The shape that two cameras agree on."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.frontend.dense_flow import DisFlow, Float32, FlowConfig
from mvdyn_gtsam.geometry import pixel_rays
from mvdyn_gtsam.refinement.context import COLOUR, LABELS, Context
from mvdyn_gtsam.refinement.moving.relief import RELIEF
from mvdyn_gtsam.refinement.moving.shape import (
    AGREES,
    FITTED,
    FittedView,
    agreed_on,
    fit_task,
    shape_task,
    shaped,
)
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.views import DenseView
from mvdyn_gtsam.refinement.workspace import Workspace
from tests.refinement.moving.test_slanted_patches import (
    BASELINE,
    SHAPE,
    VIEW,
    seen_from_the_right,
    textured,
    wall,
)

REGION = np.zeros(SHAPE, bool)
REGION[12:48, 20:60] = True
LABELS_HERE = REGION.astype(np.int32)
PLAIN = np.full((*SHAPE, 3), 100.0, np.float32)


def flat(fitted: Float32) -> Float32:
    """Planes that face the camera."""
    return np.dstack([fitted, np.zeros((*fitted.shape, 2), np.float32)])


def test_what_another_view_finds_there_is_agreed_on() -> None:
    pixels = np.array([[39.0 + 2 * k, 30.0] for k in range(4)])
    rays = pixel_rays(pixels, VIEW.intrinsics)
    theta = np.full(4, np.log(0.5), np.float32)
    jTi = np.eye(4)
    jTi[2, 3] = 1.0  # the view is a metre behind, where the points are 3 m away
    seen = np.full(SHAPE, np.nan, np.float32)
    for ray, offset in zip(rays[:3], (0.0, 0.5 * AGREES, 2.0 * AGREES), strict=True):
        column, row = np.rint(70.0 * ray[:2] * 2.0 / 3.0 + np.array([39.5, 29.5])).tolist()
        seen[int(row), int(column)] = np.log(1.0 / 3.0) + offset
    view = FittedView(seen, VIEW.intrinsics, jTi)
    found = agreed_on(theta, rays.astype(np.float32), [view])
    np.testing.assert_array_equal(found, [True, True, False, False])
    assert not agreed_on(theta, rays.astype(np.float32), []).any()


def test_depth_spreads_from_what_is_agreed_on_over_a_colour() -> None:
    theta = np.full(SHAPE, np.log(0.2), np.float32)
    theta[REGION] = np.log(0.4)
    fitted, agreed = np.full(SHAPE, np.nan, np.float32), REGION.copy()
    agreed[:, 30:] = False
    fitted[agreed] = np.log(0.5)
    found = shaped(theta, LABELS_HERE, flat(fitted), agreed, PLAIN)
    # three quarters of the region take five sixths of the way from 0.4
    np.testing.assert_allclose(found[REGION], np.log(0.5), atol=0.04)
    np.testing.assert_array_equal(found[~REGION], theta[~REGION])


def test_depth_does_not_spread_over_an_edge_of_the_image_nor_to_another_region() -> None:
    theta = np.full(SHAPE, np.log(0.4), np.float32)
    labels = np.zeros(SHAPE, np.int32)
    labels[12:48, 20:40], labels[12:48, 40:60] = 1, 2
    colour = PLAIN.copy()
    colour[:, 30:] = 200.0
    agreed = (labels == 1) & (np.arange(SHAPE[1]) < 30)
    fitted = np.where(agreed, np.float32(np.log(0.5)), np.nan).astype(np.float32)
    found = shaped(theta, labels, flat(fitted), agreed, colour)
    np.testing.assert_allclose(found[agreed], np.log(0.5), atol=0.005)
    np.testing.assert_allclose(found[12:48, 30:40], np.log(0.4), atol=0.005)
    np.testing.assert_array_equal(found[labels == 2], theta[labels == 2])


def test_a_kink_is_kept_and_a_lone_error_is_not() -> None:
    columns = np.arange(SHAPE[1], dtype=np.float32)
    roof = np.broadcast_to(np.log(0.5) - 0.004 * np.abs(columns - 40.0), SHAPE).astype(np.float32)
    fitted = np.where(REGION, roof, np.nan).astype(np.float32)
    fitted[30, 33] += 0.3
    found = shaped(np.full(SHAPE, np.log(0.45), np.float32), LABELS_HERE, flat(fitted), REGION, PLAIN)
    error = np.abs(found - roof)[REGION]
    assert error.mean() < 0.015 and error.max() < 0.03


def test_what_slants_to_its_rim_does_so_with_the_slopes_that_are_agreed_on() -> None:
    rows, columns = np.indices(SHAPE, np.float32)
    truth = np.log(0.5) + 0.01 * columns - 0.005 * rows
    fitted = np.where(REGION[..., None], np.dstack([truth, 0.01 + 0.0 * rows, -0.005 + 0.0 * rows]), np.nan)
    start = np.full(SHAPE, np.log(0.6), np.float32)
    alone, sloping = (
        np.abs(shaped(start, LABELS_HERE, planes.astype(np.float32), REGION, PLAIN) - truth)[REGION]
        for planes in (flat(fitted[..., 0]), fitted)
    )
    assert sloping.max() < 0.01 and alone.max() > 4.0 * sloping.max()


def test_a_region_in_which_nothing_is_agreed_on_stays_as_it_was() -> None:
    rough = np.random.default_rng(0).normal(0.0, 0.1, SHAPE).astype(np.float32)
    nothing = np.zeros(SHAPE, bool)
    np.testing.assert_array_equal(shaped(rough, LABELS_HERE, flat(rough + 1.0), nothing, PLAIN), rough)


def test_a_slanting_thing_that_two_cameras_see_gets_its_shape(tmp_path: Path) -> None:
    """A wall that slants, of which a flat depth is known, moves in both."""
    slope, frames = -0.006, [(0, 0), (1, 0)]
    views = tuple(DenseView.of(Camera(f"cam{k}", 80, 60, 70.0, 70.0, 39.5, 29.5), 1.0) for k in range(2))
    workspace = Workspace(tmp_path, views, 1)
    workspace.prepare("test")
    for name in ("prior", "begun", RELIEF):
        workspace.create(name)
    workspace.create(LABELS, np.uint8)
    workspace.create(FITTED, channels=(4,))
    workspace.create(COLOUR, np.uint8, channels=(3,))
    image = textured()
    other, jTi = seen_from_the_right(image, slope)
    for frame, colour in zip(frames, (image, other), strict=True):
        region = np.ones(SHAPE, bool)
        workspace.write(COLOUR, frame, np.clip(colour, 0.0, 255.0))
        workspace.write("prior", frame, np.full(SHAPE, np.log(0.5), np.float32))
        workspace.write(LABELS, frame, region)
        workspace.write(RELIEF, frame, np.zeros(SHAPE, np.float32))
    poses = np.tile(np.eye(4), (2, 1, 1, 1))
    poses[1, 0, 0, 3] = BASELINE
    np.testing.assert_allclose(np.linalg.inv(poses[1, 0]) @ poses[0, 0], jTi)
    workspace.write_array("poses", poses)
    context = Context(workspace, ((0, 1),), {}, RefinementConfig(stride=1), DisFlow(), FlowConfig())

    for task in (fit_task, shape_task):
        for frame in frames:
            task(context, frame)
    truth = np.log(wall(slope))
    seen = np.arange(SHAPE[1]) - 70.0 * BASELINE * wall(slope) > 4.0
    theta = context.image("prior", (0, 0))
    before, after = (np.abs(each - truth)[seen].mean() for each in (np.log(0.5), theta))
    assert after < 0.2 * before
    np.testing.assert_allclose(context.image("begun", (0, 0)), np.exp(theta), rtol=1e-6)
    np.testing.assert_allclose(context.image(RELIEF, (0, 0)), theta - np.float32(np.log(0.5)), atol=1e-6)
