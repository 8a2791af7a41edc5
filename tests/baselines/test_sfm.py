from __future__ import annotations

import sqlite3
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.baselines import sfm
from mvdyn_gtsam.baselines.settings import BaselineSettings, Method
from mvdyn_gtsam.capture import Camera, load_capture
from mvdyn_gtsam.errors import BaselineError, CaptureError
from tests.baselines.scenes import CX, CY, FOCAL, HEIGHT, WIDTH, write_capture


def test_pairs_are_those_of_the_paper() -> None:
    pairs = sfm.pairs_to_match(["a", "b"], 30, BaselineSettings())
    assert len(pairs) == len({frozenset(pair) for pair in pairs})
    partners: dict[str, set[str]] = {}
    for first, second in pairs:
        partners.setdefault(first, set()).add(second)
        partners.setdefault(second, set()).add(first)
    own = {sfm.image_name("a", time) for time in range(5, 26) if time != 15}
    other = {sfm.image_name("b", time) for time in range(10, 21)}
    assert partners[sfm.image_name("a", 15)] == own | other
    assert sfm.image_name("a", 10) in partners[sfm.image_name("a", 0)]
    assert sfm.image_name("a", 11) not in partners[sfm.image_name("a", 0)]


def test_windows_can_be_closed() -> None:
    settings = BaselineSettings(intra_window=1, inter_window=0)
    assert sfm.pairs_to_match(["a", "b", "c"], 2, settings) == [
        ("a/000000.png", "a/000001.png"),
        ("b/000000.png", "b/000001.png"),
        ("c/000000.png", "c/000001.png"),
        ("a/000000.png", "b/000000.png"),
        ("a/000001.png", "b/000001.png"),
        ("a/000000.png", "c/000000.png"),
        ("a/000001.png", "c/000001.png"),
        ("b/000000.png", "c/000000.png"),
        ("b/000001.png", "c/000001.png"),
    ]


def test_exhaustive_pairs_are_all() -> None:
    assert len(sfm.pairs_to_match(["a", "b"], 10, BaselineSettings(pairing="exhaustive"))) == 20 * 19 // 2


def test_intrinsics_stay_fixed_in_both_methods() -> None:
    incremental = sfm._incremental_options(BaselineSettings())
    overall = sfm._global_options(BaselineSettings(num_threads=1))
    adjustment = overall.mapper.bundle_adjustment
    assert not (incremental.ba_refine_focal_length or incremental.ba_refine_extra_params)
    assert not incremental.mapper.abs_pose_refine_focal_length
    assert not (adjustment.refine_focal_length or adjustment.refine_extra_params)
    assert not (incremental.ba_refine_principal_point or adjustment.refine_principal_point)
    assert adjustment.ceres.solver_options.num_threads == 1


def test_poses_are_turned_into_camera_to_world_and_missing_ones_are_nan() -> None:
    wTc = np.eye(4)
    wTc[:3, :3] = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
    wTc[:3, 3] = [1.0, 2.0, 3.0]
    cTw = SimpleNamespace(matrix=lambda: np.linalg.inv(wTc)[:3])
    images = {
        1: SimpleNamespace(name="b/000002.png", has_pose=True, cam_from_world=lambda: cTw),
        2: SimpleNamespace(name="a/000000.png", has_pose=False),
    }
    trajectories = sfm.read_trajectories(SimpleNamespace(images=images), ["a", "b"], 3)
    assert np.isnan(trajectories["a"]).all() and np.isnan(trajectories["b"][:2]).all()
    np.testing.assert_allclose(trajectories["b"][2], wTc, atol=1e-12)
    assert trajectories["b"].shape == (3, 4, 4)


def test_largest_model_wins_and_none_is_an_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    small, large = (SimpleNamespace(num_reg_images=lambda n=n: n) for n in (4, 9))
    found = {0: small, 1: large}
    monkeypatch.setattr("pycolmap.global_mapping", lambda *_, **__: found)
    out = tmp_path
    assert sfm.reconstruct("glomap", out, out / "db", out / "sparse", BaselineSettings()) is large
    found.clear()
    with pytest.raises(BaselineError, match="glomap found no model"):
        sfm.reconstruct("glomap", out, out / "db", out / "sparse", BaselineSettings())


def test_no_features_where_something_moves(tmp_path: Path) -> None:
    capture_folder, moving, images = tmp_path / "capture", tmp_path / "moving", tmp_path / "images"
    write_capture(capture_folder, frames=1, cameras=1)
    capture = load_capture(capture_folder)
    mask = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    mask[:, : WIDTH // 2] = 255
    (moving / "cam0").mkdir(parents=True)
    assert cv2.imwrite(str(moving / "cam0" / "000000.png"), mask)
    sfm.write_frames(capture, images)
    sfm.write_masks(capture, moving, tmp_path / "masks")
    settings = BaselineSettings(num_threads=1)
    for name, masks in (("plain", None), ("masked", tmp_path / "masks")):
        sfm.extract_features(capture.cameras, 1, images, tmp_path / f"{name}.db", settings, masks)
    plain, masked = (_keypoints(tmp_path / f"{name}.db") for name in ("plain", "masked"))
    assert (plain[:, 0] < WIDTH // 2 - 1).sum() > 20
    assert len(masked) > 20 and (masked[:, 0] >= WIDTH // 2 - 1).all()


def test_a_missing_or_wrongly_sized_mask_is_named(tmp_path: Path) -> None:
    write_capture(tmp_path / "capture", frames=1, cameras=1)
    capture = load_capture(tmp_path / "capture")
    with pytest.raises(CaptureError, match="000000.png: no readable motion mask"):
        sfm.write_masks(capture, tmp_path / "moving", tmp_path / "masks")
    (tmp_path / "moving" / "cam0").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "moving" / "cam0" / "000000.png"), np.zeros((4, 4), dtype=np.uint8))
    with pytest.raises(CaptureError, match="000000.png: mask is"):
        sfm.write_masks(capture, tmp_path / "moving", tmp_path / "masks")


def test_the_database_holds_one_pinhole_camera_per_device_at_colmaps_pixel_centres(tmp_path: Path) -> None:
    write_capture(tmp_path / "capture", frames=2)
    capture = load_capture(tmp_path / "capture")
    sfm.write_frames(capture, tmp_path / "images")
    database = tmp_path / "a.db"
    sfm.extract_features(capture.cameras, 2, tmp_path / "images", database, BaselineSettings(num_threads=1))
    with sqlite3.connect(database) as connection:
        cameras = connection.execute("SELECT params, prior_focal_length FROM cameras").fetchall()
        images = connection.execute("SELECT name FROM images").fetchall()
    assert sorted(name for (name,) in images) == [f"cam{k}/{t:06d}.png" for k in (0, 1) for t in (0, 1)]
    assert len(cameras) == 2
    for params, prior in cameras:
        np.testing.assert_allclose(np.frombuffer(params), [FOCAL, FOCAL, CX + 0.5, CY + 0.5])
        assert prior == 1


def _unknown_and_known(folder: Path) -> tuple[Camera, ...]:
    """The cameras of a capture of one frame, the first of unknown focal length, written with its frames."""
    write_capture(folder / "capture", frames=1)
    capture = load_capture(folder / "capture")
    sfm.write_frames(capture, folder / "images")
    first, second = capture.cameras
    unknown = replace(first, fx=150.0, fy=150.0, cx=CX + 1.0, cy=CY - 2.0, focal_known=False)
    return unknown, second


def test_a_guessed_focal_length_is_not_given_and_what_is_known_is(tmp_path: Path) -> None:
    cameras, database = _unknown_and_known(tmp_path), tmp_path / "a.db"
    sfm.extract_features(cameras, 1, tmp_path / "images", database, BaselineSettings(num_threads=1))
    with sqlite3.connect(database) as connection:
        stored = connection.execute(
            "SELECT images.name, model, params, prior_focal_length FROM cameras JOIN images USING (camera_id)"
        ).fetchall()
    (_, model, unknown, prior), (_, known_model, known, known_prior) = sorted(stored)
    assert (prior, known_prior) == (0, 1)
    assert model != known_model
    # 1.2 times the longer side is COLMAP's default.
    np.testing.assert_allclose(np.frombuffer(unknown), [1.2 * WIDTH, CX + 1.5, CY - 1.5])
    np.testing.assert_allclose(np.frombuffer(known), [FOCAL, FOCAL, CX + 0.5, CY + 0.5])


def test_focal_lengths_that_are_unknown_are_refined(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cameras, database = _unknown_and_known(tmp_path), tmp_path / "a.db"
    sfm.extract_features(cameras, 1, tmp_path / "images", database, BaselineSettings(num_threads=1))
    calls: list[tuple[str, Any]] = []
    found = SimpleNamespace(num_reg_images=lambda: 1)

    def called(name: str, result: Any) -> Any:
        def call(*arguments: Any, **options: Any) -> Any:
            calls.append((name, options.get("options")))
            return result

        return call

    monkeypatch.setattr("pycolmap.incremental_mapping", called("colmap", {0: found}))
    monkeypatch.setattr("pycolmap.global_mapping", called("glomap", {0: found}))
    monkeypatch.setattr("pycolmap.calibrate_view_graph", called("view graph", True))

    def run(method: Method, *which: Camera) -> list[tuple[str, Any]]:
        calls.clear()
        sfm.reconstruct(method, tmp_path, database, tmp_path / "sparse", BaselineSettings(), which)
        return list(calls)

    with sqlite3.connect(database) as connection:
        (known_id,) = connection.execute("SELECT camera_id FROM images WHERE name LIKE 'cam1/%'").fetchone()
    ((_, options),) = run("colmap", *cameras)
    assert options.ba_refine_focal_length and options.mapper.abs_pose_refine_focal_length
    assert not (options.ba_refine_principal_point or options.ba_refine_extra_params)
    assert options.constant_cameras == {known_id}
    (calibration, _), (_, options) = run("glomap", *cameras)
    assert calibration == "view graph"
    adjustment = options.mapper.bundle_adjustment
    assert adjustment.refine_focal_length
    assert not (adjustment.refine_principal_point or adjustment.refine_extra_params)
    ((_, options),) = run("colmap", cameras[1])
    assert options.summary() == sfm._incremental_options(BaselineSettings()).summary()
    ((name, options),) = run("glomap", cameras[1])
    assert name == "glomap"
    assert options.summary() == sfm._global_options(BaselineSettings()).summary()
    monkeypatch.setattr("pycolmap.calibrate_view_graph", lambda *_: False)
    with pytest.raises(BaselineError, match="glomap found no focal lengths"):
        run("glomap", *cameras)


def test_cameras_get_the_focal_lengths_of_the_model() -> None:
    guess = Camera("a", 8, 6, 5.0, 5.0, 3.5, 2.5, focal_known=False)
    known = replace(guess, name="b", fx=7.0, fy=7.5, focal_known=True)
    lost = replace(guess, name="c")
    model = SimpleNamespace(
        images={
            1: SimpleNamespace(name="b/000000.png", camera_id=4),
            2: SimpleNamespace(name="a/000001.png", camera_id=3),
        },
        cameras={
            3: SimpleNamespace(focal_length_x=6.0, focal_length_y=6.0),
            4: SimpleNamespace(focal_length_x=7.1, focal_length_y=7.6),
        },
    )
    expected = (replace(guess, fx=6.0, fy=6.0), replace(known, fx=7.1, fy=7.6), lost)
    assert sfm.read_cameras(model, (guess, known, lost)) == expected
    assert sfm.read_cameras(model, (known,)) == (known,)


def _keypoints(database: Path) -> np.ndarray:
    with sqlite3.connect(database) as connection:
        rows, columns, data = connection.execute("SELECT rows, cols, data FROM keypoints").fetchone()
    return np.frombuffer(data, dtype=np.float32).reshape(rows, columns)
