"""Description of a network in an ONNX file by the names and meanings of its tensors.

A description is a YAML file with the fields of :class:`Description`. The descriptions that the
package contains are in the folder ``descriptions/``, and have the names of their files.
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
    """Fixed size of the network input in pixels, unless the ONNX file has another fixed size."""

    mode: Literal["fixed"]
    width: int = Field(gt=0)
    height: int = Field(gt=0)
    fit: Literal["stretch", "pad"] = "stretch"
    """``stretch`` changes the aspect ratio of the image. ``pad`` keeps the aspect ratio and centers
    the image."""
    rounding: Literal["nearest", "down"] = "nearest"
    """Rounding of the image size in pixels after resizing with ``fit: pad``."""


class SideSize(Options):
    """Size of a network input that has the aspect ratio of the image."""

    mode: Literal["longest", "shortest"]
    side: int = Field(gt=0)
    """Length in pixels of the longer or shorter side of the resized image, as ``mode`` selects."""
    multiple_of: int = Field(1, gt=0)
    """Both sides of the network input are multiples of this number of pixels."""
    fit: Literal["stretch", "pad", "crop"] = "stretch"
    """Adaptation of the image sides to ``multiple_of``. ``stretch`` resizes to the nearest
    multiples, ``pad`` pads to the next larger multiples, and ``crop`` crops to the next smaller
    multiples. Cropped image borders have no prediction.
    """
    enlarge: bool = True
    """Enlarge small images."""


class IntrinsicsInput(Options):
    """Input tensor with the calibration matrix K (1, 3, 3) in pixels of the network input."""

    name: str
    first_pixel: float = Field(0.5, ge=0, le=0.5)
    """Coordinate of the center of the first pixel in the network's convention (COLMAP: 0.5)."""


class ImageInput(Options):
    """Image tensor of the network, ``(value * scale - mean) / std`` for values in 0..255.

    The values are rounded if the tensor has an integer type.
    """

    name: str | None = None
    """Name of the image tensor. null selects the first input of the model."""
    layout: Layout = "NCHW"
    channels: Literal["RGB", "BGR"] = "RGB"
    scale: float = 1.0
    mean: Triple = (0.0, 0.0, 0.0)
    std: Triple = (1.0, 1.0, 1.0)
    """Mean and std of the image tensor, in the order of ``channels``."""
    pad_value: Triple = (0.0, 0.0, 0.0)
    """RGB color of padding in 0..255, before normalization."""
    interpolation: Literal["linear", "area", "cubic", "smooth-cubic", "lanczos"] = "area"
    """Filter for resizing the image. ``area`` averages when shrinking and is linear when enlarging.
    ``linear`` and ``cubic`` are OpenCV's filters, which do not average when shrinking.
    ``smooth-cubic`` and ``lanczos`` are Pillow's filters, which average when shrinking and are
    cubic when enlarging.
    """
    size: Annotated[FixedSize | SideSize, Field(discriminator="mode")]
    intrinsics: IntrinsicsInput | None = None
    """Input tensor of the intrinsics, for networks that have one."""
    rays: str | None = None
    """Name of the input tensor with unit rays (1, 3, h, w) through the pixel centers, if any."""
    constants: dict[str, float] = Field(default_factory=dict)
    """Names and values of further input tensors that are constant."""


class DepthOutput(Options):
    """Output tensor of depth, whose values are converted to ``v = value * scale + shift``."""

    name: str
    output: Literal["depth", "disparity", "log-depth", "ray-length", "points"] = "depth"
    """Meaning of v. If ``output`` is ``depth``, ``disparity`` or ``log-depth``, depth is ``v``, ``1
    / v`` or ``exp(v)`` for the scaled and shifted value v. If ``output`` is ``ray-length``, the
    tensor value is the distance to the camera center along the ray. If ``output`` is ``points``,
    the tensor has channels x, y, z with an unknown shift of z, which is estimated from the known
    intrinsics. Pixels whose value is not positive are invalid, except for ``log-depth``.
    """
    channel: int = Field(0, ge=0)
    """Channel index of depth in the depth tensor. The channel is ignored if ``output`` is
    ``points``."""
    scale: float = 1.0
    shift: float = 0.0
    """Scale and shift of the values in the depth tensor. Scale and shift convert the values to
    meters (or 1 / meters), or make an affine disparity positive.
    """
    metric: bool
    """True if depth is in meters after the correction by ``canonical_focal``."""
    canonical_focal: float | None = Field(None, gt=0)
    """Focal length in input pixels for which the network predicts meters. Depth is multiplied by
    the focal length of the resized image divided by ``canonical_focal``.
    """
    assumed_focal: str | None = None
    """Name of the output with the horizontal focal length, in input pixels, that the network
    assumed. Depth is multiplied by the ratio of the known to the assumed focal length.
    """
    multiplier: str | None = None
    """Name of the output with a factor that converts predicted depth to meters."""
    valid_min: float = Field(0.0, ge=0)
    valid_max: float | None = Field(None, gt=0)
    """Range of valid depth, before the correction by ``canonical_focal``."""


class ConfidenceOutput(Options):
    """Output tensor of the depth uncertainty."""

    name: str
    output: Literal["confidence", "std", "variance", "exp-std"]
    """Meaning of the values in the uncertainty tensor of depth. For ``confidence`` c in [0, 1], the
    std is ``depth * (1 - c)`` (Metric3D). ``std``, ``variance`` and ``exp-std`` (whose log is the
    std) are in the unit of the depth tensor, before the correction by ``canonical_focal``.
    """


class MaskOutput(Options):
    """Output tensor of the probability that depth and normals of a pixel are valid."""

    name: str
    minimum: float = 0.5
    """Probability above which depth and normals of a pixel are valid."""


class NormalsOutput(Options):
    """Output tensor of the normals. The first three channels of the normals tensor are x, y, z."""

    name: str
    axes: tuple[Sign, Sign, Sign] = (1, 1, 1)
    """Signs that convert the axes of predicted normals to x right, y down, z forward."""


class KappaOutput(Options):
    """Output tensor of the angular uncertainty of normals."""

    name: str
    output: Literal["kappa", "angle"] = "kappa"
    """Meaning of the values in the uncertainty tensor of normals. ``kappa`` is the concentration of
    the normal distribution on the sphere of DSINE and Metric3D. ``angle`` is the std about each
    axis in rad.
    """
    channel: int = Field(0, ge=0)
    """Channel index of the uncertainty in its tensor, 3 if x, y, z of the normals precede it."""


class Outputs(Options):
    """Output tensors of the network, which predicts depth, normals, or both."""

    layout: Layout = "NCHW"
    depth: DepthOutput | None = None
    confidence: ConfidenceOutput | None = None
    normals: NormalsOutput | None = None
    kappa: KappaOutput | None = None
    mask: MaskOutput | None = None

    def names(self) -> set[str]:
        """Return the names of all output tensors that the ONNX file must have."""
        described = [self.depth, self.normals, self.kappa, self.mask, self.confidence]
        return {tensor.name for tensor in described if tensor} | self.numbers()

    def numbers(self) -> set[str]:
        """Return the names of the output tensors that hold a single number."""
        names = (self.depth.assumed_focal, self.depth.multiplier) if self.depth else ()
        return {name for name in names if name}

    @model_validator(mode="after")
    def _complete(self) -> Outputs:
        if self.depth is None and self.normals is None:
            raise ValueError("a network description must have the output depth or normals")
        if self.confidence is not None and self.depth is None:
            raise ValueError("the output confidence requires the output depth, which is missing")
        if self.kappa is not None and self.normals is None:
            raise ValueError("the output kappa requires the output normals, which is missing")
        return self


class Weights(Options):
    """Download address of the ONNX file, with its hash and size."""

    uri: str
    sha256: str | None = None
    size: int | None = None
    """Size of the ONNX file in bytes, if known."""
    companions: tuple[str, ...] = ()
    """URIs of the external data files of the ONNX file, in the same folder."""


class Description(Options):
    """Description of a network in an ONNX file."""

    name: str
    summary: str = ""
    license: str = "unknown"
    """License of the network weights."""
    weights: Weights | None = None
    """Public ONNX file of the network. null means that the user must give a local file."""
    input: ImageInput
    outputs: Outputs
    calibration: DepthCalibration = DepthCalibration()
    normals_calibration: NormalCalibration = NormalCalibration()

    def files(self, model: str | None = None, sha256: str | None = None) -> tuple[WeightsFile, ...]:
        """Return the weights files to load, with the ONNX file at the end.

        Args:
            model: Path or URI of the user's file, or None for the public file.
            sha256: Expected SHA-256 hash of the file ``model``.

        Raises:
            WeightsError: The description has no public file, and ``model`` is None.
        """
        if model is not None:
            return (WeightsFile(model, sha256, self.license),)
        public = self.weights
        if public is None:
            raise WeightsError(
                f"the description {self.name!r} has no public weights file: "
                f"give an ONNX file with --set depth.options.model=FILE"
            )
        companions = (WeightsFile(uri, license=self.license) for uri in public.companions)
        return (*companions, WeightsFile(public.uri, public.sha256, self.license, public.size))


def shipped_descriptions() -> list[str]:
    """Return the names of the shipped network descriptions, sorted."""
    return sorted(path.stem for path in _FOLDER.glob("*.yaml"))


def load_description(name: str) -> Description:
    """Load a shipped network description by its name, or a description from a YAML file.

    Raises:
        ConfigError: The description name is unknown, or the YAML file is invalid. The error message
            names the file and the invalid key.
    """
    path = Path(name).expanduser()
    if path.suffix not in (".yaml", ".yml"):
        path = _FOLDER / f"{name}.yaml"
        if name not in shipped_descriptions():
            known = shipped_descriptions()
            raise ConfigError(
                f"no network description is named {name!r}{did_you_mean(name, known)}; there are "
                f"{', '.join(known)}, or give a YAML file"
            )
    elif not path.is_file():
        raise ConfigError(f"network description file {path} does not exist")
    values = parse_yaml(path.read_text(encoding="utf-8"), str(path))
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: expected the fields of a network description")
    try:
        return parse_settings(Description, values)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
