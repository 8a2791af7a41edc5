"""What a generated scene is made from: every number of it, checked."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, fields
from numbers import Real
from typing import TYPE_CHECKING

from mvdyn_gtsam.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

PLACES = ("room", "yard")
FORMATS = ("png", "mp4")

_RANGES: dict[str, tuple[float, float]] = {
    "cameras": (1, 64),
    "frames": (1, 100_000),
    "width": (16, 8192),
    "height": (16, 8192),
    "focal": (1.0, 100_000.0),
    "fps": (0.1, 1000.0),
    "overlap": (0.0, 1.0),
    "meet": (0.0, 1.5),
    "texture": (0.0, 1.0),
    "repeat": (0.0, 1.0),
    "motion": (0.0, 1.0),
    "camera_motion": (0.0, 3.0),
    "shake": (0.0, 10.0),
    "noise": (0.0, 0.5),
    "exposure": (0.0, 0.9),
    "every": (1, 100_000),
    "seed": (0, 2**31 - 1),
}


@dataclass(frozen=True)
class SceneSettings:
    """A generated scene; the same settings give the same bytes. Raises ConfigError on a bad value."""

    cameras: int = 2
    frames: int = 60
    width: int = 512
    """px"""
    height: int = 384
    """px"""
    focal: float | None = None
    """px; None: 0.8 of the width, a view of 64 degrees."""
    fps: float = 30.0
    overlap: float = 0.6
    """Share of a camera's view that its neighbour sees, too, at the same instant (0 to 1)."""
    meet: float = 1.2
    """Metres in front of the cameras where their axes cross: more gives wider baselines at one overlap."""
    texture: float = 0.7
    """0: plain surfaces; 1: rich."""
    repeat: float = 0.0
    """Share of the surfaces that wear a repeating wallpaper (0 to 1)."""
    motion: float = 0.5
    """How much of the image moves, and how fast: 0 nothing, 1 a crowd in a hurry."""
    camera_motion: float = 0.4
    """Speed of the hand-held cameras, about, m/s."""
    shake: float = 1.0
    """Of the hands: 1 is some 3 mm and 0.2 degrees at 2 to 5 Hz."""
    noise: float = 0.01
    """Standard deviation of the sensor's noise, of full scale."""
    exposure: float = 0.0
    """How far each camera's gain drifts (0.1: between 0.9 and 1.1)."""
    place: str = "room"
    """"room", or "yard" with a sky, which has no depth and no flow."""
    format: str = "png"
    """"png": lossless frames; "mp4": one MPEG-4 video per camera, as OpenCV writes it."""
    every: int = 1
    """Depth, masks and flow of every n-th frame."""
    seed: int = 0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in _RANGES and not (field.name == "focal" and value is None):
                number = _checked(field.name, value, "int" in str(field.type))
                object.__setattr__(self, field.name, number)
        for name, value, known in (("place", self.place, PLACES), ("format", self.format, FORMATS)):
            if value not in known:
                raise ConfigError(f"{name} {value!r}: must be one of {', '.join(known)}")
        if self.format == "mp4" and (self.width % 2 or self.height % 2):
            raise ConfigError(f"size {self.width}x{self.height}: a video needs an even width and height")

    @property
    def focal_length(self) -> float:
        """px, the same in x and y."""
        return 0.8 * self.width if self.focal is None else float(self.focal)

    @property
    def field_of_view(self) -> float:
        """Horizontal, radians."""
        return 2.0 * math.atan(self.width / (2.0 * self.focal_length))

    @property
    def intrinsics(self) -> npt.NDArray[np.float64]:
        """``(3, 3)``, the principal point in the middle of the image: ``(W-1)/2, (H-1)/2``."""
        import numpy as np  # here: the command line reads the defaults before anything heavy is needed

        f = self.focal_length
        return np.array([[f, 0.0, (self.width - 1) / 2], [0.0, f, (self.height - 1) / 2], [0.0, 0.0, 1.0]])

    def to_json(self) -> dict[str, object]:
        """As it is written to and compared with ``scene.json``."""
        content: dict[str, object] = json.loads(json.dumps(asdict(self)))
        return content


def _checked(name: str, value: object, whole: bool) -> int | float:
    low, high = _RANGES[name]
    number = float(value) if isinstance(value, Real) and not isinstance(value, bool) else math.nan
    if not low <= number <= high or (whole and number != int(number)):
        kind = "a whole number" if whole else "a number"
        raise ConfigError(f"{name} {value}: must be {kind} from {low:g} to {high:g}")
    return int(number) if whole else number
