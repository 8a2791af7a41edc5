"""A tiny result whose every pixel is known: two cameras slide past a wall on which a patch moves."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.capture.model import Camera, Capture
from mvdyn_gtsam.reconstruction import CaptureInfo, Reconstruction, ReconstructionWriter

CAMERAS = (Camera("cam0", 32, 24, 30.0, 31.0, 15.0, 11.5), Camera("cam1", 40, 30, 33.0, 34.0, 19.0, 15.5))
FRAMES = 6
FPS = 10.0
DEPTH = 3.0
NO_POSE = 4
"""A frame of cam1 without a pose."""


class Gradient:
    """Red tells the column, green the row, blue the camera and time."""

    def __init__(self, camera: Camera, number: int) -> None:
        self.camera, self.number = camera, number

    def __len__(self) -> int:
        return FRAMES

    def read(self, time: int) -> np.ndarray:
        image = np.zeros((self.camera.height, self.camera.width, 3), np.uint8)
        image[..., 0] = np.arange(self.camera.width)
        image[..., 1] = np.arange(self.camera.height)[:, None]
        image[..., 2] = 100 * self.number + time
        return image


def capture() -> Capture:
    return Capture("clip", FPS, CAMERAS, tuple(Gradient(camera, i) for i, camera in enumerate(CAMERAS)))


def poses(number: int) -> np.ndarray:
    """``(T, 4, 4)``: camera ``number`` slides along x, turned by a little more at every frame."""
    wTc = np.tile(np.eye(4), (FRAMES, 1, 1))
    wTc[:, :3, :3] = Rotation.from_rotvec([[0.0, 0.02 * time, 0.0] for time in range(FRAMES)]).as_matrix()
    wTc[:, 0, 3] = 0.3 * np.arange(FRAMES) + number
    return wTc


def depth_of(camera: Camera) -> np.ndarray:
    """Deeper from left to right; the first row is invalid."""
    depth = np.tile(np.linspace(DEPTH - 1.0, DEPTH + 1.0, camera.width), (camera.height, 1))
    depth[0] = np.nan
    return depth


def motion_at(camera: Camera, time: int) -> np.ndarray:
    """A patch of 4 x 4 that goes right by 2 px per frame, its last row unconfirmed."""
    motion = np.zeros((camera.height, camera.width), np.uint8)
    motion[10:14, 4 + 2 * time : 8 + 2 * time] = 255
    motion[13, 4 + 2 * time : 8 + 2 * time] = 128
    return motion


def write_capture(folder: Path) -> Path:
    """The frames of ``capture`` as a capture folder."""
    for number, camera in enumerate(CAMERAS):
        (folder / camera.name).mkdir(parents=True)
        for time in range(FRAMES):
            image = Gradient(camera, number).read(time)
            assert cv2.imwrite(str(folder / camera.name / f"{time:06d}.png"), image[..., ::-1])
    cameras = [
        {key: getattr(camera, key) for key in ("name", "width", "height", "fx", "fy", "cx", "cy")}
        | {"source": f"{camera.name}/*.png"}
        for camera in CAMERAS
    ]
    (folder / "capture.json").write_text(json.dumps({"name": "clip", "fps": FPS, "cameras": cameras}))
    return folder


def make(
    folder: Path,
    *,
    refined: bool = True,
    groups: Sequence[Sequence[str]] = (("cam0", "cam1"),),
    source: Path | None = None,
) -> Reconstruction:
    """Confidence is 0.2 in the left half, 1 in the right; what tracking said is twice as deep."""
    info = CaptureInfo("clip", FPS, FRAMES, CAMERAS, source=None if source is None else str(source))
    with ReconstructionWriter.create(folder, info, {}) as writer:
        writer.set_groups(groups)
        _write(writer, 2.0 if refined else 1.0, refined=False)
        writer.finish_stage("tracking", 1.0)
        if refined:
            _write(writer, 1.0, refined=True)
            writer.publish_refined()
            writer.finish_stage("refinement", 1.0)
    return Reconstruction.load(folder)


def _write(writer: ReconstructionWriter, factor: float, *, refined: bool) -> None:
    for number, camera in enumerate(CAMERAS):
        wTc = poses(number)
        if number == 1:
            wTc[NO_POSE] = np.nan
        writer.write_trajectory(camera.name, np.arange(FRAMES) / FPS, wTc, refined=refined)
        confidence = np.ones((camera.height, camera.width))
        confidence[:, : camera.width // 2] = 0.2
        for time in range(FRAMES):
            writer.write_depth(camera.name, time, factor * depth_of(camera), confidence, refined=refined)
            if refined:
                writer.write_motion(camera.name, time, motion_at(camera, time))
