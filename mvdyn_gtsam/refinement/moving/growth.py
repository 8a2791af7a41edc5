"""How a moving thing grows in the image: its change of depth, whatever the other cameras see.

A thing twice as near is twice as large, wherever it moves and however the camera does. So one camera alone
follows the depth of a thing over time, up to its scale, through moments at which no other camera sees it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.context import LABELS, Context
from mvdyn_gtsam.refinement.edges import SURE_WEIGHT, Edge
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.solve.reprojection import CORRELATED_PX

Labels = npt.NDArray[np.integer]

LEAST_PIXELS = 50
"""That a measurement is made of. Source: choice."""
MOST_PIXELS = 2000
"""That are used; more take time and say the same. Source: choice."""
ONE_THING = 0.5
"""Share of each of two regions that the other has of it from which they are one thing: of others the depths
are not of the same. Source: 0.5 and 0.7 compared on two crowded random captures: what moves was 4 and 23 %
better with 0.5 than when parts of a region counted, 5 and 16 % with 0.7."""
ITERATIONS = 6
NOISE_PX = 0.5
"""Least scale of the robust fit. Source: choice, noise of flow."""
RIGID_PX = 2.0
"""Scale of the fit beyond which it is no single thing that moves. Source: of regions of five rendered scenes
those below were right to 0.002 to 0.014 over five frames, the others hardly better than nothing."""
WORST_CONDITION = 1e9
"""Of the fit; beyond, the points lie on a line."""
SIGMA = 0.03
"""Standard deviation of the log growth at best: limbs swing, things turn, and what turns or leaves the image
errs alike from frame to frame, so that many frames know little more than one. Source: 0.01 to 0.1 compared on
five rendered and four generated scenes: regions' depth is worse by 18 % with 0.01, within 6 % from 0.02 to
0.06."""

Region = tuple[Frame, int]
"""A frame and the label of one of its moving regions."""


@dataclass(frozen=True)
class Growth:
    """From one region to another of the same camera that is the same thing at another time."""

    first: Region
    second: Region
    log_growth: float
    """Of the size; that of the inverse depth is the same."""
    sigma: float
    """Its standard deviation."""


def is_one_thing(shared: int, size: int, size_there: int) -> bool:
    """Whether two regions are one thing, by the pixels they share and their own."""
    return bool(shared >= ONE_THING * max(size, size_there))


def vertical_growth(
    here: Float32, there: Float32, weight: Float32, independent: float
) -> tuple[float, float] | None:
    """Log of the growth along the image's columns from points ``here (M, 2)`` to ``there (M, 2)``, and its
    standard deviation; None for what does not move as one thing.

    ``weight (M,)`` is the trust in each, which count as ``independent`` measurements together; all in px.
    Robust affine fit of the rows: what turns about the vertical, as most things do before a camera held
    upright, keeps its height and not its width. As ``v = f Y / Z``, inverse depth changes by that factor.
    """
    chosen = np.linspace(0, len(here) - 1, min(len(here), MOST_PIXELS)).astype(np.int64)
    centred = here[chosen].astype(np.float64)
    centred -= centred.mean(axis=0)
    design = np.column_stack([centred, np.ones(len(chosen))])
    rows, trust = there[chosen, 1].astype(np.float64), weight[chosen].astype(np.float64)
    counts = trust
    for _ in range(ITERATIONS):
        normal = (design.T * counts) @ design
        if np.linalg.cond(normal) > WORST_CONDITION:
            return None
        fitted = np.linalg.solve(normal, design.T @ (counts * rows))
        error = np.abs(rows - design @ fitted)
        scale = max(NOISE_PX, 1.48 * float(np.median(error)))
        counts = trust / (1.0 + (error / scale) ** 2) ** 2
    if scale > RIGID_PX or fitted[1] <= 0.0:
        return None
    noise = scale * np.sqrt(np.linalg.inv(normal)[1, 1] * len(chosen) / min(independent, len(chosen)))
    return float(np.log(fitted[1])), float(np.hypot(SIGMA * scale / NOISE_PX, noise))


def growth_task(context: Context, frame: Frame) -> list[Growth]:
    """How the moving regions of a frame grow to those of later frames of its camera."""
    labels = np.asarray(context.workspace.read(LABELS, frame)).ravel()
    moves = np.flatnonzero(labels)
    if not len(moves):
        return []
    edges = context.edges(frame, context.poses(), own_camera=True, among=moves)
    focal = np.diag(context.workspace.views[frame[0]].camera.intrinsics)[:2].astype(np.float32)
    return [
        growth
        for edge in edges
        if edge.j[1] > frame[1]
        for growth in growths_along(
            edge, labels, np.asarray(context.workspace.read(LABELS, edge.j)).ravel(), focal, context.config
        )
    ]


def growths_along(
    edge: Edge, labels: Labels, labels_there: Labels, focal: Float32, config: RefinementConfig
) -> list[Growth]:
    """Growth of each region of the frame that an edge comes from to the one where most of it is found.

    ``labels (N,)`` and ``labels_there (N,)`` are those of the pixels of the two frames, ``focal (2,)`` in px
    of the input.
    """
    sure = np.flatnonzero((edge.weight >= SURE_WEIGHT) & (edge.nearest >= 0))
    own, there = labels[edge.pixels[sure]], labels_there[edge.nearest[sure]]
    found = []
    for label in np.unique(own[own > 0]):
        counts = np.bincount(there[own == label])
        counts[0] = 0
        other = int(counts.argmax())
        if counts[other] < max(LEAST_PIXELS, ONE_THING * np.count_nonzero(labels == label)):
            continue
        shared = sure[(own == label) & (there == other)]
        independent = len(shared) * (config.stride / CORRELATED_PX) ** 2
        measured = vertical_growth(
            edge.rays[shared, :2] * focal, edge.target[shared], edge.weight[shared], independent
        )
        if measured is None:
            continue
        # what is shared, in the pixels of the other frame
        covered = len(shared) * np.exp(2.0 * measured[0])
        if covered >= ONE_THING * np.count_nonzero(labels_there == other):
            found.append(Growth((edge.i, int(label)), (edge.j, other), *measured))
    return found
