"""``mvdyn compare``."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

from mvdyn_gtsam.cli.arguments import add_estimate_focal_argument
from mvdyn_gtsam.errors import BaselineError, CaptureError

SUMMARY = "run COLMAP and GLOMAP on the same frames, add any method's result, one table"
DESCRIPTION = """\
Run several methods on the same frames of the same capture, one after the other, each in a process of its
own, and score them alike: poses registered, errors, seconds, peak memory. DIR gets compare.json, compare.md,
plots (trajectories.png, error.png) and every method's result. A method that fails is a row that says so.

methods:
  ours                               mvdyn reconstruct, see --stage and --set
  colmap, glomap                     known PINHOLE intrinsics, one camera per device, held fixed; SIFT; frames
                                     +-10 of the same camera and +-5 of the others are matched; largest model.
                                     Focal lengths that are unknown (--estimate-focal, or so in CAPTURE) start
                                     from COLMAP's default, not from our guess, and are refined, one per
                                     device; glomap calibrates its view graph first, and where some are known
                                     refines those, too, as it can hold all or none; the table says so
  colmap-masks, glomap-masks         the same without features on what moves, see --masks
  colmap-retrieval, glomap-retrieval the same and the frames that look most alike besides, see --descriptor
  colmap-exhaustive, glomap-exhaustive  a control: every frame is matched with every other

results made elsewhere, --method NAME=PATH, become rows too; time and memory are unknown and show as -.
PATH is one of
  a folder of <camera>.txt           TUM lines: timestamp tx ty tz qx qy qz qw, camera-to-world, seconds
  a COLMAP model, .txt or .bin       images named <camera>/<frame>.png; also a folder with sparse/0 in it
  transforms.json                    nerfstudio: camera-to-world, OpenGL axes; file_path <camera>/<frame>.png
  a .npz                             one (T,4,4) or (T,3,4) per camera under its name, camera-to-world;
                                     convention="cTw" among the arrays says world-to-camera
  a reconstruction folder            of mvdyn
with depth beside the poses, if any: depth/<camera>/<frame>.npy, .npz, .png (16 bit) or .tif (float); z-depth
in the unit of the poses, of the whole frame at any resolution; 0, NaN and infinity are invalid.
Poses are of cameras with x right, y down, z forward (but for transforms.json); frames count from 0, and one
without a pose is left out (npz: NaN) and counted as a failure. PATH/import.json can say otherwise:
  {"convention": "cTw", "axes": "opengl", "timestamps": "frames", "first_frame": 1, "depth_scale": 0.001}"""
EPILOG = """\
examples:
  mvdyn compare clip --methods ours,colmap,glomap --out comparison
  mvdyn compare clip --methods ours,colmap,glomap --estimate-focal --out comparison
  mvdyn compare clip --methods ours --method vggt=runs/vggt --method vipe=runs/vipe --out comparison
  mvdyn compare clip --methods "" --method vggt=runs/vggt/poses.npz --out comparison
  mvdyn compare clip --methods glomap,glomap-masks --masks refined_result --out comparison
  mvdyn compare clip --methods glomap,glomap-retrieval --descriptor netvlad.onnx --out comparison"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("capture", type=Path, metavar="CAPTURE", help="folder of a capture")
    parser.add_argument(
        "--methods",
        default="ours,colmap,glomap",
        metavar="LIST",
        help='comma-separated, "" for none (default: %(default)s)',
    )
    parser.add_argument(
        "--method",
        dest="imported",
        action="append",
        default=[],
        metavar="NAME=PATH",
        help="a result of another method, made elsewhere; repeatable",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the comparison")
    parser.add_argument(
        "--groundtruth", type=Path, metavar="DIR", help="default: CAPTURE/groundtruth, where there is one"
    )
    parser.add_argument("--truncate", action="store_true", help="cut all cameras to the shortest")
    add_estimate_focal_argument(parser)
    parser.add_argument("--timeout", type=float, metavar="SECONDS", help="stop a method after this long")
    ours = parser.add_argument_group("ours")
    ours.add_argument(
        "--stage",
        choices=("tracking", "refinement"),
        default="tracking",
        help="how far (default: %(default)s)",
    )
    ours.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change a setting; repeatable",
    )
    baselines = parser.add_argument_group("COLMAP and GLOMAP")
    baselines.add_argument(
        "--masks",
        type=Path,
        metavar="DIR",
        help="of colmap-masks and glomap-masks: <camera>/000012.png of every frame, above 127 where something"
        " moves; or a refined reconstruction, whose motion/ is taken (default: CAPTURE/groundtruth/dynamic)",
    )
    baselines.add_argument(
        "--descriptor",
        type=Path,
        metavar="ONNX",
        help="of the retrieval methods, a global descriptor such as NetVLAD: input (1,3,H,W) float32, RGB in"
        " [0,1]; output (1,D)",
    )
    baselines.add_argument(
        "--retrieval-pairs",
        type=int,
        default=20,
        metavar="K",
        help="frames retrieved for each, of all cameras (default: %(default)s, hloc's for sequences)",
    )
    baselines.add_argument(
        "--database",
        type=Path,
        metavar="DIR",
        help="keep frames, features and matches here; methods of equal settings share them, in later"
        " comparisons too, and count their time and memory as their own",
    )
    baselines.add_argument(
        "--share-matches", action="store_true", help="the same within this comparison, nothing kept"
    )


def run(arguments: argparse.Namespace, messages: Console) -> int:
    """Run the verb."""
    from mvdyn_gtsam.baselines import BaselineSettings, compare
    from mvdyn_gtsam.config import load_config

    load_config(None, arguments.overrides)  # a mistake here must not cost a run
    methods = [method.strip() for method in arguments.methods.split(",") if method.strip()]
    imported = read_imported(arguments.imported)
    if not arguments.capture.exists():
        raise CaptureError(f"{arguments.capture}: there is no such file or folder; check the path")
    _check_options(arguments, methods)
    groundtruth = arguments.groundtruth
    if groundtruth is None and (arguments.capture / "groundtruth").is_dir():
        groundtruth = arguments.capture / "groundtruth"
    if groundtruth is None:
        messages.print("no ground truth: only registration, time and memory are compared")
    comparison = compare(
        arguments.capture,
        groundtruth,
        methods,
        arguments.out,
        imported=imported,
        stage=arguments.stage,
        settings=BaselineSettings(
            masks=arguments.masks,
            descriptor=arguments.descriptor,
            retrieval_pairs=arguments.retrieval_pairs,
        ),
        database=arguments.database,
        share_matches=arguments.share_matches,
        truncate=arguments.truncate,
        estimate_focal=arguments.estimate_focal,
        timeout_s=arguments.timeout,
        our_arguments=[word for override in arguments.overrides for word in ("--set", override)],
    )
    Console(highlight=False).print(comparison.to_table())
    messages.print(f"table: {arguments.out / 'compare.md'}")
    failed = {result.method: result.problem for result in comparison.results if result.problem is not None}
    if "ours" in failed or len(failed) == len(comparison.results):
        method = "ours" if "ours" in failed else next(iter(failed))
        log = "" if method in imported else f"; see {arguments.out / f'{method}.log'}"
        raise BaselineError(f"{method} failed: {failed[method]}{log}")
    return 0


def _check_options(arguments: argparse.Namespace, methods: list[str]) -> None:
    """Raises BaselineError for an option that no method has a use for."""
    from mvdyn_gtsam.baselines import BASELINES

    masked = [name for name, one in BASELINES.items() if one.masked]
    retrieval = [name for name, one in BASELINES.items() if one.pairing == "retrieval"]
    for option, value, wanted in (
        ("--masks", arguments.masks, masked),
        ("--descriptor", arguments.descriptor, retrieval),
    ):
        if value is not None and not set(wanted) & set(methods):
            raise BaselineError(f"{option} {value}: has no use here; add {' or '.join(wanted)} to --methods")
    if arguments.retrieval_pairs < 1:
        raise BaselineError(f"--retrieval-pairs {arguments.retrieval_pairs}: must be at least 1")


def read_imported(words: list[str]) -> dict[str, Path]:
    """``NAME=PATH`` words as a mapping. Raises BaselineError for one that is none, or a name given twice."""
    result: dict[str, Path] = {}
    for word in words:
        name, equals, path = word.partition("=")
        name = name.strip()
        if not (name and equals and path) or "|" in name:
            raise BaselineError(f"--method {word}: write NAME=PATH, for instance vggt=runs/vggt")
        if name in result:
            raise BaselineError(f"--method {word}: the name {name} is given twice; choose another")
        result[name] = Path(path)
    return result
