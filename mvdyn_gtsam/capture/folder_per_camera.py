"""The generic layout: one folder per camera with its images and ``intrinsics.txt``."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from mvdyn_gtsam.capture.assemble import Source, assemble_capture
from mvdyn_gtsam.capture.focal import camera_with_unknown_focal, first_intrinsics
from mvdyn_gtsam.capture.images import images_in, natural_key, read_bytes
from mvdyn_gtsam.capture.model import Camera, Capture
from mvdyn_gtsam.capture.streams import ImageStream
from mvdyn_gtsam.errors import CaptureError

logger = logging.getLogger(__name__)

INTRINSICS_FILE = "intrinsics.txt"
ESTIMATE = "estimate"
"""What that file holds, alone, where the focal length is not known."""
IMAGE_FOLDERS = (".", "rgb", "color", "images")
DEFAULT_FPS = 30.0
_WANTED = f"write fx fy cx cy [k1 k2 p1 p2 [k3]], or only {ESTIMATE} to have the focal length found"


def is_folder_per_camera(folder: Path) -> bool:
    """Whether a folder below ``folder`` has an ``intrinsics.txt``."""
    return bool(_camera_folders(folder))


def load_folder_per_camera(
    folder: Path,
    *,
    cameras: Sequence[str] | None = None,
    fps: float | None = None,
    truncate: bool = False,
) -> Capture:
    """Load every camera folder (or those named) below ``folder``::

        scene/cam0/intrinsics.txt     fx fy cx cy [k1 k2 p1 p2 [k3]], px at the size of the images;
                                      or only the word "estimate", to have the focal length found
        scene/cam0/*.png              the frames in natural order; or in rgb/, color/, images/
        scene/cam0/groundtruth.txt    optional, TUM lines "timestamp tx ty tz qx qy qz qw" (wTc)

    Frame k of every camera is one instant. The layout states no rate: ``fps`` defaults to 30, with a note.
    Ground truth is not read here; time stamps in it are seconds since frame 0.

    MultiCamRobolab (2-3 Azure Kinects at 30 frames per second, motion-capture poses) is not published in a
    documented layout. Map a sequence onto this one: one folder per Kinect; its colour images, only those at
    which all Kinects have one (match their time stamps, keep the k-th match as image k); its colour camera's
    ``fx fy cx cy`` and distortion, from the factory calibration at the resolution recorded; and the
    marker-body poses times the body-to-camera calibration, as ``wTc`` with OpenCV axes in metres.

    Raises CaptureError naming the file and the fix.
    """
    folder = Path(folder)
    folders = {path.name: path for path in _camera_folders(folder)}
    if not folders:
        raise CaptureError(
            f"{folder}: no folder here holds an {INTRINSICS_FILE} (fx fy cx cy, or {ESTIMATE}); add one per"
            " camera"
        )
    names = list(cameras) if cameras is not None else list(folders)
    missing = [name for name in names if name not in folders]
    if missing:
        raise CaptureError(
            f"{folder}: there is no camera folder {missing[0]} with an {INTRINSICS_FILE}; "
            f"choose among {', '.join(folders)}"
        )
    sources = [_source(folders[name]) for name in names]
    if fps is None:
        logger.warning(
            "%s: the frame rate is not stated, %g per second is taken; set fps", folder, DEFAULT_FPS
        )
        fps = DEFAULT_FPS
    return assemble_capture(folder.resolve().name, fps, sources, truncate=truncate)


def _camera_folders(folder: Path) -> list[Path]:
    return sorted((path.parent for path in folder.glob(f"*/{INTRINSICS_FILE}")), key=natural_key)


def _source(folder: Path) -> Source:
    numbers = _read_intrinsics(folder / INTRINSICS_FILE)
    images = next((found for name in IMAGE_FOLDERS if (found := _images(folder / name))), None)
    if images is None:
        raise CaptureError(f"{folder}: holds no images; put them here or in {folder.name}/rgb")
    stream = ImageStream(images)
    size = stream.width, stream.height
    if numbers is None:
        return Source(camera_with_unknown_focal(Camera(folder.name, *size, *first_intrinsics(*size))), stream)
    fx, fy, cx, cy = numbers[:4]
    return Source(Camera(folder.name, *size, fx, fy, cx, cy, distortion=numbers[4:]), stream)


def _images(folder: Path) -> list[Path]:
    return images_in(folder) if folder.is_dir() else []


def _read_intrinsics(path: Path) -> tuple[float, ...] | None:
    """The numbers of an ``intrinsics.txt``; None where it says that they are to be estimated."""
    text = read_bytes(path).decode("utf-8", errors="replace")
    words = [word for line in text.splitlines() for word in line.split("#")[0].replace(",", " ").split()]
    if words == [ESTIMATE]:
        return None
    try:
        numbers = tuple(float(word) for word in words)
    except ValueError as error:
        raise CaptureError(f"{path}: {error}; {_WANTED}") from None
    if len(numbers) not in (4, 8, 9, 12):
        raise CaptureError(f"{path}: has {len(numbers)} numbers; {_WANTED}")
    return numbers
