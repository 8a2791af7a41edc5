"""The progress of a run: a bar on a terminal, a line every few seconds elsewhere."""

from __future__ import annotations

import logging
import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

log = logging.getLogger(__name__)

SECONDS_BETWEEN_LINES = 5.0


class ConsoleProgress:
    """A ``mvdyn_gtsam.progress.Progress`` for people; a context manager, so that the terminal is restored."""

    def __init__(self, console: Console) -> None:
        self._bars = Progress(
            TextColumn("{task.description:<12}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(compact=True, elapsed_when_finished=True),
            TextColumn("{task.fields[note]}"),
            console=console,
            disable=not console.is_terminal,
        )
        self._lines = not console.is_terminal
        self._tasks: dict[str, TaskID] = {}
        self._started: dict[str, float] = {}
        self._last_line = -SECONDS_BETWEEN_LINES

    def __enter__(self) -> ConsoleProgress:
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bars.stop()

    def update(self, stage: str, done: int, total: int, note: str = "") -> None:
        """Show that ``done`` of ``total`` steps of ``stage`` are finished."""
        now = time.monotonic()
        started = self._started.setdefault(stage, now)
        if self._lines:
            finished = done >= total
            if finished or now - self._last_line >= SECONDS_BETWEEN_LINES:
                self._last_line = now
                log.info("%s", progress_line(stage, done, total, note, now - started))
            return
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(stage, total=total, note=note)
        self._bars.update(self._tasks[stage], completed=done, total=total, note=note)


def progress_line(stage: str, done: int, total: int, note: str, seconds: float) -> str:
    """``tracking 10/40 (25 %), 30 s left: note``."""
    share = f" ({100 * done // total} %)" if total > 0 else ""
    if done >= total:
        remaining = f", took {seconds:.0f} s"
    elif done > 0 and seconds > 0.0:
        remaining = f", {seconds * (total - done) / done:.0f} s left"
    else:
        remaining = ""
    return f"{stage} {done}/{total}{share}{remaining}" + (f": {note}" if note else "")
