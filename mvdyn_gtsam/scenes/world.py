"""The things in a scene: a room or a yard, what stands in it, and who moves about in it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mvdyn_gtsam.scenes.motion import Array, Limb, Motion, Orbit, Rolling, rigid, turn
from mvdyn_gtsam.scenes.settings import SceneSettings
from mvdyn_gtsam.scenes.surfaces import Patch, box, cylinder, moved, quad, sphere

ROOM_HALF, ROOM_HEIGHT = 4.2, 2.9
YARD_HALF = 9.0
FURNITURE = 26
FURNITURE_RING = (2.95, 3.8)
ACTOR_RING = (1.7, 2.5)
"""m from the middle; the cameras stand nearer to it, the furniture farther out."""
ACTORS_PER_VIEW = 4.5
"""At motion 1, in one camera's field of view."""
SPEED = (0.3, 1.3)
"""m/s of whoever moves, at motion 0 and more for motion 1."""

_LAYOUT, _PEOPLE = 1, 2


@dataclass(frozen=True)
class Body:
    """Something rigid. Where ``motion`` is None it stands still, and its patches are in the world frame."""

    name: str
    patches: tuple[Patch, ...]
    styles: tuple[str, ...]
    """Of the texture of each patch."""
    motion: Motion | None = None


def build_world(settings: SceneSettings, headings: Sequence[float]) -> list[Body]:
    """Everything in the scene. ``headings`` (rad) of the cameras say where people walk: where they look."""
    rng = np.random.default_rng([settings.seed, _LAYOUT])
    bodies = _room() if settings.place == "room" else _yard(rng)
    bodies += [_furniture(rng, index) for index in range(FURNITURE)]
    return bodies + _actors(settings, headings)


def _room() -> list[Body]:
    s, h = ROOM_HALF, ROOM_HEIGHT
    walls = [
        quad((-s, s, 0), (2 * s, 0, 0), (0, 0, h)),
        quad((s, s, 0), (0, -2 * s, 0), (0, 0, h)),
        quad((s, -s, 0), (-2 * s, 0, 0), (0, 0, h)),
        quad((-s, -s, 0), (0, 2 * s, 0), (0, 0, h)),
    ]
    floor = quad((-s, -s, 0), (2 * s, 0, 0), (0, 2 * s, 0))
    ceiling = quad((-s, s, h), (2 * s, 0, 0), (0, -2 * s, 0))
    styles = ("posters", "bricks", "posters", "bricks", "noise", "noise")
    return [Body("room", (*walls, floor, ceiling), styles)]


def _yard(rng: np.random.Generator) -> list[Body]:
    s = YARD_HALF
    bodies = [Body("ground", (quad((-s, -s, 0), (2 * s, 0, 0), (0, 2 * s, 0)),), ("noise",))]
    for index in range(10):
        angle = 2 * np.pi * (index + rng.uniform(-0.2, 0.2)) / 10
        size = (rng.uniform(1.5, 3.0), rng.uniform(2.0, 5.0), rng.uniform(1.5, 4.5))
        place = rigid(turn("z", angle), (7.0 * np.cos(angle), 7.0 * np.sin(angle), size[2] / 2))
        patches = tuple(moved(box(size), place))
        bodies.append(Body(f"house{index}", patches, ("bricks", "posters") * 3))
    return bodies


def _furniture(rng: np.random.Generator, index: int) -> Body:
    """A box, a cylinder or a sphere on the floor; every third one is a shelf that hangs."""
    angle = 2 * np.pi * (index + rng.uniform(-0.3, 0.3)) / FURNITURE
    radius = rng.uniform(*FURNITURE_RING)
    where = np.array([radius * np.cos(angle), radius * np.sin(angle), 0.0])
    facing = turn("z", angle + rng.uniform(-0.6, 0.6))
    kind = ("box", "cylinder", "shelf", "box", "sphere", "shelf")[index % 6]
    if kind == "sphere":
        r = rng.uniform(0.2, 0.4)
        patches = sphere(r, (0.0, 0.0, r))
    elif kind == "cylinder":
        patches = cylinder(rng.uniform(0.12, 0.3), rng.uniform(0.5, 1.6))
    elif kind == "shelf":
        size = rng.uniform((0.25, 0.3, 0.15), (0.5, 0.9, 0.6))
        patches = box(size.tolist())
        where[2] = rng.uniform(1.3, 2.4)
    else:
        size = rng.uniform((0.3, 0.3, 0.35), (0.7, 0.8, 1.3))
        patches = box(size.tolist(), (0.0, 0.0, size[2] / 2))
    styles = [("posters", "noise", "bricks")[int(rng.integers(3))]] * len(patches)
    return Body(f"{kind}{index}", tuple(moved(patches, rigid(facing, where))), tuple(styles))


def _actors(settings: SceneSettings, headings: Sequence[float]) -> list[Body]:
    if settings.motion == 0.0:
        return []
    rng = np.random.default_rng([settings.seed, _PEOPLE])
    margin = 0.3 * settings.field_of_view
    first, last = min(headings) - margin, max(headings) + margin
    span = min(last - first, 2 * np.pi)
    count = max(1, math.ceil(ACTORS_PER_VIEW * settings.motion * span / settings.field_of_view))
    bodies: list[Body] = []
    for index in range(count):
        angle = first + span * (index + rng.uniform(0.3, 0.7)) / count
        distance = rng.uniform(*ACTOR_RING)
        speed = (SPEED[0] + SPEED[1] * settings.motion) * rng.uniform(0.8, 1.2) * rng.choice([-1.0, 1.0])
        orbit = Orbit(
            (distance * np.cos(angle), distance * np.sin(angle)),
            rng.uniform(0.3, 0.45),
            speed,
            rng.uniform(0.0, 2 * np.pi),
        )
        kind = ("walker", "ball", "walker", "cart")[index % 4]
        if kind == "walker":
            bodies += _walker(f"{kind}{index}", orbit)
        elif kind == "ball":
            radius = rng.uniform(0.2, 0.32)
            bodies.append(Body(f"{kind}{index}", tuple(sphere(radius)), ("posters",), Rolling(orbit, radius)))
        else:
            cart = box((0.45, 0.7, 0.5), (0.0, 0.0, 0.3))
            bodies.append(Body(f"{kind}{index}", tuple(cart), ("posters",) * 6, orbit))
    return bodies


def _walker(name: str, orbit: Orbit) -> list[Body]:
    """Somebody 1.75 m tall made of boxes: trunk and head, and four limbs that swing."""
    trunk = (*box((0.42, 0.24, 0.62), (0.0, 0.0, 1.16)), *sphere(0.14, (0.0, 0.0, 1.61)))
    bodies = [Body(f"{name}.trunk", trunk, ("posters",) * len(trunk), orbit)]
    for side, label in ((-1.0, "left"), (1.0, "right")):
        for limb, hinge, size, swing, phase in (
            ("leg", (side * 0.11, 0.0, 0.86), (0.17, 0.19, 0.86), 0.5, 0.0),
            ("arm", (side * 0.28, 0.0, 1.42), (0.11, 0.13, 0.62), 0.6, np.pi),
        ):
            motion = Limb(orbit, hinge, swing, 1.3, phase + (np.pi if side > 0 else 0.0))
            patches = tuple(box(size, (0.0, 0.0, -size[2] / 2)))
            bodies.append(Body(f"{name}.{label}_{limb}", patches, ("noise",) * 6, motion))
    return bodies


def body_poses(bodies: Sequence[Body], seconds: float) -> Array:
    """``wTb (B, 4, 4)``; the identity for what stands still."""
    return np.array([np.eye(4) if body.motion is None else body.motion(seconds) for body in bodies])
