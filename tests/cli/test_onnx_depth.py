"""``mvdyn reconstruct --depth-prior model.onnx``, from PNG files to the result, on a tiny rendered scene.

Blue of its images tells the true depth, which a graph with the signature of Depth-Anything-V2 reads: a
network that is right.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

import mvdyn_gtsam.pipeline
from mvdyn_gtsam.cli.main import main
from mvdyn_gtsam.frontend.depth_priors.depth_models import USABLE
from mvdyn_gtsam.reconstruction import Reconstruction
from tests.frontend.depth_priors.onnx_networks import MEAN, STD, depth_anything_v2
from tests.tracking.synthetic_scene import Scene, two_cameras

METRES = 8.0
"""Depth of blue at its brightest."""
SETTINGS = ("tracking.grid_points=300", "tracking.keyframe_px=0.5", "graph.long_range_separation=6")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return two_cameras(count=4)


@pytest.fixture
def capture(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A capture of the scene; the start is given, since the scene is too small to be mapped."""
    cameras = []
    for view, images, depths in zip(scene.cameras, scene.images, scene.depths, strict=True):
        (tmp_path / "clip" / view.name).mkdir(parents=True)
        for time, (image, depth) in enumerate(zip(images, depths, strict=True)):
            coded = image.copy()
            coded[..., 2] = np.rint(255.0 * depth / METRES)
            cv2.imwrite(str(tmp_path / "clip" / view.name / f"{time:03d}.png"), coded[..., ::-1])
        keys = ("name", "width", "height", "fx", "fy", "cx", "cy")
        cameras.append({key: getattr(view, key) for key in keys} | {"source": f"{view.name}/*.png"})
    description = {"name": "planes", "fps": 10.0, "cameras": cameras}
    (tmp_path / "clip" / "capture.json").write_text(json.dumps(description))
    start = scene.start(((0, 1),), times=(0, 3))
    monkeypatch.setattr(
        mvdyn_gtsam.pipeline, "ClassicalInitializer", lambda *_: lambda capture, progress: start
    )
    return tmp_path / "clip"


def network(path: Path, weight: float = METRES) -> Path:
    return depth_anything_v2(path, weights=(0.0, 0.0, weight * STD[2]), bias=weight * MEAN[2])


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str]:
    words = [*(str(one) for one in arguments), "--stage", "tracking"]
    code = main(["reconstruct", *words, *(word for one in SETTINGS for word in ("--set", one))])
    return code, capsys.readouterr().err


def error(result: Reconstruction, scene: Scene) -> float:
    """Relative, of the depth that a tenth exceeds, after one scale."""
    ratio = np.concatenate(
        [
            (result.depth(view.name, time) / depth).ravel()
            for view, depths in zip(scene.cameras, scene.depths, strict=True)
            for time, depth in enumerate(depths)
        ]
    )
    return float(np.nanquantile(np.abs(ratio / np.nanmedian(ratio) - 1.0), 0.9))


def test_a_network_that_is_right_gives_better_depth(
    capture: Path, scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = network(tmp_path / "blue.onnx")
    code, said = run(capsys, capture, "--out", tmp_path / "without")
    assert code == 0, said
    words = [capture, "--out", tmp_path / "with", "--depth-prior", model]
    code, said = run(capsys, *words, "--depth-model", "depth-anything-v2-metric")
    assert code == 0, said
    result = Reconstruction.load(tmp_path / "with")
    assert error(result, scene) < 0.7 * error(Reconstruction.load(tmp_path / "without"), scene)
    assert result.manifest["depth_prior"].startswith("blue.onnx as depth-anything-v2-metric (")
    (fit,) = result.diagnostics("depth_prior")
    assert fit["scale"] == pytest.approx(1.0, abs=0.05) and fit["median_error"] < 0.05


def test_a_run_goes_on_with_its_network_only(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    right, other = network(tmp_path / "blue.onnx"), tmp_path / "other"
    other.mkdir()
    words = [capture, "--out", tmp_path / "o", "--depth-model", "depth-anything-v2-metric", "--depth-prior"]

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(mvdyn_gtsam.pipeline, "_track", stop)
        assert run(capsys, *words, right)[0] == 130
    code, said = run(capsys, capture, "--out", tmp_path / "o", "--resume")
    assert code == 1 and "began with the depth prior blue.onnx as depth-anything-v2-metric" in said
    # it may lie elsewhere by now
    (other / "moved").mkdir()
    moved = right.rename(other / "moved" / "blue.onnx")
    assert run(capsys, *words, moved, "--resume")[0] == 0
    before = (tmp_path / "o" / "manifest.json").read_bytes()
    code, said = run(capsys, *words, network(other / "blue.onnx", 9.0), "--resume")
    assert code == 1 and "was made with the depth prior blue.onnx as depth-anything-v2-metric (" in said
    assert (tmp_path / "o" / "manifest.json").read_bytes() == before
    assert run(capsys, capture, "--out", tmp_path / "o", "--resume")[0] == 0


def test_a_network_that_breaks_half_way_loses_nothing(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [capture, "--out", tmp_path / "o", "--depth-model", "depth-anything-v2-metric", "--depth-prior"]
    code, said = run(capsys, *words, network(tmp_path / "nan.onnx", np.nan))
    line = said.rstrip().splitlines()[-1]
    assert code == 1 and line.startswith(f"mvdyn: {tmp_path / 'nan.onnx'}: cam0 frame 0: ")
    assert "gives no number in depth; export it in float32" in line
    result = Reconstruction.load(tmp_path / "o")
    assert (
        result.status == "failed"
        and result.stages == ["start"]
        and not (result.folder / "predictions").exists()
    )
    assert run(capsys, *words, network(tmp_path / "blue.onnx"), "--resume")[0] == 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--depth-prior", "{tmp}/blue.onnx"],
            "both do; if it is depth-anything-v2-metric, add --depth-model",
        ),
        (
            ["--depth-prior", "{tmp}/blue.onnx", "--depth-model", "moge-2"],
            "moge-2 takes image float (1, 3, H, W), num_tokens int64 (one number) and gives points, mask",
        ),
        (
            ["--depth-prior", "{tmp}/blue.onnx", "--depth-model", "depth-anything-v2"],
            "use its metric variant",
        ),
        (["--depth-prior", "{tmp}/none.onnx"], "none.onnx: there is no such ONNX model"),
        (["--depth-prior", "{tmp}/clip/capture.json"], "is neither an .onnx file nor a folder of depths"),
        (["--depth-prior", "{tmp}", "--depth-model", "moge-2"], "is for an .onnx file"),
        (["--depth-model", "moge-2"], "needs the network's file, --depth-prior MODEL.onnx"),
    ],
)
def test_what_cannot_be_a_prior_is_one_line_before_any_work(
    words: list[str], message: str, capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network(tmp_path / "blue.onnx")
    filled = [word.format(tmp=tmp_path) for word in words]
    code, said = run(capsys, capture, "--out", tmp_path / "o", *filled)
    assert code == 1 and len(said.splitlines()) == 1 and message in said
    assert not (tmp_path / "o").exists()


def test_the_help_names_every_network(capsys: pytest.CaptureFixture[str]) -> None:
    for verb in ("reconstruct", "batch"):
        assert main([verb, "--help"]) == 0
        said = "".join(capsys.readouterr().out.split())
        assert all(name in said for name in USABLE)
