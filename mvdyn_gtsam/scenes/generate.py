"""From settings to a capture folder with exact ground truth."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.progress import NullProgress, Progress
from mvdyn_gtsam.scenes.mesh import Instant, Mesh, View, build_mesh
from mvdyn_gtsam.scenes.motion import Array, HandHeld
from mvdyn_gtsam.scenes.render import Renderer
from mvdyn_gtsam.scenes.rig import make_cameras, neighbour_overlaps, probed_seconds, solve_angle
from mvdyn_gtsam.scenes.settings import SceneSettings
from mvdyn_gtsam.scenes.world import Body, body_poses
from mvdyn_gtsam.scenes.writer import SceneWriter

SCENE_FILE = "scene.json"
STAGE = "scene"
_NOISE, _EXPOSURE = 5, 6


@dataclass(frozen=True)
class Scene:
    """A scene before it is rendered: geometry, cameras and how all of it moves."""

    settings: SceneSettings
    bodies: Sequence[Body]
    mesh: Mesh
    cameras: Sequence[HandHeld]
    angle: float
    """rad between neighbouring cameras."""

    @staticmethod
    def build(settings: SceneSettings) -> Scene:
        """Place the cameras, furnish the place and paint it."""
        angle, bodies = solve_angle(settings)
        return Scene(settings, bodies, build_mesh(bodies, settings), make_cameras(settings, angle), angle)

    def seconds(self, time: int) -> float:
        """Of a frame."""
        return time / self.settings.fps

    def wTc(self, time: int) -> Array:
        """``(C, 4, 4)`` of a frame."""
        return np.array([camera(self.seconds(time)) for camera in self.cameras])

    def views(self, time: int) -> list[View]:
        """Of every camera in a frame."""
        instant = Instant(self.mesh, body_poses(self.bodies, self.seconds(time)))
        return [View(instant, wTc) for wTc in self.wTc(time)]

    def overlaps(self) -> Array:
        """``(C - 1,)`` of neighbouring cameras, measured; see ``neighbour_overlaps``."""
        times = probed_seconds(self.settings)
        moments = [Instant(self.mesh, body_poses(self.bodies, seconds)) for seconds in times]
        return neighbour_overlaps(self.settings, self.cameras, moments)

    def gain(self, camera: int, time: int) -> float:
        """Exposure of a frame, 1 for the true one."""
        period, phase = np.random.default_rng([self.settings.seed, _EXPOSURE, camera]).random(2)
        wave = np.sin(2 * np.pi * (self.seconds(time) / (2.0 + 3.0 * period) + phase))
        return float(1.0 + self.settings.exposure * wave)


def make_scene(settings: SceneSettings, folder: Path, progress: Progress | None = None) -> Path:
    """Write the capture of ``settings`` to ``folder``, unless it is there already, and return the folder.

    Beside ``capture.json`` and ``groundtruth`` with trajectories, depth and masks, there are the forward flow
    ``groundtruth/flow/<camera>/000005.npz`` (``flow (H, W, 2)`` px to the next frame, NaN where nothing is
    seen, and ``visible (H, W)``: not hidden there) and ``scene.json``: the settings and what came of them.
    The folder appears when all of it is written. Raises ConfigError where it holds anything else, or where
    the extra ``scenes`` is missing.
    """
    folder = Path(folder)
    progress = progress or NullProgress()
    if _is_made(settings, folder):
        return folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    draft = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        draft.chmod(0o777 & ~_umask())
        _render(Scene.build(settings), SceneWriter(settings, draft, folder.name), progress)
        try:
            os.replace(draft, folder)
        except OSError:
            if not _is_made(settings, folder):  # else another process was quicker
                raise
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    return folder


def _render(scene: Scene, writer: SceneWriter, progress: Progress) -> None:
    s = scene.settings
    renderer = Renderer(scene.mesh, s)
    moving: list[list[float]] = [[] for _ in scene.cameras]
    here = scene.views(0)
    for time in range(s.frames):
        there = scene.views(time + 1)
        for camera in range(s.cameras):
            image = renderer.image(here[camera])
            writer.write_image(camera, time, _exposed(scene, image, camera, time))
            if time % s.every == 0:
                truth = renderer.truth(here[camera])
                writer.write_truth(camera, time, truth.depth, truth.moving)
                moving[camera].append(float(truth.moving.mean()))
                if time + 1 < s.frames:
                    flow = renderer.flow(truth, here[camera], there[camera])
                    writer.write_flow(camera, time, flow.flow, flow.visible)
        here = there
        progress.update(STAGE, time + 1, s.frames)
    writer.finish(np.array([scene.wTc(time) for time in range(s.frames)]).swapaxes(0, 1))
    overlaps = scene.overlaps()
    content = {
        "settings": s.to_json(),
        "overlap": _mean(overlaps),
        "overlap_of_neighbours": [round(float(value), 4) for value in overlaps],
        "angle_between_neighbours_deg": round(float(np.degrees(scene.angle)), 3),
        "moving": _mean(np.concatenate(moving)),
        "moving_per_camera": [_mean(np.array(values)) for values in moving],
        "bodies": [body.name for body in scene.bodies],
        "moving_bodies": [body.name for body in scene.bodies if body.motion is not None],
    }
    writer.write_json(SCENE_FILE, content)


def _exposed(scene: Scene, image: npt.NDArray[np.float32], camera: int, time: int) -> npt.NDArray[np.uint8]:
    s = scene.settings
    image = image * np.float32(scene.gain(camera, time))
    if s.noise > 0.0:
        rng = np.random.default_rng([s.seed, _NOISE, camera, time])
        image = image + np.float32(255.0 * s.noise) * rng.standard_normal(image.shape, dtype=np.float32)
    return np.asarray(np.clip(np.rint(image), 0, 255), dtype=np.uint8)


def _is_made(settings: SceneSettings, folder: Path) -> bool:
    """Whether the folder holds this very scene. Raises ConfigError where it holds something else."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return False
    try:
        made = json.loads((folder / SCENE_FILE).read_text())["settings"] == settings.to_json()
    except (OSError, ValueError, KeyError, TypeError):
        made = False
    if not made:
        raise ConfigError(f"{folder}: holds something else already; name a new folder, or remove it first")
    return True


def _mean(values: npt.NDArray[np.float64]) -> float | None:
    return round(float(np.mean(values)), 4) if len(values) else None


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
