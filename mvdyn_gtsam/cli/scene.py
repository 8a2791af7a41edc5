"""``mvdyn scene``."""

from __future__ import annotations

import argparse
import re
from dataclasses import fields
from pathlib import Path

from rich.console import Console

SUMMARY = "make a dynamic scene filmed by several cameras, with exact ground truth"
DESCRIPTION = """\
Make a capture out of nothing: people walk and things roll through a furnished room (or a yard) while
hand-held cameras film them. OUT becomes a capture folder with exact trajectories, depth, masks of what
moves and forward flow; scene.json says from what it was made and what came of it, such as the overlap
that was reached. The same settings give the same bytes."""
EPILOG = """\
examples:
  mvdyn scene clip --cameras 3 --frames 60 --overlap 0.4
  mvdyn scene hard --texture 0.2 --repeat 0.5 --motion 1 --noise 0.03 --exposure 0.2
  mvdyn reconstruct clip --out result && mvdyn evaluate result --groundtruth clip/groundtruth"""

_OPTIONS: dict[str, str] = {
    "cameras": "how many",
    "frames": "of each camera",
    "focal": "focal length in px (default: 0.8 of the width)",
    "fps": "frames a second",
    "overlap": "share of the view that neighbouring cameras have in common at one instant, 0 to 1",
    "meet": "metres ahead at which the cameras' axes cross: more gives wider baselines at one overlap",
    "texture": "0 plain surfaces, 1 rich ones",
    "repeat": "share of the surfaces in repeating wallpaper, 0 to 1",
    "motion": "how much of the image moves, and how fast, 0 to 1",
    "camera-motion": "speed of the hand-held cameras, m/s",
    "shake": "of the hands; 1 is a calm person",
    "noise": "standard deviation of the sensor's noise, of full scale",
    "exposure": "how far the gain of each camera drifts, of 1",
    "every": "depth, masks and flow of every n-th frame",
    "seed": "another scene of the same kind",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    from mvdyn_gtsam.scenes.settings import FORMATS, PLACES, SceneSettings

    defaults = SceneSettings()
    kinds = {field.name: int if "int" in str(field.type) else float for field in fields(SceneSettings)}
    parser.add_argument("out", type=Path, metavar="OUT", help="folder to make")
    size = f"{defaults.width}x{defaults.height}"
    parser.add_argument("--size", default=size, metavar="WxH", help="px (default: %(default)s)")
    for option, text in _OPTIONS.items():
        name = option.replace("-", "_")
        default = getattr(defaults, name)
        parser.add_argument(
            f"--{option}",
            type=kinds[name],
            default=default,
            metavar="N" if kinds[name] is int else "X",
            help=text if default is None else f"{text} (default: %(default)s)",
        )
    parser.add_argument(
        "--place", choices=PLACES, default=defaults.place, help="where it is (default: %(default)s)"
    )
    parser.add_argument(
        "--format", choices=FORMATS, default=defaults.format, help="of the frames (default: %(default)s)"
    )


def run(arguments: argparse.Namespace, messages: Console) -> int:
    """Run the verb."""
    import json

    from mvdyn_gtsam.cli.progress import ConsoleProgress
    from mvdyn_gtsam.errors import ConfigError
    from mvdyn_gtsam.scenes import SceneSettings, make_scene

    size = re.fullmatch(r"(\d+)x(\d+)", arguments.size)
    if size is None:
        raise ConfigError(f"--size {arguments.size}: write width x height in px, such as 512x384")
    names = [field.name for field in fields(SceneSettings) if field.name not in ("width", "height")]
    settings = SceneSettings(
        width=int(size[1]), height=int(size[2]), **{name: getattr(arguments, name) for name in names}
    )
    with ConsoleProgress(messages) as progress:
        folder = make_scene(settings, arguments.out, progress)
    made = json.loads((folder / "scene.json").read_text())
    overlap = made["overlap"]
    shared = "" if overlap is None else f", neighbours share {100 * overlap:.0f} % of the view"
    console = Console(soft_wrap=True, highlight=False, markup=False)
    console.print(
        f"{settings.cameras} cameras, {settings.frames} frames{shared}, "
        f"{100 * made['moving']:.0f} % of the image moves; capture in {folder}"
    )
    console.print(f"next: mvdyn reconstruct {folder} --out {folder}_result")
    return 0
