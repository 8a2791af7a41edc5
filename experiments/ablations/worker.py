"""Track one capture from a given start, in a process of its own.

``python -m experiments.ablations.worker CAPTURE START OUT [KEY=VALUE...]``
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.ablations.starts import read_start
from experiments.records import exit_status
from mvdyn_gtsam.capture import load_capture
from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.config import load_config
from mvdyn_gtsam.frontend.start.model import Start
from mvdyn_gtsam.pipeline import reconstruct
from mvdyn_gtsam.progress import Progress


class GivenStart:
    """An initializer that hands out a start that is already there."""

    def __init__(self, start: Start) -> None:
        self.start = start

    def __call__(self, capture: Capture, progress: Progress) -> Start:
        """See ``WideBaselineInitializer``."""
        return self.start


def main(arguments: Sequence[str] | None = None) -> int:
    """Returns the exit status; what went wrong is the last line."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    capture, start, out = map(Path, words[:3])

    def work() -> None:
        given = GivenStart(read_start(start))
        reconstruct(
            load_capture(capture), out, load_config(None, words[3:]), stage="tracking", initializer=given
        )

    return exit_status(work)


if __name__ == "__main__":
    sys.exit(main())
