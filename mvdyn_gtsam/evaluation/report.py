"""Scores as a table for people."""

from __future__ import annotations

from rich.table import Table

from mvdyn_gtsam.evaluation.scores import CameraScores, Scores

COLUMNS = (
    *("camera", "poses\n%", "ATE\nm", "RTE\nm", "RRE\ndeg"),
    *("Abs.Rel", "d<1.25", "M_d\nm", "M_d m\nscale"),
)


def number(value: float | None, digits: int = 4) -> str:
    """A figure, or a dash where there is none."""
    return "-" if value is None else f"{value:.{digits}f}"


def format_table(scores: Scores) -> Table:
    """One row per camera and one for all together; the caption holds what has no row."""
    table = Table(
        title="Reconstruction against ground truth",
        caption="\n".join(_notes(scores)),
        caption_justify="left",
        # Two lines of heading and no edge keep the nine columns within a terminal of 80.
        show_edge=False,
    )
    for name in COLUMNS:
        table.add_column(name, justify="left" if name == "camera" else "right", no_wrap=True)
    rows: list[tuple[str, CameraScores | Scores]] = [*scores.per_camera.items(), ("all", scores)]
    for name, row in rows:
        if name == "all":
            table.add_section()
        depth = row.depth
        table.add_row(
            name,
            f"{100 * row.registered:.1f}",
            number(row.ate_m),
            number(row.rte_m),
            number(row.rre_deg, 3),
            number(depth.abs_rel if depth else None),
            number(depth.delta_1_25 if depth else None, 3),
            number(depth.m_d if depth else None),
            number(depth.m_d_scale_only if depth else None),
            style="bold" if name == "all" else None,
        )
    return table


def _share(scores: Scores) -> str:
    """The translation error of the start in terms of the scene's depth, which is how it is judged."""
    if scores.median_depth_m is None or scores.inter_camera_start_trans_m is None:
        return ""
    share = 100 * scores.inter_camera_start_trans_m / scores.median_depth_m
    return f" (the start's error is {share:.1f} % of it)"


def _notes(scores: Scores) -> list[str]:
    notes = ["One Sim(3) over all cameras; RMSE. Abs.Rel and d<1.25 after one scale and offset per frame."]
    if not scores.complete:
        missing = scores.frames - round(scores.registered * scores.frames)
        notes.append(
            f"INCOMPLETE: {missing} of {scores.frames} frames have no pose; the errors leave these out."
        )
    if scores.inter_camera_rot_deg is not None:
        notes.append(
            f"Between cameras: {number(scores.inter_camera_trans_m)} m,"
            f" {number(scores.inter_camera_rot_deg, 3)} deg;"
            f" at the start {number(scores.inter_camera_start_trans_m)} m,"
            f" {number(scores.inter_camera_start_rot_deg, 3)} deg."
            f" Median true depth {number(scores.median_depth_m, 2)} m{_share(scores)}."
        )
    depth = scores.depth
    if depth is not None and depth.frames_without_estimate:
        notes.append(
            f"No depth for {depth.frames_without_estimate} of {depth.frames} frames with true depth."
        )
    if depth is not None and depth.m_d is not None:
        notes.append(
            "M_d: median distance of corresponding points after the full Sim(3) (m_d), and in the cameras'"
            " own frames after its scale alone (m_d_scale_only)."
        )
    if depth is not None and depth.abs_rel_moving is not None:
        notes.append(
            f"Static pixels: Abs.Rel {number(depth.abs_rel_static)}, d<1.25"
            f" {number(depth.delta_1_25_static, 3)}, M_d {number(depth.m_d_static)} m;"
            f" moving: {number(depth.abs_rel_moving)}, {number(depth.delta_1_25_moving, 3)},"
            f" {number(depth.m_d_moving)} m."
        )
    if len(scores.groups) > 1:
        for group in scores.groups:
            figures = group.problem or f"ATE {number(group.ate_m)} m, RRE {number(group.rre_deg, 3)} deg"
            notes.append(f"Group {', '.join(group.cameras)} alone: {figures}")
    return notes
