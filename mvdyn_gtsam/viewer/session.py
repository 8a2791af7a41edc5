"""Serving a result until Ctrl-C: one thread reads and draws, whatever is clicked meanwhile."""

from __future__ import annotations

import logging
import threading
import time

import viser

from mvdyn_gtsam.errors import MvdynError
from mvdyn_gtsam.viewer.controls import Controls
from mvdyn_gtsam.viewer.pictures import Choice
from mvdyn_gtsam.viewer.stage import Stage
from mvdyn_gtsam.viewer.views import ResultViews

log = logging.getLogger(__name__)

LONGEST_WAIT = 1.0
"""Seconds: Ctrl-C is heeded between waits where waiting cannot be interrupted."""


class Session:
    """What one server shows of one result.

    Controls only wake the thread that calls ``step``: it draws what is chosen by then, so that a slider that
    is dragged asks for no more instants than can be drawn.
    """

    def __init__(self, server: viser.ViserServer, views: ResultViews, choice: Choice) -> None:
        self._server = server
        self.views = views
        self._changed = threading.Event()
        self.controls = Controls(server.gui, views, choice, self._changed.set)
        self.stage = Stage(server)
        self._begun: tuple[int, bool] | None = None
        self._drawn: Choice | None = None
        self._last_frame = time.monotonic()

    def run(self) -> None:
        """Draw what is chosen until the thread is interrupted."""
        while True:
            self.step()
            self._changed.wait(self._wait())
            self._changed.clear()

    def step(self) -> None:
        """Draw what is chosen now unless it is seen already. What cannot be read is said, not raised."""
        self._go_on()
        choice = self.controls.read()
        if choice == self._drawn:
            return
        self._drawn = choice
        try:
            scene = self.views.scene(choice)
            if self._begun is None or self._begun[0] != choice.group:
                self.stage.begin(scene)
            elif self._begun[1] != choice.tracking:
                self.stage.draw_paths(scene)
            self._begun = (choice.group, choice.tracking)
            self.stage.show(scene, self.views.picture(choice))
        except MvdynError as error:  # one damaged file must not end the look at all others
            log.warning("%s", error)
            for client in self._server.get_clients().values():
                client.add_notification("This instant cannot be shown", str(error), color="red")

    def _go_on(self) -> None:
        now, rate = time.monotonic(), self.controls.rate.value
        if not self.controls.play.value:
            self._last_frame = now
            return
        frames = int((now - self._last_frame) * rate)
        if frames > 0:
            self._last_frame += frames / rate
            self.controls.go_on(frames)

    def _wait(self) -> float:
        if not self.controls.play.value:
            return LONGEST_WAIT
        due = self._last_frame + 1.0 / self.controls.rate.value
        return min(max(due - time.monotonic(), 0.0), LONGEST_WAIT)
