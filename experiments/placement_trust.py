"""What tells true placements of cameras from false ones: what the start would try, mended, and judged.

On the captures of start_variants every placement that the matches propose and dense warping does not refute
is mended as the start does, both by triangulated points and by lifted keypoints. Ground truth says which are
true. Each is then judged in care with several settings; the page says how far the trust of true and of false
ones is apart.

  true   within 2.5 degrees, a tenth of the median depth, and a tenth of scale
  false  beyond 6 degrees or a third of the median depth; what lies between counts as neither
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from experiments.altered_captures import AlteredCapture, alter_capture
from experiments.records import (
    Page,
    Run,
    experiment_parser,
    figure,
    parse,
    run_experiment,
    table,
)
from experiments.start_variants import VARIANTS, CaptureVariant, folders_of, variant_runs
from mvdyn_gtsam.config import load_config
from mvdyn_gtsam.frontend.dense_flow import DisFlow
from mvdyn_gtsam.frontend.start.camera_maps import map_camera
from mvdyn_gtsam.frontend.start.dense_map import DenseMap, testimony_flow
from mvdyn_gtsam.frontend.start.lifted_points import lift_map, match_lifted
from mvdyn_gtsam.frontend.start.placement import (
    PointMatches,
    agreeing_pairs,
    match_maps,
    propose_placements,
    same_placement,
)
from mvdyn_gtsam.frontend.start.settings import WideBaselineConfig
from mvdyn_gtsam.frontend.start.trial import mend_placement, similarity_of
from mvdyn_gtsam.frontend.start.verification import VerificationConfig, verify_placement
from mvdyn_gtsam.geometry import Similarity, rotation_angle_deg

NAME = "placement_trust"
JUDGED = {
    "4 looks, 0.1": (4, 0.1),
    "10 looks, 0.1": (10, 0.1),
    "10 looks, 0.2": (10, 0.2),
    "6 looks, 0.3": (6, 0.3),
    "10 looks, 0.3": (10, 0.3),
    "14 looks, 0.3": (14, 0.3),
}
"""``looks`` and ``other_look_careful`` of the verification."""
THRESHOLDS = (0.7, 0.75, 0.8, 0.85)
EXTREMES = 8
"""Of the least trusted true and the most trusted false placements that are shown."""


def measure(variant: CaptureVariant, overrides: Sequence[str], scenes: Path) -> dict[str, Any]:
    """Every placement that would be tried on one variant, as an entry of the records."""
    altered = alter_capture(variant.name, variant.parts, folders_of(variant, scenes))
    frontend = load_config(None, overrides).frontend
    config = frontend.wide_baseline
    flow = DisFlow(testimony_flow(frontend.flow))
    maps = {}
    for camera in range(len(altered.capture.cameras)):
        dense = map_camera(altered.capture, camera, flow=flow, config=config).dense
        if dense is not None and dense.known >= config.minimum_known:
            maps[camera] = dense
    lifted = {
        camera: lift_map(altered.capture, dense, config.lift, config.contrast)
        for camera, dense in maps.items()
    }
    tried = []
    for a, b in combinations(maps, 2):
        own = match_maps(maps[a].sparse, maps[b].sparse, config.placement)
        tried += list(_tries(altered, "own", maps[a], maps[b], own, config))
        found = match_lifted(lifted[a], lifted[b], config.lift, config.placement)
        tried += list(_tries(altered, "lifted", lifted[a], lifted[b], found, config))
    return {"variant": variant.name, "tried": tried}


def _tries(
    altered: AlteredCapture,
    points: str,
    first: DenseMap,
    second: DenseMap,
    matches: PointMatches,
    config: WideBaselineConfig,
) -> Iterator[dict[str, Any]]:
    a, b = first.sparse.camera, second.sparse.camera
    cameras = altered.capture.cameras[a], altered.capture.cameras[b]
    intrinsics = cameras[0].intrinsics, cameras[1].intrinsics
    truth = _true_place(altered, first).inverse().compose(_true_place(altered, second))
    hypotheses = propose_placements(matches, *intrinsics, config.placement)
    for hypothesis in hypotheses:
        if hypothesis.inliers < config.trial.minimum_inliers:
            continue
        hasty = verify_placement(first.views, second.views, hypothesis.aSb, config.verification)
        if hasty.trust < config.trial.minimum_trust:
            continue
        same_point = agreeing_pairs(matches, hypothesis.aSb, *intrinsics, config.placement)
        aSb, moved = mend_placement(
            cameras, (first, second), hypothesis.aSb, same_point, config.adjustment, config.trial,
            config.dense_map,
        )  # fmt: skip
        rivals = [h.support for h in hypotheses if not same_placement(h.aSb, hypothesis.aSb)]
        error = truth.inverse().compose(aSb)
        yield {
            "cameras": [camera.name for camera in cameras],
            "points": points,
            "inliers": hypothesis.inliers,
            "support": hypothesis.support,
            "rival": max(rivals, default=0.0),
            "rotation_deg": float(rotation_angle_deg(error.rotation)),
            "translation": float(np.linalg.norm(aSb.translation - truth.translation)),
            "log_scale": float(np.log(error.scale)),
            "hasty_trust": hasty.trust,
            "verdicts": {name: _verdict(moved, judge) for name, judge in _judges(config).items()},
        }


def _true_place(altered: AlteredCapture, dense: DenseMap) -> Similarity:
    sparse = dense.sparse
    truth = altered.truth[altered.capture.cameras[sparse.camera].name]
    return similarity_of(sparse.mTc, np.stack([truth[int(time)] for time in sparse.times]))


def _judges(config: WideBaselineConfig) -> dict[str, VerificationConfig]:
    return {
        name: replace(config.verification, looks=looks, other_look_careful=other)
        for name, (looks, other) in JUDGED.items()
    }


def _verdict(maps: tuple[DenseMap, DenseMap], judge: VerificationConfig) -> dict[str, float]:
    verdict = verify_placement(maps[0].views, maps[1].views, Similarity.identity(), judge, careful=True)
    return {"trust": verdict.trust, "share": verdict.share, **asdict(verdict)}


def is_true(tried: Mapping[str, Any]) -> bool | None:
    """Whether a placement is true; None for what is neither true nor false."""
    rotation, translation, log_scale = tried["rotation_deg"], tried["translation"], abs(tried["log_scale"])
    if rotation <= 2.5 and translation <= 0.1 and log_scale <= 0.1:
        return True
    return False if rotation > 6.0 or translation > 0.33 else None


def render(entries: Sequence[Mapping[str, Any]]) -> str:
    """How far the trust of true and false placements is apart by setting; the extremes of the default."""
    tried = [(entry["variant"], one) for entry in entries for one in entry["tried"]]
    true = [(variant, one) for variant, one in tried if is_true(one) is True]
    false = [(variant, one) for variant, one in tried if is_true(one) is False]
    if not true or not false:
        return f"{len(true)} true and {len(false)} false placements: nothing to compare.\n"
    rows = []
    for name in JUDGED:
        good, bad = (np.array([one["verdicts"][name]["trust"] for _, one in some]) for some in (true, false))
        counts = [f"{(good >= least).sum()} / {(bad >= least).sum()}" for least in THRESHOLDS]
        rows.append([name, figure(float((good[:, None] > bad).mean()), 3), *counts])
    columns = ("setting", "order", *(f"{least:g} and more" for least in THRESHOLDS))
    default = VerificationConfig()
    name = next(key for key, value in JUDGED.items() if value == (default.looks, default.other_look_careful))
    least = sorted(true, key=lambda pair: pair[1]["verdicts"][name]["trust"])[:EXTREMES]
    most = sorted(false, key=lambda pair: -pair[1]["verdicts"][name]["trust"])[:EXTREMES]
    extremes = [
        [kind, *_row(pair, name)] for kind, some in (("true", least), ("false", most)) for pair in some
    ]
    return (
        f"{len(true)} true and {len(false)} false placements of {len(entries)} captures. Order: how often a"
        " true one is trusted more than a false one. Then how many true / false ones reach a trust.\n\n"
        + table(columns, rows)
        + f"\nThe least trusted true and the most trusted false ones with {name}:\n\n"
        + table(
            ("", "capture", "cameras", "points", "inliers", "support", "rival", "deg", "depths", "trust"),
            extremes,
            text_columns=4,
        )
    )


def _row(pair: tuple[str, Mapping[str, Any]], name: str) -> list[str]:
    variant, one = pair
    return [
        variant,
        "-".join(one["cameras"]),
        one["points"],
        str(one["inliers"]),
        figure(one["support"]),
        figure(one["rival"]),
        figure(one["rotation_deg"]),
        figure(one["translation"], 2),
        figure(one["verdicts"][name]["trust"], 2),
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, print the tables, write them."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    parser = experiment_parser(NAME, __doc__, captures=False)
    parser.add_argument("--only", nargs="+", metavar="WORD", help="variants whose name holds one of these")
    options = parse(parser, words)

    def plan() -> list[Run]:
        return variant_runs(options, VARIANTS, measure, judged=JUDGED)

    pages = [Page(options.results / f"{NAME}.md", "Trust in true and false placements", render)]
    return run_experiment(NAME, words, options.results / f"{NAME}.json", pages, plan)


if __name__ == "__main__":
    sys.exit(main())
