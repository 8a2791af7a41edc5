"""One page that puts our figures beside the paper's: results/summary.md, summary.json and a plot.

Nothing is run here. Read are the kept results of accuracy, refinement_phases and ablations; what they lack is
"not run". The scenes differ: the paper's are filmed or rendered sequences of its own, averaged, ours one
rendered clip each, made after their description. So absolute figures are not to be compared; what can be are
ratios between methods on the same frames, and which way a figure goes when a part is left out.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments import paper
from experiments.against_paper import (
    FIGURES,
    NOT_RUN,
    OURS,
    SAME,
    Effect,
    EffectRow,
    Kept,
    MethodRow,
    direction,
    effects,
    method_rows,
    value_of,
)
from experiments.plots import Entries, bars
from experiments.records import QUICK, RESULTS, Page, figure, table, write_text
from mvdyn_gtsam.errors import MvdynError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAME = "summary"
OTHER_PAGES = {
    "ablation_depth_model": "structureless against fixed-shape depth",
    "ablation_grid_density": "density of the tracking grid",
    "ablation_edge_shares": "edge shares over time (the paper has a figure without numbers)",
    "scaling_frames": "time, memory and error against length",
    "scaling_cameras": "time, memory and error against the number of cameras",
    "scaling_frames_refinement": "time and memory of the refinement against length",
    "scaling_pixels_refinement": "time and memory of the refinement against the size of the images",
    "wide_baseline": "the wide-baseline start alone",
}
"""Pages without a table of the paper to stand beside."""


def method_table(rows: Sequence[MethodRow], keys: Sequence[str], paper_keys: Sequence[str]) -> str:
    """Paper left, here right, as Markdown."""
    columns = ["scene, capture here", "method", *(f"paper {FIGURES[key][0]}" for key in paper_keys)]
    columns += ["here registered %", *(f"here {FIGURES[key][0]}" for key in keys)]
    lines = []
    for row in rows:
        left = row.paper if isinstance(row.paper, tuple) else ("-" if row.paper is None else row.paper,)
        right = row.here if isinstance(row.here, tuple) else (row.here,)
        lines.append(
            [
                f"{row.scene or 'none'}, {row.capture}",
                row.method,
                *_cells(left, [3] * len(paper_keys)),
                figure(row.registered, 1, 100.0),
                *_cells(right, [FIGURES[key][1] for key in keys]),
            ]
        )
    return table(columns, lines, text_columns=2)


def _cells(values: Sequence[float | str | None], digits: Sequence[int]) -> list[str]:
    words = [v if isinstance(v, str) else figure(v, d) for v, d in zip(values, digits, strict=False)]
    return [*words, *[words[0] if words[0] == NOT_RUN else "-"] * (len(digits) - len(words))]


def ratio_rows(kept: Kept) -> list[list[str]]:
    """ATE of ours over that of COLMAP and GLOMAP, in the paper and here: this can be compared."""
    rows = []
    for scene, capture in paper.CAPTURES.items():
        printed = paper.TRAJECTORIES[scene]
        cells = [f"{scene}, {capture}"]
        ours, _ = kept.method(capture, OURS)
        for name in ("colmap", "glomap"):
            own, theirs = printed[OURS], printed.get(name)
            if isinstance(own, tuple) and isinstance(theirs, tuple):
                cells.append(figure(own[0] / theirs[0], 2))
            else:
                cells.append(str(theirs or "-"))
            entry, _ = kept.method(capture, name)
            here, there = value_of(ours, "ate_m"), value_of(entry, "ate_m")
            if entry is None or ours is None:
                cells.append(NOT_RUN)
            elif here is None or not there:
                cells.append(paper.FAILS)
            else:
                cells.append(figure(here / there, 2) + ("" if entry["registered"] == 1.0 else "*"))
        rows.append(cells)
    return rows


def effect_table(item: Effect) -> str:
    """Figures of one effect, as Markdown."""
    lines = []
    for row in item.rows:
        heading, digits = FIGURES[row.figure]
        lines.append(
            [
                f"{row.scene or 'none'}, {row.capture}",
                heading,
                "-" if row.paper is None else _change(*row.paper, min(digits, 3)),
                row.here if isinstance(row.here, str) else _change(*row.here, digits),
                "-" if row.paper is None else direction(row.figure, *row.paper),
                _direction_here(row),
                "-" if row.agrees is None else ("yes" if row.agrees else "NO"),
            ]
        )
    columns = ("scene, capture here", "figure", "paper", "here", "paper gets", "here gets", "agree")
    return table(columns, lines, text_columns=2)


def _change(full: float, change: float, digits: int) -> str:
    return f"{full:.{digits}f} {change:+.{digits}f}"


def _direction_here(row: EffectRow) -> str:
    if isinstance(row.here, str):
        return "worse" if row.here == paper.FAILS else "-"
    return direction(row.figure, *row.here)


def sign_rows(items: Sequence[Effect]) -> list[list[str]]:
    """Per effect: how many figures that the paper has were measured here, and how many go the same way."""
    rows = []
    for item in items:
        stated = [row for row in item.rows if row.paper is not None]
        told = [row for row in stated if row.agrees is not None]
        against = [f"{FIGURES[r.figure][0]} on {r.capture}" for r in told if not r.agrees]
        verdict = f"{sum(bool(r.agrees) for r in told)} of {len(told)}" if told else "-"
        missing = len(stated) - len(told)
        rows.append([item.name, str(len(stated)), NOT_RUN if not told else str(missing), verdict,
                     ", ".join(against) or "-"])  # fmt: skip
    return rows


def render(kept: Kept, results: Path) -> str:
    """The whole page's body."""
    items = effects(kept)
    poses = method_rows(kept, paper.TRAJECTORIES, paper.TRAJECTORY_KEYS)
    depth_keys = (*paper.DEPTH_KEYS, "m_d_scale_only")
    depth = [row for row in method_rows(kept, paper.DEPTH, depth_keys) if row.scene in (None, *paper.DEPTH)]
    parts = [
        "**The scenes differ.** The paper's are filmed or rendered sequences of its own, each figure an"
        " average over several; here each scene is one rendered clip made after the paper's description, and"
        " captures without a scene of the paper stand last. Absolute figures are not to be compared; ratios"
        " between methods on the same frames, and which way a figure goes, are.\n",
        "The paper's method uses learned flow, depth and a learned start on a GPU (20 GB); ours here runs on"
        f" a CPU with classical measurements. Our figures: commits {', '.join(kept.commits) or '-'}.\n",
        "## Which way figures go\n",
        f"A change within {100 * SAME:.0f} % counts as none, in the paper's tables as in ours.\n",
        table(
            ("left out or changed", "figures in the paper", "not run", "same way", "other way"),
            sign_rows(items),
        ),  # fmt: skip
        "## ATE of ours over that of COLMAP and GLOMAP\n",
        table(("scene, capture here", "paper, COLMAP", "here", "paper, GLOMAP", "here"), ratio_rows(kept)),
        "\\* the baseline left frames out, which its error leaves out, too.\n",
        "## Trajectories (the paper's Tables 1 to 3)\n",
        method_table(poses, paper.TRAJECTORY_KEYS, paper.TRAJECTORY_KEYS),
        "*cameras apart*: the start did not connect them, so errors over all of them mean little.\n",
        "## Depth and scene consistency (the paper's Table 4)\n",
        "M_d is strict here (after the full Sim(3)); the paper's supplement can be read either way.\n",
        method_table(depth, depth_keys, paper.DEPTH_KEYS),
        "## Ablations in full\n",
        "Each cell: the full method's value (of budgets: the smallest one's), and the change.\n",
    ]
    for item in items:
        parts += [f"### {item.name}\n", f'The paper\'s table "{item.table}".\n', effect_table(item)]
    parts += [
        "## Without a table of the paper\n",
        "".join(
            f"* {what}: "
            + (f"[{name}.md]({name}.md)\n" if (results / f"{name}.md").is_file() else f"{NOT_RUN}\n")
            for name, what in OTHER_PAGES.items()
        ),
    ]
    return "\n".join(parts)


def to_json(kept: Kept) -> dict[str, Any]:
    """The same as data."""
    return {
        "commits": kept.commits,
        "trajectories": [asdict(row) for row in method_rows(kept, paper.TRAJECTORIES, paper.TRAJECTORY_KEYS)],
        "depth": [
            asdict(row) for row in method_rows(kept, paper.DEPTH, (*paper.DEPTH_KEYS, "m_d_scale_only"))
        ],
        "effects": [asdict(item) for item in effects(kept)],
    }


def draw(kept: Kept, picture: Figure, _: Entries) -> None:
    """ATE and M_d of ours, the paper's beside these."""
    left, right = picture.subplots(1, 2)
    for axes, tables, key, place in (
        (left, paper.TRAJECTORIES, "ate_m", 0),
        (right, paper.DEPTH, "m_d", 2),
    ):
        entries = []
        for scene, printed in tables.items():
            figures = printed[OURS]
            assert isinstance(figures, tuple)
            entries.append({"scene": scene, "who": "paper", "value": figures[place]})
            entry, _name = kept.method(paper.CAPTURES[scene], OURS)
            entries.append({"scene": scene, "who": "here, another scene", "value": value_of(entry, key)})
        bars(axes, entries, "scene", "who", lambda entry: entry["value"], f"{FIGURES[key][0]}, ours")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    result.add_argument("--quick", action="store_true", help="of the results of --quick, in out/quick")
    result.add_argument(
        "--results", type=Path, metavar="DIR", help="where results are and the page goes, experiments/results"
    )
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Read, print and write the page."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    options = parser().parse_args(words)
    results = options.results or (QUICK if options.quick else RESULTS)
    path = results / f"{NAME}.md"
    try:
        kept = Kept.read(results)
        text = render(kept, results)
        item = Page(
            path, "Our figures beside the paper's", lambda _: text, lambda figure, _: draw(kept, figure, [])
        )
        problem = item.write(NAME, words, [])
        write_text(results / f"{NAME}.json", json.dumps(to_json(kept), indent=1, allow_nan=False) + "\n")
    except MvdynError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stdout.write(text)
    sys.stderr.write("".join(f"{line}\n" for line in (problem, f"written: {path}") if line))
    return 0


if __name__ == "__main__":
    sys.exit(main())
