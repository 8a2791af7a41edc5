"""Read a COLMAP model in a process of its own: ``python -m ...colmap_worker MODEL OUT.npz``."""

from __future__ import annotations

import sys

import cv2  # noqa: F401  must be loaded before pycolmap
import numpy as np
import pycolmap


def main(source: str, target: str) -> int:
    """Write arrays of the N images with a pose: names, cTw, intrinsics, sizes (w, h), distorted or not."""
    try:
        model = pycolmap.Reconstruction(source)
    except (ValueError, RuntimeError, IndexError, OSError) as error:
        sys.stderr.write(f"{' '.join(str(error).split())}\n")
        return 1
    images = [image for image in model.images.values() if image.has_pose]
    cTw = np.tile(np.eye(4), (len(images), 1, 1))
    for index, image in enumerate(images):
        cTw[index, :3] = image.cam_from_world().matrix()
    cameras = [model.cameras[image.camera_id] for image in images]
    distorted = [bool(np.any(camera.params[camera.extra_params_idxs()])) for camera in cameras]
    np.savez(
        target,
        names=np.array([image.name for image in images], dtype=str),
        cTw=cTw,
        intrinsics=np.array([camera.calibration_matrix() for camera in cameras]).reshape(-1, 3, 3),
        sizes=np.array([(camera.width, camera.height) for camera in cameras], dtype=float).reshape(-1, 2),
        distorted=np.array(distorted, dtype=bool),
    )
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
