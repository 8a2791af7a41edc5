"""Accuracy of the dense flow against exact ground truth, for choosing its settings.

Depth and poses of a rendered capture give the true flow of its static points. Every variant of the flow is
measured on the same image pairs: within a camera at several frame distances, and between cameras, guided
by poses and depth that are wrong by about a per cent and a pixel or two. The figures that matter most for
poses are the median error and the block bias (errors that neighbours share do not average out).
"""

from __future__ import annotations

import argparse
import math
import operator
import sys
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from experiments.records import QUICK, quick_scene
from mvdyn_gtsam.capture.loader import load_capture
from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.evaluation.groundtruth import GroundTruth, load_groundtruth
from mvdyn_gtsam.frontend.dense_flow import DisFlow, FlowConfig, FlowPair, pixel_raster, to_grey
from mvdyn_gtsam.frontend.guided_flow import guided_flow, predicted_flow
from mvdyn_gtsam.geometry import invert_pose

Array = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Image = npt.NDArray[np.uint8]

KINDS = ("+1", "+2", "+4", "+8", "+16", "guided+10", "guided+20", "cross+0", "cross+10")
"""Frame distances: within a camera without help, guided within a camera, guided to another camera."""
BLOCK = 32
WEIGHT_BINS = (0.0, 0.2, 0.5, 0.8, 1.01)


@dataclass(frozen=True)
class Case:
    """One ordered image pair with its truth."""

    scene: str
    kind: str
    """"+4" for a frame distance within a camera, "cross+0" for another camera."""
    image_i: Image
    image_j: Image
    depth_i: Float32
    depth_j: Float32
    intrinsics_i: Array
    intrinsics_j: Array
    jTi: Array
    truth: Float32
    """``(H, W, 2)`` px, NaN where unknown, moving or not visible in j."""
    perturbed_jTi: Array
    perturbed_depth_i: Float32
    perturbed_depth_j: Float32

    @property
    def guided(self) -> bool:
        return self.kind.startswith(("cross", "guided"))


@dataclass(frozen=True)
class Score:
    """Errors in px of one variant on one case."""

    median: float
    percentile_90: float
    share: float
    """Of the points whose truth is known, those with weight above 0.5."""
    outliers: float
    """Of the points with weight above 0.5, those wrong by more than 2 px."""
    block_bias: float
    """Root mean square over 32 px blocks of the weighted mean error vector's length."""
    bias: float
    """Length of the weighted mean error vector."""
    calibration: tuple[float, ...]
    """Median error per weight bin."""
    cpu_ms: float
    """Both directions, all threads."""


def load_cases(folder: Path, times: int, condition: str, kinds: Collection[str] = KINDS) -> Iterator[Case]:
    """Cases of one capture, ``times`` source frames per camera spread evenly."""
    capture, truth = load_capture(folder), load_groundtruth(folder / "groundtruth")
    rng = np.random.default_rng(0)
    names = [camera.name for camera in capture.cameras]
    for i, name in enumerate(names):
        frames = truth.depth_frames(name)
        for t in (frames[k] for k in np.linspace(0, len(frames) - 1, times + 1).astype(int)[:-1]):
            for kind in kinds:
                prefix, _, distance = kind.rpartition("+")
                u = t + int(distance)
                others = [j for j in range(len(names)) if j != i] if prefix == "cross" else [i]
                known = u in frames if prefix else u < capture.frame_count
                for j in others if known else []:
                    case = _case(capture, truth, (i, t), (j, u), kind, condition, rng)
                    if np.isfinite(case.truth[..., 0]).mean() > 0.1:
                        yield case


def _case(
    capture: Capture, truth: GroundTruth, key_i: tuple[int, int], key_j: tuple[int, int], kind: str,
    condition: str, rng: np.random.Generator,
) -> Case:  # fmt: skip
    (i, t), (j, u) = key_i, key_j
    camera_i, camera_j = capture.cameras[i], capture.cameras[j]
    K_i, K_j = camera_i.intrinsics, camera_j.intrinsics
    jTi = invert_pose(truth.trajectories[camera_j.name][1][u]) @ truth.trajectories[camera_i.name][1][t]
    depth_i = truth.depth(camera_i.name, t)
    known = u in truth.depth_frames(camera_j.name)
    shape_j = (camera_j.height, camera_j.width)
    depth_j = truth.depth(camera_j.name, u) if known else np.full(shape_j, np.nan, np.float32)
    flow = predicted_flow(depth_i, K_i, K_j, jTi, shape_j)
    moving = truth.moving(camera_i.name, t)
    if moving is not None:
        flow[cv2.dilate(moving.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0] = np.nan
    if known:
        flow[_occluded(flow, depth_i, depth_j, K_i, jTi)] = np.nan
    wrong_pose = np.eye(4)
    wrong_pose[:3, :3] = Rotation.from_rotvec(np.radians(0.15) * rng.standard_normal(3)).as_matrix()
    wrong_pose[:3, 3] = 0.003 * np.nanmedian(depth_i) * rng.standard_normal(3)
    return Case(
        capture.name, kind, to_grey(capture.read(i, t)), _degrade(to_grey(capture.read(j, u)), condition),
        depth_i, depth_j, K_i, K_j, jTi, flow, wrong_pose @ jTi,
        _perturbed(depth_i, rng), _perturbed(depth_j, rng),
    )  # fmt: skip


def _occluded(
    flow: Float32, depth_i: Float32, depth_j: Float32, K_i: Array, jTi: Array
) -> npt.NDArray[np.bool_]:
    target = pixel_raster(flow.shape) + flow
    x, y = pixel_raster(flow.shape)[..., 0], pixel_raster(flow.shape)[..., 1]
    ray = np.stack([(x - K_i[0, 2]) / K_i[0, 0], (y - K_i[1, 2]) / K_i[1, 1], np.ones_like(x)], axis=-1)
    depth = (ray * depth_i[..., None]) @ jTi[2, :3] + jTi[2, 3]
    there = cv2.remap(depth_j, target, None, cv2.INTER_NEAREST, borderValue=float("nan"))
    with np.errstate(invalid="ignore"):
        return ~(np.abs(depth / there - 1.0) < 0.05)


def _perturbed(depth: Float32, rng: np.random.Generator) -> Float32:
    """Depth wrong by 1 % that varies over ~100 px, and blurred: what tracking has before refinement."""
    noise = rng.standard_normal((6, 8)).astype(np.float32)
    noise = cv2.resize(noise, (depth.shape[1], depth.shape[0]), interpolation=cv2.INTER_CUBIC)
    coarse = depth[3::8, 3::8]
    wide = cv2.resize(coarse, (depth.shape[1], depth.shape[0]), interpolation=cv2.INTER_LINEAR)
    return wide * np.exp(np.float32(0.01) * noise)


def _degrade(grey: Image, condition: str) -> Image:
    if condition == "exposure":
        return np.clip(255.0 * (grey / 255.0) ** 1.2 * 0.75 + 8.0, 0, 255).astype(np.uint8)
    if condition == "blur":
        return cv2.blur(grey, (7, 1))
    return grey


@dataclass(frozen=True)
class Variant:
    name: str
    config: FlowConfig = FlowConfig()
    make: Callable[[FlowConfig], Any] = DisFlow


def measure(variant: Variant, case: Case) -> Score:
    flow = variant.make(variant.config)
    start = time.process_time()
    if case.guided:
        pair: FlowPair = guided_flow(
            flow, case.image_i, case.image_j, case.perturbed_depth_i, case.perturbed_depth_j,
            case.intrinsics_i, case.intrinsics_j, case.perturbed_jTi, variant.config,
        )  # fmt: skip
    else:
        pair = flow.measure(case.image_i, case.image_j)
    elapsed = 1e3 * (time.process_time() - start)
    return score(pair.forward, pair.forward_weight, case.truth, elapsed)


def score(flow: Float32, weight: Float32, truth: Float32, cpu_ms: float) -> Score:
    error = flow - truth
    length = np.linalg.norm(error, axis=2)
    known = np.isfinite(length)
    trusted = known & (weight > 0.5)
    if trusted.sum() < 50:
        return Score(math.nan, math.nan, float(trusted.sum() / max(known.sum(), 1)), math.nan, math.nan,
                     math.nan, (math.nan,) * (len(WEIGHT_BINS) - 1), cpu_ms)  # fmt: skip
    # The solver's robust loss would discount the outliers as well.
    robust = np.where(known, weight / (1.0 + np.nan_to_num(length) ** 2), 0.0).astype(np.float64)
    weighted = np.nan_to_num(error) * robust[..., None]
    sums, mass = _blocks(weighted), _blocks(robust[..., None])
    enough = mass[..., 0] > 0.1 * BLOCK * BLOCK
    means = sums[enough] / mass[enough]
    bins = [
        known & (weight >= low) & (weight < high)
        for low, high in zip(WEIGHT_BINS, WEIGHT_BINS[1:], strict=False)
    ]
    return Score(
        float(np.median(length[trusted])),
        float(np.percentile(length[trusted], 90)),
        float(trusted.sum() / known.sum()),
        float((length[trusted] > 2.0).mean()),
        float(np.sqrt((means**2).sum(axis=1).mean())) if len(means) else math.nan,
        float(np.linalg.norm(weighted.sum(axis=(0, 1)) / robust.sum())),
        tuple(float(np.median(length[pick])) if pick.any() else math.nan for pick in bins),
        cpu_ms,
    )


def _blocks(values: Array) -> Array:
    rows, cols = values.shape[0] // BLOCK, values.shape[1] // BLOCK
    cut = values[: rows * BLOCK, : cols * BLOCK]
    return cut.reshape(rows, BLOCK, cols, BLOCK, -1).sum(axis=(1, 3))


def sweeps() -> dict[str, list[Variant]]:
    """Named lists of variants; each starts with the default."""
    base = FlowConfig()
    medium = {"finest_scale": 2, "patch_stride": 4, "gradient_iterations": 16, "variational_iterations": 5}

    def settings(**changes: Any) -> Variant:
        return Variant(
            ", ".join(f"{k}={v}" for k, v in changes.items()) or "default", replace(base, **changes)
        )

    return {
        "default": [settings()],
        "dis": [
            settings(),
            Variant("OpenCV medium", replace(base, **medium)),
            Variant("OpenCV medium, finest_scale=1", replace(base, **{**medium, "finest_scale": 1})),
            settings(finest_scale=1),
            settings(patch_stride=4),
            settings(gradient_iterations=8),
            settings(patch_size=12, patch_stride=8),
            settings(variational_iterations=1),
        ],
        "weights": [
            settings(),
            settings(forward_backward_sigma=0.35),
            settings(forward_backward_sigma=0.7),
            settings(ncc_low=0.3, ncc_high=0.7),
            settings(ncc_window=7),
            settings(ncc_noise=4.0),
            settings(border_margin=6),
        ],
    }


def table(results: dict[str, list[tuple[Case, Score]]], by: str) -> list[str]:
    """Markdown rows: variant x kind (or scene), each the mean over its scenes' means."""
    names = [field.name for field in fields(Score) if field.name not in ("calibration",)]
    lines = [f"| variant | {by} | cases | " + " | ".join(names) + " | median by weight bin |"]
    lines.append("|---" * (len(names) + 4) + "|")
    for variant, pairs in results.items():
        for group in sorted({getattr(case, by) for case, _ in pairs}, key=_order) + ["all"]:
            picked = [(case, s) for case, s in pairs if group in ("all", getattr(case, by))]
            values = [_scene_mean(picked, operator.attrgetter(name)) for name in names]
            bins = [_scene_mean(picked, _bin_of(k)) for k in range(len(WEIGHT_BINS) - 1)]
            cells = [f"{value:.3f}" if value < 10 else f"{value:.0f}" for value in values]
            lines.append(
                f"| {variant} | {group} | {len(picked)} | " + " | ".join(cells) + " | "
                + " ".join(f"{value:.2f}" for value in bins) + " |"
            )  # fmt: skip
    return lines


def _bin_of(index: int) -> Callable[[Score], float]:
    return lambda score: score.calibration[index]


def _scene_mean(picked: list[tuple[Any, Score]], value: Callable[[Score], float]) -> float:
    means = []
    for scene in sorted({case.scene for case, _ in picked}):
        found = np.array([value(s) for case, s in picked if case.scene == scene])
        if np.isfinite(found).any():
            means.append(np.nanmean(found))
    return float(np.mean(means)) if means else math.nan


def _order(group: str) -> tuple[str, int]:
    head, _, number = group.rpartition("+")
    return head, int(number) if number.isdigit() else 0


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("captures", nargs="*", type=Path, help="rendered captures with groundtruth/depth")
    parser.add_argument("--quick", action="store_true", help="a tiny generated scene, kept in out/quick")
    parser.add_argument("--sweep", choices=sorted(sweeps()), default="default")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--times", type=int, default=3, help="source frames per camera")
    parser.add_argument("--condition", choices=["clean", "exposure", "blur"], default="clean",
                        help="what is done to every second image")  # fmt: skip
    parser.add_argument("--by", choices=["kind", "scene"], default="kind")
    parser.add_argument("--out", type=Path, help="append the table to this Markdown file")
    options = parser.parse_args(arguments)
    if options.quick == bool(options.captures):
        parser.error("name captures or give --quick")
    captures = (
        [quick_scene(options.out.parent if options.out else QUICK)] if options.quick else options.captures
    )
    variants = sweeps()[options.sweep]
    results: dict[str, list[tuple[Case, Score]]] = {variant.name: [] for variant in variants}
    for folder in captures:
        for case in load_cases(folder, options.times, options.condition, options.kinds):
            light = replace(case, **{f.name: None for f in fields(Case) if f.name not in ("scene", "kind")})  # type: ignore[arg-type]
            for variant in variants:
                results[variant.name].append((light, measure(variant, case)))
    lines = [f"## sweep {options.sweep}, {options.condition}", "", *table(results, options.by), ""]
    print("\n".join(lines))
    if options.out is not None:
        with options.out.open("a") as file:
            file.write("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
