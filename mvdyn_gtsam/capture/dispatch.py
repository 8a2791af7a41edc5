"""One door for every layout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from mvdyn_gtsam.capture.euroc import is_euroc, load_euroc
from mvdyn_gtsam.capture.folder_per_camera import is_folder_per_camera, load_folder_per_camera
from mvdyn_gtsam.capture.loader import CAPTURE_FILE, load_capture
from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.capture.multicamvideo import is_multicamvideo, load_multicamvideo
from mvdyn_gtsam.errors import CaptureError

LAYOUTS = (
    f"a folder with {CAPTURE_FILE}",
    "a EuRoC recording (mav0/cam0/sensor.yaml)",
    "a MultiCamVideo scene (videos/ and cameras/camera_extrinsics.json)",
    "one folder per camera with images and intrinsics.txt",
)


def open_capture(
    path: Path,
    *,
    truncate: bool = False,
    cameras: Sequence[str] | None = None,
    fps: float | None = None,
    focal_mm: float | None = None,
) -> Capture:
    """Load ``path`` by the layout it has; ``capture.json`` wins where it is present.

    ``cameras`` chooses some by name, ``fps`` states the rate of a folder per camera, ``focal_mm`` the lens of
    a MultiCamVideo scene; each is refused where the layout has no use for it.
    Raises CaptureError where no layout fits, listing those there are, and as the readers do.
    """
    path = Path(path)
    if not path.exists():
        raise CaptureError(f"{path}: there is no such file or folder; check the path")
    if path.suffix == ".json" or (path / CAPTURE_FILE).is_file():
        _refuse(path, CAPTURE_FILE, cameras=cameras, fps=fps, focal_mm=focal_mm)
        return load_capture(path, truncate=truncate)
    if path.is_file():
        raise CaptureError(
            f"{path}: is a single file; give each video with --camera and its --intrinsics, or"
            " with --camera and --estimate-focal"
        )
    if is_euroc(path):
        _refuse(path, "EuRoC", fps=fps, focal_mm=focal_mm)
        return replace(load_euroc(path, cameras=cameras, truncate=truncate), source=path.absolute())
    if is_multicamvideo(path):
        _refuse(path, "MultiCamVideo", fps=fps)
        scene = load_multicamvideo(path, cameras=cameras, focal_mm=focal_mm, truncate=truncate)
        return replace(scene, source=path.absolute())
    if is_folder_per_camera(path):
        _refuse(path, "folder-per-camera", focal_mm=focal_mm)
        folders = load_folder_per_camera(path, cameras=cameras, fps=fps, truncate=truncate)
        return replace(folders, source=path.absolute())
    raise CaptureError(f"{path}: not a capture; it must be {'; or '.join(LAYOUTS)}")


def _refuse(path: Path, layout: str, **options: object) -> None:
    for name, value in options.items():
        if value is not None:
            raise CaptureError(f"{path}: {name} has no meaning for the {layout} layout; leave it out")
