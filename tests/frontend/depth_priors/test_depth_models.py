"""Which network a file holds: told by its signature, named, described, or refused in one line."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto

from mvdyn_gtsam.errors import DepthPriorError
from mvdyn_gtsam.frontend.depth_priors.depth_models import KNOWN, USABLE, choose_adapter, read_sidecar
from mvdyn_gtsam.frontend.onnx_model import OnnxModel, Signature
from tests.frontend.depth_priors import onnx_networks
from tests.frontend.depth_priors.onnx_networks import Graph

RAYS = np.ones((14, 28, 3))
DOCUMENT = Path(__file__).parents[3] / "docs" / "depth_models.md"


def signature(model: Path) -> Signature:
    return OnnxModel(model, 1, DepthPriorError).signature


def chosen(model: Path, name: str | None = None) -> str:
    return choose_adapter(model, signature(model), name).name


def refused(model: Path, name: str | None = None) -> str:
    with pytest.raises(DepthPriorError) as caught:
        choose_adapter(model, signature(model), name)
    assert "\n" not in str(caught.value) and str(caught.value).startswith(
        ("--depth-model", str(model.parent))
    )
    return str(caught.value)


def as_transformers(path: Path) -> Path:
    return onnx_networks.depth_anything_v2(path, ("pixel_values", "predicted_depth"))


@pytest.mark.parametrize(
    ("write", "name"),
    [
        (lambda path: onnx_networks.moge_2(path, RAYS, 0.0), "moge-2"),
        (lambda path: onnx_networks.moge_2(path, RAYS, 0.0, fixed=True), "moge-2"),
        (onnx_networks.unidepth_v2, "unidepth-v2"),
        (lambda path: onnx_networks.unidepth_v2(path, with_camera=False), "unidepth-v2"),
    ],
)
def test_a_signature_that_one_network_has_tells_it(
    tmp_path: Path, write: Callable[[Path], Path], name: str
) -> None:
    model = write(tmp_path / "m.onnx")
    assert chosen(model) == chosen(model, name) == name


@pytest.mark.parametrize(
    ("write", "good", "bad"),
    [
        (onnx_networks.depth_anything_v2, "depth-anything-v2-metric", "depth-anything-v2"),
        (as_transformers, "depth-anything-v2-metric", "depth-anything-v2"),
        (onnx_networks.depth_anything_3_metric, "depth-anything-3-metric", "depth-anything-3-mono"),
        (
            lambda path: onnx_networks.depth_anything_3_metric(path, 5),
            "depth-anything-3-metric",
            "depth-anything-3-mono",
        ),
    ],
)
def test_a_signature_that_two_networks_have_is_never_guessed(
    tmp_path: Path, write: Callable[[Path], Path], good: str, bad: str
) -> None:
    model = write(tmp_path / "m.onnx")
    said = refused(model)
    assert f"as {good} and {bad} both do; if it is {good}, add --depth-model {good}; {bad} cannot" in said
    assert "takes " in said and " float (" in said and " and gives " in said
    assert chosen(model, good) == good
    assert f"{bad} gives" in refused(model, bad) and good in refused(model, bad)


def test_depth_that_is_inverse_or_of_another_unit_in_every_frame_is_refused(tmp_path: Path) -> None:
    said = refused(onnx_networks.depth_anything_v2(tmp_path / "m.onnx"), "depth-anything-v2")
    assert "gives inverse depth with a scale and an offset of its own in every frame" in said
    said = refused(onnx_networks.depth_anything_3(tmp_path / "3.onnx"))
    assert "depth-anything-3 gives depth with a scale of its own in every frame" in said
    assert "use DA3METRIC-LARGE, as depth-anything-3-metric" in said


@pytest.mark.parametrize(
    ("inputs", "outputs"),
    [
        ([("pixel_values", TensorProto.FLOAT, [1, 3, 28, 28])], ["depth"]),
        ([("image", TensorProto.UINT8, [1, 3, 28, 28])], ["depth"]),
        ([("image", TensorProto.FLOAT, [1, 1, 28, 28])], ["depth"]),
        ([("image", TensorProto.FLOAT, [2, 3, 28, 28])], ["depth"]),
        ([("image", TensorProto.FLOAT, [1, 3, 28, "w"])], ["depth"]),
        ([("image", TensorProto.FLOAT, [1, 4, 3, 28, 28])], ["depth", "sky"]),  # four views
        ([("image", TensorProto.FLOAT, [1, 3, 28, 28])], ["depth", "sky", "surprise"]),
        ([("image", TensorProto.FLOAT, [1, 3, 28, 28]), ("K", TensorProto.FLOAT, [1, 3, 3])], ["depth"]),
    ],
)
def test_every_part_of_the_signature_counts(
    tmp_path: Path, inputs: list[tuple[str, int, list[int | str]]], outputs: list[str]
) -> None:
    graph = Graph()
    for name in outputs:
        graph.add("Cast", inputs[0][0], output=name, to=TensorProto.FLOAT)
    model = graph.save(tmp_path / "m.onnx", inputs, [(name, []) for name in outputs])
    said = refused(model)
    assert f"gives {outputs[0]}" in said and "describe it in m.yaml beside it" in said
    for name in USABLE:
        assert f"{name} takes" in refused(model, name) and "and gives" in refused(model, name)


def test_a_wrong_name_is_answered_with_the_right_ones(tmp_path: Path) -> None:
    said = refused(onnx_networks.depth_anything_v2(tmp_path / "m.onnx"), "depth-anything")
    assert "--depth-model depth-anything: is not known; there are moge-2, unidepth-v2, " in said


def test_a_sidecar_has_the_word_before_the_signature_and_a_name_before_the_sidecar(tmp_path: Path) -> None:
    model = onnx_networks.moge_2(tmp_path / "m.onnx", RAYS, 0.0)
    (tmp_path / "m.yaml").write_text("depth: {name: predicted}\n")
    assert "m.yaml takes image float (1, 3, H, W) and gives predicted" in refused(model)
    assert chosen(model, "moge-2") == "moge-2"
    (tmp_path / "m.yaml").write_text(
        "depth: {name: points, value: points, scale: scale}\nnum_tokens: num_tokens\n"
        "ignored: [normal, mask, metric_scale]\n"
    )
    assert "m.yaml gives points with a scale of its own in every frame" in refused(model)
    (tmp_path / "m.yaml").write_text(
        "name: smaller\nimage: {size: {pixels: [1, 200000]}}\nnum_tokens: num_tokens\ntokens: 1200\n"
        "depth: {name: points, value: points, unknown_shift: true, factor: metric_scale}\n"
        "validity: {mask: mask}\nignored: [normal]\n"
    )
    assert choose_adapter(model, signature(model), None).tokens == 1200 and chosen(model) == "smaller"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("depth: [", "cannot be read"),
        ("- depth", "must hold keys and values"),
        ("1: 2", "must hold keys and values"),
        ("image: {name: input}", "has no key depth"),
        ("depth: {name: d, valu: points}", r"unknown key depth.valu \(did you mean depth.value\?\)"),
        (
            "depth: {name: d, value: disparity}",
            "depth.value is 'disparity'; it must be one of depth, inverse",
        ),
        ("depth: {name: d, scale: 2}", "depth.scale is 2; it must be one of metric, scale, affine"),
        ("depth: d", "depth is a section"),
        ("depth: {value: points}", "depth.name is missing"),
        ("depth: {name: d, unknown_shift: true}", "depth.unknown_shift needs value: points"),
        ("depth: {name: d, canonical_focal: 0}", "depth.canonical_focal is not above 0"),
        ("depth: {name: d}\nimage: {rank: 3}", "image.rank is 3; it must be 4 or 5"),
        ("depth: {name: d}\nimage: {std: [1, 1, 0]}", "image.std"),
        ("depth: {name: d}\nimage: {mean: [1, 1]}", "image.mean is .*it must hold 3 values"),
        ("depth: {name: d}\nimage: {maximum: 0}", "image.maximum is 0"),
        ("depth: {name: d}\nimage: {size: {short_side: 5, long_side: 6}}", "more than one of short_side"),
        ("depth: {name: d}\nimage: {size: {multiple: 0}}", "image.size.multiple is 0"),
        ("depth: {name: d}\nimage: {size: {pixels: [9, 4]}}", "not least, most"),
        ("depth: {name: d}\nimage: {size: {long_side: 0}}", "image.size must be positive"),
    ],
)
def test_a_sidecar_with_a_mistake_is_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "m.yaml"
    path.write_text(text)
    with pytest.raises(DepthPriorError, match=message) as caught:
        read_sidecar(path)
    assert "\n" not in str(caught.value) and str(caught.value).startswith(f"{path}: ")


def test_every_known_network_is_documented_and_the_unusable_say_what_to_use() -> None:
    documented = DOCUMENT.read_text()
    for adapter in KNOWN:
        assert f"`{adapter.name}`" in documented
        assert adapter.is_usable or any(name in adapter.instead for name in USABLE)


def test_the_descriptions_in_the_documentation_are_read(tmp_path: Path) -> None:
    blocks = [block for block in DOCUMENT.read_text().split("\n\n") if "\n    depth:" in block]
    adapters = []
    for block in blocks:
        (tmp_path / "m.yaml").write_text(textwrap.dedent(block))
        adapters.append(read_sidecar(tmp_path / "m.yaml"))
    everything, smaller = adapters
    assert everything.image.size.short_side == 518 and everything.validity.confidence == "certainty"
    assert replace(smaller, name="moge-2", tokens=1800, image=KNOWN[0].image) == KNOWN[0]
