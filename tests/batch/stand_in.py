"""In place of ``mvdyn reconstruct``: does what ``task.json`` in the capture says, and leaves a trace of it.

``python stand_in.py CAPTURE --out OUT --stage STAGE --resume --config FILE ...`` appends ``start PID`` and
``end PID`` to ``<OUT>.trace``, so that a test sees who wrote the result, when. It imports nothing heavy: the
result is a copy of one that ``write_captures`` made.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

MADE = "made"


def write_result(out: Path, cameras: tuple[str, ...] = ("cam0", "cam1"), frames: int = 4) -> None:
    """A tracked reconstruction; camera k has the poses ``true_poses(k, frames)``."""
    import numpy as np

    from mvdyn_gtsam.capture.model import Camera
    from mvdyn_gtsam.config import Config, to_dict
    from mvdyn_gtsam.reconstruction import CaptureInfo, ReconstructionWriter

    info = CaptureInfo(
        "stand-in", 10.0, frames, tuple(Camera(name, 8, 6, 10.0, 10.0, 3.5, 2.5) for name in cameras)
    )
    with ReconstructionWriter.create(out, info, to_dict(Config())) as writer:
        for index, name in enumerate(cameras):
            writer.write_trajectory(name, np.arange(frames) / 10.0, true_poses(index, frames))
        writer.finish_stage("tracking", 1.0)


def true_poses(camera: int, frames: int) -> npt.NDArray[np.float64]:
    """``wTc (frames, 4, 4)``."""
    import numpy as np

    from tests.evaluation.fakes import random_poses

    return random_poses(np.random.default_rng(camera), frames)


def write_captures(folder: Path, tasks: dict[str, dict[str, Any]]) -> Path:
    """Folders that are taken for captures, each with what the stand-in is to do there."""
    write_result(folder.parent / MADE)
    for name, task in tasks.items():
        (folder / name).mkdir(parents=True)
        (folder / name / "capture.json").write_text("{}")
        (folder / name / "task.json").write_text(json.dumps(task))
    return folder


def main(arguments: list[str]) -> int:
    capture, out = Path(arguments[0]), Path(arguments[arguments.index("--out") + 1])
    task = json.loads((capture / "task.json").read_text())
    trace = Path(f"{out}.trace")
    first = not trace.exists()
    with trace.open("a") as file:
        file.write(f"start {os.getpid()}\n")
    time.sleep(task.get("seconds", 0.0) if first else 0.0)
    if task.get("killed") == "always" or (task.get("killed") == "once" and first):
        os.kill(os.getpid(), signal.SIGKILL)
    if "fails" in task:
        sys.stderr.write(f"mvdyn: {task['fails']}\n")
        return 1
    shutil.copytree(capture.parents[1] / MADE, out)
    with trace.open("a") as file:
        file.write(f"end {os.getpid()} {' '.join(arguments[arguments.index('--config') + 2 :])}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
