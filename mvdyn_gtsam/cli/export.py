"""``mvdyn export``."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

SUMMARY = "write a reconstruction in the format of another tool"
DESCRIPTION = """\
Write a reconstruction for other tools:
  tum         trajectories, camera-to-world, as evo reads them
  ply         coloured point cloud of some or all instants
  colmap      text model (cameras, images, points3D), world-to-camera, +0.5 px
  nerfstudio  transforms.json, OpenGL axes, one entry per frame and time, and points.ply to start from
With --capture, colmap and nerfstudio get the (undistorted) images, and points get their colours."""
EPILOG = """\
examples:
  mvdyn export result --format nerfstudio --capture clip
  mvdyn export result --format ply --times 0 10 20 --capture clip --to cloud.ply"""

FORMATS = ("tum", "ply", "colmap", "nerfstudio")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("reconstruction", type=Path, metavar="OUT", help="folder of a reconstruction")
    parser.add_argument("--format", choices=FORMATS, required=True, help="what to write")
    parser.add_argument(
        "--to",
        type=Path,
        metavar="PATH",
        help="where (default: OUT/exports/<format>, for ply <name>.ply there)",
    )
    parser.add_argument("--capture", type=Path, help="the capture it was made from, for images and colours")
    parser.add_argument("--times", type=int, nargs="+", metavar="T", help="these frames only (default: all)")
    parser.add_argument(
        "--stride", type=int, help="take every n-th pixel as a point (default: ply 2, others 16)"
    )
    parser.add_argument(
        "--min-confidence",
        type=float,
        default=0.3,
        help="leave out less certain points (default: %(default)s)",
    )


def run(arguments: argparse.Namespace, messages: Console) -> int:
    """Run the verb."""
    from mvdyn_gtsam.capture import open_capture
    from mvdyn_gtsam.errors import ConfigError
    from mvdyn_gtsam.reconstruction import Reconstruction
    from mvdyn_gtsam.reconstruction.export import export_colmap, export_nerfstudio, export_ply, export_tum

    if arguments.stride is not None and arguments.stride < 1:
        raise ConfigError(f"--stride {arguments.stride}: must be at least 1")
    result = Reconstruction.load(arguments.reconstruction)
    kind = arguments.format
    target = arguments.to or result.folder / "exports" / kind
    if kind == "tum":
        if arguments.times is not None:
            raise ConfigError("--times: a trajectory is written whole; leave it out with --format tum")
        written = export_tum(result, target)
    else:
        # Longer captures are cut to what was reconstructed, so length is not checked again here.
        capture = None if arguments.capture is None else open_capture(arguments.capture, truncate=True)
        if kind == "ply" and arguments.to is None:
            target = target / f"{result.name}.ply"
        exporter = {"ply": export_ply, "colmap": export_colmap, "nerfstudio": export_nerfstudio}[kind]
        options = {} if arguments.stride is None else {"stride": arguments.stride}
        written = exporter(
            result,
            target,
            times=arguments.times,
            capture=capture,
            min_confidence=arguments.min_confidence,
            **options,
        )
    console = Console(soft_wrap=True, highlight=False, markup=False)
    for path in written:
        console.print(str(path))
    return 0
