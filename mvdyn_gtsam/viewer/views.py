"""Pictures of a result on request: reads what an instant needs, keeps few frames, never the video."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace

from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.reconstruction import Reconstruction, is_reconstruction
from mvdyn_gtsam.reconstruction.export.points import check_capture, placed_groups
from mvdyn_gtsam.reconstruction.layout import tracked_folder
from mvdyn_gtsam.viewer.frames import Frame, read_frame
from mvdyn_gtsam.viewer.pictures import (
    Choice,
    Colouring,
    Picture,
    Points,
    Show,
    camera_picture,
    gathered_points,
)
from mvdyn_gtsam.viewer.scene import Scene, posed_times, read_scene, spread_times

KEPT_INSTANTS = 8
GATHERED_TIMES = 8
"""Frames of each camera from which the still background is gathered."""
GATHERED_SHARE = 5
"""Points of the background per point of an instant."""


class ResultViews:
    """One result, and the capture that it was made from where that is known.

    Raises ResultError when no camera has been placed yet or the capture is another.
    """

    def __init__(self, result: Reconstruction, capture: Capture | None) -> None:
        if capture is not None:
            check_capture(result, capture)
        self.groups = placed_groups(result)
        self._result = result
        self._capture = capture
        self._tracked = self._find_tracked()
        self._frames: OrderedDict[tuple[bool, str, int], Frame] = OrderedDict()
        self._scenes: dict[tuple[int, bool], Scene] = {}
        self._background: tuple[Choice, Points] | None = None

    @property
    def frame_count(self) -> int:
        """Frames per camera."""
        return self._result.frame_count

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self._result.fps

    @property
    def has_motion(self) -> bool:
        """Whether it is known what moves."""
        return "refinement" in self._result.stages

    @property
    def has_tracked(self) -> bool:
        """Whether what tracking said can be shown beside the refinement."""
        return self._tracked is not None

    @property
    def shows(self) -> tuple[Show, ...]:
        """What can be asked for."""
        return tuple(Show) if self.has_motion else (Show.ALL,)

    @property
    def colourings(self) -> tuple[Colouring, ...]:
        """What can be asked for, the best first."""
        missing = set() if self.has_motion else {Colouring.MOTION}
        if self._capture is None:
            # Depth first: points in the one colour of a camera show no shape.
            return (Colouring.DEPTH, *(c for c in (Colouring.CAMERA, Colouring.CONFIDENCE, Colouring.MOTION)
                                       if c not in missing))  # fmt: skip
        return tuple(colouring for colouring in Colouring if colouring not in missing)

    def check(self, choice: Choice) -> None:
        """Raise ConfigError where ``choice`` asks for what this result does not have."""
        folder = self._result.folder
        if not 0 <= choice.group < len(self.groups):
            raise ConfigError(f"--group {choice.group}: {folder} has groups 0..{len(self.groups) - 1}")
        if choice.show not in self.shows:
            raise ConfigError(
                f"--show {choice.show}: what moves is found by the refinement; run it with:"
                " mvdyn reconstruct --resume --stage refinement"
            )
        if choice.tracking and not self.has_tracked:
            raise ConfigError(f"--tracking: {folder} holds nothing but what tracking said; leave it out")

    def scene(self, choice: Choice) -> Scene:
        """The group of cameras that was chosen, over the whole video. Raises ResultError."""
        key = (choice.group, choice.tracking)
        if key not in self._scenes:
            group = self.groups[choice.group]
            # The scale stays that of the result: nothing jumps where tracking is compared with it.
            self._scenes[key] = read_scene(self._source(choice), self._result, group)
        return self._scenes[key]

    def picture(self, choice: Choice) -> Picture:
        """All that is seen. Raises ResultError or CaptureError when a file of this instant is damaged."""
        scene = self.scene(choice)
        shown = [
            name for name in scene.names if name not in choice.hidden and scene.has_pose(name, choice.time)
        ]
        budget = choice.points // max(len(scene.names), 1)
        cameras = tuple(
            camera_picture(scene, self._frame(choice.tracking, name, choice.time), choice, budget)
            for name in shown
        )
        background = self._gathered(scene, choice) if choice.show is Show.GATHERED else None
        return Picture(choice, cameras, background)

    def _find_tracked(self) -> Reconstruction | None:
        if "refinement" not in self._result.stages:
            return None
        return self._result.tracked() if is_reconstruction(tracked_folder(self._result.folder)) else None

    def _source(self, choice: Choice) -> Reconstruction:
        return self._tracked if choice.tracking and self._tracked is not None else self._result

    def _frame(self, tracking: bool, camera: str, time: int) -> Frame:
        key = (tracking, camera, time)
        if key not in self._frames:
            source = self._source(Choice(tracking=tracking))
            # Which pixels move is told by the refinement; it holds of the tracked depth as well.
            motions = self._result if self.has_motion else None
            self._frames[key] = read_frame(source, motions, self._capture, camera, time)
            if len(self._frames) > KEPT_INSTANTS * len(self._result.cameras):
                self._frames.popitem(last=False)
        self._frames.move_to_end(key)
        return self._frames[key]

    def _gathered(self, scene: Scene, choice: Choice) -> Points:
        asked = replace(choice, time=0, point_size=0.0, frustum_size=0.0, through=None)
        if self._background is None or self._background[0] != asked:
            names = [name for name in scene.names if name not in choice.hidden]
            budget = GATHERED_SHARE * choice.points // max(GATHERED_TIMES * len(scene.names), 1)
            frames = [
                self._frame(choice.tracking, name, time)
                for name in names
                for time in spread_times(posed_times(scene.wTc[name]), GATHERED_TIMES)
            ]
            self._background = (asked, gathered_points(scene, frames, choice, budget))
        return self._background[1]
