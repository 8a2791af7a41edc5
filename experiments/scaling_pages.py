"""Tables and plots of the scaling studies: what one size took, and what it took more than the one before."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from experiments.plots import Entries, lines, scores_value
from experiments.records import figure, table
from experiments.refinement_phases import FLOW_STEPS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Entry = Mapping[str, Any]
Per = Callable[[Entry], float]
"""What seconds are divided by."""

GOAL_MB = 1500.0
"""MiB above the libraries, of any stage."""
REFINEMENT_GOAL_MB = 2e9 / 2**20
"""MiB of the refinement, all processes together: 2 GB at 3 cameras x 60 frames of 512x384."""
REFINEMENT_GOAL_RATIO = 2.0
"""The whole refinement against its flow."""
PHASES = ("start", "tracking", "refinement")


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    heading: str
    value: Callable[[Entry, Entry | None], float | None]
    """Of an entry, and the last one above it that was finished."""
    digits: int = 0
    factor: float = 1.0


def images(entry: Entry) -> float:
    """Frames of all cameras."""
    return float(entry["cameras"]) * float(entry["frames"])


def megapixels(entry: Entry) -> float:
    """Of all images together."""
    return images(entry) * image_megapixels(entry)


def image_megapixels(entry: Entry) -> float:
    """Of one image."""
    return float(entry["width"]) * float(entry["height"]) / 1e6


def phase_seconds(phase: str, entry: Entry) -> float | None:
    """Seconds of one phase, None where it did not run."""
    seconds = entry["phase_seconds"].get(phase)
    return None if seconds is None else float(seconds)


def flow_seconds(entry: Entry) -> float:
    """Seconds of the refinement's flow."""
    return float(sum(entry["refinement_seconds"].get(step, 0.0) for step in FLOW_STEPS))


def rest_seconds(entry: Entry) -> float:
    """Seconds of all the refinement but its flow, reading and writing included."""
    return float(entry["phase_seconds"]["refinement"]) - flow_seconds(entry)


def flow_ratio(entry: Entry) -> float | None:
    """The whole refinement in units of its flow, None where it has no flow."""
    flow = flow_seconds(entry)
    return float(entry["phase_seconds"]["refinement"]) / flow if flow > 0.0 else None


def all_processes_mb(entry: Entry) -> float:
    """MiB that the refinement's processes stay below together: each is at most as large as the largest."""
    return float(entry["refinement_processes"]) * float(entry["stage_peak_mb"]["refinement"])


def _score(key: str) -> Callable[[Entry, Entry | None], float | None]:
    value = scores_value(key)
    return lambda entry, before: value(entry)


def _share(
    seconds: Callable[[Entry], float | None], per: Per
) -> Callable[[Entry, Entry | None], float | None]:
    """``seconds`` per ``per``."""
    return lambda entry, before: None if (found := seconds(entry)) is None else found / per(entry)


def _growth(key: str) -> Callable[[Entry, Entry | None], float | None]:
    return lambda entry, before: None if before is None else float(entry[key]) - float(before[key])


def _added_share(per: Per) -> Callable[[Entry, Entry | None], float | None]:
    """Seconds more than before per image or megapixel more."""

    def value(entry: Entry, before: Entry | None) -> float | None:
        more = 0.0 if before is None else per(entry) - per(before)
        return None if before is None or not more else (entry["seconds"] - before["seconds"]) / more

    return value


def _wall(entry: Entry) -> float | None:
    return float(entry["seconds"])


def columns(study: str) -> list[Column]:
    """Of the whole run."""
    result = [
        Column("registered %", _score("registered"), 1, 100.0),
        Column("ATE mm", _score("ate_m"), 1, 1e3),
        Column("s", lambda entry, before: entry["seconds"]),
        Column("s per image", _share(_wall, images), 3),
        *(Column(phase, _share(partial(phase_seconds, phase), images), 3) for phase in PHASES),
    ]
    if study == "pixels":
        result.append(Column("s per Mpx", _share(_wall, megapixels), 3))
        for phase in PHASES:
            seconds = partial(phase_seconds, phase)
            result.append(Column(f"{phase} per Mpx", _share(seconds, megapixels), 3))
        result.append(Column("s per added Mpx", _added_share(megapixels), 3))
    else:
        result.append(Column("s per added image", _added_share(images), 3))
    return [
        *result,
        Column("peak MB", lambda entry, before: entry["peak_mb"]),
        Column("above libraries MB", lambda entry, before: entry["peak_mb"] - entry["libraries_mb"]),
        Column("growth MB", _growth("peak_mb")),
        Column("result MB", lambda entry, before: entry["result_mb"]),
        Column("growth MB", _growth("result_mb")),
    ]


def refinement_columns(study: str) -> list[Column]:
    """Of the refinement alone."""
    parts = {"flow": flow_seconds, "rest": rest_seconds}
    result = [
        Column("s", lambda entry, before: phase_seconds("refinement", entry), 1),
        Column("of it flow", lambda entry, before: flow_seconds(entry), 1),
        Column("the rest", lambda entry, before: rest_seconds(entry), 1),
        Column("s / flow", lambda entry, before: flow_ratio(entry), 2),
        *(Column(f"{name} per image", _share(part, images), 3) for name, part in parts.items()),
    ]
    if study == "pixels":
        result += [Column(f"{name} per Mpx", _share(part, megapixels), 3) for name, part in parts.items()]
    return [
        *result,
        Column("peak MB", lambda entry, before: entry["stage_peak_mb"]["refinement"]),
        Column("processes", lambda entry, before: entry["refinement_processes"]),
        Column("all at most MB", lambda entry, before: all_processes_mb(entry)),
        Column("of 2 GB %", lambda entry, before: all_processes_mb(entry) / REFINEMENT_GOAL_MB, 0, 100.0),
    ]


def size_of(study: str, entry: Entry) -> str:
    """What differs from row to row."""
    first, second = ("width", "height") if study == "pixels" else ("cameras", "frames")
    return f"{entry[first]} x {entry[second]}"


def rows(study: str, shown: Sequence[Column], entries: Entries) -> list[list[str]]:
    """One row per size; growth is against the last size above that was finished."""
    result: list[list[str]] = []
    before: Entry | None = None
    for entry in entries:
        size = size_of(study, entry)
        if entry["problem"] is not None:
            result.append([f"{size} (failed)", *["-"] * len(shown)])
            continue
        cells = [figure(column.value(entry, before), column.digits, column.factor) for column in shown]
        result.append([size, *cells])
        before = entry
    return result


def _table(study: str, shown: Sequence[Column], entries: Entries) -> str:
    heading = "width x height" if study == "pixels" else "cameras x frames"
    return table([heading, *(column.heading for column in shown)], rows(study, shown, entries))


def render(study: str, stage: str, entries: Entries) -> str:
    """Tables, goals and failures of one study as Markdown."""
    refined = stage == "refinement"
    per = "per image and per megapixel of all images (Mpx)" if study == "pixels" else "per image"
    apart = " of tracking and refinement, which run one after the other" if refined else ""
    commits = ", ".join(sorted({str(entry["commit"]) for entry in entries}))
    return (
        f"{_what(study, entries)}; interpreter and libraries alone take"
        f" {figure(entries[-1]['libraries_mb'], 0)} MB. Goal: at most {GOAL_MB:.0f} MB above them, growing no"
        f" more than the result. Phases in seconds {per}, MB are MiB; peak MB is the largest single"
        f" process{apart}, not the sum of several; commit {commits}.\n\n"
        + _table(study, columns(study), entries)
        + (f"\n{_refinement(study, entries)}" if refined else "")
        + _notes(study, entries)
    )


def _what(study: str, entries: Entries) -> str:
    names = ", ".join(dict.fromkeys(entry["capture"] for entry in entries))
    if study == "frames":
        return f"{names} played forwards and backwards"
    if study == "pixels":
        [size] = {f"{entry['cameras']} cameras x {entry['frames']} frames" for entry in entries}
        return f"{names}: the same scene of {size}, rendered at the size of each row"
    return f"{names}: the scene of each row"


def _refinement(study: str, entries: Entries) -> str:
    """The refinement alone, as Markdown."""
    return (
        "The refinement alone, resumed on the tracking result in a process of its own. Flow is"
        f" {' and '.join(FLOW_STEPS)}, the rest all else it does, images read and results written; goal: s at"
        f" most {REFINEMENT_GOAL_RATIO:g} times flow. peak MB is its largest single process; the sum is not"
        " measured, but as each of its processes (the main one, and its workers where there are several) is"
        f' no larger, they stay below "all at most"; goal: 2 GB ({REFINEMENT_GOAL_MB:.0f} MB) at 3 cameras'
        " x 60 frames of 512x384.\n\n" + _table(study, refinement_columns(study), entries)
    )


def _notes(study: str, entries: Entries) -> str:
    """Failures and cameras left apart, below the table."""
    found = []
    for entry in entries:
        size = f"* {size_of(study, entry)}"
        groups = ((entry.get("scores") or {}).get("groups")) or []
        if entry["problem"] is not None:
            found.append(f"{size}: {entry['problem']}")
        elif len(groups) > 1:
            names = " / ".join("+".join(group["cameras"]) for group in groups)
            found.append(f"{size}: the start leaves cameras apart ({names}); ATE over all means little")
    return "".join(f"\n{line}" for line in found) + ("\n" if found else "")


def draw(study: str, stage: str, picture: Figure, entries: Entries) -> None:
    """Seconds per image by phase, memory, and ATE over the size."""
    done = [entry for entry in entries if entry["problem"] is None]
    seconds, memory, error = picture.subplots(1, 3)

    def over(entry: Entry) -> float:
        return round(image_megapixels(entry), 3) if study == "pixels" else float(entry[study])

    def per_image(value: Callable[[Entry], float | None], entry: Entry) -> float | None:
        return None if (found := value(entry)) is None else found / images(entry)

    x = "megapixels of an image" if study == "pixels" else study
    phases = {phase: partial(per_image, partial(phase_seconds, phase)) for phase in PHASES}
    megabytes: dict[str, Callable[[Entry], float | None]] = {
        "peak, above the libraries": lambda entry: entry["peak_mb"] - entry["libraries_mb"],
        "result on disk": lambda entry: entry["result_mb"],
    }
    if stage == "refinement":
        phases["of it flow"] = partial(per_image, flow_seconds)
        megabytes["refinement, all processes at most"] = all_processes_mb
    lines(seconds, done, over, phases, x, "seconds per image")
    lines(memory, done, over, megabytes, x, "MB")
    lines(error, done, over, {"ATE": scores_value("ate_m", 1e3)}, x, "ATE (mm)")
