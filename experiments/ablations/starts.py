"""The starts that variants are tracked from: the whole one, worse ones, and none to speak of."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from time import perf_counter

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from experiments.start_errors import Frames, metres_per_unit, true_frames
from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.config import Config, to_dict
from mvdyn_gtsam.evaluation import GroundTruth
from mvdyn_gtsam.frontend.dense_flow import DisFlow
from mvdyn_gtsam.frontend.start.dense_map import testimony_flow
from mvdyn_gtsam.frontend.start.model import Start, StartFrame, start_from_arrays, start_to_arrays
from mvdyn_gtsam.frontend.start.wide_baseline import ClassicalInitializer
from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.progress import NullProgress

Array = npt.NDArray[np.float64]


class StartKind(StrEnum):
    """Where a variant's tracking begins."""

    WHOLE = "whole"
    """The wide-baseline start."""
    NOISY = "noisy"
    """The same with noise on every pose."""
    SAME_POSE = "same_pose"
    """Each camera's start from its own video alone, all cameras at one place."""
    FLAT = "flat"
    """One frame per camera, all at one place and looking at a wall at depth 1."""


@dataclass(frozen=True)
class StartChange:
    """How a variant's start is made."""

    kind: StartKind = StartKind.WHOLE
    rotation_deg: float = 0.0
    """Of noise."""
    translation_m: float = 0.0
    """Of noise, metres of the ground truth."""
    seed: int = 0

    def describe(self) -> str:
        """All that decides the start, for the key of a run."""
        if self.kind != StartKind.NOISY:
            return str(self.kind)
        return f"{self.kind}_{self.rotation_deg:g}deg_{self.translation_m:g}m_seed{self.seed}"


def make_start(
    change: StartChange, capture: Capture, truth: GroundTruth, config: Config, folder: Path
) -> Start:
    """The start that ``change`` asks for; what takes long is kept in ``folder``.

    Raises TrackingError where the classical start fails, EvaluationError where noise in metres has no scale.
    """
    if change.kind == StartKind.FLAT:
        return flat_start(capture)
    if change.kind == StartKind.SAME_POSE:
        return same_pose_start([kept_start(capture, config, folder, n) for n in range(len(capture.cameras))])
    start = kept_start(capture, config, folder)
    if change.kind == StartKind.WHOLE:
        return start
    units: dict[int, float] = {}
    for group in start.groups:
        metres = group_scale(capture, start, group, truth)
        units |= {camera: change.translation_m / metres for camera in group}
    return noisy_start(start, change.rotation_deg, units, change.seed)


def kept_start(capture: Capture, config: Config, folder: Path, camera: int | None = None) -> Start:
    """The classical start, or that of one ``camera`` alone, computed once for these settings."""
    kept = start_path(capture, config, folder, camera)
    if kept.is_file():
        return read_start(kept)
    if camera is not None:
        capture = replace(capture, cameras=(capture.cameras[camera],), streams=(capture.streams[camera],))
    began = perf_counter()
    flow = DisFlow(testimony_flow(config.frontend.flow))
    start = ClassicalInitializer(flow, config.frontend.wide_baseline)(capture, NullProgress())
    write_start(start, kept, perf_counter() - began)
    return start


def start_path(capture: Capture, config: Config, folder: Path, camera: int | None = None) -> Path:
    """Where ``kept_start`` keeps it."""
    settings = json.dumps(to_dict(config)["frontend"], sort_keys=True, default=str)
    digest = hashlib.sha256(settings.encode()).hexdigest()[:8]
    whose = "all" if camera is None else capture.cameras[camera].name
    return folder / f"start_{whose}_{digest}.npz"


def write_start(start: Start, path: Path, seconds: float = float("nan")) -> None:
    """Whole or not at all; ``seconds``: what it took to compute."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"partial_{path.name}")
    np.savez_compressed(partial, seconds=np.array(seconds), **start_to_arrays(start))  # type: ignore[arg-type]
    partial.replace(path)


def read_start(path: Path) -> Start:
    """The inverse of ``write_start``, notes left out."""
    with np.load(path) as arrays:
        return start_from_arrays(dict(arrays))


def group_scale(capture: Capture, start: Start, group: tuple[int, ...], truth: GroundTruth) -> float:
    """Metres per unit of a group's world. Raises EvaluationError where the truth defines none."""
    names = [capture.cameras[camera].name for camera in group]
    true = true_frames(capture, truth)
    placed: dict[str, Frames] = {
        name: {frame.time: frame.wTc for frame in start.frames[camera]}
        for name, camera in zip(names, group, strict=True)
    }
    known = {name: sorted(set(placed[name]) & set(true[name])) for name in names}
    return metres_per_unit(known, placed, true)


def noisy_start(start: Start, rotation_deg: float, translation: Mapping[int, float], seed: int) -> Start:
    """Every pose turned by ``rotation_deg`` and moved by ``translation`` (camera -> units); depths stay.

    Each pose has random directions of its own.

    So the paper adds it "to the initialized poses". Its size is the same for all: a level then says what was
    done rather than what was drawn.
    """
    rng = np.random.default_rng(seed)

    def moved(frame: StartFrame, distance: float) -> StartFrame:
        axis, way = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
        wTc = np.array(frame.wTc, dtype=np.float64)
        wTc[:3, :3] = wTc[:3, :3] @ Rotation.from_rotvec(np.radians(rotation_deg) * axis).as_matrix()
        wTc[:3, 3] += distance * way
        return replace(frame, wTc=wTc)

    return _changed(start, lambda camera, frame: moved(frame, translation[camera]))


def same_pose_start(alone: list[Start]) -> Start:
    """Cameras' own starts put together: each one's first frame at the origin, its median depth 1.

    What a camera's video says of itself stays; that cameras are apart, turned to one another or of another
    scale is what nobody says.
    """
    frames = []
    for start in alone:
        own = start.frames[0]
        mTf = own[0].wTc
        unit = float(np.median(np.concatenate([frame.depth for frame in own])))
        placed = []
        for frame in own:
            wTc = invert_pose(mTf) @ frame.wTc
            wTc[:3, 3] /= unit
            placed.append(replace(frame, wTc=wTc, depth=frame.depth / unit))
        frames.append(tuple(placed))
    return Start((tuple(range(len(alone))),), tuple(frames))


def flat_start(capture: Capture) -> Start:
    """Nothing known, as a single-camera tracker begins: all cameras at the origin, depth 1 everywhere."""
    frames = []
    for camera in capture.cameras:
        x, y = np.meshgrid(np.linspace(0, camera.width - 1, 9), np.linspace(0, camera.height - 1, 9))
        pixels = np.stack([x.ravel(), y.ravel()], axis=-1)
        frames.append((StartFrame(0, np.eye(4), pixels, np.ones(len(pixels))),))
    return Start((tuple(range(len(capture.cameras))),), tuple(frames))


def _changed(start: Start, change: Callable[[int, StartFrame], StartFrame]) -> Start:
    frames = tuple(tuple(change(camera, frame) for frame in own) for camera, own in enumerate(start.frames))
    return replace(start, frames=frames)
