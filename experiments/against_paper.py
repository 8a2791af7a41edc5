"""The kept results beside the paper's tables: methods on scenes, and what leaving a part out does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from experiments import paper
from experiments.ablations.studies import NOISE_DEG, NOISE_LEVELS_M, STUDIES, Variant
from experiments.records import Records, key_of
from mvdyn_gtsam.config import load_config, to_dict
from mvdyn_gtsam.errors import ConfigError

if TYPE_CHECKING:
    Entry = Mapping[str, Any]

NOT_RUN = "not run"
OURS = paper.OURS
SAME = 0.05
"""Relative change below which a figure counts as unchanged, in the paper's tables as in ours."""
FIGURES = {
    "ate_m": ("ATE m", 5),
    "rte_m": ("RTE m", 5),
    "rre_deg": ("RRE deg", 4),
    "abs_rel": ("Abs.Rel", 4),
    "delta_1_25": ("d<1.25", 3),
    "m_d": ("M_d m", 4),
    "m_d_scale_only": ("M_d scale only m", 4),
    "peak_mb": ("peak MB", 0),
    "seconds": ("s", 0),
}
"""Key -> heading and digits."""
HIGHER_IS_BETTER = ("delta_1_25",)


@dataclass(frozen=True)
class Kept:
    """What the results hold with default settings; of two runs of the same, the newer one."""

    accuracy: Mapping[tuple[str, str, str | None], Entry]
    """(capture, method, stage) -> entry"""
    phases: Mapping[tuple[str, str], Entry]
    """(capture, variant) -> entry"""
    ablations: Mapping[tuple[str, str, str], Entry]
    """(capture, digest of all settings, start) -> entry"""

    @staticmethod
    def read(folder: Path) -> Kept:
        """Raises ExperimentError where a file holds something else."""
        accuracy, phases, ablations = (
            Records(folder / f"{name}.json").entries()
            for name in ("accuracy", "refinement_phases", "ablations")
        )
        return Kept(
            {(e["capture"], e["method"].lower(), e["stage"]): e for e in accuracy if not e.get("overrides")},
            {(e["capture"], e["variant"]): e for e in phases if not e["overrides"]},
            {
                (e["capture"], digest, e["start"]): e
                for e in ablations
                if (digest := _settings_digest(tuple(e["settings"]))) is not None
            },
        )

    @property
    def commits(self) -> list[str]:
        """Of every entry, sorted."""
        every = [*self.accuracy.values(), *self.phases.values(), *self.ablations.values()]
        return sorted({str(entry["commit"]) for entry in every})

    @property
    def captures(self) -> list[str]:
        """Those with a scene of the paper first, in its order."""
        known = list(paper.CAPTURES.values())
        found = {key[0] for kept in (self.accuracy, self.phases, self.ablations) for key in kept}
        return [*known, *sorted(found - set(known))]

    def method(self, capture: str, name: str) -> tuple[Entry | None, str]:
        """Entry of a method, and how to call it; of ours the refined one, where there is one."""
        if name != OURS:
            return self.accuracy.get((capture, name.lower(), None)), name
        for entry, stage in (
            (self.accuracy.get((capture, OURS, "refinement")), "refined"),
            (self.phases.get((capture, "phases 1, 2")), "refined"),
            (self.accuracy.get((capture, OURS, "tracking")), "tracking only"),
        ):
            if entry is not None:
                apart = len((entry["scores"] or {}).get("groups") or []) > 1
                return entry, f"{OURS} ({stage}{', cameras apart' if apart else ''})"
        return None, OURS

    def variant(self, capture: str, variant: Variant) -> Entry | None:
        """Entry of a variant of the ablations."""
        digest = _settings_digest(variant.settings)
        return None if digest is None else self.ablations.get((capture, digest, variant.start.describe()))


@cache
def _settings_digest(overrides: tuple[str, ...]) -> str | None:
    """Of every setting that tracking has with ``overrides``; None where a setting is no longer known.

    Variants that come to the same are run once, under the name of the first of them.
    """
    try:
        settings = to_dict(load_config(None, overrides))
    except ConfigError:
        return None
    del settings["refinement"]
    return key_of(settings=settings)


def scene_of(capture: str) -> str | None:
    """The paper's scene that a capture was made after."""
    return next((scene for scene, own in paper.CAPTURES.items() if own == capture), None)


def value_of(entry: Entry | None, key: str) -> float | None:
    """A figure of an entry; None where it failed, was not measured or not run."""
    if entry is None or entry.get("problem") is not None:
        return None
    found = (entry.get("scores") or {}).get(key, entry.get(key))
    return None if found is None else float(found)


@dataclass(frozen=True)
class MethodRow:
    """One method on one scene."""

    scene: str | None
    capture: str
    method: str
    paper: paper.Figures | str | None
    """Figures, or why there are none; None: not in the paper."""
    here: tuple[float | None, ...] | str
    """Figures, or why there are none."""
    registered: float | None


def method_rows(
    kept: Kept, tables: Mapping[str, Mapping[str, paper.Figures | str]], keys: Sequence[str]
) -> list[MethodRow]:
    """Every method of the paper's tables and of the results, scene by scene."""
    rows = []
    for capture in kept.captures:
        scene = scene_of(capture)
        printed = tables.get(scene, {}) if scene else {}
        own = [e["method"] for (other, *_), e in kept.accuracy.items() if other == capture]
        known = {name.lower() for name in printed}
        for name in dict.fromkeys([*printed, *(name for name in own if name.lower() not in known), OURS]):
            entry, shown = kept.method(capture, name)
            figures = None if entry is None else tuple(value_of(entry, key) for key in keys)
            if name not in printed and (figures is None or set(figures) == {None}):
                continue
            here: tuple[float | None, ...] | str = NOT_RUN if figures is None else figures
            if entry is not None and entry.get("problem") is not None:
                here = paper.FAILS
            registered = None if entry is None else (entry.get("scores") or {}).get("registered")
            rows.append(MethodRow(scene, capture, shown, printed.get(name), here, registered))
    return rows


@dataclass(frozen=True)
class EffectRow:
    """One figure on one scene when a part is left out or changed."""

    scene: str | None
    capture: str
    figure: str
    paper: tuple[float, float] | None
    """The value without the change, and the change; None: not in the paper."""
    here: tuple[float, float] | str
    """The same, or why there is none."""
    agrees: bool | None
    """Whether both get worse, better or stay; None where one of them is missing."""


@dataclass(frozen=True)
class Effect:
    """What leaving out or changing one part does."""

    name: str
    table: str
    """Of the paper."""
    rows: tuple[EffectRow, ...]


def direction(key: str, full: float, change: float) -> str:
    """ "worse", "better" or "same" of a figure that was ``full`` before ``change``."""
    if abs(change) <= SAME * abs(full):
        return "same"
    return "better" if (change > 0.0) == (key in HIGHER_IS_BETTER) else "worse"


def effect(
    name: str,
    source: str,
    printed: paper.Changes,
    keys: Sequence[str],
    pairs: Mapping[str, tuple[Entry | None, Entry | None]],
) -> Effect:
    """``pairs``: capture -> the run of the full method and that without the part, None where not run."""
    rows = []
    for capture, (full, varied) in pairs.items():
        scene = scene_of(capture)
        in_paper = printed.get(scene, {}) if scene else {}
        if not in_paper and (full is None or varied is None):
            continue
        rows += [_effect_row(scene, capture, key, in_paper.get(key), full, varied) for key in keys]
    return Effect(name, source, tuple(rows))


def _effect_row(
    scene: str | None,
    capture: str,
    key: str,
    printed: tuple[float, float] | None,
    full: Entry | None,
    varied: Entry | None,
) -> EffectRow:
    before, after = value_of(full, key), value_of(varied, key)
    expected = None if printed is None else direction(key, *printed)
    here: tuple[float, float] | str = NOT_RUN
    agrees = None
    if full is not None and varied is not None:
        if before is None:
            here = "the full method has none"
        elif varied.get("problem") is not None:
            # A variant that fails where the full method does not is worse in every figure.
            here, agrees = paper.FAILS, None if expected is None else expected == "worse"
        elif after is None:
            here = "not measured"
        else:
            here = (before, after - before)
            agrees = None if expected is None else direction(key, *here) == expected
    return EffectRow(scene, capture, key, printed, here, agrees)


def effects(kept: Kept) -> list[Effect]:
    """Every ablation of the paper."""
    found = []
    for study in STUDIES.values():
        for variant in study.variants:
            if variant.reported is None:
                continue
            full = next((v for v in study.variants if v.name == variant.against), study.variants[0])
            pairs = {c: (kept.variant(c, full), kept.variant(c, variant)) for c in kept.captures}
            name = f"{study.title}: {variant.name}" + (f" against {full.name}" if variant.against else "")
            source = "Ablation studies on camera pose tracking"
            found.append(effect(name, source, variant.reported, paper.TRAJECTORY_KEYS, pairs))
    return [*found, *_noise_effects(kept), *_edge_effects(kept), *_refinement_effects(kept)]


def _noise_effects(kept: Kept) -> list[Effect]:
    """Medians over the seeds. The paper names no scene; ATE without noise is its DynamicHuman's."""
    variants = STUDIES["noisy_init"].variants
    found = []
    for metres in NOISE_LEVELS_M[1:]:
        change = paper.NOISY_START_ATE[metres] - paper.NOISY_START_ATE[0.0]
        printed = {paper.HUMAN: {"ate_m": (paper.NOISY_START_ATE[0.0], change)}}
        pairs = {
            capture: (
                _median_entry([kept.variant(capture, v) for v in variants if v.level and _metres(v) == 0.0]),
                _median_entry(
                    [kept.variant(capture, v) for v in variants if v.level and _metres(v) == metres]
                ),
            )
            for capture in kept.captures
        }
        name = f"A noisy start: {NOISE_DEG:g} deg and {metres:.2f} m against {NOISE_DEG:g} deg alone"
        found.append(effect(name, "Ablation studies on noisy initialization", printed, ("ate_m",), pairs))
    return found


def _metres(variant: Variant) -> float:
    return variant.start.translation_m


def _median_entry(entries: Sequence[Entry | None]) -> Entry | None:
    """Of the runs that there are, the median ATE; failed where half of them failed."""
    run = [entry for entry in entries if entry is not None]
    if not run:
        return None
    errors = [error for entry in run if (error := value_of(entry, "ate_m")) is not None]
    if 2 * len(errors) <= len(run):
        return {"problem": "most seeds failed"}
    return {"problem": None, "scores": {"ate_m": median(errors)}}


def _edge_effects(kept: Kept) -> list[Effect]:
    """Against the smallest budget, with as many connections made as fill the larger one."""
    variants = STUDIES["edge_budget"].variants
    least, *more = paper.EDGES
    smallest = next(v for v in variants if v.name == f"{least} edges")
    found = []
    for budget in more:
        filled = next(v for v in variants if v.name.startswith(f"{budget} edges, "))
        before, after = paper.EDGES[least], paper.EDGES[budget]
        keys = ("ate_m", "peak_mb", "seconds")
        values = {
            key: (factor * before[k], factor * (after[k] - before[k]))
            for k, (key, factor) in enumerate(zip(keys, (1.0, 1024.0, 1.0), strict=True))
        }
        pairs = {c: (kept.variant(c, smallest), kept.variant(c, filled)) for c in kept.captures}
        name = f"Budget of connections: {budget} against {least}"
        source = "Effect of the edge number (its memory is the GPU's)"
        found.append(effect(name, source, {paper.HUMAN: values}, keys, pairs))
    return found


def _refinement_effects(kept: Kept) -> list[Effect]:
    def against(variant: str) -> dict[str, tuple[Entry | None, Entry | None]]:
        return {
            c: (kept.phases.get((c, "phases 1, 2")), kept.phases.get((c, variant))) for c in kept.captures
        }

    depth = "Ablation studies on video depth evaluation and scene consistency"
    tracking = "Ablation study on refinement effect on camera tracking"
    joint = "Ablation study on the joint/iterative pose-depth optimization"
    return [
        effect("Neither phase", depth, paper.WITHOUT_PHASES, paper.DEPTH_KEYS, against("tracking")),
        effect("Phase 1 alone", depth, paper.WITHOUT_PHASE_2, paper.DEPTH_KEYS, against("phase 1")),
        effect(
            "Poses without the refinement",
            tracking,
            paper.WITHOUT_REFINEMENT,
            paper.TRAJECTORY_KEYS,
            against("tracking"),
        ),
        effect(
            "Joint in place of alternating optimization",
            joint,
            paper.JOINT,
            (*paper.TRAJECTORY_KEYS, *paper.DEPTH_KEYS),
            against("joint"),
        ),
    ]
