"""Files that are either whole or absent, and the TUM trajectory format."""

from __future__ import annotations

import contextlib
import errno
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.errors import ResultError


def write_atomically(path: Path, content: bytes) -> None:
    """Write ``content`` to a neighbour of ``path`` and rename it, so that a reader never sees half a file.

    Raises ResultError when the disk is full or the folder cannot be written; ``path`` then keeps its
    previous content.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(content)
        os.replace(temporary, path)
    except OSError as error:
        with contextlib.suppress(OSError):  # its folder may be no folder: the first error is the one to tell
            temporary.unlink(missing_ok=True)
        raise _as_result_error(path, error) from error
    except BaseException:  # Ctrl-C between the two calls must not leave the temporary file behind
        temporary.unlink(missing_ok=True)
        raise


def _as_result_error(path: Path, error: OSError) -> ResultError:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return ResultError(
            f"{path}: the disk is full; what was computed is kept: free space, then continue with --resume"
        )
    return ResultError(f"{path}: cannot be written ({error.strerror or error}); choose another place")


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as indented JSON, atomically; NaN is refused (ValueError) because JSON has none."""
    write_atomically(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


TUM_HEADER = (
    "# TUM: timestamp tx ty tz qx qy qz qw; seconds; wTc (camera-to-world), OpenCV axes"
    " (x right, y down, z forward); frames without a pose have no line\n"
)


def format_tum(timestamps: npt.NDArray[np.float64], wTc: npt.NDArray[np.float64]) -> str:
    """TUM text of poses ``(T, 4, 4)`` at ``timestamps`` ``(T,)``; poses holding NaN are left out.

    17 significant digits, so that reading gives back the same doubles; quaternions have ``qw >= 0``.
    """
    lines = [TUM_HEADER]
    present = np.isfinite(wTc).all(axis=(1, 2))
    if present.any():
        quaternions = Rotation.from_matrix(wTc[present, :3, :3]).as_quat(canonical=True)
        rows = np.column_stack([timestamps[present], wTc[present, :3, 3], quaternions])
        lines += [" ".join(f"{value:.17g}" for value in row) + "\n" for row in rows]
    return "".join(lines)


def read_tum(path: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Timestamps ``(N,)`` in seconds and poses wTc ``(N, 4, 4)`` of a TUM file.

    Raises ResultError when the file is missing or a line is not eight finite numbers with a quaternion.
    """
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise ResultError(f"{path}: cannot be read ({error})") from error
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            row = [float(word) for word in line.split()]
        except ValueError:
            row = []
        if len(row) != 8 or not np.isfinite(row).all() or np.linalg.norm(row[4:]) < 0.5:
            raise ResultError(
                f"{path}: line {number} is not 'timestamp tx ty tz qx qy qz qw'; reconstruct again"
            )
        rows.append(row)
    table = np.array(rows, dtype=np.float64).reshape(-1, 8)
    wTc = np.tile(np.eye(4), (len(table), 1, 1))
    if len(table):
        wTc[:, :3, :3] = Rotation.from_quat(table[:, 4:]).as_matrix()
        wTc[:, :3, 3] = table[:, 1:4]
    return table[:, 0], wTc
