from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.errors import EvaluationError
from mvdyn_gtsam.evaluation.depth import fit_scale_and_offset, frame_depth_error
from mvdyn_gtsam.evaluation.groundtruth import load_groundtruth
from mvdyn_gtsam.evaluation.scores import evaluate
from mvdyn_gtsam.frontend.dense_flow import pixel_raster
from mvdyn_gtsam.geometry import Similarity
from tests.evaluation.fakes import FakeReconstruction, random_poses, random_similarity, write_groundtruth

Image = npt.NDArray[np.float32]
FRAMES = 6
KEYS = [(camera, time) for camera in ("cam0", "cam1") for time in (0, 5)]


class Scene:
    """Two cameras, true depth of two frames each, quantised to the 0.1 mm that the files hold."""

    def __init__(self, capture: Path, **options: object) -> None:
        rng = np.random.default_rng(0)
        self.truth = {camera: random_poses(rng, FRAMES) for camera in ("cam0", "cam1")}
        ramp = np.linspace(1.0, 3.0, 24 * 32).reshape(24, 32)
        self.depths: dict[tuple[str, int], Image] = {
            key: (np.round((ramp + 0.3 * rng.random((24, 32))) * 1e4) / 1e4).astype(np.float32)
            for key in KEYS
        }
        self.masks = {key: np.zeros((24, 32), dtype=bool) for key in KEYS}
        for mask in self.masks.values():
            mask[:6] = True
        self.folder = write_groundtruth(capture, self.truth, self.depths, self.masks, 1e-4)

    def reconstruction(
        self, depths: dict[tuple[str, int], Image], eSg: Similarity | None = None
    ) -> FakeReconstruction:
        similarity = eSg or Similarity.identity()
        return FakeReconstruction({c: similarity.transform_poses(p) for c, p in self.truth.items()}, depths)


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path)


def test_the_exact_scene_in_another_frame_and_unit_scores_zero(scene: Scene) -> None:
    eSg = random_similarity(np.random.default_rng(1))
    depths = {key: (eSg.scale * depth).astype(np.float32) for key, depth in scene.depths.items()}
    scores = evaluate(scene.reconstruction(depths, eSg), scene.folder)
    assert scores.depth is not None
    assert scores.depth.abs_rel == pytest.approx(0.0, abs=1e-5)
    assert scores.depth.delta_1_25 == 1.0
    assert scores.depth.m_d == pytest.approx(0.0, abs=1e-4)
    assert scores.depth.m_d_scale_only == pytest.approx(0.0, abs=1e-4)
    assert scores.depth.coverage == 1.0 and scores.depth.frames == 4
    assert scores.median_depth_m == pytest.approx(np.median(list(scene.depths.values())), rel=1e-5)


def test_scale_and_offset_are_fitted_per_frame_but_not_for_the_point_distance(scene: Scene) -> None:
    depths = {
        key: ((1.0 + 0.1 * k) * depth + 0.2 * k).astype(np.float32)
        for k, (key, depth) in enumerate(scene.depths.items())
    }
    depth = evaluate(scene.reconstruction(depths), scene.folder).depth
    assert depth is not None
    assert depth.abs_rel == pytest.approx(0.0, abs=1e-5)
    assert depth.m_d is not None and depth.m_d > 0.2


def test_figures_against_a_plain_computation(scene: Scene) -> None:
    rng = np.random.default_rng(2)
    depths = {
        key: (depth * np.exp(0.2 * rng.normal(size=depth.shape))).astype(np.float32)
        for key, depth in scene.depths.items()
    }
    depth = evaluate(scene.reconstruction(depths), scene.folder).depth
    relative, moving, ratios, distances = [], [], [], []
    moving_ratios, moving_distances, static_distances = [], [], []
    v, u = np.mgrid[:24, :32]
    ray_length = np.sqrt(((u - 15.5) / 40.0) ** 2 + ((v - 11.5) / 40.0) ** 2 + 1.0)
    for key in KEYS:
        g, e = scene.depths[key].astype(np.float64), depths[key].astype(np.float64)
        design = np.stack([e.ravel(), np.ones(e.size)], axis=1)
        (s, o), *_ = np.linalg.lstsq(design, g.ravel(), rcond=None)
        relative.append(np.abs(s * e + o - g) / g)
        moving.append(relative[-1][scene.masks[key]])
        ratios.append(np.maximum((s * e + o) / g, g / (s * e + o)))
        distances.append(np.abs(e - g) * ray_length)
        moving_ratios.append(ratios[-1][scene.masks[key]])
        moving_distances.append(distances[-1][scene.masks[key]])
        static_distances.append(distances[-1][~scene.masks[key]])
    assert depth is not None
    assert depth.abs_rel == pytest.approx(np.mean(relative), rel=1e-5)
    assert depth.abs_rel_moving == pytest.approx(np.mean(moving), rel=1e-5)
    assert depth.delta_1_25 == pytest.approx(np.mean(np.array(ratios) < 1.25), abs=1e-9)
    assert depth.m_d == pytest.approx(np.median(distances), rel=1e-4)
    assert depth.m_d_scale_only == pytest.approx(np.median(distances), rel=1e-4)
    assert depth.delta_1_25_moving == pytest.approx(np.mean(np.array(moving_ratios) < 1.25), abs=1e-9)
    assert depth.m_d_moving == pytest.approx(np.median(moving_distances), rel=1e-4)
    assert depth.m_d_static == pytest.approx(np.median(static_distances), rel=1e-4)


def test_the_strict_distance_sees_the_pose_and_the_other_does_not(scene: Scene) -> None:
    """Both cameras turned about their own centres: the Sim(3) of the positions stays the identity."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("y", 3.0, degrees=True).as_matrix()
    exact = scene.reconstruction(scene.depths)
    turned = {camera: wTc @ turn for camera, wTc in scene.truth.items()}
    depth = evaluate(FakeReconstruction(turned, scene.depths), scene.folder).depth
    reference = evaluate(exact, scene.folder).depth
    assert depth is not None and reference is not None
    assert depth.m_d is not None and 0.03 < depth.m_d < 0.3
    assert depth.m_d_scale_only == pytest.approx(reference.m_d_scale_only, abs=1e-6)


def test_a_wrong_focal_length_shows_in_the_points(scene: Scene) -> None:
    reconstruction = scene.reconstruction(scene.depths)
    K = reconstruction.intrinsics("cam0")
    true = {"fx": K[0, 0] / 1.1, "fy": K[1, 1] / 1.1, "cx": K[0, 2], "cy": K[1, 2]}
    entries = [{"name": camera, **true} for camera in ("cam0", "cam1")]
    (scene.folder.parent / "capture.json").write_text(json.dumps({"depth_scale": 1e-4, "cameras": entries}))
    scores = evaluate(reconstruction, scene.folder)
    assert scores.depth is not None and scores.depth.abs_rel == pytest.approx(0.0, abs=1e-5)
    # a tenth of how far the points lie from the axis
    offsets = [
        depth[..., None] * (pixel_raster(depth.shape) - K[:2, 2]) / (K[0, 0] / 1.1) * (0.1 / 1.1)
        for depth in scene.depths.values()
    ]
    expected = np.median(np.linalg.norm(np.concatenate(offsets), axis=2))
    assert scores.depth.m_d == pytest.approx(expected, rel=1e-3)


def test_static_and_moving_pixels_are_told_apart(scene: Scene) -> None:
    rng = np.random.default_rng(3)
    depths = {}
    for key, depth in scene.depths.items():
        noisy = depth.copy()
        noisy[scene.masks[key]] *= 1.0 + 0.2 * rng.choice([-1.0, 1.0], size=scene.masks[key].sum())
        depths[key] = noisy
    depth_scores = evaluate(scene.reconstruction(depths), scene.folder).depth
    assert depth_scores is not None
    static, moving = depth_scores.abs_rel_static, depth_scores.abs_rel_moving
    assert static is not None and moving is not None and moving > 4 * static
    assert depth_scores.abs_rel == pytest.approx(0.75 * static + 0.25 * moving, rel=1e-9)


def test_a_wrong_pose_shows_in_the_strict_distance_only(scene: Scene) -> None:
    reconstruction = scene.reconstruction(dict(scene.depths))
    poses = {c: p.copy() for c, p in scene.truth.items()}
    # One frame with true depth put 1 m off; with 12 frames the common Sim(3) moves little.
    poses["cam0"][0, 0, 3] += 1.0
    moved = FakeReconstruction(poses, dict(scene.depths))
    exact, wrong = evaluate(reconstruction, scene.folder), evaluate(moved, scene.folder)
    assert wrong.depth is not None and exact.depth is not None
    first, rest = wrong.per_camera["cam0"].depth, exact.per_camera["cam0"].depth
    assert first is not None and rest is not None and first.m_d is not None
    assert first.m_d > 0.1
    assert wrong.depth.abs_rel == pytest.approx(exact.depth.abs_rel, abs=1e-6)


def test_frames_without_depth_are_counted_as_failures(scene: Scene) -> None:
    depths = {KEYS[0]: scene.depths[KEYS[0]], KEYS[1]: np.full((24, 32), np.nan, dtype=np.float32)}
    depth = evaluate(scene.reconstruction(depths), scene.folder).depth
    assert depth is not None
    assert depth.frames == 4 and depth.frames_without_estimate == 3
    assert depth.coverage == pytest.approx(0.25)
    nothing = evaluate(scene.reconstruction({}), scene.folder)
    assert nothing.depth is not None and nothing.depth.abs_rel is None and nothing.depth.m_d is None
    assert nothing.to_json()["abs_rel"] is None


def test_invalid_pixels_on_either_side_are_left_out(scene: Scene) -> None:
    depths = {key: depth.copy() for key, depth in scene.depths.items()}
    for depth in depths.values():
        depth[:, :8] = np.nan
    scores = evaluate(scene.reconstruction(depths), scene.folder).depth
    assert scores is not None
    assert scores.abs_rel == pytest.approx(0.0, abs=1e-5)
    assert scores.coverage == pytest.approx(0.75)


def test_another_size_than_the_truth_is_an_error(scene: Scene) -> None:
    small = {key: depth[::2, ::2] for key, depth in scene.depths.items()}
    with pytest.raises(EvaluationError, match="cam0 frame 0: estimated depth is"):
        evaluate(scene.reconstruction(small), scene.folder)


def test_scale_and_offset_recover_an_affine_relation_and_survive_constant_depth() -> None:
    e = np.linspace(1.0, 2.0, 50)
    assert fit_scale_and_offset(e, 3.0 * e - 0.5) == pytest.approx((3.0, -0.5))
    assert fit_scale_and_offset(np.full(50, 2.0), e) == pytest.approx((0.0, 1.5))


def test_error_map_is_nan_where_nothing_was_measured(scene: Scene) -> None:
    depths = dict(scene.depths)
    depths[KEYS[0]] = depths[KEYS[0]].copy()
    depths[KEYS[0]][0, 0] = np.nan
    groundtruth = load_groundtruth(scene.folder)
    error = frame_depth_error(scene.reconstruction(depths), groundtruth, "cam0", 0)
    assert np.isnan(error[0, 0]) and np.nanmax(error) < 1e-5
    assert np.isnan(frame_depth_error(scene.reconstruction({}), groundtruth, "cam0", 0)).all()
