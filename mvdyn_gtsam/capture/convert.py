"""Writing any capture as a folder with ``capture.json``, so that other layouts are read once only."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.errors import CaptureError

Array = npt.NDArray[np.float64]


def write_capture(capture: Capture, out: Path, *, poses: Mapping[str, Array] | None = None) -> None:
    """Write ``capture`` to the new folder ``out``: lossless images, ``capture.json``, TUM ground truth.

    Images are written as handed out, undistorted and cut to the common range, so the written cameras have
    neither distortion nor time offset; an unknown focal length stays unknown. ``poses`` maps camera names to
    ``wTc (T, 4, 4)``. The folder appears under its name only when complete. Raises CaptureError where ``out``
    exists or cannot be written, or poses and frames differ in number.
    """
    out = Path(out)
    for name, wTc in (poses or {}).items():
        if len(wTc) != capture.frame_count:
            raise CaptureError(
                f"{capture.name}: camera {name} has {capture.frame_count} frames but {len(wTc)} poses; "
                "use the poses of these very frames"
            )
    if out.exists():
        raise CaptureError(f"{out}: exists already; give another folder, or remove it")
    partial = out.with_name(out.name + ".partial")
    try:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        _write(capture, partial, poses or {})
        partial.rename(out)
    except OSError as error:
        shutil.rmtree(partial, ignore_errors=True)
        raise CaptureError(
            f"{out}: cannot be written ({error.strerror}); free some space or choose another folder"
        ) from None


def tum_lines(timestamps: Array, wTc: Array) -> str:
    """Lines ``timestamp tx ty tz qx qy qz qw`` of poses ``(T, 4, 4)`` at ``(T,)`` seconds."""
    quaternions = Rotation.from_matrix(wTc[:, :3, :3]).as_quat()
    rows = np.column_stack([timestamps, wTc[:, :3, 3], quaternions])
    return "".join(" ".join(f"{value:.9f}" for value in row) + "\n" for row in rows)


def _write(capture: Capture, folder: Path, poses: Mapping[str, Array]) -> None:
    for number, camera in enumerate(capture.cameras):
        (folder / camera.name).mkdir()
        for time in range(capture.frame_count):
            bgr = cv2.cvtColor(capture.read(number, time), cv2.COLOR_RGB2BGR)
            (folder / camera.name / f"{time:06d}.png").write_bytes(cv2.imencode(".png", bgr)[1].tobytes())
    # The written clock starts at zero, and so does its ground truth.
    timestamps = capture.timestamps - capture.start_time
    for name, wTc in poses.items():
        (folder / "groundtruth").mkdir(exist_ok=True)
        (folder / "groundtruth" / f"{name}.txt").write_text(tum_lines(timestamps, wTc))
    content = {
        "name": capture.name,
        "fps": capture.fps,
        "num_frames": capture.frame_count,
        "cameras": [
            {
                "name": camera.name,
                "source": f"{camera.name}/*.png",
                **{key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")},
                **({} if camera.focal_known else {"estimate_focal": True}),
            }
            for camera in capture.cameras
        ],
    }
    (folder / "capture.json").write_text(json.dumps(content, indent=1) + "\n")
