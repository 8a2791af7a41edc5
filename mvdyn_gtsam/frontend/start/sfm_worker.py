"""Structure from motion of one view set in a process of its own: ``python -m ...sfm_worker IN.npz OUT.npz``.

A separate process keeps COLMAP's image libraries away from OpenCV's (two copies of zlib abort at the first
PNG) and lets several cameras be solved side by side. One thread each, so that results repeat exactly.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from mvdyn_gtsam.memory import keep_freed_memory

PIXEL_CENTRE = 0.5
"""COLMAP puts the centre of the first pixel at 0.5."""

TWO_VIEW_PX = 1.0
"""Epipolar error up to which a match fits a camera's motion. COLMAP's default of 4 let the flow of a person
who walked by pass as rigid motion and put whole cameras' maps wrong."""

TRACKS_PER_VIEW = 200
"""Tracks through a view, long ones first, that global mapping positions; the others are triangulated after
it. With all of them it took 2 to 8 times as long on nine maps of four captures, the reprojection errors being
the same or larger. Of ten seeds on the worst of them (hololens_office_2seg, cam1), 200 gave six good maps and
none beyond use, 150 six and two, 100 five and two, all tracks five and two."""


FITTING_PX = 0.5
"""Reprojection error up to which a sighting speaks for a focal length. Source: choice; about what SIFT is
good to."""


def main(source: str, target: str) -> int:
    keep_freed_memory()
    problem = dict(np.load(source))
    pycolmap.logging.minloglevel = 3
    pycolmap.set_random_seed(0)
    if "focal_guesses" in problem:
        np.savez(target, **_focal_lengths(problem))
    else:
        np.savez(target, **_read_model(_mapped(problem), problem))
    return 0


def _focal_lengths(problem: dict[str, Any]) -> dict[str, Any]:
    """Where bundle adjustment with a free focal length ends from each of ``focal_guesses (G,)`` px, NaN where
    there is no model, and how many sightings fit there, ``(G,)`` each."""
    focal = np.full(len(problem["focal_guesses"]), np.nan)
    fitting = np.zeros(len(focal), np.int64)
    for index, guess in enumerate(problem["focal_guesses"]):
        # each guess from matches that its own epipolar geometry checked: far from the truth few are right
        guessed = {**problem, "intrinsics": np.array([guess, guess, *problem["intrinsics"][0, 2:]])}
        model = _mapped(guessed, free_focal=True)
        if model is not None:
            focal[index] = next(iter(model.cameras.values())).params[0]
            fitting[index] = _fitting(model)
    return {"focal": focal, "fitting": fitting}


def _fitting(model: Any) -> int:
    """Sightings within ``FITTING_PX`` of where the model has them."""
    count = 0
    for point in model.points3D.values():
        for element in point.track.elements:
            image = model.images[element.image_id]
            seen = image.project_point(point.xyz)
            if seen is not None:
                error = np.linalg.norm(seen - image.points2D[element.point2D_idx].xy)
                count += bool(error < FITTING_PX)
    return count


def _mapped(problem: dict[str, Any], free_focal: bool = False) -> Any:
    """The largest model that can be had; None where there is none."""
    best = None
    few = bool(problem.get("few_views", False))
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "views.db"
        _write_database(database, problem, "SIMPLE_PINHOLE" if free_focal else "PINHOLE")
        for mapping in (_few_views_mapping,) if few else (_global_mapping, _incremental_mapping):
            for model in mapping(database, Path(folder) / mapping.__name__, free_focal).values():
                if best is None or model.num_reg_images() > best.num_reg_images():
                    best = model
            if best is not None and best.num_reg_images() >= 0.8 * len(problem["count"]):
                break
    return best


def _write_database(path: Path, problem: dict[str, Any], camera_model: str) -> None:
    """``intrinsics`` (fx, fy, cx, cy) and ``size`` are one row for all views or one row per view."""
    sizes = np.atleast_2d(problem["size"])
    cameras = [
        _camera(row, size, camera_model)
        for row, size in zip(np.atleast_2d(problem["intrinsics"]), sizes, strict=True)
    ]
    splits = np.cumsum(problem["count"])[:-1]
    keypoints = [pixels + PIXEL_CENTRE for pixels in np.split(problem["pixels"], splits)]
    matches = np.split(problem["matches"].astype(np.uint32), np.cumsum(problem["match_count"])[:-1])
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose = True
    options.ransac.random_seed = 0
    options.ransac.max_error = TWO_VIEW_PX
    with pycolmap.Database.open(path) as database:
        sensors, rigs = [], []
        for camera in cameras:
            camera.camera_id = database.write_camera(camera)
            sensors.append(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera.camera_id))
            rig = pycolmap.Rig()
            rig.add_ref_sensor(sensors[-1])
            rigs.append(database.write_rig(rig))
        if len(cameras) == 1:
            cameras, sensors, rigs = ([one[0]] * len(keypoints) for one in (cameras, sensors, rigs))
        ids = []
        for index, (pixels, camera) in enumerate(zip(keypoints, cameras, strict=True)):
            image_id = database.write_image(pycolmap.Image(name=f"{index:06d}", camera_id=camera.camera_id))
            frame = pycolmap.Frame()
            frame.rig_id = rigs[index]
            frame.add_data_id(pycolmap.data_t(sensors[index], image_id))
            database.write_frame(frame)
            database.write_keypoints(image_id, pixels.astype(np.float32))
            ids.append(image_id)
        for (first, second), pair in zip(problem["pairs"], matches, strict=True):
            geometry = pycolmap.estimate_calibrated_two_view_geometry(
                cameras[first], keypoints[first], cameras[second], keypoints[second], pair, options
            )
            database.write_matches(ids[first], ids[second], pair)
            database.write_two_view_geometry(ids[first], ids[second], geometry)


def _camera(intrinsics: Any, size: Any, model: str) -> Any:
    fx, fy, cx, cy = intrinsics
    focal = [fx, fy] if model == "PINHOLE" else [fx]
    parameters = [*focal, cx + PIXEL_CENTRE, cy + PIXEL_CENTRE]
    camera = pycolmap.Camera(model=model, width=int(size[0]), height=int(size[1]), params=parameters)
    camera.has_prior_focal_length = True
    return camera


def _global_mapping(database: Path, output: Path, free_focal: bool) -> dict[int, Any]:
    output.mkdir()
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = 1
    options.random_seed = 0
    options.multiple_models = False
    mapper = options.mapper
    mapper.bundle_adjustment.refine_focal_length = free_focal
    mapper.bundle_adjustment.refine_extra_params = False
    mapper.bundle_adjustment.ceres.use_gpu = False
    # Huber, the default, let a person near a slow camera bend the map: 14 mm off on 100, and 6 with Cauchy.
    mapper.bundle_adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    mapper.global_positioning.use_gpu = False
    # Tighter than COLMAP's defaults (15 px, 0.01): intrinsics are known and moving things must fall out.
    mapper.retriangulation.merge_max_reproj_error = 4.0
    mapper.retriangulation.complete_max_reproj_error = 4.0
    mapper.max_normalized_reproj_error = 0.005
    mapper.track_required_tracks_per_view = TRACKS_PER_VIEW
    try:
        return dict(pycolmap.global_mapping(database, output, output, options))
    except (RuntimeError, ValueError):  # pycolmap reports a failed stage this way; the other mapper is tried
        return {}


def _incremental_mapping(database: Path, output: Path, free_focal: bool) -> dict[int, Any]:
    output.mkdir()
    options = _incremental_options()
    options.ba_refine_focal_length = free_focal
    return dict(pycolmap.incremental_mapping(database, output, output, options))


def _few_views_mapping(database: Path, output: Path, free_focal: bool) -> dict[int, Any]:
    """A handful of images far apart: few matches each, so COLMAP's 100 and 30 inliers are out of reach."""
    output.mkdir()
    options = _incremental_options()
    options.ba_refine_focal_length = free_focal
    options.min_model_size = 2
    options.triangulation.ignore_two_view_tracks = False
    # Far apart, they have the angle that video lacks; near-coincident centres are a degenerate start.
    options.mapper.init_min_tri_angle = 8.0
    options.mapper.filter_min_tri_angle = 1.5
    options.triangulation.min_angle = 1.5
    options.mapper.init_min_num_inliers = 20
    options.mapper.abs_pose_min_num_inliers = 12
    options.mapper.abs_pose_min_inlier_ratio = 0.15
    return dict(pycolmap.incremental_mapping(database, output, output, options))


def _incremental_options() -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = 0
    options.multiple_models = False
    options.min_model_size = 3
    options.extract_colors = False
    options.ba_refine_extra_params = False
    mapper = options.mapper
    mapper.abs_pose_refine_focal_length = False
    mapper.abs_pose_refine_extra_params = False
    # Hand-held video has little parallax and may move forwards; the defaults (16 degrees, 0.95) refuse it.
    mapper.init_min_tri_angle = 4.0
    mapper.init_max_forward_motion = 1.0
    mapper.filter_min_tri_angle = 0.75
    options.triangulation.min_angle = 0.75
    return options


def _read_model(model: Any, problem: dict[str, Any]) -> dict[str, Any]:
    frames = len(problem["count"])
    total = int(problem["count"].sum())
    start = np.concatenate([[0], np.cumsum(problem["count"])])
    cTw = np.full((frames, 4, 4), np.nan)
    point_of_keypoint = np.full(total, -1, np.int64)
    if model is None:
        return {"cTw": cTw, "points": np.zeros((0, 3)), "point_of_keypoint": point_of_keypoint}
    identifiers = sorted(model.points3D)
    row = {identifier: index for index, identifier in enumerate(identifiers)}
    points = np.array([model.points3D[identifier].xyz for identifier in identifiers]).reshape(-1, 3)
    for image in model.images.values():
        if not image.has_pose:
            continue
        index = int(image.name)
        cTw[index] = np.eye(4)
        cTw[index, :3] = image.cam_from_world().matrix()
        for keypoint, observation in enumerate(image.points2D):
            if observation.has_point3D():
                point_of_keypoint[start[index] + keypoint] = row[observation.point3D_id]
    return {"cTw": cTw, "points": points, "point_of_keypoint": point_of_keypoint}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2]))
