"""Which layout a path has, and reading it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.reconstruction.imports.colmap import is_model, read_model
from mvdyn_gtsam.reconstruction.imports.depth import find_depth
from mvdyn_gtsam.reconstruction.imports.nerfstudio import read_transforms
from mvdyn_gtsam.reconstruction.imports.npz import read_npz
from mvdyn_gtsam.reconstruction.imports.options import ImportOptions, read_options
from mvdyn_gtsam.reconstruction.imports.poses import ImportedPoses
from mvdyn_gtsam.reconstruction.imports.result import ImportedResult
from mvdyn_gtsam.reconstruction.imports.tum import read_tum_folder
from mvdyn_gtsam.reconstruction.manifest import is_reconstruction
from mvdyn_gtsam.reconstruction.result import Reconstruction

logger = logging.getLogger(__name__)

LAYOUTS = (
    "<camera>.txt of TUM lines",
    "a COLMAP model (cameras and images, .txt or .bin, also below sparse/)",
    "transforms.json",
    "one .npz with an array of poses per camera",
    "a reconstruction folder of mvdyn",
)

_READERS: dict[str, Callable[[Path, Capture, ImportOptions], ImportedPoses]] = {
    "tum": read_tum_folder,
    "colmap": read_model,
    "nerfstudio": read_transforms,
    "npz": read_npz,
}


def load_result(path: Path | str, capture: Capture) -> ImportedResult | Reconstruction:
    """The result at ``path``, of any method, on the frames of ``capture``; conventions: docs/import.md.

    Only poses are read here; depth files are listed and read when asked for. Raises ResultError, one line
    naming the file and the fix, for an unknown or ambiguous layout, cameras or frames that are not those of
    the capture, and matrices that are no poses. Frames without a pose are no error: the metrics count them.
    """
    path = Path(path)
    if not path.exists():
        raise ResultError(f"{path}: there is no such file or folder; check the path")
    if path.is_dir() and is_reconstruction(path):
        return _ours(path, capture)
    layout, source = find_layout(path, capture)
    folders = _places(path if path.is_dir() else path.parent)
    options = read_options(folders)
    poses = _READERS[layout](source, capture, options)
    found = {name: int(np.isfinite(wTc).all(axis=(1, 2)).sum()) for name, wTc in poses.wTc.items()}
    if not any(found.values()):
        raise ResultError(f"{source}: holds no pose of any frame of {', '.join(found)}")
    missing = len(found) * capture.frame_count - sum(found.values())
    if missing:
        logger.warning("%s: %d of %d frames have no pose", path, missing, len(found) * capture.frame_count)
    files = find_depth(folders, capture, options)
    return ImportedResult(path, capture, layout, poses.wTc, poses.intrinsics, files, options.depth_scale)


def find_layout(path: Path, capture: Capture) -> tuple[str, Path]:
    """Name of the layout and the file or folder to read. Raises ResultError for none, or more than one."""
    if path.is_file():
        layout = {".json": "nerfstudio", ".npz": "npz"}.get(path.suffix.lower())
        if layout is None:
            raise ResultError(f"{path}: not a result; give a folder, a transforms.json or a .npz")
        return layout, path
    found = [("colmap", model) for model in _models(path)]
    for folder in (path, path / "trajectories"):
        if any((folder / f"{camera.name}.txt").is_file() for camera in capture.cameras):
            found.append(("tum", folder))
    if (path / "transforms.json").is_file():
        found.append(("nerfstudio", path / "transforms.json"))
    found += [("npz", file) for file in sorted(path.glob("*.npz"))]
    if not found:
        names = ", ".join(camera.name for camera in capture.cameras)
        raise ResultError(
            f"{path}: no result of cameras {names} is recognised here; it must hold {'; or '.join(LAYOUTS)}"
        )
    if len(found) > 1:
        several = ", ".join(str(source.relative_to(path)) for _, source in found)
        raise ResultError(f"{path}: holds several results ({several}); give the path of one of them")
    return found[0]


def _models(path: Path) -> list[Path]:
    sparse = path if path.name == "sparse" else path / "sparse"
    below = sorted(folder for folder in sparse.iterdir() if folder.is_dir()) if sparse.is_dir() else []
    return [folder for folder in dict.fromkeys((path, sparse, *below)) if is_model(folder)]


def _places(folder: Path) -> list[Path]:
    """Where depth and options lie: beside the poses, and beside ``sparse/`` of a COLMAP model in it."""
    places = [folder]
    for parent in (folder, folder.parent):
        if parent.name == "sparse":
            places.append(parent.parent)
    return places


def _ours(path: Path, capture: Capture) -> Reconstruction:
    result = Reconstruction.load(path)
    names = {camera.name for camera in capture.cameras}
    if set(result.cameras) != names or result.frame_count != capture.frame_count:
        raise ResultError(
            f"{path}: has {result.frame_count} frames of {', '.join(result.cameras)}, capture"
            f" {capture.name!r} {capture.frame_count} of {', '.join(sorted(names))}; give a result of this"
            " capture"
        )
    return result
