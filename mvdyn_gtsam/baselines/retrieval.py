"""Image pairs from a global descriptor, an ONNX model that the user brings (NetVLAD, CosPlace, ...).

COLMAP's own retrieval needs a vocabulary tree, which is a download; so do the weights of any descriptor.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.errors import BaselineError
from mvdyn_gtsam.frontend.onnx_model import OnnxModel

logger = logging.getLogger(__name__)

Pair = tuple[str, str]


def describe_images(
    model: Path, images: Path, names: Sequence[str], num_threads: int = -1
) -> npt.NDArray[np.float32]:
    """Descriptors ``(N, D)`` of unit length of the images ``names`` below ``images``.

    The model takes one input ``(1, 3, H, W)`` float32, RGB in [0, 1], and gives ``(1, D)`` first; images are
    resized where it fixes H and W. Raises BaselineError for another signature and for values not finite.
    """
    session, feed, size = _open(model, num_threads)
    rows: list[npt.NDArray[np.float32]] = []
    for name in names:
        image = cv2.imread(str(images / name), cv2.IMREAD_COLOR)
        if image is None:
            raise BaselineError(f"{images / name}: cannot be read; is the disk full?")
        if size is not None and size != (image.shape[1], image.shape[0]):
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        planes = np.ascontiguousarray(image[..., ::-1].transpose(2, 0, 1)[None], dtype=np.float32) / 255.0
        descriptor = session.run({feed: planes}, None, name)[0].astype(np.float32).ravel()
        length = float(np.linalg.norm(descriptor))
        if not np.isfinite(length) or length == 0.0 or (rows and len(descriptor) != len(rows[0])):
            raise BaselineError(f"{model}: gives no descriptor of one length and finite values for {name}")
        rows.append(descriptor / length)
    return np.stack(rows)


def retrieved_pairs(
    names: Sequence[str], descriptors: npt.NDArray[np.float32], count: int, known: Collection[Pair]
) -> list[Pair]:
    """For each image the ``count`` most similar others that are not its partner in ``known`` already.

    Neighbours in time look alike most: counted among the ``count`` they would leave no room for what
    retrieval is for, connections that the windows miss. Pairs are ordered as ``names`` and listed once.
    """
    index = {name: number for number, name in enumerate(names)}
    similarity = descriptors @ descriptors.T
    np.fill_diagonal(similarity, -np.inf)
    for first, second in known:
        similarity[index[first], index[second]] = similarity[index[second], index[first]] = -np.inf
    found: set[tuple[int, int]] = set()
    for row, values in enumerate(similarity):
        for other in np.argsort(-values, kind="stable")[:count]:
            if np.isfinite(values[other]):
                found.add((min(row, int(other)), max(row, int(other))))
    return [(names[first], names[second]) for first, second in sorted(found)]


def _open(path: Path, num_threads: int) -> tuple[OnnxModel, str, tuple[int, int] | None]:
    """The model, name of its input, and ``(width, height)`` where the model fixes them."""
    model = OnnxModel(path, num_threads, BaselineError)
    inputs = model.signature.inputs
    shape = inputs[0].shape if inputs else ()
    fits = len(inputs) == 1 and len(shape) == 4 and inputs[0].type == "tensor(float)"
    if not fits or shape[1] not in (3, None) and not isinstance(shape[1], str):
        described = ", ".join(map(str, inputs)) or "nothing"
        raise BaselineError(
            f"{path}: takes {described}; it must take one float32 (1, 3, H, W), RGB in [0, 1]"
        )
    height, width = shape[2], shape[3]
    size = (width, height) if isinstance(height, int) and isinstance(width, int) else None
    return model, inputs[0].name, size
