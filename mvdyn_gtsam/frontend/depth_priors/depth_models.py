"""The depth networks that are known, and which of them a file holds.

Every number is that of the network's own code; ``docs/depth_models.md`` has their licences.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mvdyn_gtsam.config_tree import build
from mvdyn_gtsam.errors import ConfigError, DepthPriorError
from mvdyn_gtsam.frontend.depth_priors.depth_adapter import (
    DepthAdapter,
    DepthOutput,
    ImageInput,
    SizeRule,
    Validity,
)
from mvdyn_gtsam.frontend.onnx_model import Signature

logger = logging.getLogger(__name__)

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of ImageNet, in RGB: https://pytorch.org/vision/stable/models.html."""
DOCUMENTATION = "docs/depth_models.md"

MOGE_2 = DepthAdapter(
    # Any size goes in; the graph brings it to `tokens` patches of 14 x 14 px, without antialiasing, so what
    # is larger is reduced before: https://github.com/microsoft/MoGe (moge/model/modules.py). Mean and std are
    # inside.
    image=ImageInput("image", size=SizeRule(pixels=(1, 1800 * 14**2)), enlarge="linear"),
    num_tokens="num_tokens",
    tokens=1800,  # of 1200 to 2500: https://github.com/microsoft/MoGe/blob/main/docs/onnx.md
    depth=DepthOutput("points", "points", "last", unknown_shift=True, factor="metric_scale"),
    validity=Validity(mask="mask", mask_above=0.5),  # MoGeModel.infer
    ignored=("normal",),
    name="moge-2",
)
UNIDEPTH_V2 = DepthAdapter(
    # UniDepthV2.infer pads with the mean and resizes bilinearly; exports have a fixed size, 462 x 630 unless
    # asked: https://github.com/lpiccinelli-eth/UniDepth (unidepth/models/unidepthv2/export.py)
    image=ImageInput(
        "rgbs",
        size=SizeRule(pixels=(200_000, 600_000), multiple=14),
        enlarge="linear",
        reduce="linear",
        mean=MEAN,
        std=STD,
    ),
    rays="rays",
    depth=DepthOutput("pts_3d", "points", "first"),
    # `confidence` is the predicted error of log depth, so lower is better, and has no fixed range: not used.
    # https://github.com/lpiccinelli-eth/UniK3D/issues/18,
    # https://github.com/lpiccinelli-eth/UniDepth/issues/143
    ignored=("confidence", "intrinsics"),
    name="unidepth-v2",
)
# image2tensor of https://github.com/DepthAnything/Depth-Anything-V2 (metric_depth/depth_anything_v2/dpt.py):
# the short side becomes 518, cubic; fixed sizes are stretched to, as by the export that made them,
# Depth-Anything-ONNX.
_DEPTH_ANYTHING_V2_IMAGE = ImageInput(
    size=SizeRule(short_side=518, multiple=14, fixed="stretch"), reduce="cubic", mean=MEAN, std=STD
)
DEPTH_ANYTHING_V2_METRIC = DepthAdapter(
    image=_DEPTH_ANYTHING_V2_IMAGE,
    depth=DepthOutput("depth"),
    name="depth-anything-v2-metric",
)
DEPTH_ANYTHING_V2 = replace(
    DEPTH_ANYTHING_V2_METRIC,
    depth=DepthOutput("depth", "inverse depth", scale="affine"),
    name="depth-anything-v2",
    instead="use its metric variant, for indoors or outdoors, as depth-anything-v2-metric",
)
# InputProcessor of https://github.com/ByteDance-Seed/Depth-Anything-3: long side 504, area or cubic.
_DEPTH_ANYTHING_3_IMAGE = ImageInput(size=SizeRule(long_side=504, multiple=14), mean=MEAN, std=STD)
DEPTH_ANYTHING_3_METRIC = DepthAdapter(
    image=_DEPTH_ANYTHING_3_IMAGE,
    # metres = focal / 300 * depth, sky from 0.3: README.md and utils/alignment.py there
    depth=DepthOutput("depth", canonical_focal=300.0),
    validity=Validity(sky="sky", sky_from=0.3),
    name="depth-anything-3-metric",
)
DEPTH_ANYTHING_3_MONO = replace(
    DEPTH_ANYTHING_3_METRIC,
    depth=DepthOutput("depth", scale="affine"),
    name="depth-anything-3-mono",
    instead="use DA3METRIC-LARGE, as depth-anything-3-metric",
)
DEPTH_ANYTHING_3 = DepthAdapter(
    image=replace(_DEPTH_ANYTHING_3_IMAGE, name="pixel_values", rank=5),
    depth=DepthOutput("predicted_depth", scale="scale"),
    ignored=("confidence", "extrinsics", "intrinsics"),
    name="depth-anything-3",
    instead="use DA3METRIC-LARGE, as depth-anything-3-metric",
)


def _as_transformers(adapter: DepthAdapter) -> DepthAdapter:
    """The same network with the names of exports by Hugging Face, such as onnx-community's."""
    return replace(
        adapter,
        image=replace(adapter.image, name="pixel_values"),
        depth=replace(adapter.depth, name="predicted_depth"),
    )


KNOWN = (
    MOGE_2,
    replace(MOGE_2, num_tokens=None),  # exported for one size and number of tokens
    UNIDEPTH_V2,
    replace(UNIDEPTH_V2, rays=None),  # it then guesses the camera, in every frame anew
    DEPTH_ANYTHING_V2_METRIC,
    _as_transformers(DEPTH_ANYTHING_V2_METRIC),
    DEPTH_ANYTHING_3_METRIC,
    replace(DEPTH_ANYTHING_3_METRIC, image=replace(_DEPTH_ANYTHING_3_IMAGE, rank=5)),
    DEPTH_ANYTHING_V2,
    _as_transformers(DEPTH_ANYTHING_V2),
    DEPTH_ANYTHING_3,
    DEPTH_ANYTHING_3_MONO,
    replace(DEPTH_ANYTHING_3_MONO, image=replace(_DEPTH_ANYTHING_3_IMAGE, rank=5)),
)
"""Several of one name: as it is exported by several programs."""
USABLE = tuple(dict.fromkeys(adapter.name for adapter in KNOWN if adapter.is_usable))
"""Names of those that can be a depth prior."""


def sidecar_of(model: Path) -> Path:
    """The description that may lie beside ``model``."""
    return model.with_suffix(".yaml")


def choose_adapter(model: Path, signature: Signature, name: str | None) -> DepthAdapter:
    """The network that ``model`` holds: ``name``, or what its sidecar describes, or what its signature tells.

    Raises DepthPriorError, in one line, where it is none of these, could be several, or cannot be a prior.
    """
    if name is not None:
        candidates: Sequence[DepthAdapter] = [adapter for adapter in KNOWN if adapter.name == name]
        if not candidates:
            raise DepthPriorError(
                f"--depth-model {name}: is not known; there are {', '.join(USABLE)}, and {DOCUMENTATION}"
                " tells how to describe another one"
            )
        fitting = _fitting(model, signature, candidates)
    elif (sidecar := sidecar_of(model)).is_file():
        fitting = _fitting(model, signature, [read_sidecar(sidecar)])
    else:
        fitting = _recognised(model, signature)
    adapter = fitting[0]
    if not adapter.is_usable:
        raise DepthPriorError(_why_not(model, adapter))
    return adapter


def read_sidecar(path: Path) -> DepthAdapter:
    """The network that a YAML file describes, with the keys of DepthAdapter. Raises DepthPriorError."""
    import yaml

    try:
        content: Any = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise DepthPriorError(f"{path}: cannot be read ({' '.join(str(error).split())[:200]})") from error
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise DepthPriorError(f"{path}: must hold keys and values as {DOCUMENTATION} has them")
    if "depth" not in content:
        raise DepthPriorError(f"{path}: has no key depth; {DOCUMENTATION} has an example")
    try:
        adapter = build(DepthAdapter, content)
    except ConfigError as error:
        raise DepthPriorError(f"{path}: {error}") from error
    return adapter if "name" in content else replace(adapter, name=path.name)


def _fitting(model: Path, signature: Signature, candidates: Sequence[DepthAdapter]) -> list[DepthAdapter]:
    fitting = [adapter for adapter in candidates if adapter.fits(signature)]
    if not fitting:
        expected = ", or ".join(dict.fromkeys(str(adapter) for adapter in candidates))
        raise DepthPriorError(f"{model}: {signature}; {candidates[0].name} {expected}")
    return fitting


def _recognised(model: Path, signature: Signature) -> list[DepthAdapter]:
    fitting = [adapter for adapter in KNOWN if adapter.fits(signature)]
    names = list(dict.fromkeys(adapter.name for adapter in fitting))
    if not names:
        raise DepthPriorError(
            f"{model}: {signature}, as none of {', '.join(dict.fromkeys(one.name for one in KNOWN))} does;"
            f" describe it in {sidecar_of(model).name} beside it, see {DOCUMENTATION}"
        )
    if len(names) > 1:
        usable = " or ".join(name for name in names if name in USABLE)
        others = " and ".join(name for name in names if name not in USABLE)
        raise DepthPriorError(
            f"{model}: {signature}, as {' and '.join(names)} both do; if it is {usable}, add --depth-model"
            f" {usable}; {others} cannot be a depth prior"
        )
    return fitting


def _why_not(model: Path, adapter: DepthAdapter) -> str:
    value = adapter.depth.value
    missing = {"scale": "a scale", "affine": "a scale and an offset"}[adapter.depth.scale]
    advice = adapter.instead or "use a network whose unit is the same in all frames"
    return (
        f"{model}: {adapter.name} gives {value} with {missing} of its own in every frame, and a depth prior"
        f" needs depth with one for all frames; {advice}"
    )
