"""Variable keys of the graph: pose ``X`` and log depth scale ``S`` of a (camera, time) frame, mount ``M``,
intrinsics ``F`` of a camera.

A key packs ``character (8 bits) | camera (16 bits) | time (40 bits)`` into one integer, so sorting keys sorts
by kind, camera and time. ``gtsam.DefaultKeyFormatter`` prints the character and one number; use ``key_name``.
``X`` holds a ``gtsam.Pose3`` (wTc), ``S`` a plain double (``values.insert(S(c, t), 0.0)``, ``atDouble``),
``M`` the ``gtsam.Pose3`` aTb of two cameras a and b mounted on one another, b in place of the time,
``F`` a ``gtsam.Cal3_S2``.
"""

from __future__ import annotations

_TIME_BITS = 40
_CAMERA_BITS = 16
_TIME_LIMIT = 1 << _TIME_BITS
_CAMERA_LIMIT = 1 << _CAMERA_BITS


def _pack(character: str, camera: int, time: int) -> int:
    if not 0 <= camera < _CAMERA_LIMIT:
        raise ValueError(f"camera index {camera} is outside 0..{_CAMERA_LIMIT - 1}")
    if not 0 <= time < _TIME_LIMIT:
        raise ValueError(f"time index {time} is outside 0..{_TIME_LIMIT - 1}")
    return (ord(character) << (_TIME_BITS + _CAMERA_BITS)) | (int(camera) << _TIME_BITS) | int(time)


def X(camera: int, time: int) -> int:  # noqa: N802 - the field's name for a pose key
    """Key of the pose ``wTc`` of a camera at a time index."""
    return _pack("x", camera, time)


def S(camera: int, time: int) -> int:  # noqa: N802 - the field's name for a scale key
    """Key of the log depth scale of a camera at a time index."""
    return _pack("s", camera, time)


def M(camera_a: int, camera_b: int) -> int:  # noqa: N802 - in line with the others
    """Key of the relative pose ``aTb`` of two cameras mounted on one another."""
    return _pack("m", camera_a, camera_b)


def F(camera: int) -> int:  # noqa: N802 - in line with the others
    """Key of the intrinsics of a camera, its focal length above all, the same at all times."""
    return _pack("f", camera, 0)


def camera_and_time(key: int) -> tuple[int, int]:
    """The ``(camera, time)`` that ``X`` or ``S`` packed into ``key``."""
    return (key >> _TIME_BITS) & (_CAMERA_LIMIT - 1), key & (_TIME_LIMIT - 1)


def key_kind(key: int) -> str:
    """``"x"`` for a pose key, ``"s"`` for a log depth scale key."""
    return chr(key >> (_TIME_BITS + _CAMERA_BITS))


def key_name(key: int) -> str:
    """Readable name such as ``x(cam 1, t 25)``."""
    camera, time = camera_and_time(key)
    return f"{key_kind(key)}(cam {camera}, t {time})"
