"""``mvdyn compare`` and ``mvdyn evaluate`` on results of other methods: what is asked for and refused."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvdyn_gtsam import baselines
from mvdyn_gtsam.cli.main import main
from mvdyn_gtsam.demo import demo_capture
from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.reconstruction.files import read_tum

pytest.importorskip("evo", reason="evo, the eval extra, is not installed")

CAMERAS = ("cam0", "cam1")


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    code = main([str(word) for word in words])
    output = capsys.readouterr()
    return code, output.out, output.err


def last_line(text: str) -> str:
    return text.rstrip().splitlines()[-1]


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    """The true poses of the demo as world-to-camera matrices, the last frame lost."""
    poses = {camera: read_tum(demo_capture() / "groundtruth" / f"{camera}.txt")[1] for camera in CAMERAS}
    cTw = {camera: invert_pose(wTc) for camera, wTc in poses.items()}
    cTw["cam1"][-1] = np.nan
    folder = tmp_path / "vggt"
    folder.mkdir()
    np.savez(
        folder / "poses.npz", allow_pickle=False, convention="cTw", **{c: p[:, :3] for c, p in cTw.items()}
    )
    return folder


def test_compare_takes_a_result_made_elsewhere(
    foreign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    words = ["compare", demo_capture(), "--methods", "", "--method", f"vggt={foreign}", "--out", out]
    code, said, err = run(capsys, *words)
    assert code == 0, err
    assert re.search(r"vggt +98\.8 +0\.0000 .* - +- *$", said, re.MULTILINE)
    (row,) = json.loads((out / "compare.json").read_text())["methods"]
    assert row["seconds"] is None and row["scores"]["ate_m"] < 1e-6
    assert row["registered"] == pytest.approx(81 / 82)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--method", "vggt"], "write NAME=PATH"),
        (["--method", "=runs"], "write NAME=PATH"),
        (["--method", "a=x", "--method", "a=y"], "given twice"),
        (["--method", "colmap=x"], "a method of its own; rename it"),
        (["--method", "vggt=nowhere"], "nowhere: there is no such file"),
        (["--methods", "vggt"], "given as --method NAME=PATH"),
        (["--methods", ""], "no method to compare"),
        (["--methods", "glomap-retrieval"], "--descriptor, or compare with glomap-exhaustive"),
        (["--methods", "glomap-masks"], "has masks of 5 of 41 frames"),
        (["--methods", "glomap", "--masks", "m"], "add colmap-masks or glomap-masks"),
        (["--methods", "glomap", "--descriptor", "m"], "add colmap-retrieval or glomap-retrieval"),
        (["--methods", "glomap-retrieval", "--descriptor", "m.onnx"], "no such ONNX model"),
        (["--methods", "glomap", "--retrieval-pairs", "0"], "at least 1"),
    ],
)
def test_mistakes_are_one_line_before_anything_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    code, _, err = run(capsys, "compare", demo_capture(), "--out", tmp_path / "out", *words)
    assert code == 1 and message in last_line(err), err
    assert len(err.strip().splitlines()) == 1 and not (tmp_path / "out").exists()


def test_compare_passes_everything_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: dict[str, Any] = {}

    def compare(capture: Path, groundtruth: Path, methods: list[str], out: Path, **options: Any) -> Any:
        asked.update(options, methods=methods)
        row = baselines.MethodResult("a", None, None, 1.0, 1.0, 10.0, out / "a")
        return baselines.Comparison("robodog", (row,))

    monkeypatch.setattr(baselines, "compare", compare)
    words = [
        "--methods",
        "ours, glomap-masks,glomap-retrieval",
        "--method",
        "vggt=runs/a=b",
        "--stage",
        "refinement",
    ]
    words += ["--masks", "m", "--descriptor", "d.onnx", "--retrieval-pairs", "9", "--database", "db"]
    words += ["--estimate-focal"]
    code, _, err = run(capsys, "compare", demo_capture(), "--out", tmp_path, *words)
    assert code == 0, err
    assert asked["methods"] == ["ours", "glomap-masks", "glomap-retrieval"]
    assert asked["imported"] == {"vggt": Path("runs/a=b")}
    assert asked["stage"] == "refinement" and asked["database"] == Path("db") and asked["estimate_focal"]
    assert asked["settings"] == baselines.BaselineSettings(
        masks=Path("m"), descriptor=Path("d.onnx"), retrieval_pairs=9
    )


def test_the_help_names_every_method_and_layout(capsys: pytest.CaptureFixture[str]) -> None:
    text = run(capsys, "compare", "--help")[1]
    words = set(re.findall(r"[\w./<>-]+", text))
    assert {*baselines.BASELINES, "ours"} <= words
    for wanted in (
        "TUM",
        "COLMAP model",
        "transforms.json",
        ".npz",
        "OpenGL",
        "import.json",
        "depth_scale",
        "estimate",
    ):
        assert wanted in text
    assert "compare --help" in run(capsys, "evaluate", "--help")[1]


def test_evaluate_reads_a_result_made_elsewhere(
    foreign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth, scores = demo_capture() / "groundtruth", tmp_path / "scores.json"
    code, out, err = run(capsys, "evaluate", foreign / "poses.npz", "--groundtruth", truth, "--json", scores)
    assert code == 0 and "INCOMPLETE" in out, err
    figures = json.loads(scores.read_text())
    assert figures["ate_m"] < 1e-6 and figures["registered"] == pytest.approx(81 / 82)
    assert figures["per_camera"]["cam0"]["registered"] == 1.0


def test_evaluate_needs_the_capture_of_such_a_result(
    foreign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(demo_capture() / "groundtruth", tmp_path / "alone" / "groundtruth")
    words = ["evaluate", foreign, "--groundtruth", tmp_path / "alone" / "groundtruth"]
    code, _, err = run(capsys, *words)
    assert code == 1 and "name it with --capture" in last_line(err) and str(foreign) in err
    code, _, err = run(capsys, *words, "--capture", demo_capture())
    assert code == 0, err
    code, _, err = run(capsys, *words, "--capture", tmp_path / "nowhere")
    assert code == 1 and "nowhere" in last_line(err)
    code, _, err = run(capsys, "evaluate", tmp_path / "none", *words[2:])
    assert code == 1 and "none: no such file or folder" in last_line(err)
