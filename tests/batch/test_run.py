"""Whole batches on Dask processes; a stand-in takes the place of the reconstruction."""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
import pytest

from mvdyn_gtsam.batch import BatchError, BatchReport, BatchSettings, Clip, Row, State, guard, run_batch
from mvdyn_gtsam.batch.scheduling import local_cluster, remote_cluster, run_clips
from mvdyn_gtsam.config import load_config
from mvdyn_gtsam.errors import DepthPriorError
from mvdyn_gtsam.frontend.depth_priors.onnx_depth import OnnxDepth
from tests.batch import stand_in
from tests.batch.stand_in import true_poses, write_captures
from tests.evaluation.fakes import write_groundtruth
from tests.frontend.depth_priors.onnx_networks import depth_anything_v2

SETTINGS = BatchSettings(
    stage="tracking", workers=2, threads=1, command=(sys.executable, "-S", stand_in.__file__)
)


@pytest.fixture(scope="module")
def settings() -> Iterator[BatchSettings]:
    """A running scheduler with two workers, once for all: each start takes seconds."""
    with local_cluster(2, retries=3) as client:
        yield dataclasses.replace(SETTINGS, scheduler=client.scheduler_info()["address"])


def states(report: BatchReport) -> dict[str, str]:
    return {row.clip: row.state.value for row in report.rows}


def trace(out: Path, name: str) -> list[str]:
    return [line.split()[0] for line in (out / f"{name}.trace").read_text().splitlines()]


def worker_of(clip: str) -> psutil.Process | None:
    """The Dask worker whose process works on ``clip``, once that has begun."""
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):
            if process.cmdline()[2:3] == [guard.__file__] and clip in process.cmdline()[3]:
                return process.parents()[1]
    return None


def wait_until(condition: Callable[[], bool], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def test_twelve_clips_finish_though_a_worker_is_killed(tmp_path: Path) -> None:
    # The acceptance test of the batch: 12 clips, 2 workers, one of them killed in the middle.
    clips: dict[str, dict[str, Any]] = {f"clip{n:02d}": {"seconds": 0.1} for n in range(12)}
    clips["clip04"] = {"seconds": 60.0}  # the first attempt: the other worker comes far meanwhile
    folder, out = write_captures(tmp_path / "clips", clips), tmp_path / "out"
    killed: list[psutil.Process] = []

    def kill_one(row: Row) -> None:
        if row.clip == "clip07":
            wait_until(lambda: (out / "clip04.trace").exists())
            worker = worker_of("clip04")
            assert worker is not None
            worker.kill()
            killed.append(worker)

    report = run_batch(folder, out, settings=SETTINGS, on_row=kill_one)
    assert len(killed) == 1
    assert states(report) == dict.fromkeys(clips, "done"), report.to_markdown()
    # It was begun again once the killed worker's process was gone; nothing else was done twice.
    assert trace(out, "clip04") == ["start", "start", "end"]
    assert all(trace(out, name) == ["start", "end"] for name in clips if name != "clip04")


def test_failures_stop_nobody_and_a_second_run_does_only_what_is_left(
    tmp_path: Path, settings: BatchSettings
) -> None:
    tasks: dict[str, dict[str, Any]] = {
        "bad": {"fails": "cam0.mp4: cut short"},
        "crash": {"killed": "always"},
        "good": {},
        "late": {"seconds": 30},
        "unlucky": {"killed": "once"},
    }
    folder, out = write_captures(tmp_path / "clips", tasks), tmp_path / "out"
    write_groundtruth(folder / "good", {f"cam{n}": true_poses(n, 4) for n in range(2)})
    settings = dataclasses.replace(settings, retries=1, timeout_s=6.0)
    report = run_batch(folder, out, settings=settings)
    rows = {row.clip: row for row in report.rows}
    assert states(report) == {
        "bad": "failed", "crash": "failed", "good": "done", "late": "failed", "unlucky": "done"
    }  # fmt: skip
    assert rows["bad"].problem == "mvdyn: cam0.mp4: cut short (exit code 1)"
    assert "killed by SIGKILL" in str(rows["crash"].problem)
    assert rows["late"].problem == "stopped after 6 s"
    assert trace(out, "crash") == ["start", "start"] and trace(out, "late") == ["start"]
    good = rows["good"]
    assert (good.cameras, good.frames, good.registered) == (2, 4, 1.0)
    assert good.seconds is not None and good.peak_mb is not None and good.peak_mb > 5
    assert good.ate_m is not None and good.ate_m < 1e-6
    assert json.loads((out / "batch.json").read_text()) == report.to_json()
    assert "* bad: mvdyn: cam0.mp4: cut short (exit code 1)" in (out / "batch.md").read_text()
    # Its process may use one thread, and so may its pool.
    assert "--set refinement.workers=1" in (out / "good.trace").read_text()

    (folder / "bad" / "task.json").write_text("{}")
    (folder / "late" / "task.json").write_text("{}")
    (folder / "crash" / "task.json").write_text("{}")
    skipped = run_batch(folder, out, settings=dataclasses.replace(settings, skip_failed=True))
    assert states(skipped) == {**states(report), "good": "kept", "unlucky": "kept"}
    again = {row.clip: row for row in run_batch(folder, out, settings=settings).rows}
    assert {name: row.state.value for name, row in again.items()} == {
        "bad": "done", "crash": "done", "good": "kept", "late": "done", "unlucky": "kept"
    }  # fmt: skip
    assert again["good"] == dataclasses.replace(good, state=State.KEPT)
    assert trace(out, "good") == ["start", "end"]


def test_every_clip_is_given_its_depth_prior(
    tmp_path: Path, settings: BatchSettings, caplog: pytest.LogCaptureFixture
) -> None:
    folder, out = write_captures(tmp_path / "clips", {"with": {}, "without": {}}), tmp_path / "out"
    settings = dataclasses.replace(settings, depth_priors=tmp_path / "depths")
    with pytest.raises(BatchError, match="depths: holds no depth prior"):
        run_batch(folder, out, settings=settings)
    (tmp_path / "depths" / "with").mkdir(parents=True)
    assert states(run_batch(folder, out, settings=settings)) == {"with": "done", "without": "done"}
    assert f"--depth-prior {tmp_path / 'depths' / 'with'}" in (out / "with.trace").read_text()
    assert "--depth-prior" not in (out / "without.trace").read_text()
    assert "no depth prior for without" in caplog.text


def test_a_result_without_the_depth_prior_that_is_asked_for_is_not_kept(
    tmp_path: Path, settings: BatchSettings
) -> None:
    folder, out = write_captures(tmp_path / "clips", {"clip": {}}), tmp_path / "out"
    run_batch(folder, out, settings=settings)
    (tmp_path / "depths" / "clip").mkdir(parents=True)
    settings = dataclasses.replace(settings, depth_priors=tmp_path / "depths")
    report = run_batch(folder, out, settings=settings)
    # the stand-in cannot write where a result is; mvdyn says what differs
    assert states(report) == {"clip": "failed"} and trace(out, "clip") == ["start", "end", "start"]


def test_one_network_serves_every_clip_and_is_checked_first(tmp_path: Path, settings: BatchSettings) -> None:
    folder, out = write_captures(tmp_path / "clips", {"a": {}, "b": {}}), tmp_path / "out"
    model = depth_anything_v2(tmp_path / "m.onnx")
    settings = dataclasses.replace(settings, depth_priors=model)
    with pytest.raises(DepthPriorError, match="add --depth-model depth-anything-v2-metric"):
        run_batch(folder, out, settings=settings)
    assert not out.exists()
    settings = dataclasses.replace(settings, depth_model="depth-anything-v2-metric")
    assert states(run_batch(folder, out, settings=settings)) == {"a": "done", "b": "done"}
    for name in "ab":
        said = (out / f"{name}.trace").read_text()
        assert f"--depth-prior {model} --depth-model depth-anything-v2-metric" in said
    # the stand-in's result does not tell of a network; one that tells of this is kept
    manifest = json.loads((out / "a" / "manifest.json").read_text())
    manifest["depth_prior"] = OnnxDepth(model, "depth-anything-v2-metric").name
    (out / "a" / "manifest.json").write_text(json.dumps(manifest))
    assert states(run_batch(folder, out, settings=settings)) == {"a": "kept", "b": "failed"}
    assert trace(out, "a") == ["start", "end"]
    settings = dataclasses.replace(settings, depth_priors=None)
    with pytest.raises(DepthPriorError, match="needs the network's file"):
        run_batch(folder, out, settings=settings)


def test_an_interrupted_batch_leaves_no_process_and_goes_on(tmp_path: Path, settings: BatchSettings) -> None:
    tasks: dict[str, dict[str, Any]] = {f"clip{n}": {"seconds": 0.0 if n == 0 else 30.0} for n in range(4)}
    folder, out = write_captures(tmp_path / "clips", tasks), tmp_path / "out"

    def interrupt(row: Row) -> None:
        wait_until(lambda: (out / "clip1.trace").exists())
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_batch(folder, out, settings=settings, on_row=interrupt)
    assert [
        p for p in psutil.process_iter(["cmdline"]) if str(out) in " ".join(p.info["cmdline"] or [])
    ] == []
    rows = json.loads((out / "batch.json").read_text())["clips"]
    assert [row["state"] for row in rows] == ["done"] + ["unfinished"] * 3
    for n in range(4):
        (folder / f"clip{n}" / "task.json").write_text("{}")
    assert states(run_batch(folder, out, settings=settings)) == {
        "clip0": "kept", "clip1": "done", "clip2": "done", "clip3": "done"
    }  # fmt: skip


def test_a_result_of_another_configuration_is_not_taken_for_finished(
    tmp_path: Path, settings: BatchSettings
) -> None:
    folder, out = write_captures(tmp_path / "clips", {"clip": {}}), tmp_path / "out"
    run_batch(folder, out, settings=settings)
    # No stage that ran has used the refinement's settings.
    unused = load_config(None, ["refinement.stride=4", "refinement.workers=2"])
    assert states(run_batch(folder, out, unused, settings)) == {"clip": "kept"}
    (folder / "clip" / "task.json").write_text('{"fails": "made with another configuration"}')
    # Nor does a default that changed matter, or a setting that is new: nobody asked for either.
    manifest = json.loads((out / "clip" / "manifest.json").read_text())
    manifest["config"]["tracking"]["window"] = 30
    del manifest["config"]["tracking"]["step_iterations"]
    (out / "clip" / "manifest.json").write_text(json.dumps(manifest))
    assert states(run_batch(folder, out, settings=settings)) == {"clip": "kept"}
    assert json.loads((out / ".batch" / "config.json").read_text()) == {}
    other = load_config(None, ["tracking.window=20"])
    report = run_batch(folder, out, other, settings)
    assert states(report) == {"clip": "failed"} and "another configuration" in str(report.rows[0].problem)


def test_a_damaged_result_stops_no_other_clip(tmp_path: Path, settings: BatchSettings) -> None:
    folder, out = write_captures(tmp_path / "clips", {"damaged": {}, "whole": {}}), tmp_path / "out"
    (out / "damaged").mkdir(parents=True)
    (out / "damaged" / "manifest.json").write_text('{"format": "mvdyn-reconstruction"')
    report = run_batch(folder, out, settings=settings)
    assert states(report) == {"damaged": "failed", "whole": "done"}
    assert "damaged/manifest.json: cannot be read" in str(report.rows[0].problem)


def test_a_folder_that_cannot_be_used_is_refused(tmp_path: Path) -> None:
    folder = write_captures(tmp_path / "clips", {"clip": {}})
    (tmp_path / "file").touch()
    with pytest.raises(BatchError, match="file/out: cannot be written .*; choose another --out"):
        run_batch(folder, tmp_path / "file" / "out", settings=SETTINGS)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "batch.json").write_text("[]")
    with pytest.raises(BatchError, match=r"batch\.json: is not the table of a batch"):
        run_batch(folder, tmp_path / "out", settings=SETTINGS)


def test_two_batches_do_not_share_a_folder(tmp_path: Path, settings: BatchSettings) -> None:
    folder, out = write_captures(tmp_path / "clips", {"clip": {}}), tmp_path / "out"
    seen: list[str] = []

    def second(row: Row) -> None:
        with pytest.raises(BatchError, match="another batch is working on it") as caught:
            run_batch(folder, out, settings=settings)
        seen.append(str(caught.value))

    run_batch(folder, out, settings=settings, on_row=second)
    assert len(seen) == 1


def test_a_scheduler_that_is_not_there_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mvdyn_gtsam.batch.scheduling.CONNECT_S", 0.3)
    for address in ("tcp://127.0.0.1:9", "nowhere://1", "127.0.0.1"):
        with pytest.raises(BatchError, match="no Dask scheduler answers there"), remote_cluster(address):
            pass


@pytest.mark.parametrize("misses", [1, 2])
def test_a_machine_too_busy_to_start_dask_in_time_is_asked_twice(
    misses: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    from distributed import LocalCluster
    from distributed.utils import LoopRunner

    start, tries = LoopRunner._start_unlocked, []

    def late(runner: LoopRunner) -> None:
        tries.append(runner)
        assert len(tries) > misses
        start(runner)

    with LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:
        monkeypatch.setattr(LoopRunner, "_start_unlocked", late)
        if misses == 2:
            with (
                pytest.raises(BatchError, match="too busy; try again"),
                remote_cluster(cluster.scheduler_address),
            ):
                pass
        else:
            with remote_cluster(cluster.scheduler_address) as client:
                assert client.submit(len, "ab").result() == 2
    assert len(tries) == 2


@pytest.mark.slow  # the client tries for half a minute to reach it again
def test_the_loss_of_the_scheduler_is_said(tmp_path: Path) -> None:
    from distributed import LocalCluster

    folder = write_captures(tmp_path / "clips", {"clip0": {}, "clip1": {"seconds": 30.0}})
    out = tmp_path / "out"
    with LocalCluster(n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None) as cluster:
        settings = dataclasses.replace(SETTINGS, workers=None, scheduler=cluster.scheduler_address)
        with pytest.raises(BatchError, match="the Dask scheduler was lost; what is finished is kept"):
            run_batch(folder, out, settings=settings, on_row=lambda row: threading_close(cluster))
    rows = json.loads((out / "batch.json").read_text())["clips"]
    assert [row["state"] for row in rows] == ["done", "unfinished"]


def threading_close(cluster: object) -> None:
    threading.Thread(target=cluster.close, daemon=True).start()  # type: ignore[attr-defined]


def die(clip: Clip) -> Row:
    """A job that takes its worker along, unless its clip is a good one."""
    if clip.name == "deadly":
        os._exit(1)
    return Row(clip.name, State.DONE)


def broken(clip: Clip) -> Row:
    raise RuntimeError("a bug\nover two lines")


@pytest.mark.slow  # three workers start, one after the other
def test_a_clip_that_kills_every_worker_is_given_up_and_the_others_finish() -> None:
    rows: list[Row] = []
    clips = [Clip(name, Path(name)) for name in ("a", "deadly", "b", "c")]
    with local_cluster(1, retries=1) as client:
        run_clips(client, clips, die, retries=1, on_row=rows.append, stop=lambda: None)
        run_clips(client, clips[:1], broken, retries=0, on_row=rows.append, stop=lambda: None)
    first = {row.clip: row.state.value for row in rows[:4]}
    assert first == {"a": "done", "deadly": "failed", "b": "done", "c": "done"}
    problem = next(row.problem for row in rows if row.clip == "deadly")
    assert problem is not None and problem.startswith("its worker died 2 times")
    assert rows[4].problem == "RuntimeError: a bug over two lines"
