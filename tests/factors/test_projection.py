from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import gtsam
import numpy as np
import pytest

from factors.projection import adjoint, relative_poses, reproject, reproject_with_jacobians
from tests.factors.synthetic import make_scene, matrices, numerical_jacobian, perturbed


def test_does_not_import_gtsam() -> None:
    modules = ["projection", "robust", "compression", "keys", "flow_terms"]
    imports = ", ".join(f"factors.{module}" for module in modules)
    code = f"import sys, {imports}; sys.exit('gtsam' in sys.modules)"
    root = Path(__file__).resolve().parents[2]
    assert subprocess.run([sys.executable, "-c", code], cwd=root, check=False).returncode == 0


@pytest.mark.parametrize("seed", range(3))
def test_pixels_match_the_native_camera(seed: int) -> None:
    scene = make_scene(np.random.default_rng(seed), 20, 3)
    w_points = scene.wTi.transformFrom((scene.rays * np.exp(scene.log_depth)[:, None]).T)
    for edge, wTj in enumerate(scene.wTj):
        fx, fy, cx, cy = scene.intrinsics_j[edge]
        camera = gtsam.PinholeCameraCal3_S2(wTj, gtsam.Cal3_S2(fx, fy, 0.0, cx, cy))
        expected = np.array([camera.project(point) for point in w_points.T])
        np.testing.assert_allclose(scene.pixels[edge], expected, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_jacobians_are_numerical_ones(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = make_scene(rng, 15, 3)
    wTi, *wTj = perturbed(rng, scene.poses, 0.02)

    def pixels(delta: np.ndarray) -> np.ndarray:
        wTi_moved = wTi.retract(delta[:6]).matrix()
        wTj_moved = matrices([pose.retract(delta[6:12]) for pose in wTj])
        return reproject(
            scene.rays, scene.log_depth + delta[12], wTi_moved, wTj_moved, scene.intrinsics_j
        ).pixels.ravel()

    expected = numerical_jacobian(pixels, 13).reshape(3, 15, 2, 13)
    _, jacobians = reproject_with_jacobians(
        scene.rays, scene.log_depth, wTi.matrix(), matrices(wTj), scene.intrinsics_j
    )
    np.testing.assert_allclose(jacobians.wTi, expected[..., :6], rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(jacobians.wTj, expected[..., 6:12], rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(jacobians.log_depth, expected[..., 12], rtol=1e-5, atol=1e-4)


def test_linearisation_is_that_of_the_native_projection_factor() -> None:
    rng = np.random.default_rng(5)
    scene = make_scene(rng, 10, 2)
    wTi, *wTj = perturbed(rng, scene.poses, 0.02)
    i_points = scene.rays * np.exp(scene.log_depth)[:, None]
    w_points = wTi.transformFrom(i_points.T).T
    reprojection, jacobians = reproject_with_jacobians(
        scene.rays, scene.log_depth, wTi.matrix(), matrices(wTj), scene.intrinsics_j
    )
    for edge in range(2):
        fx, fy, cx, cy = scene.intrinsics_j[edge]
        for k in range(10):
            values = gtsam.Values()
            values.insert(0, wTj[edge])
            values.insert(1, w_points[k])
            factor = gtsam.GenericProjectionFactorCal3_S2(
                scene.pixels[edge, k],
                gtsam.noiseModel.Unit.Create(2),
                0,
                1,
                gtsam.Cal3_S2(fx, fy, 0.0, cx, cy),
            )
            native, rhs = factor.linearize(values).jacobian()
            np.testing.assert_allclose(jacobians.wTj[edge, k], native[:, :6], atol=1e-9)
            np.testing.assert_allclose(reprojection.pixels[edge, k] - scene.pixels[edge, k], -rhs, atol=1e-9)
            # the landmark moves along the ray, and rigidly with frame i
            by_point = native[:, 6:]
            wRi = wTi.rotation().matrix()
            np.testing.assert_allclose(jacobians.log_depth[edge, k], by_point @ wRi @ i_points[k], atol=1e-9)
            np.testing.assert_allclose(jacobians.wTi[edge, k, :, 3:], by_point @ wRi, atol=1e-9)


def test_points_behind_the_camera_are_invalid_and_finite() -> None:
    rays = np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]])
    wTj = np.eye(4)[None].repeat(2, axis=0)
    wTj[0, 2, 3] = 2.0  # exactly on the first point's plane
    wTj[1, 2, 3] = 5.0
    reprojection, jacobians = reproject_with_jacobians(
        rays, np.log([2.0, 2.0]), np.eye(4), wTj, np.tile([100.0, 100.0, 50.0, 50.0], (2, 1))
    )
    assert not reprojection.valid.any()
    for array in (reprojection.pixels, jacobians.wTi, jacobians.wTj, jacobians.log_depth):
        assert np.isfinite(array).all()
    assert not jacobians.wTi.any() and not jacobians.wTj.any() and not jacobians.log_depth.any()


def test_intrinsics_as_matrices_and_as_vectors() -> None:
    scene = make_scene(np.random.default_rng(2), 5, 2)
    K = np.zeros((2, 3, 3))
    K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2] = scene.intrinsics_j.T
    K[:, 2, 2] = 1.0
    pixels = reproject(scene.rays, scene.log_depth, scene.wTi.matrix(), matrices(scene.wTj), K).pixels
    np.testing.assert_array_equal(pixels, scene.pixels)
    with pytest.raises(ValueError, match="intrinsics"):
        reproject(scene.rays, scene.log_depth, scene.wTi.matrix(), matrices(scene.wTj), K[0])


def test_adjoint_and_relative_pose_match_gtsam() -> None:
    scene = make_scene(np.random.default_rng(4), 1, 3)
    jTi = relative_poses(scene.wTi.matrix(), matrices(scene.wTj))
    for edge, wTj in enumerate(scene.wTj):
        native = wTj.between(scene.wTi)
        np.testing.assert_allclose(jTi[edge], native.matrix(), atol=1e-12)
        np.testing.assert_allclose(adjoint(jTi)[edge], native.AdjointMap(), atol=1e-12)
