"""A fingerprint tells models apart by all of their weights, wherever they lie."""

from __future__ import annotations

from pathlib import Path

import onnx
import pytest
from onnx.external_data_helper import set_external_data

from mvdyn_gtsam.errors import BaselineError, DepthPriorError
from mvdyn_gtsam.frontend.onnx_model import OnnxModel, fingerprint
from tests.frontend.depth_priors.onnx_networks import depth_anything_v2


def test_it_depends_on_the_content_alone(tmp_path: Path) -> None:
    a, b = depth_anything_v2(tmp_path / "a.onnx"), depth_anything_v2(tmp_path / "b.onnx")
    c = depth_anything_v2(tmp_path / "c.onnx", bias=5.0)
    assert fingerprint(a) == fingerprint(b) != fingerprint(c)
    assert fingerprint(a, b"described") not in (fingerprint(a), fingerprint(c)) and len(fingerprint(a)) == 12


def test_weights_in_another_file_count(tmp_path: Path) -> None:
    found = []
    for folder, weight in (("a", 0.5), ("b", 0.75), ("c", 0.5)):
        (tmp_path / folder).mkdir()
        model = onnx.load(str(depth_anything_v2(tmp_path / "m.onnx", weights=(weight, 0.0, 0.0))))
        path = tmp_path / folder / "m.onnx"
        # the three weights; without the axes the graph could not be checked
        (weights,) = [one for one in model.graph.initializer if len(one.raw_data) == 12]
        set_external_data(weights, location="weights.bin")
        onnx.save(model, str(path))
        OnnxModel(path, 1, DepthPriorError)
        found.append(fingerprint(path))
    assert (tmp_path / "a" / "m.onnx").read_bytes() == (tmp_path / "b" / "m.onnx").read_bytes()
    assert found[0] == found[2] != found[1]


def test_failures_are_of_the_caller_s_kind(tmp_path: Path) -> None:
    (tmp_path / "m.onnx").write_bytes(b"")
    for failure in (BaselineError, DepthPriorError):
        with pytest.raises(failure, match=r"m\.onnx: cannot be read as an ONNX model"):
            OnnxModel(tmp_path / "m.onnx", 1, failure)
        with pytest.raises(failure, match=r"none\.onnx: there is no such ONNX model"):
            OnnxModel(tmp_path / "none.onnx", 1, failure)
