"""Arguments that several verbs share, and how they are read."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mvdyn_gtsam.errors import CaptureError

if TYPE_CHECKING:
    from mvdyn_gtsam.capture import Capture
    from mvdyn_gtsam.config import Config


def add_capture_arguments(parser: argparse.ArgumentParser) -> None:
    """CAPTURE, or --camera and --intrinsics in its place, and --estimate-focal."""
    parser.add_argument(
        "capture",
        nargs="?",
        type=Path,
        metavar="CAPTURE",
        help="folder with capture.json, or of a known layout (EuRoC, MultiCamVideo, folder per camera)",
    )
    group = parser.add_argument_group("cameras in place of CAPTURE (repeat both, in the same order)")
    group.add_argument(
        "--camera", action="append", default=[], metavar="VIDEO", help="a video, or a quoted glob of images"
    )
    group.add_argument(
        "--intrinsics",
        action="append",
        default=[],
        metavar="FX,FY,CX,CY",
        help="its pinhole intrinsics in px, pixel centres at integers; may be left out of all with"
        " --estimate-focal",
    )
    group.add_argument("--fps", type=float, help="frame rate, where the files do not say it")
    add_estimate_focal_argument(parser, "; --resume needs it again")
    parser.add_argument(
        "--truncate", action="store_true", help="accept cameras of different length: cut all to the shortest"
    )


def add_estimate_focal_argument(parser: argparse.ArgumentParser, more: str = "") -> None:
    """--estimate-focal; ``more`` ends its help."""
    parser.add_argument(
        "--estimate-focal",
        action="store_true",
        help="the focal lengths are not known: find each camera's in its video. The camera must move from its"
        " place (turning is not enough) and have square pixels, no distortion, and a principal point near the"
        " centre, or near cx,cy. Intrinsics that are given are first guesses. For some cameras only:"
        f' "estimate_focal": true in capture.json{more}',
    )


def add_depth_model_argument(parser: argparse.ArgumentParser) -> None:
    """--depth-model."""
    parser.add_argument(
        "--depth-model",
        metavar="NAME",
        help="which network the .onnx file of --depth-prior holds, where its inputs and outputs do not tell:"
        " moge-2, unidepth-v2, depth-anything-v2-metric or depth-anything-3-metric",
    )


def add_config_arguments(parser: argparse.ArgumentParser) -> None:
    """--config and --set."""
    parser.add_argument("--config", type=Path, metavar="FILE", help="TOML or JSON file of settings")
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change one setting, e.g. tracking.window=20; repeatable; `mvdyn config` lists all",
    )


def read_config(arguments: argparse.Namespace) -> Config:
    """The whole configuration the arguments ask for. Raises ConfigError."""
    from mvdyn_gtsam.config import config_from_dict

    return config_from_dict(read_settings(arguments))


def read_settings(arguments: argparse.Namespace, *, alone: bool = True) -> dict[str, Any]:
    """The settings the arguments name, nested; ``alone`` as in ``load_settings``. Raises ConfigError."""
    from mvdyn_gtsam.config import load_settings

    overrides = list(arguments.overrides)
    if getattr(arguments, "truncate", False):
        overrides.append("capture.truncate=true")
    return load_settings(arguments.config, overrides, alone=alone)


def read_capture(arguments: argparse.Namespace, config: Config) -> Capture:
    """The checked capture the arguments name. Raises CaptureError."""
    from mvdyn_gtsam.capture import with_unknown_focal

    capture = _open_capture(arguments, config)
    return with_unknown_focal(capture) if arguments.estimate_focal else capture


def _open_capture(arguments: argparse.Namespace, config: Config) -> Capture:
    from mvdyn_gtsam.capture import capture_from_cameras, open_capture

    truncate = config.capture.truncate
    if arguments.capture is None and not arguments.camera:
        raise CaptureError(
            "no input: give a CAPTURE folder, or --camera with --intrinsics for each video, or --camera for"
            " each and --estimate-focal where intrinsics are not known"
        )
    if arguments.capture is not None:
        if arguments.camera or arguments.intrinsics:
            raise CaptureError(f"{arguments.capture}: give either a CAPTURE folder or --camera, not both")
        return open_capture(arguments.capture, truncate=truncate, fps=arguments.fps)
    intrinsics = [parse_intrinsics(text) for text in arguments.intrinsics]
    given = None if arguments.estimate_focal and not intrinsics else intrinsics
    return capture_from_cameras(arguments.camera, given, fps=arguments.fps, truncate=truncate)


def parse_intrinsics(text: str) -> tuple[float, ...]:
    """``"fx,fy,cx,cy"`` as four finite numbers. Raises CaptureError."""
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 4 or not all(math.isfinite(value) for value in values):
        raise CaptureError(f"--intrinsics {text}: write four numbers, fx,fy,cx,cy in px")
    return values
