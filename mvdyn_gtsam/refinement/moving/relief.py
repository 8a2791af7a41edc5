"""How the points of a moving thing lie about its depth, made one over time.

The views of one instant match patches, and find each with an error of its own; the flow finds the same points
in the frames before and after, where they lie about the thing's depth in the same way, found anew.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.context import LABELS, Context
from mvdyn_gtsam.refinement.edges import FlowTargets
from mvdyn_gtsam.refinement.moving.growth import is_one_thing

Labels = npt.NDArray[np.integer]

RELIEF = "relief"
"""The array of how much nearer, in log depth, the points of moving regions are than their regions; NaN
elsewhere, and where nothing is known of that."""


def relief_task(context: Context, frame: Frame) -> None:
    """Where phase 2 begins, with the relief of what moves in a frame made one with that of those around."""
    workspace, relief = context.workspace, context.image(RELIEF, frame)
    if not np.isfinite(relief).any():
        return
    targets = context.flow_targets(frame)
    there = [(frame[0], int(time)) for time in targets.times]
    labels, *labels_there = (np.asarray(workspace.read(LABELS, j)) for j in (frame, *there))
    evened = relief_over_time(
        relief, labels, targets, [context.image(RELIEF, j) for j in there], labels_there
    )
    theta = context.image("prior", frame) + np.nan_to_num(evened - relief)
    workspace.write("prior", frame, theta)
    workspace.write("begun", frame, np.exp(theta))


def relief_over_time(
    relief: Float32,
    labels: Labels,
    targets: FlowTargets,
    reliefs_there: Sequence[Float32],
    labels_there: Sequence[Labels],
) -> Float32:
    """``relief (h, w)`` as the median of itself and of what the ``targets`` find in the frames there.

    NaN stays NaN. Of the regions ``labels (h, w)``, 0 elsewhere; frames in which a region is not one thing,
    but one of several or several in one, have no say in its relief.
    """
    pixels = np.flatnonzero(np.isfinite(relief))
    own, sizes = labels.ravel()[pixels], np.bincount(labels.ravel())
    table = np.full((len(targets.times) + 1, len(pixels)), np.nan, np.float32)
    table[0] = relief.ravel()[pixels]
    for row, found, other, regions in zip(
        table[1:], targets.pixels, reliefs_there, labels_there, strict=True
    ):
        at, sizes_there = found[pixels], np.bincount(regions.ravel())
        # the last pixel stands for none, and is masked
        there = np.where(at >= 0, regions.ravel()[at], 0)
        for label in np.unique(own):
            shared = np.bincount(there[own == label], minlength=2)
            counterpart = 1 + int(shared[1:].argmax())
            if shared[counterpart] and is_one_thing(
                shared[counterpart], sizes[label], sizes_there[counterpart]
            ):
                same = (own == label) & (there == counterpart)
                row[same] = other.ravel()[at[same]]
    result = relief.copy()
    result.ravel()[pixels] = np.nanmedian(table, axis=0)
    return result
