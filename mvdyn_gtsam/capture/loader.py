"""The two plain forms of a capture: a folder with capture.json, and videos with intrinsics."""

from __future__ import annotations

import difflib
import json
import logging
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mvdyn_gtsam.capture.assemble import CAMERA_NAME, Source, assemble_capture, open_media
from mvdyn_gtsam.capture.focal import camera_with_unknown_focal, first_intrinsics
from mvdyn_gtsam.capture.model import Camera, Capture
from mvdyn_gtsam.errors import CaptureError

CAPTURE_FILE = "capture.json"

_CAMERA_KEYS = ("name", "source", "width", "height", "fx", "fy", "cx", "cy")
_OPTIONAL_CAMERA_KEYS = ("distortion", "time_offset", "estimate_focal")
_KIND_NAMES = {"str": "a text", "list": "a list", "bool": "true or false"}

logger = logging.getLogger(__name__)


def load_capture(source: Path, *, truncate: bool = False) -> Capture:
    """Load a folder with ``capture.json`` (or that file): streams opened and checked, nothing kept decoded.

    A camera whose ``estimate_focal`` is true has a focal length yet to be found: ``fx`` is its first guess
    where given, ``cx, cy`` are the centre of the image where not given.
    Keys that only inform ("about", "depth_scale") are accepted; ``num_frames`` is checked where given.
    ``truncate`` accepts cameras of different length, and truncated videos, by cutting all to the shortest.
    Raises CaptureError, naming the file and the fix, on anything missing, undecodable or inconsistent.
    """
    source = Path(source)
    path = source / CAPTURE_FILE if source.is_dir() else source
    content = _read_json(path)
    where = str(path)
    entries = _get(content, "cameras", list, where)
    fps = _number(content, "fps", where)
    num_frames = _integer(content, "num_frames", where) if "num_frames" in content else None
    name = _get(content, "name", str, where) if "name" in content else path.resolve().parent.name
    cameras = [_camera(entry, f"{where}: cameras[{index}]") for index, entry in enumerate(entries)]
    sources = [
        Source(camera, open_media(entry["source"], path.parent, truncate))
        for camera, entry in zip(cameras, entries, strict=True)
    ]
    capture = assemble_capture(
        name or path.parent.name, fps, sources, truncate=truncate, num_frames=num_frames
    )
    return replace(capture, source=source.absolute())


def capture_from_cameras(
    videos: Sequence[str | Path],
    intrinsics: Sequence[Sequence[float] | None] | None = None,
    *,
    fps: float | None = None,
    distortion: Sequence[Sequence[float]] | None = None,
    time_offsets: Sequence[float] | None = None,
    name: str = "capture",
    truncate: bool = False,
) -> Capture:
    """Capture from one video, or glob of images, per camera and its ``(fx, fy, cx, cy)`` in px.

    None in place of those four numbers, or of all intrinsics, is a focal length yet to be found, of a camera
    without distortion whose principal point is the centre of the image.
    Cameras are named after their files (``cam0.mp4``: cam0; ``left/*.png``: left), or cam0, cam1, ... where
    those would clash or be no file names. ``fps`` comes from the videos unless given; images need it.
    ``distortion`` (OpenCV order) and ``time_offsets`` (s) are per camera.
    Raises CaptureError as ``load_capture`` does.
    """
    if not videos:
        raise CaptureError("no cameras given; name at least one video or image pattern with --camera")
    per_camera = {"intrinsics": intrinsics, "distortion": distortion, "time offsets": time_offsets}
    for what, values in per_camera.items():
        if values is not None and len(values) != len(videos):
            hint = ", or none with --estimate-focal (intrinsics=None) to have the focal lengths found"
            raise CaptureError(
                f"{len(videos)} cameras but {len(values)} {what}; give one per camera, in order"
                f"{hint if what == 'intrinsics' else ''}"
            )
    sources = []
    for index, (video, camera_name) in enumerate(zip(videos, _camera_names(videos), strict=True)):
        values = None if intrinsics is None else intrinsics[index]
        if values is not None and len(values) != 4:
            raise CaptureError(f"{video}: intrinsics must be fx,fy,cx,cy: 4 numbers, not {len(values)}")
        media = open_media(str(video), Path("."), truncate)
        size = media.width, media.height
        fx, fy, cx, cy = first_intrinsics(*size) if values is None else (float(value) for value in values)
        camera = Camera(
            camera_name,
            *size,
            fx,
            fy,
            cx,
            cy,
            distortion=tuple(float(value) for value in distortion[index]) if distortion else (),
            time_offset=float(time_offsets[index]) if time_offsets else 0.0,
        )
        sources.append(Source(camera_with_unknown_focal(camera) if values is None else camera, media))
    if fps is None:
        rates = [source.media.fps for source in sources if source.media.fps is not None]
        if not rates:
            raise CaptureError(f"{videos[0]}: images do not say their rate; give it with --fps")
        fps = min(rates)
    return assemble_capture(name, fps, sources, truncate=truncate)


def _camera_names(videos: Sequence[str | Path]) -> list[str]:
    paths = [Path(video) for video in videos]
    names = [
        path.parent.name if any(letter in path.name for letter in "*?[") else path.stem for path in paths
    ]
    distinct = len({name.lower() for name in names}) == len(names)
    if distinct and all(CAMERA_NAME.fullmatch(name) for name in names):
        return names
    return [f"cam{index}" for index in range(len(videos))]


def _read_json(path: Path) -> Mapping[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise CaptureError(
            f"{path}: there is no such file; give a folder that holds {CAPTURE_FILE}"
        ) from None
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror}); check its permissions") from None
    except UnicodeDecodeError:
        raise CaptureError(f"{path}: is not UTF-8 text; save it as UTF-8 JSON") from None
    except json.JSONDecodeError as error:
        raise CaptureError(
            f"{path}: not valid JSON at line {error.lineno}, column {error.colno}: {error.msg}"
        ) from None
    if not isinstance(content, dict):
        raise CaptureError(f'{path}: must hold an object {{"name": ..., "fps": ..., "cameras": [...]}}')
    return content


def _camera(entry: object, where: str) -> Camera:
    if not isinstance(entry, dict):
        raise CaptureError(f"{where}: must be an object with the keys {', '.join(_CAMERA_KEYS)}")
    for key in entry:
        if key in _CAMERA_KEYS or key in _OPTIONAL_CAMERA_KEYS:
            continue
        # A misspelt optional key would change the result without a word.
        close = difflib.get_close_matches(key, _OPTIONAL_CAMERA_KEYS, n=1)
        if close:
            raise CaptureError(f"{where}: unknown key {key!r}; did you mean {close[0]!r}?")
        logger.warning("%s: unknown key %r is ignored", where, key)
    _get(entry, "source", str, where)
    distortion = _get(entry, "distortion", list, where) if entry.get("distortion") is not None else []
    estimate_focal = "estimate_focal" in entry and _get(entry, "estimate_focal", bool, where)
    width, height = _integer(entry, "width", where), _integer(entry, "height", where)
    if estimate_focal:
        fx, fy, cx, cy = _first_intrinsics(entry, width, height, where)
    else:
        fx, fy, cx, cy = _intrinsics(entry, where)
    camera = Camera(
        _get(entry, "name", str, where),
        width,
        height,
        fx,
        fy,
        cx,
        cy,
        distortion=tuple(_as_number(value, "distortion", where) for value in distortion),
        time_offset=_number(entry, "time_offset", where) if "time_offset" in entry else 0.0,
    )
    return camera_with_unknown_focal(camera, where) if estimate_focal else camera


def _intrinsics(entry: Mapping[str, Any], where: str) -> tuple[float, float, float, float]:
    for key in ("fx", "fy"):
        if key not in entry:
            raise CaptureError(
                f'{where}: the key "{key}" is missing; add it, or "estimate_focal": true to have the focal'
                " length found"
            )
    fx, fy, cx, cy = (_number(entry, key, where) for key in ("fx", "fy", "cx", "cy"))
    return fx, fy, cx, cy


def _first_intrinsics(
    entry: Mapping[str, Any], width: int, height: int, where: str
) -> tuple[float, float, float, float]:
    """Of a camera whose focal length is yet to be found; any of them may be left out."""
    fx, _, cx, cy = first_intrinsics(width, height)
    focals = [_number(entry, key, where) for key in ("fx", "fy") if key in entry]
    if len(set(focals)) > 1:
        raise CaptureError(
            f"{where}: fx and fy differ: {focals[0]:g} and {focals[1]:g}, but one focal length will be"
            " found, of square pixels; give fx alone as its first guess, or neither"
        )
    fx = focals[0] if focals else fx
    cx, cy = (_number(entry, k, where) if k in entry else v for k, v in (("cx", cx), ("cy", cy)))
    return fx, fx, cx, cy


def _get(content: Mapping[str, Any], key: str, kind: type, where: str) -> Any:
    if key not in content:
        raise CaptureError(f'{where}: the key "{key}" is missing; add it')
    if not isinstance(content[key], kind):
        raise CaptureError(
            f'{where}: "{key}" must be {_KIND_NAMES[kind.__name__]}, not {json.dumps(content[key])}'
        )
    return content[key]


def _number(content: Mapping[str, Any], key: str, where: str) -> float:
    if key not in content:
        raise CaptureError(f'{where}: the key "{key}" is missing; add it')
    return _as_number(content[key], key, where)


def _as_number(value: object, key: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
        raise CaptureError(f'{where}: "{key}" must be a finite number, not {json.dumps(value)}')
    return float(value)


def _integer(content: Mapping[str, Any], key: str, where: str) -> int:
    value = _number(content, key, where)
    if value != int(value) or value < 1:
        raise CaptureError(f'{where}: "{key}" must be a positive whole number, not {value:g}')
    return int(value)
