"""Depth out of ONNX files: each known network is fed as it wants and read as it says."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.errors import DepthPriorError
from mvdyn_gtsam.frontend.depth_priors.depth_files import DepthFiles
from mvdyn_gtsam.frontend.depth_priors.depth_prior import DepthPrior
from mvdyn_gtsam.frontend.depth_priors.onnx_depth import OnnxDepth, open_depth_prior
from mvdyn_gtsam.geometry import pixel_rays
from tests.frontend.depth_priors import onnx_networks
from tests.frontend.depth_priors.onnx_networks import MEAN, STD, Graph, true_depth

WIDTH, HEIGHT = 60, 40
K = np.array([[55.0, 0.0, 29.5], [0.0, 55.0, 19.5], [0.0, 0.0, 1.0]])


def ramps(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Red grows to the right and green downwards, so that any resize keeps them; blue is the same."""
    image = np.full((height, width, 3), 60, np.uint8)
    image[..., 0] = np.linspace(20, 200, width)
    image[..., 1] = np.linspace(240, 30, height)[:, None]
    return image


def predict(
    prior: DepthPrior, image: np.ndarray, intrinsics: np.ndarray = K
) -> tuple[np.ndarray, np.ndarray | None]:
    found = prior.predict(image, intrinsics, "cam0", 7)
    assert found is not None and found[0].dtype == np.float32 and found[0].shape == image.shape[:2]
    return found


def frame_rays(intrinsics: np.ndarray = K, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """``(H, W, 3)`` with z = 1."""
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
    return pixel_rays(pixels.astype(float), intrinsics).reshape(height, width, 3)


def inside(field: np.ndarray) -> np.ndarray:
    """Without the border, which cubic interpolation bends."""
    return field[3:-3, 3:-3]


@pytest.mark.parametrize("size", [("height", "width"), (56, 56), (518, 518)])
@pytest.mark.parametrize("names", [("image", "depth"), ("pixel_values", "predicted_depth")])
def test_depth_anything_v2_metric(
    tmp_path: Path, names: tuple[str, str], size: tuple[int | str, int | str]
) -> None:
    model = onnx_networks.depth_anything_v2(tmp_path / "m.onnx", names, size)
    depth, confidence = predict(OnnxDepth(model, "depth-anything-v2-metric"), ramps())
    assert confidence is None
    np.testing.assert_allclose(inside(depth), inside(true_depth(ramps())), rtol=0.01)


@pytest.mark.parametrize("rank", [4, 5])
def test_depth_anything_3_metric_grows_with_the_focal_length_and_knows_the_sky(
    tmp_path: Path, rank: int
) -> None:
    model = onnx_networks.depth_anything_3_metric(tmp_path / "m.onnx", rank)
    prior = OnnxDepth(model, "depth-anything-3-metric")
    image = ramps(84, 84)  # 28 x 28 in the middle of 42 x 28: a third
    image[:30, :, 2] = 100  # 0.39 of the sky
    intrinsics = np.array([[80.0, 0.0, 41.5], [0.0, 100.0, 41.5], [0.0, 0.0, 1.0]])
    depth, _ = predict(prior, image, intrinsics)
    np.testing.assert_array_equal(np.isnan(depth), np.broadcast_to(np.arange(84)[:, None] < 30, (84, 84)))
    np.testing.assert_allclose(depth[34:-3, 3:-3], (true_depth(image) * 30.0 / 300.0)[34:-3, 3:-3], rtol=0.02)
    twice, _ = predict(prior, image, intrinsics * [[2.0], [2.0], [1.0]])
    np.testing.assert_allclose(twice, 2.0 * depth, rtol=1e-6)


@pytest.mark.parametrize(("fixed", "scalar"), [(False, True), (False, False), (True, True)])
@pytest.mark.parametrize("shift", [0.0, 0.7, -1.5])
def test_moge_2_gets_back_the_shift_that_it_leaves_open(
    tmp_path: Path, shift: float, fixed: bool, scalar: bool
) -> None:
    image = ramps()
    image[:, :9, 2] = 200  # where the mask says no
    model = onnx_networks.moge_2(tmp_path / "m.onnx", frame_rays(), shift, fixed=fixed, scalar=scalar)
    depth, _ = predict(OnnxDepth(model), image)
    assert np.isnan(depth[:, :9]).all()
    np.testing.assert_allclose(depth[:, 9:], 2.0 * (1.0 + 3.0 * image[:, 9:, 0] / 255.0), rtol=2e-4)


def test_moge_2_sees_large_images_reduced_and_the_shift_fits_all_the_same(tmp_path: Path) -> None:
    image, intrinsics = ramps(900, 600), np.array([[800.0, 0, 449.5], [0, 820.0, 299.5], [0, 0, 1.0]])
    scale = (1800 * 14**2 / (900 * 600)) ** 0.5
    width, height = round(900 * scale), round(600 * scale)
    smaller = np.array(
        [[800.0 * width / 900, 0, (width - 1) / 2], [0, 820.0 * height / 600, (height - 1) / 2], [0, 0, 1]]
    )
    model = onnx_networks.moge_2(tmp_path / "m.onnx", frame_rays(smaller, width, height), 0.9)
    depth, _ = predict(OnnxDepth(model), image, intrinsics)
    np.testing.assert_allclose(inside(depth), inside(2.0 * (1.0 + 3.0 * image[..., 0] / 255.0)), rtol=0.01)


def test_unidepth_v2_is_told_the_rays_of_what_it_sees(tmp_path: Path) -> None:
    # 60 x 40 becomes 42 x 28
    model = onnx_networks.unidepth_v2(tmp_path / "m.onnx")
    off_centre = np.array([[55.0, 0.0, 24.0], [0.0, 50.0, 23.0], [0.0, 0.0, 1.0]])
    depth, confidence = predict(OnnxDepth(model), ramps(), off_centre)
    along = 1.0 / np.linalg.norm(frame_rays(off_centre), axis=-1)
    np.testing.assert_allclose(inside(depth), inside(true_depth(ramps()) * along), rtol=0.01)
    assert confidence is None  # what it gives is an error, whose range nobody knows


def test_unidepth_v2_pads_what_has_another_shape(tmp_path: Path) -> None:
    model = onnx_networks.unidepth_v2(tmp_path / "m.onnx", (28, 70))
    depth, _ = predict(OnnxDepth(model), ramps())
    along = 1.0 / np.linalg.norm(frame_rays(), axis=-1)
    np.testing.assert_allclose(inside(depth), inside(true_depth(ramps()) * along), rtol=0.01)


def test_unidepth_v2_without_camera(tmp_path: Path) -> None:
    model = onnx_networks.unidepth_v2(tmp_path / "m.onnx", with_camera=False)
    depth, _ = predict(OnnxDepth(model), ramps())
    np.testing.assert_allclose(inside(depth), inside(true_depth(ramps())), rtol=0.01)


SIDECAR = """
image: {name: input, channels: BGR, maximum: 255, mean: [10, 20, 30], std: [50, 60, 70],
        size: {long_side: 60}}
depth: {name: out, value: VALUE, scale: metric}
"""


def other_network(path: Path, value: str, confidence: bool = False) -> Path:
    """Blue, green and red of 255, less 10, 20 and 30, over 50, 60 and 70, and 3, through ``value``."""
    graph = Graph()
    mixed = graph.mixed("input", 1, (0.2, 0.3, 0.4), 6.0)
    if value == "inverse depth":
        graph.add("Reciprocal", mixed, output="out")
    else:
        graph.add("Identity", mixed, output="out")
    outputs: list[tuple[str, list[int | str]]] = [("out", ["n", "h", "w"])]
    if confidence:
        graph.mixed("input", 1, (0.0, 0.0, 0.1), 0.0, output="uncertainty")
        outputs.append(("uncertainty", ["n", "h", "w"]))
    return graph.save(path, [("input", TensorProto.FLOAT, ["n", 3, "h", "w"])], outputs)


def other_depth(image: np.ndarray) -> np.ndarray:
    return ((image[..., ::-1] - [10.0, 20, 30]) / [50.0, 60, 70]) @ [0.2, 0.3, 0.4] + 6.0


@pytest.mark.parametrize("value", ["depth", "inverse depth", "distance"])
def test_a_sidecar_describes_any_other_network(tmp_path: Path, value: str) -> None:
    model = other_network(tmp_path / "m.onnx", value)
    (tmp_path / "m.yaml").write_text(SIDECAR.replace("VALUE", value))
    prior = OnnxDepth(model)
    depth, _ = predict(prior, ramps())
    along = 1.0 / np.linalg.norm(frame_rays(), axis=-1) if value == "distance" else 1.0
    np.testing.assert_allclose(depth, other_depth(ramps()) * along, rtol=1e-5)
    assert prior.name.startswith("m.onnx as m.yaml (")
    (tmp_path / "m.yaml").write_text(SIDECAR.replace("VALUE", value) + "validity: {}\n")
    assert OnnxDepth(model).name != prior.name


def test_confidence_may_be_an_uncertainty(tmp_path: Path) -> None:
    model = other_network(tmp_path / "m.onnx", "depth", confidence=True)
    validity = "validity: {confidence: uncertainty, better: lower}\n"
    (tmp_path / "m.yaml").write_text(SIDECAR.replace("VALUE", "depth") + validity)
    _, confidence = predict(OnnxDepth(model), ramps())
    assert confidence is not None
    np.testing.assert_allclose(confidence, np.clip(1 - 0.1 * (ramps()[..., 0] - 30.0) / 70, 0, 1), atol=1e-5)


def test_depth_is_not_mixed_across_edges(tmp_path: Path) -> None:
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[:, 30:] = 255
    near, far = true_depth(np.array([0.0, 0, 0])), true_depth(np.array([255.0, 255, 255]))
    model = onnx_networks.depth_anything_v2(tmp_path / "m.onnx", size=(28, 28))
    depth, _ = predict(OnnxDepth(model, "depth-anything-v2-metric"), image)
    # a pixel of the network covers 2.1 of the frame; one of them, at the edge, saw both
    np.testing.assert_allclose(depth[:, :26], near, rtol=0.02)
    np.testing.assert_allclose(depth[:, 34:], far, rtol=0.02)


def test_what_is_not_finite_or_not_positive_is_unknown(tmp_path: Path) -> None:
    # the logarithm of a ramp: minus infinity, negative, positive
    graph = Graph()
    red = graph.mixed("image", 1, (STD[0] * 4, 0, 0), MEAN[0] * 4)
    graph.add("Log", red, output="depth")
    path = tmp_path / "m.onnx"
    graph.save(path, [("image", TensorProto.FLOAT, [1, 3, 4, 60])], [("depth", [1, 4, 60])])
    image = np.zeros((4, 60, 3), np.uint8)
    image[..., 0] = np.arange(60) * 4
    depth, _ = predict(OnnxDepth(path, "depth-anything-v2-metric"), image)
    np.testing.assert_array_equal(np.isfinite(depth[0]), np.arange(60) * 4 > 255 / 4)


def test_a_frame_without_a_number_ends_the_run_in_one_line(tmp_path: Path) -> None:
    model = onnx_networks.depth_anything_v2(tmp_path / "m.onnx", bias=np.nan)
    with pytest.raises(DepthPriorError, match=r"m\.onnx: cam0 frame 7: .*gives no number.*float32") as caught:
        OnnxDepth(model, "depth-anything-v2-metric").predict(ramps(), K, "cam0", 7)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("bias", "said"), [(3.0, "one depth for all pixels"), (-3.0, "no depth")])
def test_a_frame_that_tells_nothing_is_unknown_with_a_warning(
    tmp_path: Path, bias: float, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    model = onnx_networks.depth_anything_v2(tmp_path / "m.onnx", weights=(0.0, 0.0, 0.0), bias=bias)
    assert OnnxDepth(model, "depth-anything-v2-metric").predict(ramps(), K, "cam0", 7) is None
    (record,) = [one for one in caplog.records if one.levelno == logging.WARNING]
    assert f"m.onnx: cam0 frame 7: depth-anything-v2-metric gives {said}" in record.getMessage()


def test_moge_2_of_nothing_but_sky_is_unknown(tmp_path: Path) -> None:
    model = onnx_networks.moge_2(tmp_path / "m.onnx", frame_rays(), 0.5)
    assert OnnxDepth(model).predict(np.full((HEIGHT, WIDTH, 3), 255, np.uint8), K, "cam0", 7) is None


@pytest.mark.parametrize(
    ("operation", "message"),
    [
        (
            lambda graph, mixed: graph.add("Unsqueeze", mixed, graph.constant([3], np.int64), output="depth"),
            None,
        ),
        (
            lambda graph, mixed: graph.add("Concat", mixed, mixed, axis=0, output="depth"),
            r"depth of shape \(2, 518, 784\); it must be \(1, H, W\)",
        ),
        (
            lambda graph, mixed: graph.add("MatMul", mixed, graph.constant(np.zeros((5, 5))), output="depth"),
            r"fails on cam0 frame 7",
        ),
    ],
)
def test_outputs_are_read_in_any_rank_and_anything_else_is_one_line(
    tmp_path: Path, operation: Callable[[Graph, str], str], message: str | None
) -> None:
    graph, path = Graph(), tmp_path / "m.onnx"
    operation(graph, graph.mixed("image", 1))
    graph.save(path, [("image", TensorProto.FLOAT, [1, 3, "h", "w"])], [("depth", [])])
    prior = OnnxDepth(path, "depth-anything-v2-metric")
    if message is None:
        assert predict(prior, ramps())[0].shape == (HEIGHT, WIDTH)
        return
    with pytest.raises(DepthPriorError, match=message) as caught:
        prior.predict(ramps(), K, "cam0", 7)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value) and "frame 7" in str(caught.value)


def test_half_precision_goes_in_where_it_is_asked_for(tmp_path: Path) -> None:
    graph = Graph()
    graph.mixed(graph.add("Cast", "image", to=TensorProto.FLOAT), 1, output="depth")
    path = tmp_path / "m.onnx"
    graph.save(path, [("image", TensorProto.FLOAT16, [1, 3, "h", "w"])], [("depth", [1, "h", "w"])])
    depth, _ = predict(OnnxDepth(path, "depth-anything-v2-metric"), ramps())
    np.testing.assert_allclose(inside(depth), inside(true_depth(ramps())), rtol=0.02)


def test_the_name_tells_models_apart_and_not_where_they_lie(tmp_path: Path) -> None:
    for folder, bias in (("a", 4.0), ("b", 4.0), ("c", 5.0)):
        (tmp_path / folder).mkdir()
        onnx_networks.depth_anything_v2(tmp_path / folder / "m.onnx", bias=bias)
    a, b, c = (OnnxDepth(tmp_path / folder / "m.onnx", "depth-anything-v2-metric").name for folder in "abc")
    assert a == b != c and a.startswith("m.onnx as depth-anything-v2-metric (")


def test_the_path_tells_a_network_from_a_folder(tmp_path: Path) -> None:
    cameras = (Camera("cam0", WIDTH, HEIGHT, 55.0, 55.0, 29.5, 19.5),)
    model = onnx_networks.depth_anything_v2(tmp_path / "m.onnx")
    assert isinstance(open_depth_prior(model, cameras, "depth-anything-v2-metric"), OnnxDepth)
    (tmp_path / "depth.onnx" / "cam0").mkdir(parents=True)
    np.save(tmp_path / "depth.onnx" / "cam0" / "000000.npy", np.ones((HEIGHT, WIDTH)))
    assert isinstance(open_depth_prior(tmp_path / "depth.onnx", cameras), DepthFiles)
    (tmp_path / "m.pt").write_bytes(b"x")
    for path, network, message in (
        (tmp_path / "none.onnx", None, r"none\.onnx: there is no such ONNX model"),
        (tmp_path / "none", None, r"none: no such folder"),
        (tmp_path / "m.pt", None, r"m\.pt: is neither an \.onnx file nor a folder"),
        (tmp_path, "moge-2", r"--depth-model moge-2 is for an \.onnx file"),
    ):
        with pytest.raises(DepthPriorError, match=message):
            open_depth_prior(path, cameras, network)
