"""MultiCamVideo scenes: ``videos/camNN.mp4`` and ``cameras/camera_extrinsics.json``.

Layout and numbers: https://github.com/KlingAIResearch/ReCamMaster (dataset section of its README).
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.assemble import Source, assemble_capture
from mvdyn_gtsam.capture.convert import write_capture
from mvdyn_gtsam.capture.images import natural_key, read_bytes
from mvdyn_gtsam.capture.model import Camera, Capture
from mvdyn_gtsam.capture.streams import CroppedStream, VideoStream
from mvdyn_gtsam.errors import CaptureError

Array = npt.NDArray[np.float64]

EXTRINSICS_FILE = Path("cameras") / "camera_extrinsics.json"
SENSOR_MM = 23.76
SIZE = (512, 384)
"""Width and height the dataset is evaluated at, after a centred 4:3 crop."""

_FOCAL = re.compile(r"f(\d+(?:\.\d+)?)_aperture")
_CENTIMETRES_PER_METRE = 100.0


def is_multicamvideo(folder: Path) -> bool:
    """Whether ``folder`` is one MultiCamVideo scene."""
    return (folder / EXTRINSICS_FILE).is_file() and (folder / "videos").is_dir()


def load_multicamvideo(
    scene_folder: Path,
    *,
    cameras: Sequence[str] | None = None,
    focal_mm: float | None = None,
    truncate: bool = False,
) -> Capture:
    """Load the named cameras (default: all) of a scene, cropped to 4:3 and resized to 512x384.

    The focal length comes from the folder name (``f24_aperture5``) unless given, on a sensor 23.76 mm wide.
    Raises CaptureError naming the file and the fix.
    """
    scene_folder = Path(scene_folder)
    videos = sorted((scene_folder / "videos").glob("*.mp4"), key=natural_key)
    if not videos:
        raise CaptureError(f"{scene_folder}/videos: there are no *.mp4; give the folder of one scene")
    by_name = {video.stem: video for video in videos}
    names = list(cameras) if cameras is not None else list(by_name)
    missing = [name for name in names if name not in by_name]
    if missing:
        raise CaptureError(
            f"{scene_folder}: there is no camera {missing[0]}; choose among {', '.join(by_name)}"
        )
    focal = focal_mm if focal_mm is not None else _focal_of(scene_folder)
    sources = [_source(VideoStream(by_name[name], truncate), name, focal) for name in names]
    rates = [source.media.fps for source in sources if source.media.fps is not None]
    if not rates:
        raise CaptureError(
            f"{videos[0]}: the container states no frame rate; re-encode it at 15 frames per second"
        )
    return assemble_capture(scene_folder.resolve().name, min(rates), sources, truncate=truncate)


def multicamvideo_poses(scene_folder: Path, camera: str) -> Array:
    """``wTc (T, 4, 4)`` of one camera: OpenCV axes, metres, a right-handed world.

    The file holds Unreal's row-vector matrices (rows: forward, right, up, position; cm). The official
    conversion reorders the camera axes and leaves the left-handed world alone, so its rotations have
    determinant -1; mirroring the world's y axis as well makes them proper and keeps relative poses.
    Raises CaptureError where the file lacks the camera or a frame, or a matrix is no rotation.
    """
    path = Path(scene_folder) / EXTRINSICS_FILE
    try:
        content = json.loads(read_bytes(path))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CaptureError(f"{path}: not valid JSON: {error}") from None
    if not isinstance(content, dict) or not content:
        raise CaptureError(f'{path}: must hold {{"frame0": {{"cam01": "[...] ..."}}, ...}}')
    return np.stack([_pose(content, f"frame{time}", camera, path) for time in range(len(content))])


def convert_multicamvideo(
    scene_folder: Path,
    out: Path,
    *,
    cameras: Sequence[str] | None = None,
    focal_mm: float | None = None,
    truncate: bool = False,
) -> None:
    """Write a scene as a capture folder with ``groundtruth/<camera>.txt`` (TUM, ``wTc``).

    Raises CaptureError where the scene cannot be read, poses and frames differ in number, or ``out`` exists.
    """
    capture = load_multicamvideo(scene_folder, cameras=cameras, focal_mm=focal_mm, truncate=truncate)
    poses = {camera.name: multicamvideo_poses(scene_folder, camera.name) for camera in capture.cameras}
    if truncate:
        poses = {name: wTc[: capture.frame_count] for name, wTc in poses.items()}
    write_capture(capture, out, poses=poses)


def _focal_of(scene_folder: Path) -> float:
    for part in reversed(scene_folder.resolve().parts):
        found = _FOCAL.match(part)
        if found:
            return float(found[1])
    raise CaptureError(
        f"{scene_folder}: no folder above tells the focal length by a name like f24_aperture5; give focal_mm"
    )


def _source(video: VideoStream, name: str, focal_mm: float) -> Source:
    if focal_mm <= 0:
        raise CaptureError(f"{video.label}: focal_mm is {focal_mm:g}; give the focal length in millimetres")
    width, height = SIZE
    crop_width = min(video.width, video.height * width // height)
    crop_height = min(video.height, crop_width * height // width)
    left, top = (video.width - crop_width) // 2, (video.height - crop_height) // 2
    sx, sy = width / crop_width, height / crop_height
    focal = focal_mm / SENSOR_MM * video.width
    camera = Camera(
        name,
        width,
        height,
        fx=focal * sx,
        fy=focal * sy,
        cx=((video.width - 1) / 2 - left + 0.5) * sx - 0.5,
        cy=((video.height - 1) / 2 - top + 0.5) * sy - 0.5,
    )
    return Source(camera, CroppedStream(video, (left, top, crop_width, crop_height), SIZE))


def _pose(content: Mapping[str, Any], frame: str, camera: str, path: Path) -> Array:
    try:
        text = content[frame][camera]
    except (KeyError, TypeError):
        raise CaptureError(f"{path}: {frame} has no entry {camera}; download the file again") from None
    numbers = re.findall(r"[-+0-9.eE]+", text) if isinstance(text, str) else []
    try:
        rows = np.array([float(number) for number in numbers]).reshape(4, 4)
    except ValueError:
        raise CaptureError(
            f"{path}: {frame}, {camera}: must be four rows of four numbers, not {text!r}"
        ) from None
    forward, right, up, position = rows[:, :3]
    world_mirror = np.array([1.0, -1.0, 1.0])
    u, singular, vt = np.linalg.svd(world_mirror[:, None] * np.stack([right, -up, forward], axis=1))
    if abs(singular - 1.0).max() > 1e-3 or np.linalg.det(u @ vt) < 0:
        raise CaptureError(
            f"{path}: {frame}, {camera}: is not a rotation with Unreal's axes; download it again"
        )
    wTc = np.eye(4)
    wTc[:3, :3] = u @ vt
    wTc[:3, 3] = world_mirror * position / _CENTIMETRES_PER_METRE
    return wTc
