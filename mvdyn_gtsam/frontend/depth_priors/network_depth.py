"""What a depth network gives, read as its adapter says: z-depth, NaN where unknown, and a confidence."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.depth_priors.depth_adapter import DepthAdapter, Validity
from mvdyn_gtsam.frontend.depth_priors.depth_prior import Float32
from mvdyn_gtsam.frontend.depth_priors.network_image import Placement
from mvdyn_gtsam.frontend.depth_priors.point_shift import recover_shift
from mvdyn_gtsam.geometry import pixel_rays

Array = npt.NDArray[np.float64]
Outputs = Mapping[str, npt.NDArray[Any]]
Size = tuple[int, int]


def network_depth(
    outputs: Outputs, adapter: DepthAdapter, placement: Placement, intrinsics: Array
) -> tuple[Float32, Float32 | None]:
    """Depth ``(h, w)`` over the canvas, NaN where unknown, and confidence ``(h, w)`` in [0, 1] or None.

    ``intrinsics (3, 3)`` are those of the canvas; ``h`` and ``w`` are what the network gives. Raises
    ValueError, saying what it is, for an output that is no such thing.
    """
    rule, canvas = adapter.depth, placement.canvas
    raw = outputs[rule.name]
    if raw.dtype.kind != "f" or not np.isfinite(raw).any():
        raise ValueError(f"gives no number in {rule.name}; export it in float32, or use another depth prior")
    raw = raw.astype(np.float32)
    values = _points(raw, rule.name, rule.points_axis) if rule.value == "points" else _plane(raw, rule.name)
    shape = (values.shape[0], values.shape[1])
    known = np.zeros(shape, bool)
    inside = placement.inside(shape)
    known[inside] = _known(outputs, adapter.validity, shape)[inside]
    focal = (intrinsics[0, 0] * shape[1] / canvas[0], intrinsics[1, 1] * shape[0] / canvas[1])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # what comes of it is unknown
        if rule.value == "points":
            shift = recover_shift(values, known, focal) if rule.unknown_shift else 0.0
            depth = values[..., 2] + (np.nan if shift is None else shift)
        elif rule.value == "distance":
            depth = values * unit_rays(canvas, intrinsics, shape)[..., 2]
        else:
            depth = 1.0 / values if rule.value == "inverse depth" else values
        if rule.factor is not None:
            depth = depth * _number(outputs[rule.factor], rule.factor)
        if rule.canonical_focal is not None:
            depth = depth * (0.5 * (intrinsics[0, 0] + intrinsics[1, 1]) / rule.canonical_focal)
        depth = depth.astype(np.float32)
    known &= np.isfinite(depth) & (depth > 0.0)
    return np.where(known, depth, np.float32(np.nan)), _confidence(outputs, adapter.validity, shape)


def unit_rays(canvas: Size, intrinsics: Array, shape: tuple[int, int] | None = None) -> Array:
    """Unit rays ``(h, w, 3)`` through the pixels of the canvas, or of a field of ``shape`` over it."""
    height, width = shape if shape is not None else (canvas[1], canvas[0])
    x = (np.arange(width) + 0.5) * (canvas[0] / width) - 0.5
    y = (np.arange(height) + 0.5) * (canvas[1] / height) - 0.5
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = pixel_rays(pixels, intrinsics).reshape(height, width, 3)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def _known(outputs: Outputs, validity: Validity, shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
    known = np.ones(shape, bool)
    if validity.mask is not None:
        known &= _like(outputs, validity.mask, shape) > validity.mask_above
    if validity.sky is not None:
        known &= _like(outputs, validity.sky, shape) < validity.sky_from
    return known


def _confidence(outputs: Outputs, validity: Validity, shape: tuple[int, int]) -> Float32 | None:
    if validity.confidence is None:
        return None
    values = _like(outputs, validity.confidence, shape).astype(np.float32)
    return np.clip(values if validity.better == "higher" else 1.0 - values, 0.0, 1.0)


def _like(outputs: Outputs, name: str, shape: tuple[int, int]) -> npt.NDArray[Any]:
    plane = _plane(outputs[name], name)
    if plane.shape != shape:
        raise ValueError(f"gives {name} of shape {plane.shape} for a depth of {shape}")
    return plane


def _plane(array: npt.NDArray[Any], name: str) -> npt.NDArray[Any]:
    """``(h, w)`` of an array with any ones around."""
    inner = _without_ones(array, 2)
    inner = inner[..., 0] if inner.ndim == 3 and inner.shape[2] == 1 else inner
    if inner.ndim != 2 or not inner.size:
        raise ValueError(f"gives {name} of shape {array.shape}; it must be (1, H, W), for one image")
    return inner


def _points(array: npt.NDArray[Any], name: str, axis: str) -> npt.NDArray[Any]:
    """``(h, w, 3)``"""
    inner = _without_ones(array, 3)
    if inner.ndim != 3 or not inner.size or inner.shape[0 if axis == "first" else 2] != 3:
        expected = "(1, 3, H, W)" if axis == "first" else "(1, H, W, 3)"
        raise ValueError(f"gives {name} of shape {array.shape}; it must be {expected}, for one image")
    return inner.transpose(1, 2, 0) if axis == "first" else inner


def _without_ones(array: npt.NDArray[Any], rank: int) -> npt.NDArray[Any]:
    while array.ndim > rank and array.shape[0] == 1:
        array = array[0]
    return array


def _number(array: npt.NDArray[Any], name: str) -> float:
    if array.size != 1:
        raise ValueError(f"gives {name} of shape {array.shape}; it must be one number")
    return float(array.reshape(-1)[0])
