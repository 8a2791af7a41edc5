"""Processes: results in order, failures in one line, nobody left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.errors import ConfigError, ResultError
from mvdyn_gtsam.frontend.dense_flow import DisFlow, FlowConfig
from mvdyn_gtsam.refinement.context import COLOUR, Context
from mvdyn_gtsam.refinement.pool import TaskPool, worker_count
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.tasks import windows
from mvdyn_gtsam.refinement.views import DenseView
from mvdyn_gtsam.refinement.workspace import Workspace

CAMERA = Camera("cam0", 16, 12, 20.0, 20.0, 7.5, 5.5)


def context(folder: Path) -> Context:
    """One camera without edges; its frames hold their number as depth."""
    config = RefinementConfig(stride=1, window=2)
    workspace = Workspace(folder, (DenseView.of(CAMERA, 1.0),), 6)
    workspace.prepare("test")
    for name in ("before", "after", "prior", "prior_weight", "information"):
        workspace.create(name)
    workspace.create(COLOUR, np.uint8, channels=(3,))
    workspace.create("moving", np.uint8)
    for time_ in range(6):
        workspace.write("before", (0, time_), np.full((12, 16), 1.0 + time_, np.float32))
        workspace.write("prior", (0, time_), np.full((12, 16), np.log(1.0 + time_), np.float32))
        workspace.write("prior_weight", (0, time_), np.ones((12, 16), np.float32))
    workspace.write_array("poses", np.tile(np.eye(4), (1, 6, 1, 1)))
    return Context(workspace, ((0,),), {}, config, DisFlow(), FlowConfig())


@pytest.mark.parametrize("workers", [1, 2])
def test_every_window_is_solved_and_written(tmp_path: Path, workers: int) -> None:
    work = context(tmp_path)
    with TaskPool(work, workers) as pool:
        assert list(pool.map("window", windows("before", "after", 6, 2, 1))) == [None] * 3
    for time_ in range(6):
        np.testing.assert_allclose(work.image("after", (0, time_)), 1.0 + time_, rtol=1e-5)


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_of_a_task_reaches_the_caller(tmp_path: Path, workers: int) -> None:
    with TaskPool(context(tmp_path), workers) as pool, pytest.raises(FileNotFoundError):
        list(pool.map("window", windows("missing", "after", 6, 2, 1)))


class DeadlyFlow(DisFlow):
    """Ends the process that first receives it, as a kernel short of memory does."""

    def __setstate__(self, state: object) -> None:
        os._exit(9)


class ClosedFlow(DisFlow):
    """Holds what cannot travel, as a session of a network does."""

    def __init__(self) -> None:
        super().__init__()
        self.session = lambda: None


@pytest.mark.parametrize(
    ("flow", "error", "message"),
    [(DeadlyFlow(), ResultError, "--resume"), (ClosedFlow(), ConfigError, "refinement.workers=1")],
)
def test_what_goes_wrong_is_told_with_its_remedy(
    tmp_path: Path, flow: DisFlow, error: type[Exception], message: str
) -> None:
    work = context(tmp_path)
    broken = Context(work.workspace, work.groups, {}, work.config, flow, work.flow_config)
    with pytest.raises(error, match=message), TaskPool(broken, 2) as pool:
        list(pool.map("window", windows("before", "after", 6, 2, 1)))


def test_zero_workers_means_one_per_processor() -> None:
    assert worker_count(0) == len(os.sched_getaffinity(0))
    assert worker_count(3) == 3


def test_workers_leave_when_their_parent_is_killed(tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(
        textwrap.dedent(f"""
        import sys, time
        from pathlib import Path
        sys.path.insert(0, {str(Path(__file__).parents[2])!r})
        from tests.refinement.test_pool import context
        from mvdyn_gtsam.refinement.pool import TaskPool
        if __name__ == "__main__":
            with TaskPool(context(Path({str(tmp_path / "work")!r})), 2) as pool:
                print(*pool._executor._processes, flush=True)
                time.sleep(60)
        """)
    )
    parent = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    workers = [int(word) for word in parent.stdout.readline().split()]
    assert len(workers) == 2
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    deadline = time.monotonic() + 20.0
    while any(_runs(worker) for worker in workers) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not any(_runs(worker) for worker in workers)


def _runs(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def test_windows_cover_all_times_and_are_alike() -> None:
    bounds = [job[2:4] for job in windows("before", "after", 61, 8, 1)]
    assert bounds[0][0] == 0 and bounds[-1][1] == 61
    assert all(end == first for (_, end), (first, _) in zip(bounds, bounds[1:], strict=False))
    lengths = {end - first for first, end in bounds}
    assert max(lengths) <= 8 and max(lengths) - min(lengths) <= 1
