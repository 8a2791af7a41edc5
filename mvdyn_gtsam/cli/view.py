"""``mvdyn view``."""

from __future__ import annotations

import argparse
import importlib.util
import logging
import math
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from mvdyn_gtsam.errors import ConfigError, MvdynError, ViewerError

if TYPE_CHECKING:
    from mvdyn_gtsam.capture import Capture
    from mvdyn_gtsam.reconstruction import Reconstruction
    from mvdyn_gtsam.viewer.pictures import Choice
    from mvdyn_gtsam.viewer.views import ResultViews

SUMMARY = "look at a reconstruction in 3D, in the browser or in a file"
DESCRIPTION = """\
Look at a reconstruction in 3D: at every instant the points that each camera sees, the cameras with their
images, and their paths. It is served to the browser until Ctrl-C, or with --save written to one HTML file
that a browser opens and plays, without a server or a network.
Points have the colours of the images while the capture is where it was, or where --capture says; otherwise
those of their depth.
Needs the extra: pip install 'mvdyn_gtsam[view]'"""
EPILOG = """\
examples:
  mvdyn view result
  mvdyn view result --save scene.html                              # to copy from a server and open
  mvdyn view result --save scene.html --show gathered --every 2
  mvdyn view result --capture moved/clip"""

SHOWS = ("all", "moving", "still", "gathered")
POINTS_SERVED, POINTS_SAVED = 100_000, 40_000
INSTANTS_SAVED = 60
"""As many are saved at most unless --every says otherwise."""

log = logging.getLogger(__name__)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("reconstruction", type=Path, metavar="OUT", help="folder of a reconstruction")
    parser.add_argument("--capture", type=Path, help="the capture it was made from, where it was moved since")
    parser.add_argument("--host", default="127.0.0.1", help="address to serve at (default: %(default)s)")
    parser.add_argument("--port", type=int, default=8080, help="0 takes any free one (default: %(default)s)")
    parser.add_argument("--save", type=Path, metavar="FILE", help="write FILE.html instead of serving")
    parser.add_argument(
        "--every",
        type=int,
        metavar="N",
        help=f"save every n-th frame (default: as many as make at most {INSTANTS_SAVED})",
    )
    begin = parser.add_argument_group("what is saved, or seen first")
    begin.add_argument(
        "--show",
        choices=SHOWS,
        default="all",
        help="points of an instant: all, what moves, what stands still, or what moves within what stands"
        " still, gathered from several times (default: %(default)s)",
    )
    begin.add_argument(
        "--points",
        type=int,
        metavar="N",
        help=f"at most, of one instant (default: {POINTS_SERVED}, saved {POINTS_SAVED})",
    )
    begin.add_argument(
        "--min-confidence",
        type=float,
        default=0.0,
        help="leave out less certain points (default: %(default)s)",
    )
    begin.add_argument(
        "--group",
        type=int,
        default=0,
        help="of cameras, where nothing connects them all (default: %(default)s)",
    )
    begin.add_argument("--tracking", action="store_true", help="what tracking said, before the refinement")


def run(arguments: argparse.Namespace, messages: Console) -> int:
    """Run the verb."""
    _check(arguments)
    from mvdyn_gtsam.reconstruction import Reconstruction
    from mvdyn_gtsam.viewer.views import ResultViews

    result = Reconstruction.load(arguments.reconstruction)
    capture = _capture(arguments.capture, result)
    views = ResultViews(result, capture)
    choice = _choice(arguments, views)
    views.check(choice)
    placed = {name for group in views.groups for name in group}
    for name in result.cameras:
        if name not in placed:
            log.warning("%s could not be placed and is not shown", name)
    if len(views.groups) > 1:
        groups = "; ".join(f"{index}: {', '.join(group)}" for index, group in enumerate(views.groups))
        log.info("no view connects these groups of cameras, shown is %d of %s", choice.group, groups)
    if arguments.save is not None:
        _save(arguments, views, choice, messages)
    else:
        _serve(arguments, views, choice)
    return 0


def _check(arguments: argparse.Namespace) -> None:
    if importlib.util.find_spec("viser") is None:
        raise ViewerError("the viewer needs viser: pip install 'mvdyn_gtsam[view]'")
    for option, value in (("--every", arguments.every), ("--points", arguments.points)):
        if value is not None and value < 1:
            raise ConfigError(f"{option} {value}: must be at least 1")
    if not 0.0 <= arguments.min_confidence <= 1.0:
        raise ConfigError(f"--min-confidence {arguments.min_confidence}: must be between 0 and 1")
    if arguments.every is not None and arguments.save is None:
        raise ConfigError("--every: says what --save writes; leave it out, or name a file with --save")
    if arguments.save is not None and arguments.save.suffix != ".html":
        raise ConfigError(f"--save {arguments.save}: the file is for a browser; end its name in .html")


def _capture(given: Path | None, result: Reconstruction) -> Capture | None:
    """The capture that was ``given``, or the one the result was made from where it still is."""
    from mvdyn_gtsam.capture import open_capture
    from mvdyn_gtsam.reconstruction.export.points import check_capture

    # Longer captures are cut to what was reconstructed, so length is not checked again here.
    if given is not None:
        return open_capture(given, truncate=True)
    source = result.capture_source
    if source is not None and source.exists():
        try:
            capture = open_capture(source, truncate=True)
            check_capture(result, capture)
            return capture
        except MvdynError as error:  # nobody asked for it: the result is shown without
            log.warning("%s", error)
    log.info("colours tell depth, near yellow; for those of the images name the capture with --capture")
    return None


def _choice(arguments: argparse.Namespace, views: ResultViews) -> Choice:
    from mvdyn_gtsam.viewer.pictures import Choice, Show

    default = POINTS_SERVED if arguments.save is None else POINTS_SAVED
    return Choice(
        group=arguments.group,
        tracking=arguments.tracking,
        show=Show(arguments.show),
        colouring=views.colourings[0],
        min_confidence=arguments.min_confidence,
        points=arguments.points or default,
    )


def _serve(arguments: argparse.Namespace, views: ResultViews, choice: Choice) -> None:
    from mvdyn_gtsam.viewer.server import addresses, open_server
    from mvdyn_gtsam.viewer.session import Session

    console = Console(soft_wrap=True, highlight=False, markup=False)
    try:
        with open_server(arguments.host, arguments.port) as server:
            views.scene(choice)  # a result without a pose is a failure, not an empty scene
            session = Session(server, views, choice)
            for line in addresses(arguments.host, server.get_port()):
                console.print(line)
            console.print("Ctrl-C ends it")
            session.run()
    except KeyboardInterrupt:
        console.print("the viewer has ended")  # the usual way to end it, so no failure


def _save(arguments: argparse.Namespace, views: ResultViews, choice: Choice, messages: Console) -> None:
    from mvdyn_gtsam.cli.progress import ConsoleProgress
    from mvdyn_gtsam.viewer.recording import save_html

    every = arguments.every or math.ceil(views.frame_count / INSTANTS_SAVED)
    times = range(0, views.frame_count, every)
    with ConsoleProgress(messages) as progress:
        save_html(views, choice, times, every / views.fps, arguments.save, progress)
    size = arguments.save.stat().st_size / 1e6
    Console(soft_wrap=True, highlight=False, markup=False).print(
        f"{arguments.save}: {len(times)} instants, {size:.1f} MB; open it with a browser"
    )
