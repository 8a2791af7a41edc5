"""How long-running stages tell the outside how far they are."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Receives a line of state from a stage; must be cheap, it is called once per frame."""

    def update(self, stage: str, done: int, total: int, note: str = "") -> None:
        """``done`` of ``total`` steps of ``stage`` are finished; ``note`` says what is worked on."""
        ...


class NullProgress:
    """Says nothing."""

    def update(self, stage: str, done: int, total: int, note: str = "") -> None:
        """Ignore the state."""
