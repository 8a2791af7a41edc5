"""The per-pixel depth solve: its system against finite differences and explicit Jacobians, its solution
against a general optimiser and against the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares, minimize, minimize_scalar
from scipy.sparse.linalg import spsolve

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.geometry import project, transform_points
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.edges import Edge
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.solve import depth
from mvdyn_gtsam.refinement.solve.depth import (
    FLOW_FLOOR_PX,
    RATIO_FLOOR,
    DepthPrior,
    FrameProblem,
    cost,
    normal_equations,
    robust_cost,
    solve_frame,
)
from mvdyn_gtsam.refinement.solve.lattice import neighbour_likeness
from mvdyn_gtsam.refinement.solve.residuals import confidence
from tests.refinement.dense_edges import (
    in_double,
    small_view,
    true_edge,
    true_edges,
    true_theta,
    with_wrong_flow,
)
from tests.refinement.scenes import INTRINSICS, Scene, two_cameras

Array = npt.NDArray[np.float64]

FRAME: Frame = (0, 1)
CONFIG = RefinementConfig()


@dataclass(frozen=True)
class Problem:
    """A frame of 8 x 6 pixels, away from every solution and every kink of its cost."""

    theta: Any
    edges: list[Edge]
    others: dict[Frame, Any]
    image_weights: Any
    prior: DepthPrior

    def with_config(self, config: RefinementConfig) -> FrameProblem:
        """As the code under test takes it."""
        return FrameProblem(self.edges, self.others, self.image_weights, self.prior, config)


def problem(seed: int = 0) -> Problem:
    """Residuals between 0.25 and 3 px and between 0.02 and 0.2 of depth: above the floors, on both sides of
    the lambdas."""
    rng = np.random.default_rng(seed)
    scene, view = two_cameras(), small_view(20)
    theta = true_theta(scene, FRAME, view).astype(np.float64) + rng.normal(0.0, 0.05, view.shape)
    edges, others = [], {}
    for j in ((0, 0), (0, 2), (1, 1)):
        edge = in_double(true_edge(scene, FRAME, j, view))
        reprojected = edge.target + edge.terms(np.exp(theta).ravel()[edge.pixels]).residual
        wanted: Any = _either_sign(rng, 0.25, 3.0, edge.target.shape)
        weight: Any = rng.uniform(0.3, 1.0, len(edge.pixels))
        edges.append(replace(edge, target=reprojected - wanted, weight=weight))
        # what the edge says frame j has, and 2 to 20 % away from it; several pixels may see the same one
        there = true_theta(scene, j, view).astype(np.float64)
        seen = edge.nearest >= 0
        ratio = edge.terms(np.exp(theta).ravel()[edge.pixels]).depth_ratio
        expected = theta.ravel()[edge.pixels] - np.log(ratio)
        there.ravel()[edge.nearest[seen]] = expected[seen] + _either_sign(rng, 0.02, 0.2, int(seen.sum()))
        others[j] = there
    weights = tuple(rng.uniform(0.1, 1.0, view.shape) for _ in range(2))
    weights[0][:, -1] = weights[1][-1] = 0.0
    prior: Any = (theta + rng.normal(0.0, 0.1, view.shape), rng.uniform(1.0, 30.0, view.shape))
    return Problem(theta, edges, others, weights, DepthPrior(*prior))


def _either_sign(rng: np.random.Generator, low: float, high: float, shape: Any) -> Any:
    return np.exp(rng.uniform(np.log(low), np.log(high), shape)) * rng.choice([-1.0, 1.0], shape)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("only", ["flow", "disparity", "smoothness", "prior", "all"])
def test_the_gradient_is_that_of_the_cost(seed: int, only: str) -> None:
    """No residual is below a floor, where the cost has a kink and its reweighted form has none."""
    given_ = problem(seed)
    config = CONFIG
    if only != "all":
        config = replace(
            CONFIG,
            flow_weight=float(only == "flow"),
            disparity_weight=7.0 * (only == "disparity"),
            smoothness=2.0 * (only == "smoothness"),
        )
    if only not in ("prior", "all"):
        nothing = DepthPrior(given_.prior.theta, np.zeros_like(given_.prior.weight))
        given_ = replace(given_, prior=nothing)
    gradient = normal_equations(given_.theta, given_.with_config(config)).gradient.ravel()
    numeric = np.empty(given_.theta.size)
    step = 1e-6
    for pixel in range(given_.theta.size):
        moved = np.zeros(given_.theta.size)
        moved[pixel] = step
        up, down = (given_.theta + sign * moved.reshape(given_.theta.shape) for sign in (1, -1))
        above, below = (cost(theta, given_.with_config(config)) for theta in (up, down))
        numeric[pixel] = (above - below) / (2.0 * step)
    assert np.abs(numeric).max() > 1.0
    np.testing.assert_allclose(gradient, numeric, rtol=1e-4, atol=1e-4 * np.abs(numeric).max())


def test_the_problem_lies_off_the_floors_and_on_both_sides_of_the_lambdas() -> None:
    """What the finite differences above rely on."""
    given_ = problem()
    for edge in given_.edges:
        residual = np.abs(edge.terms(np.exp(given_.theta).ravel()[edge.pixels]).residual)
        assert residual.min() > 2.0 * FLOW_FLOOR_PX
        assert residual.sum(axis=1).min() < CONFIG.flow_lambda < residual.sum(axis=1).max()


def explicit_matrix(given_: Problem, config: RefinementConfig) -> Array:
    """``J^T W J`` from dense rows: finite differences for the flow, the definitions for the rest."""
    theta, size = given_.theta.ravel(), given_.theta.size
    rows: list[Array] = []
    weights: list[float] = []

    def add(row: Array, weight: float) -> None:
        rows.append(row)
        weights.append(weight)

    for edge in given_.edges:
        for k, pixel in enumerate(edge.pixels):

            def reprojected(value: float, edge: Edge = edge, k: int = k) -> tuple[Array, float]:
                point = transform_points(edge.jTi, edge.rays[k : k + 1].astype(np.float64) * np.exp(-value))
                found, z = project(point, INTRINSICS)
                return found[0], float(z[0])

            def slope(value: float, reprojected: Any = reprojected) -> tuple[Array, float]:
                (up, far), (down, near) = reprojected(value + 1e-5), reprojected(value - 1e-5)
                return (up - down) / 2e-5, (np.log(far) - np.log(near)) / 2e-5

            by_theta, by_depth = slope(theta[pixel])
            at, z = reprojected(theta[pixel])
            residual = at - edge.target[k]
            trust = float(edge.weight[k]) * min(1.0, config.flow_lambda / np.abs(residual).sum())
            for axis in range(2):
                row = np.zeros(size)
                row[pixel] = by_theta[axis]
                add(row, config.flow_weight * trust / max(abs(residual[axis]), FLOW_FLOOR_PX))
            if edge.nearest[k] >= 0:
                ratio = -given_.others[edge.j].ravel()[edge.nearest[k]] - np.log(z)
                trust = float(edge.weight[k]) * min(1.0, config.disparity_lambda / abs(ratio))
                row = np.zeros(size)
                row[pixel] = -by_depth
                add(row, config.disparity_weight * trust / max(abs(ratio), RATIO_FLOOR))
    height, width = given_.theta.shape
    for pixel in range(size):
        y, x = divmod(pixel, width)
        row = np.zeros(size)
        row[pixel] = 1.0
        add(row, float(given_.prior.weight[y, x]))
        for image_weight, other, exists in (
            (given_.image_weights[0][y, x], pixel + 1, x + 1 < width),
            (given_.image_weights[1][y, x], pixel + width, y + 1 < height),
        ):
            if exists:
                row = np.zeros(size)
                row[pixel], row[other] = -1.0, 1.0
                jump = (theta[other] - theta[pixel]) / config.smoothness_scale
                add(row, config.smoothness * image_weight / config.smoothness_scale**2 / (1.0 + jump**2))
    jacobian = np.array(rows)
    return np.asarray((jacobian.T * np.array(weights)) @ jacobian)


@pytest.mark.parametrize("seed", range(2))
def test_the_five_diagonals_are_the_explicit_system(seed: int) -> None:
    given_ = problem(seed)
    # beyond so wide a kernel the links are of all strengths
    config = replace(CONFIG, smoothness_scale=0.05)
    matrix = normal_equations(given_.theta, given_.with_config(config)).lattice.matrix().toarray()
    np.testing.assert_allclose(matrix, explicit_matrix(given_, config), rtol=2e-3, atol=1e-2)
    np.testing.assert_array_equal(matrix, matrix.T)
    assert np.linalg.eigvalsh(matrix.astype(np.float64)).min() > 0.0
    # nothing but the five diagonals, nor a link from the end of a row to the next row's beginning
    width = given_.theta.shape[1]
    assert matrix[width - 1, width] == 0.0
    row, col = np.nonzero(matrix)
    assert set(np.abs(row - col)) == {0, 1, width}


@pytest.mark.parametrize("seed", [0, 1])
def test_the_step_solves_the_system(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one Gauss-Newton step, against a direct solve."""
    given_ = problem(seed)
    frame = given_.with_config(CONFIG)
    normal = normal_equations(given_.theta, frame)
    expected = spsolve(
        normal.lattice.matrix().tocsc().astype(np.float64), -normal.gradient.ravel().astype(np.float64)
    )
    assert np.abs(expected).max() < depth.LARGEST_STEP
    monkeypatch.setattr(depth, "SOLVER_TOLERANCE", 1e-6)
    solved, _ = solve_frame(given_.theta, frame, iterations=1)
    np.testing.assert_allclose((solved - given_.theta).ravel(), expected, atol=1e-4 * np.abs(expected).max())


def test_information_is_that_of_the_flow_alone() -> None:
    """Frames that agree about a depth no flow has measured must not pass for evidence."""
    given_ = problem()
    corner = np.zeros(given_.theta.size, bool)
    corner[:3] = True
    edges = [edge.without(corner) for edge in given_.edges]
    given_ = replace(given_, edges=edges)
    whole = normal_equations(given_.theta, given_.with_config(CONFIG))
    nothing = DepthPrior(given_.prior.theta, np.zeros_like(given_.prior.weight))
    alone = replace(given_, others={}, prior=nothing)
    flow = normal_equations(given_.theta, alone.with_config(replace(CONFIG, smoothness=0.0)))
    np.testing.assert_allclose(flow.lattice.total(), flow.information)
    np.testing.assert_allclose(whole.information, flow.information)
    assert (flow.information.ravel()[:3] == 0.0).all() and (flow.information.ravel()[3:] > 0.0).any()


def stacked(given_: Problem, config: RefinementConfig, floors: tuple[float, float]) -> Any:
    """Residuals of the quadratic form of the cost, for scipy; confidence is 1 and the floors are above all
    residuals."""

    def residuals(flat: Array) -> Array:
        theta = flat.reshape(given_.theta.shape)
        parts: list[Any] = [(np.sqrt(given_.prior.weight) * (theta - given_.prior.theta)).ravel()]
        for edge in given_.edges:
            points = edge.rays.astype(np.float64) / np.exp(flat[edge.pixels])[:, None]
            found, z = project(transform_points(edge.jTi, points), INTRINSICS)
            weight = np.sqrt(config.flow_weight * edge.weight / floors[0])
            parts.append(((found - edge.target) * weight[:, None]).ravel())
            seen = edge.nearest >= 0
            ratio = -given_.others[edge.j].ravel()[edge.nearest[seen]] - np.log(z[seen])
            parts.append(np.sqrt(config.disparity_weight * edge.weight[seen] / floors[1]) * ratio)
        strength = np.sqrt(config.smoothness) / config.smoothness_scale
        across, down = given_.image_weights
        parts.append((strength * np.sqrt(across[:, :-1]) * np.diff(theta, axis=1)).ravel())
        parts.append((strength * np.sqrt(down[:-1]) * np.diff(theta, axis=0)).ravel())
        return np.concatenate(parts)

    return residuals


@pytest.mark.parametrize("seed", range(2))
def test_the_solution_is_that_of_a_general_optimiser(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """With weights that stay the same: lambdas, floors and kernel above all residuals."""
    floors = (50.0, 2.0)
    monkeypatch.setattr(depth, "FLOW_FLOOR_PX", floors[0])
    monkeypatch.setattr(depth, "RATIO_FLOOR", floors[1])
    config = replace(
        CONFIG, flow_lambda=1e6, disparity_lambda=1e6, smoothness_scale=100.0, smoothness=2e4, flow_weight=9.0
    )
    given_ = problem(seed)
    found, _ = solve_frame(given_.theta, given_.with_config(config), 25)
    residuals = stacked(given_, config, floors)
    expected = least_squares(residuals, given_.theta.ravel(), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    assert np.abs(expected.x - given_.theta.ravel()).max() > 0.05
    np.testing.assert_allclose(found.ravel(), expected.x, atol=2e-4)


@pytest.mark.parametrize("seed", range(2))
def test_a_general_descent_ends_at_no_lower_robust_cost(seed: int) -> None:
    """The cost as it is used, confidences and kinks and all."""
    given_ = problem(seed)
    config = replace(CONFIG, smoothness_scale=0.1, smoothness=0.2)

    def objective(flat: Array) -> tuple[float, Array]:
        theta = flat.reshape(given_.theta.shape)
        gradient = normal_equations(theta, given_.with_config(config)).gradient
        return cost(theta, given_.with_config(config)), gradient.ravel().astype(np.float64)

    found, _ = solve_frame(given_.theta, given_.with_config(config), 20)
    before, after = objective(given_.theta.ravel())[0], objective(found.ravel().astype(np.float64))[0]
    descent = minimize(objective, given_.theta.ravel(), jac=True, method="L-BFGS-B")
    assert descent.fun < before
    assert after < descent.fun + 0.1 * (before - descent.fun)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return two_cameras()


def weak_prior(theta: Float32) -> DepthPrior:
    return DepthPrior(theta, np.full(theta.shape, CONFIG.prior_sigma**-2 * 1e-3, np.float32))


def outlined(truth: Float32) -> tuple[Float32, Float32]:
    """Weights of an image that is plain but for a change of luminance where depth changes."""
    return neighbour_likeness(60.0 * truth[..., None], CONFIG.edge_contrast)


def off_the_truth(theta: Float32) -> Float32:
    """Up to 20 % away, as waves over the image: noise of single pixels would be too easy."""
    row, col = np.mgrid[: theta.shape[0], : theta.shape[1]]
    return (theta + 0.2 * np.sin(0.4 * row + 0.25 * col)).astype(np.float32)


# In so small a view the floor's depth changes by more per pixel than a smoothness for real views allows.
GENTLE = replace(CONFIG, smoothness=0.2)


@pytest.mark.parametrize("share", [0.0, 0.2])
@pytest.mark.parametrize("iterations", [5, 20])
def test_depth_is_recovered_from_a_wrong_start(scene: Scene, share: float, iterations: int) -> None:
    view = small_view(4)
    truth, edges = true_theta(scene, FRAME, view), true_edges(scene, FRAME, view)
    start = off_the_truth(truth)
    solved, information = solve_frame(
        start,
        FrameProblem(with_wrong_flow(edges, share), {}, outlined(truth), weak_prior(start), GENTLE),
        iterations,
    )
    assert np.median(np.abs(start - truth)) > 0.1
    error = np.abs(solved - truth)
    assert np.median(error) < 0.001
    assert np.quantile(error, 0.9) < 0.02
    seen = np.zeros(truth.size, bool)
    for edge in edges:
        seen[edge.pixels] = True
    np.testing.assert_array_equal(information.ravel() > 0.0, seen)


def test_more_iterations_do_not_join_depths_that_the_flow_tells_apart(scene: Scene) -> None:
    """The image is plain: it is for the flow alone to keep the box before the wall."""
    view = small_view(4)
    truth, edges = true_theta(scene, FRAME, view), true_edges(scene, FRAME, view)
    plain = neighbour_likeness(np.zeros((*truth.shape, 1), np.float32), CONFIG.edge_contrast)
    errors = [
        np.abs(
            solve_frame(truth, FrameProblem(edges, {}, plain, weak_prior(truth), CONFIG), iterations)[0]
            - truth
        )
        for iterations in (5, 20)
    ]
    joined = [(error > 0.4).mean() for error in errors]
    assert joined[1] < joined[0] + 0.02


def test_a_hole_without_flow_is_filled_from_its_surroundings(scene: Scene) -> None:
    view = small_view(4)
    truth = true_theta(scene, FRAME, view)
    hole = np.zeros(truth.shape, bool)
    hole[14:22, 14:20] = True
    assert np.ptp(truth[12:24, 12:22]) < 0.1, "the hole and its surroundings are on the box"
    edges = [edge.without(hole.ravel()) for edge in true_edges(scene, FRAME, view)]
    start = off_the_truth(truth)
    start[hole] = truth[hole] + 0.3
    solved, information = solve_frame(
        start, FrameProblem(edges, {}, outlined(truth), weak_prior(start), CONFIG), 10
    )
    assert np.abs(solved - truth)[hole].max() < 0.03
    assert (information[hole] == 0.0).all()
    unsmoothed, _ = solve_frame(
        start,
        FrameProblem(edges, {}, outlined(truth), weak_prior(start), replace(CONFIG, smoothness=0.0)),
        10,
    )
    np.testing.assert_allclose(unsmoothed[hole], start[hole], atol=1e-3)


def test_disparity_pulls_neighbours_together(scene: Scene) -> None:
    """No flow says anything about depth; each frame was 5 % off, to either side."""
    view = small_view(4)
    i, j = (0, 1), (1, 1)
    forth, back = true_edge(scene, i, j, view), true_edge(scene, j, i, view)
    config = replace(CONFIG, flow_weight=0.0, smoothness=0.0)
    start = {
        i: true_theta(scene, i, view) + np.float32(0.05),
        j: true_theta(scene, j, view) - np.float32(0.05),
    }

    def disagreement(theta: dict[Frame, Float32]) -> float:
        rho = np.exp(theta[i]).ravel()[forth.pixels]
        ratio = np.log(forth.terms(rho).depth_ratio / rho) + theta[j].ravel()[forth.nearest]
        return float(np.median(np.abs(ratio[forth.nearest >= 0])))

    def solved(weight: float) -> dict[Frame, Float32]:
        theta, used = dict(start), replace(config, disparity_weight=weight)
        for _ in range(2):
            for frame, edge in ((i, forth), (j, back)):
                image, prior = outlined(start[frame]), weak_prior(start[frame])
                theta[frame], _ = solve_frame(
                    theta[frame], FrameProblem([edge], theta, image, prior, used), 4
                )
        return theta

    assert disagreement(start) == pytest.approx(0.1, abs=0.03)
    assert disagreement(solved(0.0)) == pytest.approx(disagreement(start), abs=1e-3)
    together = solved(5.0)
    assert disagreement(together) < 0.1 * disagreement(start)
    for frame in (i, j):
        moved = np.abs(together[frame] - true_theta(scene, frame, view))
        # at an outline the nearest pixel may lie on the other side of it
        assert np.quantile(moved, 0.9) < 0.06


@pytest.mark.parametrize("edge_at", [None, 10])
def test_smoothness_does_not_cross_an_edge_of_the_image(edge_at: int | None) -> None:
    """The left half is known to be at 0, the right one hardly known at 0.3."""
    grey = np.full((12, 20), 50.0)
    if edge_at is not None:
        grey[:, edge_at:] = 120.0
    prior = DepthPrior(np.zeros((12, 20), np.float32), np.full((12, 20), 1e3, np.float32))
    prior.theta[:, 10:], prior.weight[:, 10:] = 0.3, 1e-2
    config = replace(CONFIG, smoothness_scale=1.0, smoothness=5.0)
    weights = neighbour_likeness(grey[..., None], config.edge_contrast)
    solved, _ = solve_frame(prior.theta, FrameProblem([], {}, weights, prior, config), 10)
    np.testing.assert_allclose(solved[:, :10], 0.0, atol=0.02)
    if edge_at is None:
        assert solved[:, 10:].max() < 0.05
    else:
        np.testing.assert_allclose(solved[:, 10:], 0.3, atol=1e-3)


@given(st.floats(1e-3, 1e3), st.floats(0.01, 10.0))
def test_the_robust_cost_is_the_least_over_all_confidences(residual: float, scale: float) -> None:
    def explicit(c: float) -> float:
        return c * residual + scale * float(np.log(1.0 / c))

    found = float(robust_cost(np.array([residual]), scale)[0])
    assert found == pytest.approx(explicit(float(confidence(np.array([residual]), scale)[0])), rel=1e-9)
    search = minimize_scalar(explicit, bounds=(1e-9, 1.0), method="bounded", options={"xatol": 1e-12})
    assert found == pytest.approx(search.fun, rel=1e-4, abs=1e-9)
