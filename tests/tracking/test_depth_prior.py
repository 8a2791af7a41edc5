"""A depth prior in tracking: right it gives better depth, wrong it does not ruin the poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mvdyn_gtsam.config import TrackingConfig, load_config
from mvdyn_gtsam.frontend.dense_flow import DisFlow
from mvdyn_gtsam.frontend.depth_priors.aligned_prior import GridDepth, PriorAtGrid
from mvdyn_gtsam.frontend.grid import Grid
from mvdyn_gtsam.tracking.depth import prior_information, with_prior
from mvdyn_gtsam.tracking.tracker import Tracker
from tests.tracking.synthetic_scene import WIDTH, Scene, two_cameras
from tests.tracking.test_tracker import SMALL, errors

Array = np.ndarray
Distort = Callable[[Array, Grid], Array]
CONFIG = TrackingConfig()


def given_prior(
    scene: Scene, distort: Distort = lambda depth, grid: depth, confidence: float = 1.0
) -> PriorAtGrid:
    """The true depth, distorted."""

    def at_grid(camera: int, time: int, image: Array, grid: Grid) -> GridDepth:
        np.testing.assert_array_equal(image, scene.images[camera][time])
        depth = distort(grid.sample(scene.depths[camera][time]), grid)
        return GridDepth(np.log(depth), np.full(len(grid), confidence))

    return at_grid


def tilted(depth: Array, grid: Grid) -> Array:
    """A plane that rises from half the median depth on the left to twice of it on the right."""
    return np.median(depth) * np.exp2(2.0 * grid.pixels[:, 0] / WIDTH - 1.0)


@dataclass(frozen=True)
class Run:
    tracker: Tracker
    position: float
    rotation: float
    depth: float
    """Mean error of log depth over all frames, after one scale."""


def run(scene: Scene, prior: PriorAtGrid | None, *settings: str) -> Run:
    config = load_config(None, [*SMALL, *settings])
    start = scene.start(((0, 1),), times=(0, scene.wTc.shape[1] - 1))
    tracker = Tracker(scene.cameras, start, DisFlow(config.frontend.flow), config, depth_prior=prior)
    for time in range(scene.wTc.shape[1]):
        tracker.step(time, [images[time] for images in scene.images])
    result = tracker.finish()
    wrong = []
    for depth in tracker.frame_depths():
        truth = np.log(result.grids[depth.camera].sample(scene.depths[depth.camera][depth.time]))
        wrong.append(depth.log_depth - truth)
    difference = np.stack(wrong)
    error = float(np.abs(difference - np.median(difference)).mean())
    return Run(tracker, *errors(result.wTc, scene.wTc), error)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return two_cameras(count=6)


@pytest.fixture(scope="module")
def without(scene: Scene) -> Run:
    return run(scene, None)


@pytest.fixture(scope="module")
def right(scene: Scene) -> Run:
    return run(scene, given_prior(scene), "tracking.depth_prior_lambda=0.05")


def test_the_true_depth_gives_better_depth_and_no_worse_poses(without: Run, right: Run) -> None:
    assert right.depth < 0.6 * without.depth
    assert right.position < 1.1 * without.position and right.rotation < 1.1 * without.rotation


def test_the_paper_s_weight_helps_too(scene: Scene, without: Run) -> None:
    found = run(scene, given_prior(scene))
    assert found.depth < 0.95 * without.depth
    assert found.position < 1.1 * without.position and found.rotation < 1.1 * without.rotation


def test_a_wrong_prior_does_not_ruin_the_poses(scene: Scene, without: Run) -> None:
    wrong = run(scene, given_prior(scene, tilted))
    # 1.04 and 1.3 times
    assert wrong.position < 1.2 * without.position and wrong.rotation < 1.6 * without.rotation
    # it is used, and one of little confidence hardly is
    assert wrong.depth > 1.3 * without.depth
    assert run(scene, given_prior(scene, tilted, 0.01)).depth < 1.2 * without.depth


def test_every_frame_has_it_in_the_unit_of_the_state(scene: Scene) -> None:
    settings = "tracking.depth_prior_lambda=0.05", "tracking.keyframe_px=8", "tracking.polish_rounds=0"
    state = run(scene, given_prior(scene), *settings).tracker.state
    frames = [frame for lists in (state.tracks, state.others) for track in lists for frame in track]
    assert len(frames) == 12 and any(state.others)
    for frame in frames:
        truth = np.log(state.views[frame.camera].grid.sample(scene.depths[frame.camera][frame.time]))
        truth -= np.log(state.unit(frame.camera))
        # a tenth of the belief is what was carried
        wrong = np.abs(frame.prior_log_depth + frame.log_scale - truth)
        assert np.median(wrong) < 0.02, frame.frame
        assert (frame.prior_sigma < 0.2).all()
    for track in state.tracks:  # nothing was carried to the first
        truth = np.log(state.views[track[0].camera].grid.sample(scene.depths[track[0].camera][0]))
        np.testing.assert_allclose(
            track[0].prior_log_depth, truth - np.log(state.unit(track[0].camera)), atol=1e-12
        )


def test_every_frame_is_asked_for_once(scene: Scene) -> None:
    asked: list[tuple[int, int]] = []
    prior = given_prior(scene)

    def counting(camera: int, time: int, image: Array, grid: Grid) -> GridDepth | None:
        asked.append((camera, time))
        return prior(camera, time, image, grid) if time % 2 else None

    found = run(scene, counting, "tracking.polish_rounds=0")
    assert sorted(asked) == [(camera, time) for camera in range(2) for time in range(6)]
    for track in found.tracker.state.tracks:
        for frame in track:
            assert (frame.depth_prior is not None) == bool(frame.time % 2)
            # where the prior knows nothing the carried depth is as firm as ever
            assert (frame.prior_sigma < CONFIG.carried_sigma).all() == bool(frame.time % 2)


def test_lambda_is_the_paper_s() -> None:
    """Errors of flow at 1/8 resolution and of inverse depth cost as in Eq. 4, up to one factor."""
    flow_px, depth = 1.7, 0.03
    paper = (flow_px / 8.0) ** 2, CONFIG.depth_prior_lambda * depth**2
    ours = 0.5 * (flow_px / CONFIG.noise_px) ** 2, 0.5 * prior_information(CONFIG) * depth**2
    assert ours[1] / ours[0] == pytest.approx(paper[1] / paper[0])
    assert prior_information(CONFIG) ** -0.5 == pytest.approx(0.3536, abs=1e-4)


POINTS = 40
CARRIED = np.arange(POINTS) < 30


def depths(seed: int) -> tuple[Array, GridDepth]:
    """What was carried, and a prior that is unknown at some points."""
    rng = np.random.default_rng(seed)
    log_depth = rng.normal(0.0, 0.5, POINTS)
    prior = log_depth + rng.normal(0.3, 0.05, POINTS)
    prior[rng.random(POINTS) < 0.3] = np.nan
    prior[:2] = log_depth[:2] + 0.3
    return log_depth, GridDepth(prior, rng.uniform(0.05, 1.0, POINTS))


@given(st.integers(0, 2**32 - 1))
def test_with_lambda_0_the_prior_only_fills_what_was_not_carried(seed: int) -> None:
    log_depth, prior = depths(seed)
    belief = with_prior(log_depth, CARRIED, prior, replace(CONFIG, depth_prior_lambda=0.0))
    filled = ~CARRIED & np.isfinite(prior.log_depth)
    np.testing.assert_array_equal(belief.log_depth[~filled], log_depth[~filled])
    scale = belief.log_depth[filled] - prior.log_depth[filled]
    np.testing.assert_allclose(scale, -0.3, atol=0.06)  # that of what was carried
    np.testing.assert_array_equal(belief.prior_log_depth, belief.log_depth)
    np.testing.assert_allclose(belief.prior_sigma, CONFIG.carried_sigma)
    assert belief.log_scale == 0.0


@given(st.integers(0, 2**32 - 1), st.floats(1e-4, 1.0))
def test_both_are_believed_by_their_information(seed: int, weight: float) -> None:
    log_depth, prior = depths(seed)
    config = replace(CONFIG, depth_prior_lambda=weight)
    belief = with_prior(log_depth, CARRIED, prior, config)
    known = np.isfinite(prior.log_depth)
    np.testing.assert_array_equal(belief.log_depth[CARRIED], log_depth[CARRIED])
    mean = belief.prior_log_depth + belief.log_scale
    np.testing.assert_allclose(mean[~known], log_depth[~known])
    np.testing.assert_allclose(belief.prior_sigma[~known], config.carried_sigma)
    np.testing.assert_allclose(belief.prior_log_depth[known & ~CARRIED], prior.log_depth[known & ~CARRIED])
    # the sum of two Gaussian costs, and its minimum
    information = prior_information(config) * prior.confidence
    carried, given_ = log_depth[CARRIED & known], (prior.log_depth + belief.log_scale)[CARRIED & known]
    gradient = (mean[CARRIED & known] - carried) * config.carried_sigma**-2.0
    gradient += (mean[CARRIED & known] - given_) * information[CARRIED & known]
    np.testing.assert_allclose(gradient, 0.0, atol=1e-9 * (1.0 + information.max()))
    np.testing.assert_allclose(
        belief.prior_sigma[known] ** -2.0, information[known] + config.carried_sigma**-2.0
    )


def test_without_anything_carried_the_prior_is_taken_as_it_is() -> None:
    log_depth, prior = depths(3)
    belief = with_prior(log_depth, np.zeros(POINTS, bool), prior, CONFIG)
    known = np.isfinite(prior.log_depth)
    np.testing.assert_array_equal(belief.log_depth, np.where(known, prior.log_depth, log_depth))
    assert belief.log_scale == 0.0
