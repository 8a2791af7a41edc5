"""The panel beside the 3D scene: what somebody chooses, read as one value."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import viser

from mvdyn_gtsam.viewer.pictures import Choice, Colouring, Show
from mvdyn_gtsam.viewer.views import ResultViews

NOBODY = "no camera"
REFINED, TRACKED = "refined", "tracked"
THOUSAND = 1000
FIRST_RATE = 10.0
"""Frames per second that most machines draw."""


class Controls:
    """Builds the panel; ``changed`` is called, on viser's threads, whenever something is moved.

    Its attributes are the handles of the panel's elements.
    """

    def __init__(
        self, gui: viser.GuiApi, views: ResultViews, choice: Choice, changed: Callable[[], None]
    ) -> None:
        self._gui = gui
        self._views = views
        self._add_sources(choice)
        self._add_time(choice)
        self._add_points(choice)
        self._add_cameras(choice)
        handles: tuple[Any, ...] = (  # viser's type of all inputs is private
            self.group, self.source, self.time, self.play, self.rate, self.show, self.colouring,
            self.confidence, self.points, self.point_size, self.frustum_size, self.through,
            *self.visible.values(),
        )  # fmt: skip
        for handle in handles:
            handle.on_update(lambda _: changed())
        self._offer_group(choice.group)

    def read(self) -> Choice:
        """What is chosen now."""
        group = self._group_names().index(self.group.value)
        if group != self._offered:
            self._offer_group(group)
        return Choice(
            time=min(int(self.time.value), self._views.frame_count - 1),
            group=group,
            tracking=self.source.value == TRACKED,
            hidden=frozenset(name for name, handle in self.visible.items() if not handle.value),
            show=Show(self.show.value),
            colouring=Colouring(self.colouring.value),
            min_confidence=float(self.confidence.value),
            points=round(self.points.value * THOUSAND),
            point_size=float(self.point_size.value),
            frustum_size=float(self.frustum_size.value),
            through=None if self.through.value == NOBODY else self.through.value,
        )

    def go_on(self, frames: int) -> None:
        """Move the time by ``frames``, from the end to the beginning."""
        time: Any = self.time  # whose value viser declares to be read-only, but for pyright
        time.value = (int(time.value) + frames) % self._views.frame_count

    def _group_names(self) -> list[str]:
        return [", ".join(group) for group in self._views.groups]

    def _offer_group(self, group: int) -> None:
        """Offer the cameras of ``group`` alone."""
        self._offered = group
        for name, handle in self.visible.items():
            handle.visible = name in self._views.groups[group]
        self.through.options = (NOBODY, *self._views.groups[group])

    def _add_sources(self, choice: Choice) -> None:
        names = self._group_names()
        self.group = self._gui.add_dropdown(
            "group",
            names,
            initial_value=names[choice.group],
            visible=len(names) > 1,
            hint="cameras that nothing connects: each group has a world frame and a scale of its own",
        )
        self.source = self._gui.add_dropdown(
            "poses, depth",
            (REFINED, TRACKED),
            initial_value=TRACKED if choice.tracking else REFINED,
            visible=self._views.has_tracked,
        )

    def _add_time(self, choice: Choice) -> None:
        last = max(self._views.frame_count - 1, 1)  # a slider needs two ends, of a single frame as well
        with self._gui.add_folder("time"):
            self.time = self._gui.add_slider("frame", 0, last, 1, min(choice.time, last))
            self.play = self._gui.add_checkbox("play", False)
            fastest = max(60.0, self._views.fps)
            self.rate = self._gui.add_slider("frames a second", 0.5, fastest, 0.5, FIRST_RATE)

    def _add_points(self, choice: Choice) -> None:
        with self._gui.add_folder("points"):
            self.show = self._gui.add_dropdown(
                "show",
                tuple(show.value for show in self._views.shows),
                initial_value=choice.show.value,
                hint="gathered: what moves, within what stands still at several times",
            )
            self.colouring = self._gui.add_dropdown(
                "colour",
                tuple(colouring.value for colouring in self._views.colourings),
                initial_value=choice.colouring.value,
            )
            self.confidence = self._gui.add_slider("confidence from", 0.0, 1.0, 0.01, choice.min_confidence)
            thousands = choice.points / THOUSAND
            self.points = self._gui.add_slider(
                "thousands", min(1.0, thousands), max(300.0, thousands), 1.0, thousands
            )
            self.point_size = self._gui.add_slider("size", 0.2, 4.0, 0.1, choice.point_size)

    def _add_cameras(self, choice: Choice) -> None:
        with self._gui.add_folder("cameras"):
            self.visible = {
                name: self._gui.add_checkbox(name, name not in choice.hidden)
                for group in self._views.groups
                for name in group
            }
            self.frustum_size = self._gui.add_slider("frustum", 0.02, 0.5, 0.01, choice.frustum_size)
            self.through = self._gui.add_dropdown("look through", (NOBODY,), initial_value=NOBODY)
