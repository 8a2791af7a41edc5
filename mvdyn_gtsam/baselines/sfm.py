"""Structure from motion through pycolmap, phase by phase; runs only inside the worker process.

``cv2`` is imported before ``pycolmap`` on purpose: the other order aborts at the first PNG write
(two copies of zlib). https://colmap.github.io/pycolmap/pycolmap.html
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pycolmap

from mvdyn_gtsam.baselines.settings import BaselineSettings, Method
from mvdyn_gtsam.capture.model import Camera, Capture
from mvdyn_gtsam.errors import BaselineError, CaptureError
from mvdyn_gtsam.geometry import invert_pose

Array = npt.NDArray[np.float64]

PIXEL_CENTRE = 0.5
"""COLMAP puts the centre of the first pixel at 0.5."""


def image_name(camera: str, time: int) -> str:
    """Name of a frame inside the image folder and the database, ``<camera>/<%06d>.png``."""
    return f"{camera}/{time:06d}.png"


def write_frames(capture: Capture, folder: Path) -> None:
    """Write every frame losslessly to ``folder/<camera>/<%06d>.png``.

    Raises BaselineError when a frame cannot be written.
    """
    for number, camera in enumerate(capture.cameras):
        (folder / camera.name).mkdir(parents=True, exist_ok=True)
        for time in range(capture.frame_count):
            path = folder / image_name(camera.name, time)
            rgb = capture.read(number, time)
            # Level 1: the frames are read once and thrown away, so time matters more than size.
            if not cv2.imwrite(str(path), rgb[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1]):
                raise BaselineError(f"cannot write {path}: is the disk full?")


def write_masks(capture: Capture, moving: Path, folder: Path) -> None:
    """Turn motion masks (255 = moving) into COLMAP's (0 = no features), ``<image name>.png`` each.

    Raises CaptureError when a mask is missing or of another size than the frames.
    """
    for camera in capture.cameras:
        (folder / camera.name).mkdir(parents=True, exist_ok=True)
        for time in range(capture.frame_count):
            source = moving / camera.name / f"{time:06d}.png"
            mask = cv2.imread(str(source), cv2.IMREAD_GRAYSCALE)
            if mask is None:
                raise CaptureError(f"{source}: no readable motion mask; give one per frame or drop the masks")
            if mask.shape != (camera.height, camera.width):
                raise CaptureError(
                    f"{source}: mask is {mask.shape[::-1]}, frames are {(camera.width, camera.height)}"
                )
            cv2.imwrite(str(folder / f"{image_name(camera.name, time)}.png"), np.where(mask > 127, 0, 255))


def extract_features(
    cameras: tuple[Camera, ...],
    frame_count: int,
    images: Path,
    database: Path,
    settings: BaselineSettings,
    masks: Path | None = None,
) -> None:
    """SIFT on the CPU with COLMAP's defaults; one PINHOLE camera per device with its known intrinsics.

    A camera of unknown focal length is a SIMPLE_PINHOLE whose focal length is COLMAP's default, not known.
    """
    pycolmap.set_random_seed(settings.random_seed)
    extraction = pycolmap.FeatureExtractionOptions(num_threads=settings.num_threads, use_gpu=False)
    for camera in cameras:
        reader = pycolmap.ImageReaderOptions()
        if camera.focal_known:
            reader.camera_model = "PINHOLE"
            principal_point = f"{camera.cx + PIXEL_CENTRE!r},{camera.cy + PIXEL_CENTRE!r}"
            reader.camera_params = f"{camera.fx!r},{camera.fy!r},{principal_point}"
        else:
            # Whatever is given as parameters counts as known.
            reader.camera_model = "SIMPLE_PINHOLE"
        if masks is not None:
            reader.mask_path = str(masks)
        pycolmap.extract_features(
            database,
            images,
            image_names=[image_name(camera.name, time) for time in range(frame_count)],
            camera_mode=pycolmap.CameraMode.PER_FOLDER,
            reader_options=reader,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )
        if not camera.focal_known:
            _set_principal_point(camera, database)


def _set_principal_point(camera: Camera, database: Path) -> None:
    with pycolmap.Database.open(database) as opened:
        stored = opened.read_camera(_camera_id(camera, opened))
        stored.principal_point_x = camera.cx + PIXEL_CENTRE
        stored.principal_point_y = camera.cy + PIXEL_CENTRE
        opened.update_camera(stored)


def _camera_id(camera: Camera, database: Any) -> int:
    return int(database.read_image_with_name(image_name(camera.name, 0)).camera_id)


def pairs_to_match(cameras: list[str], frame_count: int, settings: BaselineSettings) -> list[tuple[str, str]]:
    """Image pairs of the paper: own camera within +-intra_window, other cameras within +-inter_window."""
    if settings.pairing == "exhaustive":
        names = [image_name(camera, time) for camera in cameras for time in range(frame_count)]
        return list(itertools.combinations(names, 2))
    pairs = []
    for camera in cameras:
        for time in range(frame_count):
            for other in range(time + 1, min(time + settings.intra_window + 1, frame_count)):
                pairs.append((image_name(camera, time), image_name(camera, other)))
    for first, second in itertools.combinations(cameras, 2):
        for time in range(frame_count):
            low = max(0, time - settings.inter_window)
            for other in range(low, min(time + settings.inter_window + 1, frame_count)):
                pairs.append((image_name(first, time), image_name(second, other)))
    return pairs


def match_features(pairs: list[tuple[str, str]], database: Path, settings: BaselineSettings) -> None:
    """Match and geometrically verify the given pairs with COLMAP's defaults."""
    pycolmap.set_random_seed(settings.random_seed)
    list_path = database.with_suffix(".pairs.txt")
    list_path.write_text("".join(f"{first} {second}\n" for first, second in pairs))
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = settings.random_seed
    pycolmap.match_image_pairs(
        database,
        matching_options=pycolmap.FeatureMatchingOptions(num_threads=settings.num_threads, use_gpu=False),
        pairing_options=pycolmap.ImportedPairingOptions(match_list_path=str(list_path)),
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )


def reconstruct(
    method: Method,
    images: Path,
    database: Path,
    out: Path,
    settings: BaselineSettings,
    cameras: Sequence[Camera] = (),
) -> Any:
    """Largest model found, intrinsics held fixed but for the focal lengths that ``cameras`` do not know.

    GLOMAP refines those that are known along with them. The database is changed.
    Raises BaselineError when no model was found.
    """
    out.mkdir(parents=True, exist_ok=True)
    pycolmap.set_random_seed(settings.random_seed)
    refine_focal = not all(camera.focal_known for camera in cameras)
    if method == "colmap":
        options = _incremental_options(settings)
        if refine_focal:
            options.ba_refine_focal_length = True
            options.mapper.abs_pose_refine_focal_length = True
            with pycolmap.Database.open(database) as opened:
                options.constant_cameras = {_camera_id(c, opened) for c in cameras if c.focal_known}
        models = pycolmap.incremental_mapping(database, images, out, options=options)
    else:
        options = _global_options(settings)
        if refine_focal:
            # As COLMAP says to where focal lengths are not known: global mapping alone does not find them.
            calibration = pycolmap.ViewGraphCalibrationOptions(random_seed=settings.random_seed)
            if not pycolmap.calibrate_view_graph(database, calibration):
                raise BaselineError(f"{method} found no focal lengths in the view graph")
            options.mapper.bundle_adjustment.refine_focal_length = True
        models = pycolmap.global_mapping(database, images, out, options=options)
    if not models:
        raise BaselineError(f"{method} found no model")
    return max(models.values(), key=lambda model: model.num_reg_images())


def _incremental_options(settings: BaselineSettings) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = settings.num_threads
    options.random_seed = settings.random_seed
    options.extract_colors = False
    options.ba_refine_focal_length = False
    options.ba_refine_principal_point = False
    options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    return options


def _global_options(settings: BaselineSettings) -> Any:
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = settings.num_threads
    options.random_seed = settings.random_seed
    options.mapper.num_threads = settings.num_threads
    options.mapper.random_seed = settings.random_seed
    options.mapper.global_positioning.use_gpu = False
    adjustment = options.mapper.bundle_adjustment
    adjustment.refine_focal_length = False
    adjustment.refine_principal_point = False
    adjustment.refine_extra_params = False
    adjustment.ceres.use_gpu = False
    adjustment.ceres.solver_options.num_threads = settings.num_threads
    return options


def read_cameras(model: Any, cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """``cameras`` with the focal lengths of the model, where some were unknown and it has frames of them."""
    if all(camera.focal_known for camera in cameras):
        return tuple(cameras)
    found = {image.name.split("/")[0]: model.cameras[image.camera_id] for image in model.images.values()}
    return tuple(
        replace(camera, fx=found[camera.name].focal_length_x, fy=found[camera.name].focal_length_y)
        if camera.name in found
        else camera
        for camera in cameras
    )


def read_trajectories(model: Any, cameras: list[str], frame_count: int) -> dict[str, Array]:
    """``wTc`` ``(T, 4, 4)`` of each camera, NaN where the model has no pose."""
    trajectories = {camera: np.full((frame_count, 4, 4), np.nan) for camera in cameras}
    for image in model.images.values():
        if not image.has_pose:
            continue
        camera, file_name = image.name.split("/")
        cTw = np.eye(4)
        cTw[:3] = image.cam_from_world().matrix()
        trajectories[camera][int(Path(file_name).stem)] = invert_pose(cTw)
    return trajectories
