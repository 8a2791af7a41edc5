"""Which studies there are, what each changes, and the paper's table that it stands for."""

from __future__ import annotations

from dataclasses import dataclass, replace

from experiments import paper
from experiments.ablations.starts import StartChange, StartKind

PRIOR_OFF = ("tracking.start_rotation_deg=180.0", "tracking.start_translation=10.0")
"""The start's poses are where the solver begins, as in the paper, and hold nothing: ours trusts its own start
to 0.02 degrees, which nobody may do whose start was made worse."""
NOISE_LEVELS_M = tuple(paper.NOISY_START_ATE)
NOISE_DEG = 3.0
SEEDS = (0, 1, 2)
BUDGETS = tuple(paper.EDGES)
WINDOW_EDGES = 48
"""Connections that one per keyframe and camera makes in a window of 25 frames of two cameras."""


@dataclass(frozen=True)
class Variant:
    """One way to track, next to the full method."""

    name: str
    settings: tuple[str, ...] = ()
    start: StartChange = StartChange()
    reported: paper.Changes | None = None
    """What the paper reports of its like."""
    against: str = ""
    """The variant that it is set against; empty: the first."""
    level: str = ""
    """Variants of one level are one line of the summary: the same but for the seed."""


@dataclass(frozen=True)
class Study:
    """One question, one page."""

    name: str
    title: str
    stands_for: str
    """The paper's table or figure with its figures, or that it has none."""
    about: str
    """What the variants are and what to mind when reading."""
    variants: tuple[Variant, ...]
    """The first is what the others are set against, where they do not say."""
    quick: tuple[str, ...] = ()
    """Variants that ``--quick`` runs; empty: all."""

    def shortened(self) -> Study:
        """The study as ``--quick`` runs it."""
        if not self.quick:
            return self
        kept = [variant for variant in self.variants if variant.name in self.quick]
        return replace(
            self, variants=tuple(v if v.against in self.quick else replace(v, against="") for v in kept)
        )


FULL = Variant("full method")


def _ate(changes: paper.Changes) -> str:
    """The paper's ATE per scene, with and without."""
    cells = (f"{scene} {full:.3f} {change:+.3f} m" for scene, (full, change) in ate_changes(changes).items())
    return f"ATE {', '.join(cells)}"


def ate_changes(changes: paper.Changes) -> dict[str, tuple[float, float]]:
    """Scene -> ATE of the paper's full method and its change, m."""
    return {scene: figures["ate_m"] for scene, figures in changes.items()}


def _noise(level_m: float, seed: int) -> Variant:
    level = f"{NOISE_DEG:g} deg, {level_m:.2f} m"
    start = StartChange(StartKind.NOISY, NOISE_DEG, level_m, seed)
    return Variant(f"{level}, seed {seed}", PRIOR_OFF, start, against="start not held", level=level)


def _budget(budget: int) -> Variant:
    return Variant(f"{budget} edges", (f"graph.max_active_edges={budget}",))


def _filled(budget: int) -> Variant:
    per_frame = budget // WINDOW_EDGES
    settings = (f"graph.max_active_edges={budget}", f"graph.st_per_frame={per_frame}",
                f"graph.polish_per_frame={2 * per_frame}")  # fmt: skip
    return Variant(f"{budget} edges, {per_frame} per keyframe", settings)


STUDIES = {
    study.name: study
    for study in (
        Study(
            "without_init",
            "Without the wide-baseline start",
            f'Table "Ablation studies on camera pose tracking", w/o W.B. Init.: {_ate(paper.WITHOUT_START)}.',
            "The paper does not say what takes the start's place; it says that single-camera trackers begin"
            " by frames that overlap in time. So: *own maps* - each camera's start from its own video"
            " alone, all cameras at one place and of one median depth, nothing said of how they stand to"
            " one another; *nothing* - every camera at the origin looking at a wall at depth 1, as such"
            " trackers begin. In both, connections between cameras are made and solved as always, and the"
            " start's poses hold nothing; *start not held* has the whole start on the same terms.",
            (
                FULL,
                Variant("start not held", PRIOR_OFF),
                Variant("own maps", PRIOR_OFF, StartChange(StartKind.SAME_POSE), paper.WITHOUT_START),
                Variant("nothing", PRIOR_OFF, StartChange(StartKind.FLAT), paper.WITHOUT_START),
            ),
            quick=("full method", "own maps"),
        ),
        Study(
            "without_st_graph",
            "Without the spatio-temporal graph",
            'Table "Ablation studies on camera pose tracking", w/o ST-Graph:'
            f" {_ate(paper.WITHOUT_ST_GRAPH)}; RoboDog_non-overlap hardly overlaps.",
            'In the paper the method then "degenerates to running separate video reconstruction and then'
            ' aligning them via feed-forward predicted poses". So: no connection and no mount between'
            " cameras, in tracking and polish (`graph.inter_camera=false`); the poses of the start alone"
            " say where each camera is. Ours come from a start that was adjusted over all cameras together"
            " and is trusted, so less is lost than with a network's; *start noisy* takes away that help:"
            " the start's poses off by 3 degrees and 0.05 m, with the graph and without.",
            (
                FULL,
                Variant(
                    "no graph between cameras", ("graph.inter_camera=false",), reported=paper.WITHOUT_ST_GRAPH
                ),
                Variant("start noisy", PRIOR_OFF, StartChange(StartKind.NOISY, NOISE_DEG, 0.05, 0)),
                Variant(
                    "start noisy, no graph between cameras",
                    (
                        "graph.inter_camera=false",
                        f"tracking.start_rotation_deg={NOISE_DEG}",
                        "tracking.start_translation=0.02",
                    ),
                    StartChange(StartKind.NOISY, NOISE_DEG, 0.05, 0),
                    paper.WITHOUT_ST_GRAPH,
                    against="start noisy",
                ),
            ),
            quick=("full method", "no graph between cameras"),
        ),
        Study(
            "noisy_init",
            "A noisy start",
            'Table "Ablation studies on noisy initialization" (3 degrees and): ATE 0.013 m at 0 m, 0.013 at'
            " 0.02 m, 0.016 at 0.05 m, 0.044 at 0.10 m.",
            "Every pose of the start is turned by 3 degrees about a random axis and moved by so many metres"
            " in a random direction, each pose on its own; sparse depths stay. The start's poses hold"
            " nothing; *start not held* has the start without noise on the same terms. Three seeds.",
            (
                FULL,
                Variant("start not held", PRIOR_OFF),
                *(_noise(level, seed) for level in NOISE_LEVELS_M for seed in SEEDS),
            ),
            quick=("full method", _noise(0.10, 0).name),
        ),
        Study(
            "edge_budget",
            "The budget of connections between cameras",
            'Supplement, "Effect of the edge number" on DynamicHuman: 48 edges ATE 0.019 m, 14.58 GiB, 43'
            " s; 96: 0.017 m, 16.96 GiB, 64 s; 192: 0.013 m, 20.04 GiB, 112 s.",
            "`graph.max_active_edges`: first alone, then with as many connections made per keyframe as fill"
            " it in a window of 25 frames of two cameras, in tracking and, twice that, in the polish."
            " Memory is the process's peak, libraries included.",
            (
                _budget(96),
                *(_budget(budget) for budget in BUDGETS if budget != 96),
                *(_filled(budget) for budget in BUDGETS if budget > WINDOW_EDGES),
            ),
            quick=(_budget(96).name, _filled(192).name),
        ),
        Study(
            "depth_model",
            "Structureless factor against a depth map of fixed shape",
            "No table of the paper: its bundle adjustment solves every depth too. DESIGN 5 gives the reason.",
            "`tracking.depth_model`: *fixed shape* - poses are solved with the pairwise factor over X_i,"
            " X_j and one scale S_i per keyframe, the shape of its depth map held and solved anew only"
            " between solves; *carried shape* - that shape is never solved, only carried along from the"
            " start.",
            (
                FULL,
                Variant("fixed shape", ("tracking.depth_model=fixed_shape",)),
                Variant("carried shape", ("tracking.depth_model=carried_shape",)),
            ),
        ),
        Study(
            "grid_density",
            "Density of the tracking grid",
            "No table of the paper, which tracks at an eighth of the resolution.",
            "`tracking.grid_points`, about so many points per frame; the step between them follows.",
            (
                *(
                    Variant(f"{points} points", (f"tracking.grid_points={points}",))
                    for points in (768, 192, 384, 1536, 3072)
                ),
            ),
            quick=("768 points", "192 points"),
        ),
        Study(
            "edge_shares",
            "Shares of connections over time",
            'Supplement, figure "Edge count statistics across different scenes": few connections between'
            " cameras in RoboDog_non-overlap.",
            "Connections of the active window after each time step, by kind, as tracking recorded them; the"
            " polish adds long-range ones.",
            (FULL,),
        ),
    )
}
