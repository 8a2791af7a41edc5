"""Put the pages of experiments/results/ into the README's table slots.

A slot is what stands between `<!-- table: NAME -->` and `<!-- end: NAME -->`; the page's command and tables
replace it, the page's title and plot are left out. Slots whose page does not exist are left as they are and
named.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from experiments.records import RESULTS, ROOT, ExperimentError, write_text
from mvdyn_gtsam.errors import MvdynError

PAGES = {
    "accuracy": "accuracy.md",
    "time": "glomap_against_best.md",
    "refinement": "refinement_phases.md",
    "start": "wide_baseline.md",
    "memory": "scaling_frames.md",
}
"""Slot -> page."""


def fill(text: str, pages: Mapping[str, str]) -> str:
    """``text`` with each slot's content replaced by that of its page. Raises ExperimentError for no slot."""
    for name, page in pages.items():
        slot = re.compile(rf"(<!-- table: {re.escape(name)} -->\n).*?(<!-- end: {re.escape(name)} -->)", re.S)
        if not slot.search(text):
            raise ExperimentError(f"there is no slot between <!-- table: {name} --> and <!-- end: {name} -->")
        # A plot's path is that from the page, and the README has pictures of its own.
        body = re.sub(r"\A# .*\n+|^!\[[^\]]*\]\([^)]*\)\n", "", page, flags=re.M).strip("\n")
        text = slot.sub(lambda found, body=body: f"{found[1]}\n{body}\n\n{found[2]}", text)  # type: ignore[misc]
    return text


def main(arguments: Sequence[str] | None = None) -> int:
    """Fill what there is."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--readme", type=Path, default=ROOT / "README.md", metavar="FILE")
    parser.add_argument("--results", type=Path, default=RESULTS, metavar="DIR", help="where the pages are")
    options = parser.parse_args(arguments)
    pages = {name: options.results / page for name, page in PAGES.items()}
    try:
        if not options.readme.is_file():
            raise ExperimentError(f"{options.readme}: there is no such file")
        found = {name: path.read_text() for name, path in pages.items() if path.is_file()}
        write_text(options.readme, fill(options.readme.read_text(), found))
    except MvdynError as error:
        sys.stderr.write(f"{options.readme}: {error}\n")
        return 1
    for name, path in pages.items():
        sys.stderr.write(f"{name}: {'filled' if name in found else f'left as it was, no {path}'}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
