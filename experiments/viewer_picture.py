"""A picture of one instant as `mvdyn view` shows it, taken by a browser that needs no screen.

What moves is seen within the still scene gathered from several times. Needs the extra view and Chromium, or a
browser that takes its options; on a machine without a graphics card it draws in software.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2

from experiments.records import ROOT, ExperimentError
from mvdyn_gtsam.capture import load_capture
from mvdyn_gtsam.errors import MvdynError
from mvdyn_gtsam.progress import NullProgress
from mvdyn_gtsam.reconstruction import Reconstruction
from mvdyn_gtsam.reconstruction.files import write_atomically
from mvdyn_gtsam.viewer.pictures import Choice, Show
from mvdyn_gtsam.viewer.views import ResultViews

WIDTH, HEIGHT = 1000, 640
"""px"""
POINTS = 150_000
SECONDS = 120.0
"""As long may the browser take."""
DRAWING_MS = 20_000
"""Of the page's own time before the picture is taken."""
WITHOUT_BUTTONS = "<style>.mantine-Notifications-root,.mantine-Paper-root{display:none !important}</style>"
QUALITY = 85


def picture(capture: Path, result: Path, time: int, browser: str) -> bytes:
    """JPEG of frame ``time``. Raises MvdynError when something is missing or the browser fails."""
    from mvdyn_gtsam.viewer.recording import save_html

    views = ResultViews(Reconstruction.load(result), load_capture(capture))
    choice = Choice(show=Show.GATHERED, points=POINTS, point_size=1.8)
    views.check(choice)
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "page.html"
        save_html(views, choice, [time], 1.0, page, NullProgress())
        page.write_text(page.read_text().replace("</head>", f"{WITHOUT_BUTTONS}</head>", 1))
        taken = _photograph(page, browser)
    done, content = cv2.imencode(".jpg", taken, (cv2.IMWRITE_JPEG_QUALITY, QUALITY))
    if not done:
        raise RuntimeError("OpenCV could not encode the picture")
    return content.tobytes()


def _photograph(page: Path, browser: str) -> cv2.typing.MatLike:
    program = shutil.which(browser)
    if program is None:
        raise ExperimentError(f"--browser {browser}: is not installed; install Chromium or name another")
    target = page.with_suffix(".png")
    command = [
        program, "--headless=new", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
        f"--window-size={WIDTH},{HEIGHT}", f"--virtual-time-budget={DRAWING_MS}", f"--screenshot={target}",
        f"--user-data-dir={page.parent / 'profile'}", page.as_uri(),
    ]  # fmt: skip
    if os.geteuid() == 0:
        command.insert(1, "--no-sandbox")  # Chromium refuses to start as root with it
    try:
        subprocess.run(command, capture_output=True, timeout=SECONDS, check=False)
    except subprocess.TimeoutExpired as error:
        raise ExperimentError(f"{browser}: took no picture within {SECONDS:g} s") from error
    taken = cv2.imread(str(target)) if target.is_file() else None
    if taken is None:
        raise ExperimentError(f"{browser}: took no picture; run it by hand on a page of mvdyn view --save")
    return taken


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    result.add_argument("capture", type=Path)
    result.add_argument("result", type=Path, help="refined result of that capture")
    result.add_argument("--frame", type=int, default=30, help="default: %(default)s")
    result.add_argument("--browser", default="chromium", help="default: %(default)s")
    result.add_argument("--out", type=Path, default=ROOT / "docs" / "pictures" / "viewer.jpg", metavar="FILE")
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Take the picture."""
    options = parser().parse_args(arguments)
    try:
        write_atomically(
            options.out, picture(options.capture, options.result, options.frame, options.browser)
        )
    except MvdynError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stderr.write(f"written: {options.out}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
