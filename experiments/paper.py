"""Figures of the paper's tables, as printed: metres and degrees, averages over the sequences of a scene.

Sun et al., Dense Dynamic Scene Reconstruction and Camera Pose Estimation from Multi-View Videos. Its scenes
are not ours: MultiCamRobolab and MultiCamVideo are filmed or rendered sequences of theirs, and what stands
beside them here is one rendered clip each, made after their description.
"""

from __future__ import annotations

from collections.abc import Mapping

OVERLAP, NON_OVERLAP, ARM = "RoboDog_overlap", "RoboDog_non-overlap", "RoboArm"
HUMAN, THREE, VIDEO = "DynamicHuman", "3-Cameras", "MultiCamVideo"

CAPTURES = {
    OVERLAP: "robodog_overlap",
    NON_OVERLAP: "robodog_nonoverlap",
    ARM: "roboarm",
    HUMAN: "dynamic_human",
    THREE: "three_cameras",
    VIDEO: "multicamvideo",
}
"""Scene -> the rendered capture made after its description."""

Figures = tuple[float, float, float]
FAILS = "fails"
NO_MEMORY = "OOM"

OURS = "ours"
TRAJECTORIES: Mapping[str, Mapping[str, Figures | str]] = {
    VIDEO: {
        "colmap": (0.073, 0.004, 0.110),
        "VGGT": NO_MEMORY,
        "VGGT, every 8th frame": (0.027, 0.016, 0.177),
        "Fast3R": (0.144, 0.056, 1.948),
        "FastVGGT": (0.023, 0.008, 0.080),
        "CUT3R": (0.175, 0.011, 0.164),
        OURS: (0.005, 0.001, 0.011),
    },
    OVERLAP: {
        "colmap": (0.134, 0.006, 0.179),
        "glomap": FAILS,
        "colmap-masks": (0.045, 0.005, 0.174),
        "glomap-masks": FAILS,
        "colmap-retrieval": (0.112, 0.005, 0.176),
        "glomap-retrieval": FAILS,
        "VGGT": NO_MEMORY,
        "VGGT, every 8th frame": (0.024, 0.012, 0.446),
        "Fast3R": (0.148, 0.081, 1.510),
        "FastVGGT": (0.021, 0.009, 0.234),
        "CUT3R": (0.277, 0.016, 0.299),
        OURS: (0.011, 0.003, 0.157),
    },
    NON_OVERLAP: {
        "colmap": FAILS,
        "glomap": FAILS,
        "colmap-masks": FAILS,
        "glomap-masks": FAILS,
        "colmap-retrieval": FAILS,
        "glomap-retrieval": FAILS,
        "VGGT": NO_MEMORY,
        "VGGT, every 8th frame": (0.019, 0.014, 0.423),
        "Fast3R": (0.701, 0.207, 4.723),
        "FastVGGT": (0.020, 0.013, 0.266),
        "CUT3R": (0.377, 0.021, 0.326),
        OURS: (0.020, 0.003, 0.163),
    },
    ARM: {
        "colmap": (0.008, 0.002, 0.072),
        "glomap": (0.006, 0.001, 0.053),
        "colmap-masks": (0.008, 0.002, 0.068),
        "glomap-masks": (0.005, 0.001, 0.054),
        "colmap-retrieval": (0.008, 0.002, 0.071),
        "glomap-retrieval": (0.005, 0.001, 0.054),
        "VGGT": NO_MEMORY,
        "VGGT, every 8th frame": (0.006, 0.004, 0.187),
        "Fast3R": (0.063, 0.066, 1.118),
        "FastVGGT": (0.006, 0.004, 0.107),
        "CUT3R": (0.055, 0.003, 0.112),
        OURS: (0.005, 0.001, 0.059),
    },
    HUMAN: {
        "colmap": (0.133, 0.011, 0.276),
        "glomap": (0.020, 0.009, 0.259),
        "colmap-masks": FAILS,
        "glomap-masks": (0.028, 0.008, 0.250),
        "colmap-retrieval": (0.082, 0.010, 0.270),
        "glomap-retrieval": (0.019, 0.009, 0.244),
        "VGGT": NO_MEMORY,
        "VGGT, every 8th frame": (0.032, 0.057, 1.713),
        "Fast3R": (0.180, 0.100, 1.258),
        "FastVGGT": (0.020, 0.013, 0.286),
        "CUT3R": (0.196, 0.016, 0.330),
        OURS: (0.013, 0.009, 0.257),
    },
    THREE: {
        "colmap": (0.343, 0.013, 0.376),
        "Fast3R": (0.376, 0.154, 1.825),
        "FastVGGT": (0.032, 0.017, 0.363),
        "CUT3R": (0.474, 0.0351, 0.467),
        OURS: (0.020, 0.011, 0.326),
    },
}
"""Tables 1 to 3: scene -> method -> (ATE m, RTE m, RRE deg). "fails": not every image was registered."""

DEPTH: Mapping[str, Mapping[str, Figures | str]] = {
    OVERLAP: {
        "VGGT": NO_MEMORY,
        "VGGT, every 8th frame": (0.068, 0.939, 0.376),
        "Fast3R": (0.144, 0.788, 0.580),
        "FastVGGT": (0.026, 0.978, 0.128),
        "CUT3R": (0.048, 0.968, 0.715),
        OURS: (0.011, 0.989, 0.091),
    },
    NON_OVERLAP: {
        "VGGT": NO_MEMORY,
        "VGGT, every 8th frame": (0.060, 0.947, 0.327),
        "Fast3R": (0.157, 0.749, 1.501),
        "FastVGGT": (0.018, 0.988, 0.095),
        "CUT3R": (0.040, 0.987, 0.581),
        OURS: (0.018, 0.991, 0.092),
    },
    ARM: {
        "VGGT": NO_MEMORY,
        "VGGT, every 8th frame": (0.171, 0.772, 0.547),
        "Fast3R": (0.191, 0.714, 0.763),
        "FastVGGT": (0.060, 0.906, 0.292),
        "CUT3R": (0.158, 0.745, 0.708),
        OURS: (0.059, 0.947, 0.289),
    },
    HUMAN: {
        "VGGT": NO_MEMORY,
        "VGGT, every 8th frame": (0.194, 0.900, 0.461),
        "Fast3R": (0.214, 0.735, 1.799),
        "FastVGGT": (0.030, 0.987, 0.185),
        "CUT3R": (0.060, 0.963, 0.503),
        OURS: (0.030, 0.971, 0.112),
    },
}
"""Table 4: scene -> method -> (Abs.Rel, delta < 1.25, M_d m)."""

TRAJECTORY_KEYS = ("ate_m", "rte_m", "rre_deg")
DEPTH_KEYS = ("abs_rel", "delta_1_25", "m_d")
Changes = Mapping[str, Mapping[str, tuple[float, float]]]
"""Scene -> figure -> (the full method's value, change without the part)."""


def _changes(keys: tuple[str, ...], full: Mapping[str, Figures], change: Mapping[str, Figures]) -> Changes:
    return {
        scene: {key: (full[scene][k], change[scene][k]) for k, key in enumerate(keys)} for scene in change
    }


_FULL_POSES: Mapping[str, Figures] = {
    OVERLAP: (0.011, 0.003, 0.157),
    NON_OVERLAP: (0.020, 0.003, 0.163),
    ARM: (0.005, 0.001, 0.059),
    HUMAN: (0.013, 0.009, 0.257),
}
WITHOUT_START = _changes(
    TRAJECTORY_KEYS,
    _FULL_POSES,
    {
        OVERLAP: (0.284, 0.003, -0.002),
        NON_OVERLAP: (0.496, 0.019, 0.026),
        ARM: (0.084, 0.002, 0.001),
        HUMAN: (0.130, 0.001, 0.009),
    },
)
WITHOUT_ST_GRAPH = _changes(
    TRAJECTORY_KEYS,
    _FULL_POSES,
    {
        OVERLAP: (0.158, 0.003, -0.002),
        NON_OVERLAP: (0.006, 0.000, -0.002),
        ARM: (0.012, 0.000, -0.001),
        HUMAN: (0.141, 0.002, 0.007),
    },
)
NOISY_START_ATE = {0.0: 0.013, 0.02: 0.013, 0.05: 0.016, 0.10: 0.044}
"""Metres of noise, with 3 degrees -> ATE m; the scene is not named."""

_FULL_DEPTH: Mapping[str, Figures] = {
    OVERLAP: (0.011, 0.989, 0.091),
    NON_OVERLAP: (0.018, 0.991, 0.092),
    ARM: (0.059, 0.947, 0.289),
    HUMAN: (0.030, 0.971, 0.112),
}
WITHOUT_PHASES = _changes(
    DEPTH_KEYS,
    _FULL_DEPTH,
    {
        OVERLAP: (0.020, 0.001, 0.066),
        NON_OVERLAP: (0.014, 0.001, 0.060),
        ARM: (0.068, -0.123, 0.226),
        HUMAN: (0.028, 0.007, 0.063),
    },
)
WITHOUT_PHASE_2 = _changes(
    DEPTH_KEYS,
    _FULL_DEPTH,
    {
        OVERLAP: (0.012, 0.001, 0.029),
        NON_OVERLAP: (0.005, 0.001, 0.012),
        ARM: (0.044, -0.083, 0.087),
        HUMAN: (0.003, 0.007, 0.012),
    },
)
WITHOUT_REFINEMENT = _changes(
    TRAJECTORY_KEYS,
    {
        **_FULL_POSES,
        # As printed there; the main table has 0.020.
        NON_OVERLAP: (0.026, 0.003, 0.163),
        THREE: (0.020, 0.011, 0.326),
    },
    {
        OVERLAP: (0.000, 0.000, -0.004),
        NON_OVERLAP: (0.004, 0.000, 0.016),
        ARM: (0.003, 0.000, -0.005),
        HUMAN: (0.003, 0.000, 0.000),
        THREE: (0.011, -0.002, 0.000),
    },
)
JOINT = _changes(TRAJECTORY_KEYS, _FULL_POSES, {HUMAN: (0.004, 0.003, 0.046)})
"""Poses and depth solved together against alternating: 0.017, 0.012, 0.303 against 0.013, 0.009, 0.257."""
EDGES = {48: (0.019, 14.58, 43.49), 96: (0.017, 16.96, 63.93), 192: (0.013, 20.04, 111.95)}
"""On DynamicHuman: budget -> ATE m, GPU GiB, seconds."""
