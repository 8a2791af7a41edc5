"""The small generated scene of ``--quick``: made in seconds, solved in seconds, nothing to download."""

from __future__ import annotations

from pathlib import Path

from mvdyn_gtsam.scenes import SceneSettings, make_scene


def quick_settings(cameras: int = 2, frames: int = 14) -> SceneSettings:
    """A rich room at 256x192, slow in frames and quick in cameras, so that few frames have parallax."""
    return SceneSettings(
        cameras=cameras,
        frames=frames,
        width=256,
        height=192,
        fps=15.0,
        overlap=0.75,
        texture=1.0,
        motion=0.25,
        camera_motion=0.9,
        noise=0.005,
    )


def quick_capture(folder: Path, cameras: int = 2, frames: int = 14) -> Path:
    """The folder of a capture with ground truth, below ``folder``; made once for the same settings."""
    return make_scene(quick_settings(cameras, frames), Path(folder) / f"quick_{cameras}x{frames}")
