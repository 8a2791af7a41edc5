"""Retrieval with tiny ONNX graphs: the mean colour of an image, or of its pixels one by one."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from mvdyn_gtsam.baselines.retrieval import describe_images, retrieved_pairs
from mvdyn_gtsam.errors import BaselineError


def write_model(
    path: Path, shape: list[int | str | None], operation: str, kind: int = TensorProto.FLOAT
) -> Path:
    source = helper.make_tensor_value_info("image", kind, shape)
    target = helper.make_tensor_value_info("descriptor", kind, None)
    nodes = {
        "mean": [
            helper.make_node("GlobalAveragePool", ["image"], ["pooled"]),
            helper.make_node("Flatten", ["pooled"], ["descriptor"]),
        ],
        "pixels": [helper.make_node("Flatten", ["image"], ["descriptor"])],
        "infinite": [helper.make_node("Log", ["image"], ["descriptor"])],
    }[operation]
    graph = helper.make_graph(nodes, "descriptor", [source], [target])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)])
    model.ir_version = 8
    onnx.save(model, str(path))
    return path


def write_images(
    folder: Path, colours: dict[str, tuple[int, int, int]], size: tuple[int, int] = (8, 6)
) -> list[str]:
    for name, rgb in colours.items():
        image = np.full((size[1], size[0], 3), rgb[::-1], np.uint8)
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(folder / name), image)
    return list(colours)


def test_the_model_sees_rgb_from_zero_to_one(tmp_path: Path) -> None:
    names = write_images(tmp_path, {"a/0.png": (255, 51, 0)})
    model = write_model(tmp_path / "m.onnx", [1, 3, "h", "w"], "mean")
    (row,) = describe_images(model, tmp_path, names, num_threads=1)
    expected = np.array([1.0, 0.2, 0.0])
    np.testing.assert_allclose(row, expected / np.linalg.norm(expected), atol=1e-6)


def test_images_are_resized_to_a_fixed_input(tmp_path: Path) -> None:
    names = write_images(tmp_path, {"a/0.png": (255, 0, 0), "a/1.png": (0, 255, 0)}, size=(40, 30))
    model = write_model(tmp_path / "m.onnx", [1, 3, 6, 8], "pixels")
    descriptors = describe_images(model, tmp_path, names, num_threads=1)
    assert descriptors.shape == (2, 3 * 6 * 8)
    np.testing.assert_allclose(descriptors @ descriptors.T, np.eye(2), atol=1e-6)


@pytest.mark.parametrize(
    ("shape", "kind", "operation", "message"),
    [
        ([1, 1, 6, 8], TensorProto.FLOAT, "pixels", "must take one float32"),
        ([1, 144], TensorProto.FLOAT, "pixels", "must take one float32"),
        ([1, 3, 6, 8], TensorProto.DOUBLE, "pixels", "must take one float32"),
        ([1, 3, "h", "w"], TensorProto.FLOAT, "infinite", "finite values for a/0.png"),
    ],
)
def test_another_signature_is_refused(
    tmp_path: Path, shape: list[int | str | None], kind: int, operation: str, message: str
) -> None:
    names = write_images(tmp_path, {"a/0.png": (255, 0, 0)})
    with pytest.raises(BaselineError, match=message) as caught:
        describe_images(write_model(tmp_path / "m.onnx", shape, operation, kind), tmp_path, names)
    assert "m.onnx" in str(caught.value) and "\n" not in str(caught.value)


def test_descriptors_of_different_length_are_refused(tmp_path: Path) -> None:
    names = write_images(tmp_path, {"a/0.png": (255, 0, 0)})
    names += write_images(tmp_path, {"a/1.png": (255, 0, 0)}, size=(4, 4))
    with pytest.raises(BaselineError, match="one length"):
        describe_images(write_model(tmp_path / "m.onnx", [1, 3, "h", "w"], "pixels"), tmp_path, names)


def test_a_file_that_is_no_model(tmp_path: Path) -> None:
    (tmp_path / "m.onnx").write_bytes(b"nothing")
    with pytest.raises(BaselineError, match="m.onnx: cannot be read as an ONNX model") as caught:
        describe_images(tmp_path / "m.onnx", tmp_path, [])
    assert "\n" not in str(caught.value)


def test_the_most_similar_are_paired_once_and_known_partners_make_room() -> None:
    angles = np.radians([0.0, 10.0, 25.0, 90.0])
    descriptors = np.column_stack([np.cos(angles), np.sin(angles)]).astype(np.float32)
    names = ["a", "b", "c", "d"]
    assert retrieved_pairs(names, descriptors, 1, []) == [("a", "b"), ("b", "c"), ("c", "d")]
    # (a, b) is matched anyway: both turn to the next similar one.
    assert retrieved_pairs(names, descriptors, 1, [("b", "a")]) == [("a", "c"), ("b", "c"), ("c", "d")]
    everything = retrieved_pairs(names, descriptors, 10, [("a", "b")])
    assert len(everything) == 5 and ("a", "b") not in everything
