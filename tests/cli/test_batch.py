"""``mvdyn batch``: what it says, and its exit codes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from experiments.quick import quick_capture
from mvdyn_gtsam.batch import BatchSettings, Row, State
from mvdyn_gtsam.batch.report import BatchReport
from mvdyn_gtsam.cli.main import main
from mvdyn_gtsam.reconstruction import Reconstruction
from tests.batch.stand_in import write_captures


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main(["batch", *(str(argument) for argument in arguments)])
    output = capsys.readouterr()
    return code, output.out, output.err


def last_line(text: str) -> str:
    return text.rstrip().splitlines()[-1]


def test_arguments_arrive_and_a_failed_clip_is_the_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: list[object] = []
    rows = [Row("good", State.DONE, 2, 41, 1.0, 33.2, 512.0)]

    def stand_in(folder, out, config, settings, *, progress, on_row):  # type: ignore[no-untyped-def]
        seen[:] = [folder, out, config, settings]
        for done, row in enumerate(rows):
            on_row(row)
            progress.update("batch", done + 1, len(rows), row.clip)
        return BatchReport(settings.stage, tuple(rows))

    monkeypatch.setattr("mvdyn_gtsam.batch.run_batch", stand_in)
    words = [tmp_path / "clips", "--out", tmp_path / "out", "--set", "tracking.window=20"]
    words += ["--stage", "tracking", "--workers", 2, "--threads-per-worker", 3, "--retries", 1]
    words += ["--timeout", 60, "--no-evaluate", "--skip-failed"]
    words += ["--depth-prior", "m.onnx", "--depth-model", "moge-2"]
    code, out, err = run(capsys, *words)
    assert seen == [
        tmp_path / "clips",
        tmp_path / "out",
        {"tracking": {"window": 20}},
        BatchSettings(
            *("tracking", 2, 3, None, 1, 60.0),
            evaluate=False,
            skip_failed=True,
            depth_priors=Path("m.onnx"),
            depth_model="moge-2",
        ),
    ]
    assert code == 0 and "good" in out and "2 x 41" in out
    assert "good: done, 33 s" in err and "batch 1/1" in err

    rows.append(Row("bad", State.FAILED, problem="cam0.mp4: the file is empty"))
    code, out, err = run(capsys, tmp_path / "clips", "--out", tmp_path / "out", "--scheduler", "tcp://a:1")
    assert isinstance(seen[3], BatchSettings) and seen[3].scheduler == "tcp://a:1"
    assert code == 1 and "bad: failed: cam0.mp4: the file is empty" in err
    assert last_line(err).startswith("mvdyn: 1 of 2 clips failed; see ")


@pytest.mark.parametrize(
    "words",
    [
        ["--workers", "0"],
        ["--workers", "two"],
        ["--timeout", "0"],
        ["--timeout", "soon"],
        ["--retries", "-1"],
        ["--threads-per-worker", "1.5"],
        ["--workers", "2", "--scheduler", "tcp://a:1"],
    ],
)
def test_wrong_arguments_are_one_line(
    tmp_path: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, err = run(capsys, tmp_path, "--out", tmp_path / "out", *words)
    assert code == 2 and len(err.splitlines()) == 1 and words[0] in err


def test_what_cannot_be_started_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    clips = write_captures(tmp_path / "clips", {"one": {}})
    (tmp_path / "file").touch()
    out = ["--out", tmp_path / "out"]
    for words, line in (
        ([empty, *out], "holds no captures"),
        ([tmp_path / "nothing", *out], "there is no such folder"),
        ([clips / "one", *out], "is one capture itself"),
        ([clips, "--out", tmp_path / "file" / "out"], "cannot be written"),
        ([clips, *out, "--set", "tracking.windw=20"], "did you mean"),
    ):
        code, _, err = run(capsys, *words)
        assert code == 1 and line in err and len(err.splitlines()) == 1, err
        assert not (tmp_path / "out").exists()
    monkeypatch.setitem(sys.modules, "distributed", None)
    code, _, err = run(capsys, clips, *out)
    assert code == 1 and err == "mvdyn: batch needs Dask distributed: pip install 'mvdyn_gtsam[batch]'\n"


def test_ground_truth_without_the_means_to_score_is_said_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clips = write_captures(tmp_path / "clips", {"one": {}})
    (clips / "one" / "groundtruth").mkdir()
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    code, _, err = run(capsys, clips, "--out", tmp_path / "out")
    assert code == 1 and "scoring needs evo: pip install 'mvdyn_gtsam[eval]', or add --no-evaluate" in err


def _heed_ctrl_c() -> None:
    """A job that a shell put into the background ignores Ctrl-C, and hands that down to its children."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.slow
def test_two_captures_interrupted_by_ctrl_c_and_gone_on_with(tmp_path: Path) -> None:
    folder, out = tmp_path / "clips", tmp_path / "out"
    for cameras, frames in ((2, 10), (2, 11)):
        quick_capture(folder, cameras, frames)
    shutil.copytree(folder / "quick_2x10", folder / "broken")
    next((folder / "broken" / "cam0").iterdir()).write_bytes(b"")
    command = [sys.executable, "-m", "mvdyn_gtsam", "batch", str(folder), "--out", str(out)]
    command += ["--stage", "tracking", "--workers", "2"]
    first = subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, start_new_session=True, preexec_fn=_heed_ctrl_c
    )
    while not list(out.glob("quick*/manifest.json")):
        assert first.poll() is None
        time.sleep(0.05)
    os.killpg(first.pid, signal.SIGINT)  # as a terminal does: to every process of the job
    err = first.communicate(timeout=60)[1]
    assert first.returncode == 130, err
    assert [line for line in err.splitlines() if line.strip()][-2:] == [
        "stopped; what is finished is kept, and the same command goes on",
        "mvdyn: interrupted",
    ]
    assert "Traceback" not in err
    assert not [p for p in psutil.process_iter(["cmdline"]) if str(out) in (p.info["cmdline"] or [])]

    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1, done.stderr
    assert last_line(done.stderr).startswith("mvdyn: 1 of 3 clips failed")
    rows = {row["clip"]: row for row in json.loads((out / "batch.json").read_text())["clips"]}
    assert rows["broken"]["state"] == "failed" and "broken/" in rows["broken"]["problem"]
    for name in ("quick_2x10", "quick_2x11"):
        row = rows.pop(name)
        assert row["state"] in ("done", "resumed", "kept") and row["registered"] == 1.0
        assert row["cameras"] == 2 and row["ate_m"] < 0.05 and 0.0 < row["abs_rel"] < 0.5
        assert Reconstruction.load(out / name).status == "complete"
