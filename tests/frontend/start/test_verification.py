"""Dense warping as a witness, on rendered planes whose placement is known."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.grid import Grid
from mvdyn_gtsam.frontend.start.dense_map import DepthView
from mvdyn_gtsam.frontend.start.verification import Verdict, VerificationConfig, verify_placement
from mvdyn_gtsam.geometry import Similarity
from tests.frontend.start.synthetic_maps import similarity
from tests.tracking.synthetic_scene import HEIGHT, WIDTH, camera, render

CONFIG = VerificationConfig()
STRIDE = 4
MAP_B = similarity(0.4, (0.3, -0.5, 0.2), (1.0, 0.5, -2.0))
"""The world in map b: another frame, another scale."""
TRUTH = MAP_B.inverse()
"""Map b in map a, which is the world."""


def pose(x: float, y: float, z: float, turn: float) -> np.ndarray:
    wTc = np.eye(4)
    wTc[:3, :3] = Rotation.from_rotvec([0.0, turn, 0.0]).as_matrix()
    wTc[:3, 3] = x, y, z
    return wTc


def view(wTc: np.ndarray, mSw: Similarity, time: int = 0) -> DepthView:
    image, depth = render(wTc, camera("any"))
    grid = Grid.covering(WIDTH, HEIGHT, STRIDE)
    return DepthView(
        time=time,
        mTc=mSw.transform_poses(wTc),
        intrinsics=camera("any").intrinsics,
        grid=grid,
        depth=mSw.scale * grid.sample(depth),
        image=cv2.GaussianBlur(image[..., 0].astype(np.float32), (0, 0), 0.35 * STRIDE),
    )


@pytest.fixture(scope="module")
def views_a() -> list[DepthView]:
    return [view(pose(0.1 * t, 0.0, 0.1 * t, 0.0), Similarity.identity(), t) for t in range(2)]


@pytest.fixture(scope="module")
def views_b() -> list[DepthView]:
    return [view(pose(-0.6 - 0.1 * t, 0.1, 0.0, 0.1), MAP_B, t) for t in range(2)]


def test_the_true_placement_is_trusted(views_a: list[DepthView], views_b: list[DepthView]) -> None:
    verdict = verify_placement(views_a, views_b, TRUTH, CONFIG)
    assert verdict.trust > 0.95
    assert verdict.frame_pairs == 4
    assert 0.3 < verdict.agreement / verdict.frame_pairs < 2.0  # both directions of each pair count


def test_a_fine_pattern_is_not_held_against_a_depth_within_tolerance() -> None:
    """Depth that is 6 % off moves stripes by half their period: dark ones meet light ones."""
    grid = Grid.covering(WIDTH, HEIGHT, STRIDE)
    intrinsics = camera("any").intrinsics
    across = np.arange(WIDTH)
    stripes = np.tile(100.0 + 60.0 * np.sin(2.0 * np.pi * across / 8.5), (HEIGHT, 1)).astype(np.float32)

    def striped(x: float, depth: float) -> DepthView:
        shift = np.eye(4)
        shift[0, 3] = x
        # the wall is at depth 2 and shows its stripes to both
        shifted = np.roll(stripes, -round(x * intrinsics[0, 0] / 2.0), axis=1)
        return DepthView(0, shift, intrinsics, grid, np.full(len(grid), depth), shifted)

    first, second = striped(0.0, 2.0 * 1.06), striped(1.0, 2.0 * 1.06)
    hasty = verify_placement([first], [second], Similarity.identity(), CONFIG)
    careful = verify_placement([first], [second], Similarity.identity(), CONFIG, careful=True)
    assert hasty.contradiction > 0.3
    assert hasty.contradiction > 10.0 * careful.contradiction
    assert careful.agreement == hasty.agreement


def test_far_aside_more_depths_find_where_surfaces_look_the_same() -> None:
    """Depth that is 3 % off moves a texture by several times its grain; a wrong surface stays wrong."""
    grid = Grid.covering(WIDTH, HEIGHT, STRIDE)
    intrinsics = camera("any").intrinsics
    random = np.random.default_rng(0)
    texture = cv2.GaussianBlur(random.uniform(0.0, 255.0, (HEIGHT, 4 * WIDTH)), (0, 0), 1.0)
    texture = (100.0 + texture - texture.mean()).astype(np.float32)

    def seen_from(x: float, wall: np.ndarray) -> DepthView:
        shift, first = np.eye(4), round(x * intrinsics[0, 0] / 2.0)
        shift[0, 3] = x
        depth = np.full(len(grid), 2.0 * 1.03)
        return DepthView(0, shift, intrinsics, grid, depth, wall[:, first : first + WIDTH].copy())

    one, beside = seen_from(0.0, texture), seen_from(1.5, texture)
    other = seen_from(1.5, texture[::-1])
    few, many = replace(CONFIG, looks=2), replace(CONFIG, looks=10)
    true, false = (
        [
            verify_placement([one], [view], Similarity.identity(), config, careful=True).contradiction
            for config in (few, many)
        ]
        for view in (beside, other)
    )
    assert true[0] > 0.1 and true[1] < 0.2 * true[0]
    assert false[1] > 3.0 * true[1]


@pytest.mark.parametrize(
    "wrong",
    [
        similarity(1.0, (0.0, 0.0, 0.0), (0.4, 0.0, 0.0)),
        similarity(1.0, (0.0, 0.0, 0.0), (0.0, 0.0, -1.2)),
        similarity(0.75, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        similarity(1.0, (0.0, 0.1, 0.0), (0.0, 0.0, 0.0)),
    ],
    ids=["beside", "in front", "smaller", "turned"],
)
def test_a_wrong_placement_is_contradicted(
    views_a: list[DepthView], views_b: list[DepthView], wrong: Similarity
) -> None:
    true = verify_placement(views_a, views_b, TRUTH, CONFIG)
    verdict = verify_placement(views_a, views_b, wrong.compose(TRUTH), CONFIG)
    assert verdict.trust < 0.6
    assert verdict.contradiction > 5.0 * true.contradiction
    assert verdict.agreement < 0.6 * true.agreement


def test_what_is_hidden_says_nothing() -> None:
    # Camera a stands between the small plane and the wall; b, farther back, sees only the plane.
    a = view(pose(-0.6, 0.2, 3.6, 0.0), Similarity.identity())
    b = view(pose(-0.6, 0.2, 2.9, 0.0), Similarity.identity())
    assert np.nanmax(b.depth) < 1.0 < np.nanmin(a.depth)
    verdict = verify_placement([a], [b], Similarity.identity(), CONFIG)
    assert verdict == Verdict(0.0, 0.0, 1)


def test_views_that_share_nothing_say_nothing(views_a: list[DepthView]) -> None:
    behind = view(pose(0.0, 0.0, 0.0, 0.0), Similarity.identity())
    turned = similarity(1.0, (0.0, np.pi, 0.0), (0.0, 0.0, 0.0))
    verdict = verify_placement(views_a, [behind], turned, CONFIG)
    assert verdict == Verdict(0.0, 0.0, 0)
    assert verdict.trust == 0.0


def test_plain_surfaces_and_unknown_depth_prove_nothing(
    views_a: list[DepthView], views_b: list[DepthView]
) -> None:
    plain = [replace(one, image=np.full_like(one.image, 90.0)) for one in views_a]
    assert (
        verify_placement(plain, [replace(b, image=b.image * 0) for b in views_b], TRUTH, CONFIG).agreement
        == 0
    )
    unknown = [replace(one, depth=np.full_like(one.depth, np.nan)) for one in views_a]
    verdict = verify_placement(unknown, views_b, TRUTH, CONFIG)
    assert verdict.agreement == verdict.contradiction == 0.0


def test_the_order_of_the_cameras_does_not_matter(views_a: list[DepthView], views_b: list[DepthView]) -> None:
    forward = verify_placement(views_a, views_b, TRUTH, CONFIG)
    backward = verify_placement(views_b, views_a, TRUTH.inverse(), CONFIG)
    assert forward.agreement == pytest.approx(backward.agreement, rel=1e-6)
    assert forward.contradiction == pytest.approx(backward.contradiction, abs=1e-6)
    assert forward.frame_pairs == backward.frame_pairs


def test_nonsense_is_refused() -> None:
    with pytest.raises(ConfigError, match="agree"):
        VerificationConfig(agree=0.2, conflict=0.1)
    with pytest.raises(ConfigError, match="looks is 3"):
        VerificationConfig(looks=3)
    with pytest.raises(ConfigError, match="other_look_careful"):
        VerificationConfig(other_look_careful=0.7)
