"""What has to be known of a depth network besides its file: how images go in, and what comes out."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.onnx_model import Signature, Tensor

Interpolation = Literal["nearest", "linear", "cubic", "area"]

FLOATS = ("tensor(float)", "tensor(float16)")
INTEGERS = ("tensor(int64)", "tensor(int32)")


@dataclass(frozen=True)
class SizeRule:
    """To which size images are brought where the model leaves it open: one of the first three, or none.

    Where the model fixes its size, that holds, and ``fixed`` says how images of another shape get into it.
    """

    short_side: int | None = None
    """px"""
    long_side: int | None = None
    """px"""
    pixels: tuple[int, int] | None = None
    """Least and most pixels; images in between keep their size."""
    multiple: int = 1
    """Both sides are multiples of it, 14 for networks on DINOv2."""
    fixed: Literal["pad", "stretch"] = "pad"
    """``pad``: as large as fits, in the middle, with ``ImageInput.padding`` around."""

    def __post_init__(self) -> None:
        given = [side for side in (self.short_side, self.long_side, self.pixels) if side is not None]
        _require(len(given) <= 1, "image.size has more than one of short_side, long_side and pixels")
        _require(self.multiple >= 1, f"image.size.multiple is {self.multiple}; at least 1")
        sides = [side for side in (self.short_side, self.long_side, *(self.pixels or ())) if side is not None]
        _require(all(side >= 1 for side in sides), "image.size must be positive")
        _require(
            self.pixels is None or self.pixels[0] <= self.pixels[1],
            "image.size.pixels is not least, most",
        )


@dataclass(frozen=True)
class ImageInput:
    """The input that takes the image, and what is done to it before."""

    name: str = "image"
    rank: int = 4
    """4: ``(1, 3, H, W)``; 5: ``(1, 1, 3, H, W)``, a network for several views that is given one."""
    size: SizeRule = field(default_factory=SizeRule)
    enlarge: Interpolation = "cubic"
    reduce: Interpolation = "area"
    channels: Literal["RGB", "BGR"] = "RGB"
    maximum: float = 1.0
    """White before ``mean`` and ``std``: 1 or 255."""
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Subtracted, in the order of ``channels``."""
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Divided by after that."""
    padding: tuple[float, float, float] = (0.485, 0.456, 0.406)
    """Colour around padded images, of 1, in the order of ``channels``: the mean of ImageNet, which is zero
    once normalised, as UniDepth pads (https://github.com/lpiccinelli-eth/UniDepth, ``unidepthv2.py``)."""

    def __post_init__(self) -> None:
        _require(self.rank in (4, 5), f"image.rank is {self.rank}; it must be 4 or 5")
        _require(self.maximum > 0.0, f"image.maximum is {self.maximum}; it must be above 0")
        _require(all(one > 0.0 for one in self.std), f"image.std is {list(self.std)}; all above 0")

    @property
    def shape(self) -> str:
        """For messages."""
        return "(1, 3, H, W)" if self.rank == 4 else "(1, 1, 3, H, W)"


@dataclass(frozen=True)
class DepthOutput:
    """The output that tells depth, and what it is."""

    name: str = ""
    value: Literal["depth", "inverse depth", "distance", "points"] = "depth"
    """``depth`` along the optical axis, one over it, ``distance`` along the ray, or ``points`` in the
    camera's axes, x right, y down, z forward, of which z is taken. Other than points: ``(1, H, W)`` with any
    ones."""
    points_axis: Literal["first", "last"] = "last"
    """Where x, y, z of ``points`` are: ``(1, 3, H, W)`` or ``(1, H, W, 3)``."""
    scale: Literal["metric", "scale", "affine"] = "metric"
    """``metric``: one unit for all frames, whatever it is. ``scale``: a unit of its own in each frame, and
    ``affine``: an offset, too; a depth prior cannot be made of these."""
    unknown_shift: bool = False
    """z of ``points`` lacks an offset that differs from frame to frame; the intrinsics tell it."""
    factor: str | None = None
    """Output of one number, by which depth is multiplied."""
    canonical_focal: float | None = None
    """px; depth is that of a camera with this focal length, and grows with the focal length of the image that
    goes in, the mean of both axes."""

    def __post_init__(self) -> None:
        _require(bool(self.name), "depth.name is missing: the output that tells depth")
        _require(self.value == "points" or not self.unknown_shift, "depth.unknown_shift needs value: points")
        _require(
            self.canonical_focal is None or self.canonical_focal > 0.0, "depth.canonical_focal is not above 0"
        )


@dataclass(frozen=True)
class Validity:
    """Outputs that say where depth is to be believed; each ``(1, H, W)`` with any ones."""

    mask: str | None = None
    """Depth is known where it is above ``mask_above``."""
    mask_above: float = 0.5
    sky: str | None = None
    """Depth is unknown where it is not below ``sky_from``."""
    sky_from: float = 0.3
    confidence: str | None = None
    """In [0, 1]."""
    better: Literal["higher", "lower"] = "higher"
    """``lower``: it is an uncertainty, and the confidence is 1 less it."""

    @property
    def names(self) -> tuple[str, ...]:
        """Those there are."""
        return tuple(name for name in (self.mask, self.sky, self.confidence) if name is not None)


@dataclass(frozen=True)
class DepthAdapter:
    """A network: what goes in, what comes out, and how to tell it by its signature."""

    depth: DepthOutput = field(default_factory=lambda: DepthOutput("depth"))
    image: ImageInput = field(default_factory=ImageInput)
    validity: Validity = field(default_factory=Validity)
    rays: str | None = None
    """Input ``(1, 3, H, W)`` of the unit rays of its pixels, in the camera's axes."""
    num_tokens: str | None = None
    """Input of one whole number, how many patches the network sees."""
    tokens: int = 1800
    """Its value."""
    ignored: tuple[str, ...] = ()
    """Outputs that may be there, too."""
    name: str = "model.yaml"
    """What it is called on the command line and in the manifest."""
    instead: str = ""
    """What to use in place of a network that cannot be a depth prior."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """Those that are asked for."""
        factor = () if self.depth.factor is None else (self.depth.factor,)
        return (self.depth.name, *self.validity.names, *factor)

    @property
    def is_usable(self) -> bool:
        """Whether one scale and offset can bring all its frames to the reconstruction's unit."""
        return self.depth.scale == "metric"

    def fits(self, signature: Signature) -> bool:
        """Whether a model of ``signature`` can be this network."""
        inputs = {tensor.name: tensor for tensor in signature.inputs}
        outputs = {tensor.name for tensor in signature.outputs}
        wanted = {self.image.name, *(name for name in (self.rays, self.num_tokens) if name is not None)}
        return (
            set(inputs) == wanted
            and set(self.outputs) <= outputs <= {*self.outputs, *self.ignored}
            and _takes_image(inputs[self.image.name], self.image.rank)
            and (self.rays is None or _takes_image(inputs[self.rays], 4))
            and (self.num_tokens is None or _takes_number(inputs[self.num_tokens]))
        )

    def __str__(self) -> str:
        inputs = [f"{self.image.name} float ({self.image.shape.strip('()')})"]
        inputs += [f"{self.rays} float (1, 3, H, W)"] if self.rays is not None else []
        inputs += [f"{self.num_tokens} int64 (one number)"] if self.num_tokens is not None else []
        return f"takes {', '.join(inputs)} and gives {', '.join(self.outputs)}"


def fixed_size(tensor: Tensor) -> tuple[int, int] | None:
    """``(width, height)`` where the model fixes those of its image."""
    height, width = tensor.shape[-2:]
    return (width, height) if isinstance(width, int) and isinstance(height, int) else None


def _takes_image(tensor: Tensor, rank: int) -> bool:
    if tensor.type not in FLOATS or len(tensor.shape) != rank:
        return False
    *ones, channels, height, width = tensor.shape
    return (
        all(one == 1 or not isinstance(one, int) for one in ones)
        and (channels == 3 or not isinstance(channels, int))
        and isinstance(height, int) == isinstance(width, int)
    )


def _takes_number(tensor: Tensor) -> bool:
    # exports differ: a scalar, or one number in a list
    return tensor.type in INTEGERS and tensor.shape in ((), (1,))


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ConfigError(message)
