"""The pages of the studies: tables, what they say against the paper, and plots."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.ablations.measure import KINDS
from experiments.ablations.studies import FULL, NOISE_LEVELS_M, Study
from experiments.paper import CAPTURES, NOISY_START_ATE
from experiments.plots import bars, scores_value
from experiments.records import figure, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Entry = Mapping[str, Any]

COLUMNS = (
    "capture",
    "variant",
    "registered %",
    "ATE mm",
    "change mm",
    "RTE mm",
    "RRE deg",
    "between cameras mm",
    "between cameras deg",
    "edges between cameras %",
    "grid step px",
    "s",
    "CPU s",
    "peak MB",
)
SAME = 0.05
"""Relative change of ATE below which nothing is said to have got better or worse."""


def render(study: Study, entries: Sequence[Entry]) -> str:
    """The page's body: what it stands for, one row per run, and what the rows say."""
    commits = ", ".join(sorted({str(entry["commit"]) for entry in entries})) or "-"
    parts = [
        f"The paper: {study.stands_for}\n",
        f"{study.about}\n",
        "RMSE, one Sim(3) over all cameras together; tracking alone, its start made beforehand and not part"
        " of"
        f" time and memory. Commit {commits}.\n",
        table(COLUMNS, [row(entry, reference_of(entries, entry)) for entry in entries], text_columns=2),
    ]
    if any(variant.level for variant in study.variants):
        parts.append(_levels(entries))
    if study.name == "edge_shares":
        parts.append(_shares(entries))
    if study.name == "edge_budget":
        parts.append(_most_active(entries))
    return "\n".join([*parts, *filter(None, [_verdicts(entries), _notes(entries)])])


def reference_of(entries: Sequence[Entry], entry: Entry) -> Entry | None:
    """The run that this one is set against: the named one or the first of its capture."""
    own = [other for other in entries if other["capture"] == entry["capture"]]
    return next((other for other in own if entry["against"] in ("", other["variant"])), None)


def ate(entry: Entry | None) -> float | None:
    """ATE in metres, None for a run that failed."""
    return None if entry is None or entry["scores"] is None else entry["scores"]["ate_m"]


def row(entry: Entry, reference: Entry | None) -> list[str]:
    """Cells of one run, in the order of ``COLUMNS``."""
    scores = entry["scores"] or {}
    own, other = ate(entry), ate(reference)
    change = "-"
    if own is not None and other is not None and entry is not reference:
        change = f"{1e3 * (own - other):+.2f}"
    return [
        entry["capture"],
        entry["variant"] if entry["problem"] is None else f"{entry['variant']} (failed)",
        figure(entry["registered"], 1, 100.0),
        figure(own, 2, 1e3),
        change,
        figure(scores.get("rte_m"), 2, 1e3),
        figure(scores.get("rre_deg"), 3),
        figure(scores.get("inter_camera_trans_m"), 1, 1e3),
        figure(scores.get("inter_camera_rot_deg"), 3),
        figure(_between(entry), 0, 100.0),
        figure(entry.get("grid_step_px"), 0),
        figure(entry.get("seconds"), 0),
        figure(entry.get("cpu_seconds"), 0),
        figure(entry.get("peak_mb"), 0),
    ]


def _between(entry: Entry) -> float | None:
    """Share of the measured directions, polish included, that join two cameras."""
    if not entry.get("directions"):
        return None
    return float(entry["directions_between_cameras"] / entry["directions"])


def _verdicts(entries: Sequence[Entry]) -> str:
    """Whether what the paper says hurts does so here, a line for each."""
    lines = []
    for entry in entries:
        if entry["reported"] is not None:
            verdict = _verdict(entry, reference_of(entries, entry))
            lines.append(f"* {entry['capture']}, {entry['variant']}: {verdict}{_like(entry)}\n")
    return "".join(lines)


def _verdict(entry: Entry, reference: Entry | None) -> str:
    own, full = ate(entry), ate(reference)
    if reference is None or full is None:
        return "nothing to set it against, there is no ATE of that"
    if len(reference["groups"]) > 1:
        return "says nothing, the start left cameras apart before anything was taken away"
    if own is None:
        return f"fails, where {reference['variant']} does not: the paper's sign"
    change = (
        f"ATE {1e3 * full:.2f} -> {1e3 * own:.2f} mm, between cameras {_apart(reference)} -> {_apart(entry)},"
        f" against {reference['variant']}"
    )
    if own > (1.0 + SAME) * full:
        return f"hurts, the paper's sign ({change})"
    if own < (1.0 - SAME) * full:
        return f"HELPS, against the paper's sign ({change})"
    return f"changes next to nothing ({change})"


def _apart(entry: Entry) -> str:
    scores = entry["scores"]
    millimetres, degrees = scores.get("inter_camera_trans_m"), scores.get("inter_camera_rot_deg")
    return f"{figure(millimetres, 1, 1e3)} mm {figure(degrees, 3)} deg"


def _like(entry: Entry) -> str:
    """The paper's figures for the scene that this capture was made after; the scenes are not the same."""
    scene = next((name for name, capture in CAPTURES.items() if capture == entry["capture"]), None)
    if scene not in entry["reported"]:
        return ""
    full, change = entry["reported"][scene]
    return f"; the paper on its {scene}: {1e3 * full:.0f} -> {1e3 * (full + change):.0f} mm"


def _notes(entries: Sequence[Entry]) -> str:
    """Failures, frames left out and cameras left apart."""
    lines = []
    for entry in entries:
        name = f"* {entry['capture']}, {entry['variant']}"
        if entry["problem"] is not None:
            lines.append(f"{name} failed: {entry['problem']}; log: {entry['log']}")
        elif entry["registered"] < 1.0:
            lines.append(f"{name}: incomplete; the errors leave out the frames without a pose")
        if len(entry.get("groups") or []) > 1:
            groups = "; ".join("+".join(group) for group in entry["groups"])
            lines.append(f"{name}: its start leaves cameras apart ({groups}); errors over all mean little")
    return "".join(f"{line}\n" for line in lines)


def _levels(entries: Sequence[Entry]) -> str:
    """Seeds taken together, the paper's figure beside them; its scene is another."""
    rows = []
    levels = dict.fromkeys((e["capture"], e["level"], e["noise_m"]) for e in entries if e["level"])
    for capture, level, noise_m in levels:
        own = [e for e in entries if (e["capture"], e["level"]) == (capture, level)]
        errors = [value for e in own if (value := ate(e)) is not None]
        between = [e["scores"]["inter_camera_trans_m"] for e in own if e["scores"]]
        rows.append(
            [
                capture,
                level,
                f"{len(errors)} of {len(own)}",
                figure(median(errors) if errors else None, 2, 1e3),
                figure(max(errors) if errors else None, 2, 1e3),
                figure(median(between) if between and None not in between else None, 1, 1e3),
                figure(NOISY_START_ATE.get(noise_m), 0, 1e3),
            ]
        )
    columns = ("capture", "noise", "finished", "median ATE mm", "worst ATE mm", "median between cameras mm",
               "paper's ATE mm")  # fmt: skip
    return table(columns, rows, text_columns=2)


def shares(entry: Entry) -> dict[str, np.ndarray]:
    """Per kind ``(T,)`` share of the active connections at each step; 0 where there are none."""
    counts = {kind: np.array(entry["edges_per_step"][kind], float) for kind in KINDS}
    total = np.maximum(sum(counts.values()), 1.0)
    return {kind: count / total for kind, count in counts.items()}


def _shares(entries: Sequence[Entry]) -> str:
    rows = []
    for entry in entries:
        if entry["scores"] is None:
            continue
        own = shares(entry)
        steps = len(own[KINDS[0]])
        total = [sum(entry["edges_per_step"][kind][step] for kind in KINDS) for step in range(steps)]
        spans = {"whole video": slice(None), "first third": slice(0, max(1, steps // 3)),
                 "last third": slice(-max(1, steps // 3), None)}  # fmt: skip
        for name, span in spans.items():
            rows.append(
                [
                    entry["capture"],
                    name,
                    *(figure(float(own[kind][span].mean()), 1, 100.0) for kind in KINDS),
                    figure(float(np.mean(total[span])), 0),
                ]
            )
    return table(("capture", "steps", *(f"{_words(k)} %" for k in KINDS), "active"), rows, text_columns=2)


def _words(kind: str) -> str:
    return kind.replace("spatio_temporal", "spatio-temporal")


def _most_active(entries: Sequence[Entry]) -> str:
    """Whether the budget was ever reached, without which it cannot matter."""
    rows = []
    for entry in entries:
        if entry["scores"] is None:
            continue
        steps = entry["edges_per_step"]
        active = np.add(steps["spatial"], steps["spatio_temporal"])
        rows.append([entry["capture"], entry["variant"], figure(float(active.max()), 0)])
    return table(("capture", "variant", "most active between cameras"), rows, text_columns=2)


# ---- plots -------------------------------------------------------------------------------------------


def plot_of(study: Study) -> Callable[[Figure, Sequence[Entry]], None]:
    """The plot of the study's page."""
    if study.name == "edge_shares":
        return plot_shares
    if study.name in ("edge_budget", "grid_density"):
        return plot_costs
    return plot_noise if study.name == "noisy_init" else plot_bars


def _captures(entries: Sequence[Entry]) -> list[str]:
    return list(dict.fromkeys(entry["capture"] for entry in entries))


def plot_bars(figure: Figure, entries: Sequence[Entry]) -> None:
    """ATE of every variant, a cluster per capture."""
    bars(figure.add_subplot(), entries, "capture", "variant", scores_value("ate_m", 1e3), "ATE, mm")


def plot_costs(figure: Figure, entries: Sequence[Entry]) -> None:
    """ATE, memory and time side by side: what more of something brings and what it takes."""
    first, second, third = figure.subplots(1, 3)
    bars(first, entries, "capture", "variant", scores_value("ate_m", 1e3), "ATE, mm")
    bars(second, entries, "capture", "variant", lambda entry: entry.get("peak_mb"), "peak memory, MB")
    bars(third, entries, "capture", "variant", lambda entry: entry.get("cpu_seconds"), "CPU s")
    handles, labels = first.get_legend_handles_labels()
    for axes in (first, second, third):
        if (legend := axes.get_legend()) is not None:
            legend.remove()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize="small")


def plot_noise(figure: Figure, entries: Sequence[Entry]) -> None:
    """ATE against translation noise, a dot per seed and a line through the medians; dashed: full method."""
    axes = figure.add_subplot()
    for number, capture in enumerate(_captures(entries)):
        colour = f"C{number}"
        own = [e for e in entries if e["capture"] == capture]
        dots = [(e["noise_m"], 1e3 * value) for e in own if e["level"] and (value := ate(e)) is not None]
        axes.plot([x for x, _ in dots], [y for _, y in dots], ".", color=colour)
        levels = [level for level in NOISE_LEVELS_M if any(x == level for x, _ in dots)]
        middle = [median(y for x, y in dots if x == level) for level in levels]
        axes.plot(levels, middle, "-", color=colour, label=capture)
        full = next((value for e in own if e["variant"] == FULL.name and (value := ate(e)) is not None), None)
        if full is not None:
            axes.axhline(1e3 * full, color=colour, linestyle="--", linewidth=1.0)
    axes.set_xlabel("noise on the start's positions, m (and 3 degrees); dashed: full method")
    axes.set_yscale("log")
    axes.set_ylabel("ATE, mm")
    axes.grid(axis="y", alpha=0.3)
    if axes.lines:
        axes.legend(fontsize="small")


def plot_shares(figure: Figure, entries: Sequence[Entry]) -> None:
    """Shares of the active connections over time, stacked, one panel per capture."""
    drawn = [entry for entry in entries if entry["scores"] is not None]
    panels = figure.subplots(1, max(1, len(drawn)), squeeze=False, sharey=True)[0]
    for axes, entry in zip(panels, drawn, strict=False):
        own = shares(entry)
        steps = range(len(own[KINDS[0]]))
        axes.stackplot(steps, [100.0 * own[k] for k in KINDS], labels=[_words(k) for k in KINDS], alpha=0.8)
        axes.set_title(entry["capture"], fontsize="small")
        axes.set_xlabel("time step")
        axes.set_ylim(0.0, 100.0)
    panels[0].set_ylabel("share of active connections, %")
    if drawn:
        panels[0].legend(fontsize="small", loc="lower left")
