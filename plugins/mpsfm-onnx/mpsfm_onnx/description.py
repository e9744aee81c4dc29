"""The description of a network: what its tensors are called and what they mean.

A description is a YAML file with the fields of :class:`Description`. The shipped ones lie in
``descriptions/``; their names are the files' names.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from mpsfm_core import Options, WeightsFile
from mpsfm_core.data.errors import ConfigError, WeightsError, did_you_mean
from mpsfm_core.data.options import parse_settings
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, NormalCalibration
from mpsfm_core.support.yaml_text import parse_yaml

_FOLDER = Path(__file__).parent / "descriptions"

Layout = Literal["NCHW", "NHWC"]
Triple = tuple[float, float, float]
Sign = Literal[-1, 1]


class FixedSize(Options):
    """A canvas of one size. A model whose file fixes another one has that."""

    mode: Literal["fixed"]
    width: int = Field(gt=0)
    height: int = Field(gt=0)
    fit: Literal["stretch", "pad"] = "stretch"
    """``stretch`` changes the aspect ratio; ``pad`` keeps it and puts the image in the middle."""
    rounding: Literal["nearest", "down"] = "nearest"
    """Of the sides of an image that keeps its aspect ratio."""


class SideSize(Options):
    """A canvas that follows the image's shape."""

    mode: Literal["longest", "shortest"]
    side: int = Field(gt=0)
    """Length in pixels of the longer or the shorter side."""
    multiple_of: int = Field(1, gt=0)
    """Both sides of the canvas are multiples of it."""
    fit: Literal["stretch", "pad", "crop"] = "stretch"
    """To the nearest multiples by stretching, to the next ones by padding, or to the ones before
    by cutting the border off, where the view then gets no prediction."""
    enlarge: bool = True
    """Whether small images are enlarged."""


class IntrinsicsInput(Options):
    """The tensor of the calibration matrix (1, 3, 3) of the image as it lies on the input."""

    name: str
    first_pixel: float = Field(0.5, ge=0, le=0.5)
    """Where the network has the centre of the first pixel."""


class ImageInput(Options):
    """The tensor of the image: ``(value * scale - mean) / std`` of values in 0..255, rounded
    where the model wants integers."""

    name: str | None = None
    """None: the model's first input."""
    layout: Layout = "NCHW"
    channels: Literal["RGB", "BGR"] = "RGB"
    scale: float = 1.0
    mean: Triple = (0.0, 0.0, 0.0)
    std: Triple = (1.0, 1.0, 1.0)
    """Both in the order of ``channels``."""
    pad_value: Triple = (0.0, 0.0, 0.0)
    """RGB in 0..255, before normalisation."""
    interpolation: Literal["linear", "area", "cubic", "smooth-cubic", "lanczos"] = "area"
    """``area`` averages when shrinking and is linear when enlarging. ``linear`` and ``cubic`` take
    the nearest pixels alone, as OpenCV does; ``smooth-cubic`` and ``lanczos`` average when
    shrinking, as Pillow does, and are cubic when enlarging."""
    size: Annotated[FixedSize | SideSize, Field(discriminator="mode")]
    intrinsics: IntrinsicsInput | None = None
    """For networks that are told the camera."""
    rays: str | None = None
    """For those that are told it by the tensor of unit rays (1, 3, h, w) through the centres of
    the input's pixels."""
    constants: dict[str, float] = Field(default_factory=dict)
    """Further inputs that always have one value."""


class DepthOutput(Options):
    """The tensor that depth comes from; ``v = value * scale + shift`` is its quantity."""

    name: str
    output: Literal["depth", "disparity", "log-depth", "ray-length", "points"] = "depth"
    """``depth``, ``disparity``, ``log-depth``: depth is ``v``, ``1 / v`` or ``exp(v)``.
    ``ray-length``: ``v`` is the distance to the camera. ``points``: three channels x, y, z whose z
    lacks a shift, which the known camera tells. Pixels where ``v <= 0`` are invalid, except for
    log-depth."""
    channel: int = Field(0, ge=0)
    """Of the tensor, for all but ``points``."""
    scale: float = 1.0
    shift: float = 0.0
    """Turn the network's unit into metres (or 1/m), or an affine disparity into a positive one."""
    metric: bool
    """Whether depth then is in metres (with ``canonical_focal``: after that correction)."""
    canonical_focal: float | None = Field(None, gt=0)
    """Focal length in input pixels for which the network predicts metres: its depth is multiplied
    by ``focal / canonical_focal``, with the focal length of the resized image."""
    assumed_focal: str | None = None
    """The tensor with the horizontal focal length in input pixels that the network guessed: its
    depth is multiplied by ``focal / assumed_focal``."""
    multiplier: str | None = None
    """The tensor with a number that turns depth into metres."""
    valid_min: float = Field(0.0, ge=0)
    valid_max: float | None = Field(None, gt=0)
    """Range of depth in which the network is right, before the canonical correction."""


class ConfidenceOutput(Options):
    """The tensor that the network's own uncertainty of depth comes from."""

    name: str
    output: Literal["confidence", "std", "variance", "exp-std"]
    """``confidence`` c in [0, 1]: std = depth * (1 - c) (Metric3D). ``std``, ``variance`` and
    ``exp-std``, whose logarithm is the std: in the unit of the depth tensor, before the canonical
    correction."""


class MaskOutput(Options):
    """The tensor that says where depth and normals are valid."""

    name: str
    minimum: float = 0.5
    """Valid above it."""


class NormalsOutput(Options):
    """The tensor of the surface normals; its first three channels are x, y, z."""

    name: str
    axes: tuple[Sign, Sign, Sign] = (1, 1, 1)
    """Signs that turn the network's axes into x right, y down, z forward."""


class KappaOutput(Options):
    """The tensor that the normals' angular variance comes from."""

    name: str
    output: Literal["kappa", "angle"] = "kappa"
    """``kappa``: the concentration of DSINE and Metric3D. ``angle``: std about each axis, rad."""
    channel: int = Field(0, ge=0)
    """3 if it is the fourth channel of the normals."""


class Outputs(Options):
    """What the network predicts: depth, normals, or both."""

    layout: Layout = "NCHW"
    depth: DepthOutput | None = None
    confidence: ConfidenceOutput | None = None
    normals: NormalsOutput | None = None
    kappa: KappaOutput | None = None
    mask: MaskOutput | None = None

    def names(self) -> set[str]:
        """Tensors that a model must have."""
        described = [self.depth, self.normals, self.kappa, self.mask, self.confidence]
        return {tensor.name for tensor in described if tensor} | self.numbers()

    def numbers(self) -> set[str]:
        """Tensors that are one number and no map."""
        found = (self.depth.assumed_focal, self.depth.multiplier) if self.depth else ()
        return {name for name in found if name}

    @model_validator(mode="after")
    def _complete(self) -> Outputs:
        if self.depth is None and self.normals is None:
            raise ValueError("a network must predict depth or normals")
        if self.confidence is not None and self.depth is None:
            raise ValueError("confidence belongs to depth, which is not described")
        if self.kappa is not None and self.normals is None:
            raise ValueError("kappa belongs to normals, which are not described")
        return self


class Weights(Options):
    """Where the model can be downloaded."""

    uri: str
    sha256: str | None = None
    size: int | None = None
    """In bytes, where it is known."""
    companions: tuple[str, ...] = ()
    """Further URIs of the same folder, for models with external data."""


class Description(Options):
    """A network in an ONNX file."""

    name: str
    summary: str = ""
    license: str = "unknown"
    """Of the weights."""
    weights: Weights | None = None
    """None: there is no public file; the user names a local one."""
    input: ImageInput
    outputs: Outputs
    calibration: DepthCalibration = DepthCalibration()
    normals_calibration: NormalCalibration = NormalCalibration()

    def files(self, model: str | None = None, sha256: str | None = None) -> tuple[WeightsFile, ...]:
        """The files to load, the model last: ``model`` with its hash, else the public ones.

        Raises:
            WeightsError: there is no public file.
        """
        if model is not None:
            return (WeightsFile(model, sha256, self.license),)
        public = self.weights
        if public is None:
            raise WeightsError(
                f"the description {self.name!r} has no public weights file: "
                f"name yours with --set depth.options.model=FILE"
            )
        companions = (WeightsFile(uri, license=self.license) for uri in public.companions)
        return (*companions, WeightsFile(public.uri, public.sha256, self.license, public.size))


def shipped_descriptions() -> list[str]:
    """Names of the descriptions that come with this package."""
    return sorted(path.stem for path in _FOLDER.glob("*.yaml"))


def load_description(name: str) -> Description:
    """A shipped description by name, or one from a YAML file.

    Raises:
        ConfigError: there is none of that name, or the file breaks a rule; the message gives
            file and key.
    """
    path = Path(name).expanduser()
    if path.suffix not in (".yaml", ".yml"):
        path = _FOLDER / f"{name}.yaml"
        if name not in shipped_descriptions():
            known = shipped_descriptions()
            raise ConfigError(
                f"no description {name!r}{did_you_mean(name, known)}; there are "
                f"{', '.join(known)}, or give a YAML file"
            )
    elif not path.is_file():
        raise ConfigError(f"description file {path} does not exist")
    values = parse_yaml(path.read_text(encoding="utf-8"), str(path))
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: expected the fields of a description")
    try:
        return parse_settings(Description, values)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
