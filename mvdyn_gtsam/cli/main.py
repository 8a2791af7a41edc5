"""``mvdyn``: parses the command line, runs one verb, turns every failure into one line and an exit code."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
from collections.abc import Sequence
from types import FrameType
from typing import NoReturn

from rich.console import Console
from rich.logging import RichHandler

from mvdyn_gtsam.cli import batch, compare, config, demo, evaluate, export, reconstruct, scene, view
from mvdyn_gtsam.errors import MvdynError
from mvdyn_gtsam.memory import keep_freed_memory

EXIT_OK, EXIT_ERROR, EXIT_USAGE, EXIT_INTERNAL, EXIT_INTERRUPTED = 0, 1, 2, 3, 130

DESCRIPTION = """\
Several people film one event with hand-held cameras. From the synchronised videos, with their
intrinsics or without, mvdyn recovers the pose of every camera and a dense depth map for every frame,
all in one world frame, while things move in the scene."""

EPILOG = """\
start here:
  mvdyn demo                                     the bundled clip, end to end, scored
  mvdyn reconstruct CAPTURE --out OUT            your own capture
  mvdyn view OUT --capture CAPTURE               look at it in 3D, in the browser
  mvdyn export OUT --format nerfstudio           for other tools
  mvdyn batch FOLDER --out OUT                   every capture of a folder
  mvdyn VERB --help                              every verb explains itself

exit codes: 0 done, 1 failed (one line says why), 2 wrong command line, 3 a bug, 130 interrupted"""

VERBS = (reconstruct, batch, evaluate, compare, export, view, demo, scene, config)


class _Parser(argparse.ArgumentParser):
    """Wrong command lines are one line too, without the usage in front."""

    def error(self, message: str) -> NoReturn:
        self.exit(EXIT_USAGE, f"{self.prog}: {message}; see {self.prog} --help\n")


def build_parser() -> argparse.ArgumentParser:
    """The parser of all verbs; the parsed namespace holds ``run``, the function of its verb."""
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument("--verbose", "-v", action="store_true", help="say more about what is done")
    shared.add_argument("--debug", action="store_true", help="show the traceback of a failure")
    parser = _Parser(
        prog="mvdyn",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="store_true", help="print the version and exit")
    # Typed as plain parsers, because the parent that is shared is one.
    verbs: argparse._SubParsersAction[argparse.ArgumentParser] = parser.add_subparsers(
        title="verbs", metavar="VERB", dest="verb", parser_class=_Parser
    )
    for module in VERBS:
        name = module.__name__.rsplit(".", 1)[-1]
        verb = verbs.add_parser(
            name,
            parents=[shared],
            help=module.SUMMARY,
            description=module.DESCRIPTION,
            epilog=module.EPILOG,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        module.add_arguments(verb)
        verb.set_defaults(run=module.run)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``mvdyn`` with ``argv`` (default: the process's) and return its exit code."""
    # Before numpy is loaded: BLAS threads beside our own make many small systems seven times slower.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    keep_freed_memory()
    parser = build_parser()
    try:
        arguments = parser.parse_args(argv)
    except SystemExit as stop:  # --help and wrong command lines
        return stop.code if isinstance(stop.code, int) else EXIT_USAGE
    if arguments.version:
        from importlib.metadata import version

        Console().print(f"mvdyn {version('mvdyn_gtsam')}", highlight=False)
        return EXIT_OK
    if arguments.verb is None:
        parser.print_help(sys.stderr)
        return EXIT_USAGE
    return _run(arguments)


def _run(arguments: argparse.Namespace) -> int:
    errors = Console(stderr=True, soft_wrap=True, highlight=False, markup=False)
    _set_up_logging(errors, arguments.verbose)
    previous = signal.signal(signal.SIGTERM, _interrupt)  # a polite kill leaves a readable result, too
    try:
        return int(arguments.run(arguments, errors) or EXIT_OK)
    except MvdynError as error:
        _show(errors, f"mvdyn: {error}", arguments.debug)
        return EXIT_ERROR
    except KeyboardInterrupt:
        _show(errors, f"mvdyn: interrupted{_what_is_kept(arguments)}", arguments.debug)
        return EXIT_INTERRUPTED
    except BrokenPipeError:  # `mvdyn config | head`: nobody reads any more, which is no failure of ours
        return EXIT_ERROR
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _show(errors, f"mvdyn: {where}{error.strerror or error}", arguments.debug)
        return EXIT_ERROR
    except Exception as error:  # the one place where a bug becomes a line instead of a traceback
        hint = "" if arguments.debug else "; run again with --debug for the traceback and report it"
        _show(errors, f"mvdyn: internal error: {type(error).__name__}: {error}{hint}", arguments.debug)
        return EXIT_INTERNAL
    finally:
        signal.signal(signal.SIGTERM, previous)


def _what_is_kept(arguments: argparse.Namespace) -> str:
    if arguments.verb != "reconstruct" or not (arguments.out / "manifest.json").is_file():
        return ""
    return f"; what was finished is in {arguments.out} and can be read; continue with --resume"


def _show(errors: Console, message: str, debug: bool) -> None:
    if debug:
        errors.print_exception()
    errors.print(" ".join(message.split()))


def _set_up_logging(console: Console, verbose: bool) -> None:
    handler = RichHandler(console=console, show_time=False, show_path=False, show_level=False, markup=False)
    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[handler], force=True)
    logging.getLogger("mvdyn_gtsam").setLevel(logging.DEBUG if verbose else logging.INFO)


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
