"""Phase 2, depth: per-pixel inverse depth of a frame with the poses held fixed.

The unknown of a pixel is ``theta = log rho``, the log of its inverse depth. L_flow ties it to the flow,
L_disp to the depth that other frames have where the flow leads, smoothness to its four neighbours where the
image has no edge. Every Gauss-Newton step is a sparse symmetric system with five diagonals, solved by
conjugate gradients; confidences and absolute values are weights,
renewed at each step. Frames are solved in turn, each with the newest depth of the others: block Gauss-Seidel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.edges import Edge
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.solve.lattice import Lattice, lattice_solution
from mvdyn_gtsam.refinement.solve.residuals import FlowTerms, confidence, ratio_terms, reweighted

LARGEST_STEP = 0.5
"""Of ``theta`` per Gauss-Newton step: the linearisation of the flow holds about that far."""
FLOW_FLOOR_PX = 0.1
"""Residuals below are noise of the flow: their absolute value is taken for its square."""
RATIO_FLOOR = 0.005
"""The same for the ratio of depths."""
WIDEST_KERNEL = 8.0
"""Smoothness scales of the first step's kernel at most: beyond, it would join all depths whatever the flow
says, and the narrow kernel would not find back."""
SOLVER_TOLERANCE = 0.005
"""Relative residual at which conjugate gradients end. Source: 0.02 left large plain things of multicamvideo
halfway, 0.005 changes nothing on robodog_overlap."""
SOLVER_STEPS = 300
"""Conjugate-gradient steps at most; beyond, what is far from any evidence keeps its depth a little longer.
Source: 80 to 300 compared there, as the tolerance."""


@dataclass(frozen=True)
class DepthPrior:
    """What a frame's depth is drawn to where flow says little."""

    theta: Float32
    """``(h, w)`` log inverse depth."""
    weight: Float32
    """``(h, w)`` inverse variance."""


@dataclass(frozen=True)
class FrameProblem:
    """What decides the depth of one frame."""

    edges: Sequence[Edge]
    others: Mapping[Frame, Float32]
    """``theta (h, w)`` of the frames that the edges lead to, as far as L_disp shall use them."""
    image_weights: tuple[Float32, Float32]
    """Of ``lattice.neighbour_likeness``."""
    prior: DepthPrior
    config: RefinementConfig

    @cached_property
    def agreements(self) -> tuple[Agreement | None, ...]:
        """What L_disp compares each edge with; None for those that it does not use."""
        return tuple(self._agreement(edge) for edge in self.edges)

    def _agreement(self, edge: Edge) -> Agreement | None:
        theta_there = self.others.get(edge.j)
        if theta_there is None or not self.config.disparity_weight > 0.0:
            return None
        inside = edge.nearest >= 0
        weight = np.float32(self.config.disparity_weight) * edge.weight * inside
        return Agreement(np.exp(theta_there.ravel()[edge.nearest]), weight)


@dataclass(frozen=True)
class Agreement:
    """The depth of another frame where an edge's flow leads."""

    inverse_depth: Float32
    """``(M,)`` any where the flow leads outside."""
    weight: Float32
    """``(M,)`` of L_disp; 0 there."""


@dataclass(frozen=True)
class Normal:
    """Gauss-Newton system of one frame."""

    lattice: Lattice
    gradient: Float32
    """``(h, w)``"""
    information: Float32
    """``(h, w)`` what the flow alone says about each pixel: inverse variance of ``theta``."""


def solve_frame(
    theta: Float32,
    problem: FrameProblem,
    iterations: int,
) -> tuple[Float32, Float32]:
    """``theta (h, w)`` after Gauss-Newton steps, and the information ``(h, w)`` that the flow has on it."""
    information = np.zeros_like(theta)
    for iteration in range(iterations):
        # depth edges are found coarse to fine: a wide kernel first
        widening = min(WIDEST_KERNEL, 2.0 ** max(0, iterations - 2 - iteration))
        normal = normal_equations(theta, problem, widening)
        step = lattice_solution(normal.lattice, -normal.gradient, SOLVER_TOLERANCE, SOLVER_STEPS)
        theta = theta + np.clip(step, -LARGEST_STEP, LARGEST_STEP)
        information = normal.information
    return theta, information


def normal_equations(
    theta: Float32,
    problem: FrameProblem,
    widening: float = 1.0,
) -> Normal:
    """The reweighted cost at ``theta (h, w)`` to second order; ``widening`` is of the smoothness kernel."""
    prior, config = problem.prior, problem.config
    information, agreement, gradient = (np.zeros(theta.size, np.float32) for _ in range(3))
    inverse_depth = np.exp(theta).ravel()
    for edge, there in zip(problem.edges, problem.agreements, strict=True):
        rho = inverse_depth[edge.pixels]
        terms = edge.terms(rho)
        _add_flow(information, gradient, edge, rho, terms, config)
        if there is not None:
            _add_ratio(agreement, gradient, edge, rho, terms, there, config)
    across, down, total = _smoothness(theta, problem.image_weights, config, widening)
    total += gradient.reshape(theta.shape) + prior.weight * (theta - prior.theta)
    diagonal = (information + agreement).reshape(theta.shape) + prior.weight
    return Normal(Lattice(diagonal, across, down), total, information.reshape(theta.shape))


def cost(
    theta: Float32,
    problem: FrameProblem,
) -> float:
    """The cost whose reweighted form ``normal_equations`` linearises: floors and confidences as there."""
    edges, others, image_weights = problem.edges, problem.others, problem.image_weights
    prior, config = problem.prior, problem.config
    inverse_depth = np.exp(theta).ravel()
    total = 0.0
    for edge in edges:
        rho = inverse_depth[edge.pixels]
        terms = edge.terms(rho)
        each = np.abs(terms.residual).sum(axis=1)
        total += config.flow_weight * float(
            (edge.weight * robust_cost(each, config.flow_lambda))[terms.valid].sum()
        )
        there = others.get(edge.j)
        if there is not None and config.disparity_weight > 0.0:
            seen = terms.valid & (edge.nearest >= 0)
            rho_j = np.exp(there.ravel()[edge.nearest[seen]])
            ratio = ratio_terms(rho[seen], rho_j, terms.depth_ratio[seen], edge.jTi[2, 3])
            each = robust_cost(np.abs(ratio.residual), config.disparity_lambda)
            total += config.disparity_weight * float((edge.weight[seen] * each).sum())
    scale = config.smoothness_scale
    for difference, weight in zip(
        (np.diff(theta, axis=1), np.diff(theta, axis=0)), image_weights, strict=True
    ):
        weight = weight[:, :-1] if difference.shape[1] < theta.shape[1] else weight[:-1]
        total += 0.5 * config.smoothness * float((weight * np.log1p((difference / scale) ** 2)).sum())
    return total + 0.5 * float((prior.weight * (theta - prior.theta) ** 2).sum())


def robust_cost(cost: npt.NDArray[np.floating], scale: float) -> npt.NDArray[np.floating]:
    """``cost`` with its confidence eliminated: itself up to ``scale``, ``scale (1 + log(cost / scale))``
    beyond."""
    return np.where(cost < scale, cost, scale * (1.0 + np.log(np.maximum(cost, scale) / scale)))


def _add_flow(
    information: Float32,
    gradient: Float32,
    edge: Edge,
    rho: Float32,
    terms: FlowTerms,
    config: RefinementConfig,
) -> None:
    """Pixels occur once per edge; ``rho (M,)``."""
    residual, slope = terms.residual.T, terms.by_inverse_depth.T * rho
    trust = edge.weight * terms.valid
    trust *= confidence(np.abs(residual[0]) + np.abs(residual[1]), config.flow_lambda)
    trust *= np.float32(config.flow_weight)
    weighted = reweighted(residual, FLOW_FLOOR_PX) * trust * slope
    information[edge.pixels] += weighted[0] * slope[0] + weighted[1] * slope[1]
    gradient[edge.pixels] += weighted[0] * residual[0] + weighted[1] * residual[1]


def _add_ratio(
    agreement: Float32,
    gradient: Float32,
    edge: Edge,
    rho: Float32,
    terms: FlowTerms,
    there: Agreement,
    config: RefinementConfig,
) -> None:
    ratio = ratio_terms(rho, there.inverse_depth, terms.depth_ratio, edge.jTi[2, 3])
    weight = there.weight * terms.valid * confidence(np.abs(ratio.residual), config.disparity_lambda)
    slope = ratio.by_inverse_depth_i * rho
    weighted = weight * reweighted(ratio.residual, RATIO_FLOOR) * slope
    agreement[edge.pixels] += weighted * slope
    gradient[edge.pixels] += weighted * ratio.residual


def _smoothness(
    theta: Float32,
    image_weights: tuple[Float32, Float32],
    config: RefinementConfig,
    widening: float,
) -> tuple[Float32, Float32, Float32]:
    """Weights ``(h, w)`` to the right and lower neighbours, and their share of the gradient."""
    scale = np.float32(config.smoothness_scale * widening)
    across, down = (np.float32(config.smoothness / config.smoothness_scale**2) * w for w in image_weights)
    right, below = np.diff(theta, axis=1), np.diff(theta, axis=0)
    across[:, :-1] /= 1.0 + (right / scale) ** 2
    down[:-1] /= 1.0 + (below / scale) ** 2
    gradient = np.zeros_like(theta)
    pull = across[:, :-1] * right
    gradient[:, :-1] -= pull
    gradient[:, 1:] += pull
    pull = down[:-1] * below
    gradient[:-1] -= pull
    gradient[1:] += pull
    return across, down, gradient
