"""Small ONNX graphs with the signatures of real depth networks, whose outputs can be computed by hand.

Names, types, ranks and dynamic axes are those of the export scripts that
``mvdyn_gtsam/frontend/depth_models.py`` names; what is between them is a sum of the colours.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

MEAN, STD = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
Shape = Sequence[int | str]

WEIGHTS, BIAS = (0.5, 0.25, -0.125), 4.0
"""Of the depth that most of the graphs give: a sum of the three planes they see."""


def true_depth(colour: np.ndarray) -> np.ndarray:
    """Of pixels ``(..., 3) uint8`` RGB, as a network sees them that wants ImageNet's normalisation."""
    return (colour / 255.0 - MEAN) / STD @ np.array(WEIGHTS) + BIAS


class Graph:
    """Nodes that are added one after the other, and saved."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, value: Any, kind: Any = np.float32) -> str:
        name = f"constant{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value, kind), name))
        return name

    def add(self, operation: str, *inputs: str, output: str | None = None, **attributes: Any) -> str:
        output = output or f"value{len(self.nodes)}"
        self.nodes.append(helper.make_node(operation, list(inputs), [output], **attributes))
        return output

    def mixed(
        self,
        image: str,
        axis: int,
        weights: Sequence[float] = WEIGHTS,
        bias: float = BIAS,
        *,
        keep: bool = False,
        output: str | None = None,
    ) -> str:
        """``bias`` plus the planes along ``axis`` of the image times ``weights``."""
        shape = [1] * axis + [3, 1, 1]
        parts = self.add("Mul", image, self.constant(np.reshape(weights, shape)))
        total = self.add("ReduceSum", parts, self.constant([axis], np.int64), keepdims=int(keep))
        return self.add("Add", total, self.constant(bias), output=output)

    def save(
        self, path: Path, inputs: Sequence[tuple[str, Any, Shape]], outputs: Sequence[tuple[str, Shape]]
    ) -> Path:
        graph = helper.make_graph(
            self.nodes,
            "network",
            [helper.make_tensor_value_info(name, kind, list(shape)) for name, kind, shape in inputs],
            [helper.make_tensor_value_info(name, TensorProto.FLOAT, list(shape)) for name, shape in outputs],
            self.constants,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)])
        model.ir_version = 8
        onnx.checker.check_model(model)
        onnx.save(model, str(path))
        return path


def depth_anything_v2(
    path: Path,
    names: tuple[str, str] = ("image", "depth"),
    size: tuple[int | str, int | str] = ("height", "width"),
    *,
    weights: Sequence[float] = WEIGHTS,
    bias: float = BIAS,
) -> Path:
    """As Depth-Anything-ONNX exports it, or onnx-community: ``pixel_values``, ``predicted_depth``."""
    graph = Graph()
    graph.mixed(names[0], 1, weights, bias, output=names[1])
    image = (names[0], TensorProto.FLOAT, ["batch_size", 3, *size])
    return graph.save(path, [image], [(names[1], ["batch_size", *size])])


def depth_anything_3_metric(path: Path, rank: int = 4, size: tuple[int, int] = (28, 42)) -> Path:
    """As ros2-depth-anything-v3-trt exports it, or with the views of Depth-Anything-3; blue is the sky."""
    graph = Graph()
    graph.mixed("image", rank - 3, keep=rank == 4, output="depth")
    graph.mixed("image", rank - 3, (0.0, 0.0, STD[2]), MEAN[2], keep=rank == 4, output="sky")
    ones: list[int | str] = [1] if rank == 4 else [1, "N"]
    outputs = [(name, [1, 1 if rank == 4 else "N", *size]) for name in ("depth", "sky")]
    return graph.save(path, [("image", TensorProto.FLOAT, [*ones, 3, *size])], outputs)


def depth_anything_3(path: Path) -> Path:
    """As onnx-community exports DA3-BASE."""
    graph = Graph()
    graph.mixed("pixel_values", 2, output="predicted_depth")
    graph.mixed("pixel_values", 2, output="confidence")
    for name, shape in (("extrinsics", (1, 1, 3, 4)), ("intrinsics", (1, 1, 3, 3))):
        graph.add("Identity", graph.constant(np.zeros(shape)), output=name)
    sides = ["batch_size", "num_images", "height", "width"]
    return graph.save(
        path,
        [("pixel_values", TensorProto.FLOAT, [*sides[:2], 3, *sides[2:]])],
        [("predicted_depth", sides), ("confidence", sides), ("extrinsics", "abcd"), ("intrinsics", "abcd")],
    )


def moge_2(
    path: Path,
    rays: np.ndarray,
    shift: float,
    *,
    fixed: bool = False,
    scalar: bool = True,
    red: float = 3.0,
) -> Path:
    """As docs/onnx.md of MoGe exports it, for images of the size of ``rays (H, W, 3)`` with z = 1.

    z is 1 and ``red`` times red, less ``shift``; the mask is 1 less blue; metric_scale is num_tokens / 900.
    """
    graph = Graph()
    z = graph.mixed("image", 1, (red, 0.0, 0.0), 1.0)
    z = graph.add("Unsqueeze", z, graph.constant([3], np.int64))
    points = graph.add("Mul", z, graph.constant(rays[None]))
    graph.add("Sub", points, graph.constant([0.0, 0.0, shift]), output="points")
    graph.add("Identity", "points", output="normal")
    graph.mixed("image", 1, (0.0, 0.0, -1.0), 1.0, output="mask")
    tokens = graph.constant(1800.0) if fixed else graph.add("Cast", "num_tokens", to=TensorProto.FLOAT)
    tokens = graph.add("Reshape", tokens, graph.constant([1], np.int64))
    graph.add("Div", tokens, graph.constant(900.0), output="metric_scale")
    sides: list[int | str] = list(rays.shape[:2]) if fixed else ["height", "width"]
    batch: int | str = 1 if fixed else "batch_size"
    inputs: list[tuple[str, Any, Shape]] = [("image", TensorProto.FLOAT, [batch, 3, *sides])]
    inputs += [] if fixed else [("num_tokens", TensorProto.INT64, [] if scalar else [1])]
    outputs: list[tuple[str, Shape]] = [
        ("points", [batch, *sides, 3]),
        ("normal", [batch, *sides, 3]),
        ("mask", [batch, *sides]),
        ("metric_scale", [batch]),
    ]
    return graph.save(path, inputs, outputs)


def unidepth_v2(path: Path, size: tuple[int, int] = (28, 42), *, with_camera: bool = True) -> Path:
    """As UniDepth's export.py makes it; the radius along the rays is the sum of the colours."""
    graph = Graph()
    radius = graph.mixed("rgbs", 1, keep=True)
    straight = graph.constant(np.broadcast_to(np.reshape([0.0, 0.0, 1.0], (1, 3, 1, 1)), (1, 3, *size)))
    graph.add("Mul", "rays" if with_camera else straight, radius, output="pts_3d")
    graph.add("Identity", radius, output="confidence")
    graph.add("Identity", graph.constant(np.eye(3)[None]), output="intrinsics")
    image: list[tuple[str, Any, Shape]] = [("rgbs", TensorProto.FLOAT, ["batch", 3, *size])]
    rays: list[tuple[str, Any, Shape]] = [("rays", TensorProto.FLOAT, ["batch", 3, *size])]
    return graph.save(
        path,
        image + (rays if with_camera else []),
        [
            ("pts_3d", ["batch", 3, *size]),
            ("confidence", ["batch", 1, *size]),
            ("intrinsics", ["batch", 3, 3]),
        ],
    )
