"""``mvdyn reconstruct``."""

from __future__ import annotations

import argparse
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from mvdyn_gtsam.cli.arguments import (
    add_capture_arguments,
    add_config_arguments,
    add_depth_model_argument,
    read_capture,
    read_settings,
)
from mvdyn_gtsam.cli.progress import ConsoleProgress
from mvdyn_gtsam.errors import DepthPriorError, ResultError

if TYPE_CHECKING:
    from mvdyn_gtsam.capture import Capture
    from mvdyn_gtsam.config import Config
    from mvdyn_gtsam.frontend.depth_priors.depth_prior import DepthPrior
    from mvdyn_gtsam.reconstruction import Reconstruction

SUMMARY = "recover every camera's pose and depth for every frame"
DESCRIPTION = """\
Recover the pose of every camera and a dense depth map for every frame, in one world frame.
OUT gets manifest.json, trajectories/<camera>.txt (TUM, camera-to-world), depth/ and confidence/.
Ctrl-C at any time: what is in OUT can be read, and --resume continues, with the settings it began with:
--set and --config may change those of stages that are not finished; settings that are new since take their
defaults, and those that are no more are left out with a warning. A run that began with --depth-prior needs it
again until tracking is finished.
A depth prior is depth of single images: files that any network or sensor wrote, or a network itself, as an
ONNX file that you bring. It must give depth in one unit for all frames, as MoGe-2, UniDepthV2,
Depth-Anything-V2 metric and Depth-Anything-3 metric do. Others are described in a YAML file beside the model:
docs/depth_models.md says how, and whose weights may not be used commercially."""
EPILOG = """\
examples:
  mvdyn reconstruct clip --out result
  mvdyn reconstruct --camera a.mp4 --intrinsics 800,800,639.5,359.5 \\
                    --camera b.mp4 --intrinsics 810,810,639.5,359.5 --out result
  mvdyn reconstruct --camera a.mp4 --camera b.mp4 --estimate-focal --out result   # intrinsics not known
  mvdyn reconstruct clip --out result --stage tracking         # poses and rough depth, in half the time
  mvdyn reconstruct clip --out result --resume                # refine it later
  mvdyn reconstruct clip --out result --set tracking.window=20
  mvdyn reconstruct clip --out result --depth-prior depth_of_single_images
  mvdyn reconstruct clip --out result --depth-prior moge-2-vits-normal.onnx
  mvdyn reconstruct clip --out result --depth-prior indoor.onnx --depth-model depth-anything-v2-metric"""

STAGES = ("tracking", "refinement")
BYTES_PER_PIXEL = 1.0
"""Depth and confidence on disk, measured 0.9 on noisy depth."""
PREDICTION_BYTES_PER_PIXEL = 8.0
"""What a depth prior says, kept until tracking is finished: depth and confidence."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    add_capture_arguments(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="OUT", help="folder of the result")
    parser.add_argument(
        "--stage",
        choices=STAGES,
        default=STAGES[-1],
        help="last stage to run: poses and rough depth only, or dense depth too (default: %(default)s)",
    )
    parser.add_argument(
        "--depth-prior",
        type=Path,
        metavar="FOLDER|MODEL.onnx",
        help="z-depth of single images, from a network or a sensor: FOLDER/<camera>/000012.npy, (H, W) in any"
        " unit, or .npz with depth and confidence (0 to 1); 0 or NaN is unknown, and so are frames without a"
        " file; or the network itself; one scale and offset are found for all",
    )
    add_depth_model_argument(parser)
    add_config_arguments(parser)
    again = parser.add_mutually_exclusive_group()
    again.add_argument(
        "--resume",
        action="store_true",
        help="continue the run that OUT holds, with the settings it began with",
    )
    again.add_argument(
        "--overwrite", action="store_true", help="remove the reconstruction that OUT holds first"
    )


def run(arguments: argparse.Namespace, messages: Console) -> int:
    """Run the verb."""
    from mvdyn_gtsam.reconstruction import refuse_unusable
    from mvdyn_gtsam.resuming import configure

    settings = read_settings(arguments, alone=not arguments.resume)
    refuse_unusable(arguments.out, resume=arguments.resume, overwrite=arguments.overwrite)
    config = configure(arguments.out, settings, resume=arguments.resume).config
    capture = read_capture(arguments, config)
    depth_prior = _depth_prior(arguments, capture)
    started = time.monotonic()
    result = reconstruct_with_progress(
        capture,
        arguments.out,
        settings,
        stage=arguments.stage,
        resume=arguments.resume,
        overwrite=arguments.overwrite,
        messages=messages,
        depth_prior=depth_prior,
    )
    for line in summary(result, time.monotonic() - started):
        Console(soft_wrap=True, highlight=False, markup=False).print(line)
    return 0


def _depth_prior(arguments: argparse.Namespace, capture: Capture) -> DepthPrior | None:
    """The one that is asked for. Raises DepthPriorError."""
    if arguments.depth_prior is None:
        if arguments.depth_model is not None:
            raise DepthPriorError(
                f"--depth-model {arguments.depth_model}: needs the network's file, --depth-prior MODEL.onnx"
            )
        return None
    from mvdyn_gtsam.frontend.depth_priors.onnx_depth import open_depth_prior

    return open_depth_prior(arguments.depth_prior, capture.cameras, arguments.depth_model)


def reconstruct_with_progress(
    capture: Capture,
    out: Path,
    config: Config | Mapping[str, Any],
    *,
    stage: str,
    resume: bool,
    overwrite: bool,
    messages: Console,
    depth_prior: DepthPrior | None = None,
) -> Reconstruction:
    """Say what will be done, do it, show how far it is."""
    for line in announcement(capture, out, predicted=depth_prior is not None):
        messages.print(line)
    from mvdyn_gtsam.pipeline import reconstruct
    from mvdyn_gtsam.reconstruction import is_reconstruction, remove_reconstruction

    if overwrite and is_reconstruction(out):
        remove_reconstruction(out)
    with ConsoleProgress(messages) as progress:
        return reconstruct(
            capture, out, config, stage=stage, resume=resume, progress=progress, depth_prior=depth_prior
        )


def announcement(capture: Capture, out: Path, predicted: bool = False) -> list[str]:
    """What is about to be reconstructed and how much disk it takes, with a depth prior that is ``predicted``
    too.

    Raises ResultError where the disk cannot hold it.
    """
    sizes = sorted({f"{camera.width}x{camera.height}" for camera in capture.cameras})
    pixels = sum(camera.width * camera.height for camera in capture.cameras) * capture.frame_count
    needed = pixels * BYTES_PER_PIXEL
    takes = f"the result takes about {needed / 1e6:.0f} MB"
    if predicted:
        kept = pixels * PREDICTION_BYTES_PER_PIXEL
        needed += kept
        takes += f" and its depth prior up to {kept / 1e6:.0f} MB until tracking is done"
    lines = [
        f"{capture.name}: {len(capture.cameras)} cameras x {capture.frame_count} frames, {', '.join(sizes)},"
        f" {capture.fps:g} fps; {takes} in {out}"
    ]
    unknown = [camera.name for camera in capture.cameras if not camera.focal_known]
    if unknown:
        lines.append(f"focal length to be found in the video: {', '.join(unknown)}")
    if len(capture.cameras) == 1:
        lines.append("one camera only: its depth rests on its own motion, and what moves is not seen twice")
    parent = next((folder for folder in (out, *out.absolute().parents) if folder.exists()), Path("/"))
    free = shutil.disk_usage(parent).free
    if free < needed:
        raise ResultError(
            f"{out}: {takes}, and the disk has {free / 1e6:.0f} MB left; free space or choose another --out"
        )
    return lines


def summary(result: Reconstruction, seconds: float) -> list[str]:
    """What came out, in lines for people."""
    import numpy as np

    posed = sum(
        int(np.isfinite(result.trajectory(name)[1]).all(axis=(1, 2)).sum()) for name in result.cameras
    )
    total = result.frame_count * len(result.cameras)
    lines = [f"{posed} of {total} frames have a pose; {seconds:.0f} s; result in {result.folder}"]
    if len(result.groups) > 1:
        groups = "; ".join(", ".join(group) for group in result.groups)
        lines.append(f"no view connects these groups of cameras, each has a world frame of its own: {groups}")
    lines += [str(note) for note in result.manifest.get("notes", [])]
    lines.append(f"next: mvdyn view {result.folder}, to look at it in 3D")
    lines.append(f"      mvdyn export {result.folder} --format nerfstudio|colmap|ply|tum")
    return lines
