from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.errors import EvaluationError
from mvdyn_gtsam.evaluation.alignment import align
from mvdyn_gtsam.evaluation.association import associate
from mvdyn_gtsam.evaluation.groundtruth import GroundTruth
from mvdyn_gtsam.evaluation.scores import Scores, evaluate, evaluate_poses
from mvdyn_gtsam.evaluation.trajectory import trajectory_errors
from mvdyn_gtsam.geometry import Similarity
from tests.evaluation.fakes import FakeReconstruction, perturbed, random_poses, random_similarity

Array = npt.NDArray[np.float64]
Alignment = Callable[[Array, Array], tuple[float, Array]]
seeds = st.integers(0, 10_000)


def truth_of(trajectories: dict[str, Array], fps: float = 10.0) -> GroundTruth:
    return GroundTruth(Path("nowhere"), {c: (np.arange(len(p)) / fps, p) for c, p in trajectories.items()})


def scene(seed: int, cameras: int = 2, frames: int = 12) -> tuple[dict[str, Array], dict[str, Array]]:
    """True poses, and noisy ones in a frame and scale of their own."""
    rng = np.random.default_rng(seed)
    truth = {f"cam{k}": random_poses(rng, frames) for k in range(cameras)}
    eSg = random_similarity(rng)
    return truth, {c: eSg.transform_poses(perturbed(rng, p, 0.02, 0.01)) for c, p in truth.items()}


def horn_similarity(g: Array, e: Array) -> tuple[float, Array]:
    """Scale and rotation of the positions ``(N, 3)`` by Horn's quaternion method: no SVD."""
    g0, e0 = g - g.mean(0), e - e.mean(0)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = e0.T @ g0
    horn = np.array(
        [
            [xx + yy + zz, yz - zy, zx - xz, xy - yx],
            [yz - zy, xx - yy - zz, xy + yx, zx + xz],
            [zx - xz, xy + yx, -xx + yy - zz, yz + zy],
            [xy - yx, zx + xz, yz + zy, -xx - yy + zz],
        ]
    )
    w, x, y, z = np.linalg.eigh(horn)[1][:, -1]
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
    return float(np.sum(g0 * (e0 @ rotation.T)) / np.sum(e0**2)), rotation


def umeyama_similarity(g: Array, e: Array) -> tuple[float, Array]:
    """The same by the singular values, equations 38 to 43 of https://doi.org/10.1109/34.88573."""
    g0, e0 = g - g.mean(0), e - e.mean(0)
    u, singular, vt = np.linalg.svd(g0.T @ e0 / len(g))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return float(np.sum(singular * sign) / np.mean(np.sum(e0**2, axis=1))), u @ np.diag(sign) @ vt


def independent_scores(
    truth: dict[str, Array], estimate: dict[str, Array], similarity: Alignment
) -> tuple[float, float, float, float, float]:
    """ATE, RTE, RRE and the two inter-camera errors from numpy alone; NaN poses are missing."""
    has = {c: np.isfinite(p[:, 0, 3]) for c, p in estimate.items()}
    g = np.concatenate([truth[c][has[c], :3, 3] for c in truth])
    e = np.concatenate([estimate[c][has[c], :3, 3] for c in truth])
    scale, rotation = similarity(g, e)
    residual = scale * (e - e.mean(0)) @ rotation.T - (g - g.mean(0))
    relative, between = [], []
    for camera in truth:
        for t in np.flatnonzero(has[camera][:-1] & has[camera][1:]):
            true_step = np.linalg.inv(truth[camera][t]) @ truth[camera][t + 1]
            step = np.linalg.inv(estimate[camera][t]) @ estimate[camera][t + 1]
            relative.append(_difference(true_step, step, scale))
    for a, b in itertools.combinations(truth, 2):
        for t in np.flatnonzero(has[a] & has[b]):
            true_step = np.linalg.inv(truth[b][t]) @ truth[a][t]
            step = np.linalg.inv(estimate[b][t]) @ estimate[a][t]
            between.append(_difference(true_step, step, scale))
    rte, rre = np.sqrt(np.mean(np.square(relative), axis=0))
    trans, rot = np.sqrt(np.mean(np.square(between), axis=0))
    ate = np.sqrt(np.mean(np.sum(residual**2, axis=1)))
    return float(ate), float(rte), float(rre), float(trans), float(rot)


def _difference(truth: Array, step: Array, scale: float) -> tuple[float, float]:
    rotation = truth[:3, :3].T @ step[:3, :3]
    sine = 0.5 * np.linalg.norm(rotation - rotation.T) / np.sqrt(2.0)
    angle = np.degrees(np.arctan2(sine, 0.5 * (np.trace(rotation) - 1.0)))
    return float(np.linalg.norm(scale * step[:3, 3] - truth[:3, 3])), float(angle)


def figures(scores: Scores) -> tuple[float, ...]:
    values = (
        scores.ate_m,
        scores.rte_m,
        scores.rre_deg,
        scores.inter_camera_trans_m,
        scores.inter_camera_rot_deg,
    )
    return tuple(float("nan") if value is None else value for value in values)


@given(
    seeds,
    st.integers(2, 4),
    st.floats(-3.0, 3.0).map(lambda exponent: 10.0**exponent),
    st.sampled_from([0.0, 1.0, 1e4]),
    st.floats(0.0, 0.5),
)
def test_agrees_with_an_independent_implementation(
    seed: int, cameras: int, scale: float, offset: float, missing: float
) -> None:
    truth, estimate = scene(seed, cameras)
    rng = np.random.default_rng(seed + 1)
    turn = Rotation.random(random_state=rng).as_matrix()
    eSe = Similarity(scale, turn, offset * max(1.0, scale) * rng.normal(size=3))
    gSg = Similarity(1.0, np.eye(3), offset * rng.normal(size=3))
    truth = {c: gSg.transform_poses(p) for c, p in truth.items()}
    estimate = {c: eSe.transform_poses(p) for c, p in estimate.items()}
    for poses in estimate.values():
        # Two steps and one instant of all cameras stay, so that every figure exists.
        poses[3:][rng.random(len(poses) - 3) < missing] = np.nan
    scores = evaluate_poses(FakeReconstruction(estimate), truth_of(truth))
    for similarity in (horn_similarity, umeyama_similarity):
        expected = independent_scores(truth, estimate, similarity)
        np.testing.assert_allclose(figures(scores), expected, rtol=0, atol=1e-6)


@given(seeds, st.sampled_from([1e-6, 1e-3, 1.0, 1e3, 1e6]))
def test_invariant_to_the_frame_and_unit_of_the_reconstruction(seed: int, scale: float) -> None:
    truth, estimate = scene(seed)
    similarity = random_similarity(np.random.default_rng(seed + 1), scale)
    moved = {c: similarity.transform_poses(p) for c, p in estimate.items()}
    before = evaluate_poses(FakeReconstruction(estimate), truth_of(truth))
    after = evaluate_poses(FakeReconstruction(moved), truth_of(truth))
    np.testing.assert_allclose(figures(after), figures(before), rtol=1e-6, atol=1e-6)
    assert after.scale * scale == pytest.approx(before.scale, rel=1e-6)


def test_exact_poses_score_zero() -> None:
    truth, _ = scene(3)
    similarity = random_similarity(np.random.default_rng(0))
    moved = {c: similarity.transform_poses(p) for c, p in truth.items()}
    scores = evaluate_poses(FakeReconstruction(moved), truth_of(truth))
    np.testing.assert_allclose(figures(scores), 0.0, atol=1e-5)
    assert scores.registered == 1.0 and scores.complete


def test_cameras_are_aligned_together_and_not_each_alone() -> None:
    truth, _ = scene(4)
    shifted = {"cam0": truth["cam0"], "cam1": truth["cam1"].copy()}
    shifted["cam1"][:, 0, 3] += 1.0
    scores = evaluate_poses(FakeReconstruction(shifted), truth_of(truth))
    assert scores.ate_m > 0.05
    alone = evaluate_poses(FakeReconstruction(shifted, groups=[["cam0"], ["cam1"]]), truth_of(truth))
    assert alone.ate_m == scores.ate_m


def test_groups_get_figures_of_their_own_besides_the_common_ones() -> None:
    truth, _ = scene(5)
    rng = np.random.default_rng(1)
    apart = {c: random_similarity(rng).transform_poses(p) for c, p in truth.items()}
    scores = evaluate(FakeReconstruction(apart, groups=[["cam0"], ["cam1"]]), truth_of(truth))
    assert scores.ate_m > 0.05
    assert [group.cameras for group in scores.groups] == [("cam0",), ("cam1",)]
    for group in scores.groups:
        assert group.ate_m == pytest.approx(0.0, abs=1e-9)


def test_a_camera_in_no_group_is_a_group_of_its_own() -> None:
    truth, estimate = scene(6, cameras=3)
    scores = evaluate(FakeReconstruction(estimate, groups=[["cam0", "cam2"]]), truth_of(truth))
    assert [group.cameras for group in scores.groups] == [("cam0", "cam2"), ("cam1",)]


def test_missing_frames_are_counted_and_not_bridged() -> None:
    truth, estimate = scene(7)
    estimate["cam0"][5] = np.nan
    # The step from 4 to 6 is made huge: were it bridged, RTE would show it.
    truth["cam0"][6:, :3, 3] += 50.0
    estimate_scores = evaluate_poses(FakeReconstruction(estimate), truth_of(truth))
    assert estimate_scores.registered == pytest.approx(23 / 24)
    assert not estimate_scores.complete
    assert estimate_scores.per_camera["cam0"].registered == pytest.approx(11 / 12)
    reference = associate(FakeReconstruction(estimate), truth_of(truth))["cam0"]
    assert reference.has_estimate.sum() == 11
    steps = {c: len(p) - 1 for c, p in truth.items()}
    steps["cam0"] -= 2
    errors = trajectory_errors(associate(FakeReconstruction(estimate), truth_of(truth)).values())
    assert {c: len(e) for c, e in errors.relative_translation_m.items()} == steps


def test_a_camera_without_any_pose_or_not_there_at_all_counts_as_missing() -> None:
    truth, estimate = scene(8)
    absent = evaluate_poses(FakeReconstruction({"cam0": estimate["cam0"]}), truth_of(truth))
    nothing = dict(estimate, cam1=np.full_like(estimate["cam1"], np.nan))
    empty = evaluate_poses(FakeReconstruction(nothing), truth_of(truth))
    for scores in (absent, empty):
        assert scores.registered == 0.5 and not scores.complete
        assert scores.per_camera["cam1"].ate_m is None
        assert scores.inter_camera_rot_deg is None


def test_no_pose_at_all_is_an_error() -> None:
    truth, estimate = scene(9)
    nothing = {c: np.full_like(p, np.nan) for c, p in estimate.items()}
    with pytest.raises(EvaluationError, match="no frame has both"):
        evaluate_poses(FakeReconstruction(nothing), truth_of(truth))


def test_no_common_camera_is_an_error() -> None:
    truth, estimate = scene(9)
    with pytest.raises(EvaluationError, match="none is in both"):
        evaluate_poses(FakeReconstruction({"left": estimate["cam0"]}), truth_of(truth))


def static_rig(cameras: int, frames: int = 5) -> dict[str, Array]:
    rng = np.random.default_rng(cameras)
    return {f"cam{k}": np.tile(random_poses(rng, 1, step=1.0), (frames, 1, 1)) for k in range(cameras)}


@pytest.mark.parametrize("cameras", [2, 3, 6])
def test_cameras_that_stand_still(cameras: int) -> None:
    truth = static_rig(cameras)
    similarity = random_similarity(np.random.default_rng(2))
    estimate = {c: similarity.transform_poses(p) for c, p in truth.items()}
    scores = evaluate_poses(FakeReconstruction(estimate), truth_of(truth))
    np.testing.assert_allclose(figures(scores), 0.0, atol=1e-5)
    assert scores.scale == pytest.approx(1.0 / similarity.scale)


def test_one_camera_that_stands_still_cannot_be_aligned() -> None:
    truth = static_rig(1)
    with pytest.raises(EvaluationError, match="all true positions coincide"):
        evaluate_poses(FakeReconstruction(truth), truth_of(truth))


def test_estimated_positions_that_coincide_are_an_error() -> None:
    truth, _ = scene(10)
    stuck = {c: np.tile(np.eye(4), (len(p), 1, 1)) for c, p in truth.items()}
    with pytest.raises(EvaluationError, match="all estimated positions coincide"):
        evaluate_poses(FakeReconstruction(stuck), truth_of(truth))


@given(seeds)
def test_motion_on_a_line_takes_the_turn_about_it_from_the_orientations(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_poses(rng, 10)
    truth[:, :3, 3] = np.outer(np.linspace(0.0, 3.0, 10), rng.normal(0.0, 1.0, 3)) + 1.0
    eSg = random_similarity(rng)
    gSe = align(truth, eSg.transform_poses(truth))
    expected = eSg.inverse()
    assert gSe.scale == pytest.approx(expected.scale, rel=1e-9)
    np.testing.assert_allclose(gSe.rotation, expected.rotation, atol=1e-6)
    np.testing.assert_allclose(gSe.translation, expected.translation, atol=1e-6)


def test_mirrored_positions_are_not_matched_by_a_reflection() -> None:
    truth, _ = scene(11)
    mirrored = {c: p.copy() for c, p in truth.items()}
    for poses in mirrored.values():
        poses[:, 0, 3] *= -1.0
    gSe = align(np.concatenate(list(truth.values())), np.concatenate(list(mirrored.values())))
    assert np.linalg.det(gSe.rotation) == pytest.approx(1.0)


def test_a_camera_turned_by_one_degree_shows_between_the_cameras_only() -> None:
    truth, _ = scene(12, frames=20)
    turned = {c: p.copy() for c, p in truth.items()}
    turned["cam1"][:, :3, :3] = (
        truth["cam1"][:, :3, :3] @ Rotation.from_euler("x", 1.0, degrees=True).as_matrix()
    )
    scores = evaluate_poses(FakeReconstruction(turned), truth_of(truth))
    assert scores.inter_camera_rot_deg == pytest.approx(1.0, abs=1e-6)
    assert scores.ate_m == pytest.approx(0.0, abs=1e-9)
    (pair,) = scores.per_pair
    assert pair.cameras == ("cam0", "cam1") and pair.instants == 20


def test_the_start_is_the_first_eight_frames() -> None:
    truth, _ = scene(13, frames=20)
    late = {c: p.copy() for c, p in truth.items()}
    late["cam1"][8:, :3, :3] = (
        truth["cam1"][8:, :3, :3] @ Rotation.from_euler("y", 2.0, degrees=True).as_matrix()
    )
    scores = evaluate_poses(FakeReconstruction(late), truth_of(truth))
    assert scores.inter_camera_start_rot_deg == pytest.approx(0.0, abs=1e-5)
    assert scores.inter_camera_rot_deg == pytest.approx(2.0 * np.sqrt(12 / 20), abs=1e-6)


def test_frames_are_matched_by_time_when_the_truth_starts_late_or_has_gaps() -> None:
    truth, _ = scene(14, cameras=1)
    times = np.arange(12) / 10.0 + 0.004
    keep = [2, 3, 4, 8, 9]
    groundtruth = GroundTruth(Path("nowhere"), {"cam0": (times[keep], truth["cam0"][keep])})
    match = associate(FakeReconstruction(truth), groundtruth)["cam0"]
    assert match.frames.tolist() == keep
    assert match.frame_count == 12
    scores = evaluate_poses(FakeReconstruction(truth), groundtruth)
    assert scores.ate_m == pytest.approx(0.0, abs=1e-9) and scores.complete


def test_true_frames_the_reconstruction_does_not_have_are_missing() -> None:
    truth, _ = scene(15)
    short = {c: p[:9] for c, p in truth.items()}
    scores = evaluate_poses(FakeReconstruction(short), truth_of(truth))
    assert scores.registered == pytest.approx(9 / 12) and not scores.complete


def test_without_evo_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "evo.core.trajectory", None)
    truth, estimate = scene(16)
    with pytest.raises(EvaluationError, match=r"pip install mvdyn_gtsam\[eval\]"):
        evaluate_poses(FakeReconstruction(estimate), truth_of(truth))


def test_large_coordinates_do_not_spoil_the_alignment() -> None:
    truth, _ = scene(17)
    far = Similarity(1.0, np.eye(3), np.array([4.0e5, 5.0e6, 100.0]))
    scores = evaluate_poses(
        FakeReconstruction(truth), truth_of({c: far.transform_poses(p) for c, p in truth.items()})
    )
    assert scores.ate_m == pytest.approx(0.0, abs=1e-6)
