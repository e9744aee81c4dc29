"""Description of a network: names and meaning of its tensors.

A description is a YAML file with the fields of :class:`Description`. Shipped descriptions are in
``descriptions/``; the file name is the name of the description.
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
    """Network input of one size; the fixed size of a model file has priority."""

    mode: Literal["fixed"]
    width: int = Field(gt=0)
    height: int = Field(gt=0)
    fit: Literal["stretch", "pad"] = "stretch"
    """``stretch`` changes the aspect ratio; ``pad`` keeps it and centers the image."""
    rounding: Literal["nearest", "down"] = "nearest"
    """Rounding of the sides of an image that keeps its aspect ratio."""


class SideSize(Options):
    """Network input with the aspect ratio of the image."""

    mode: Literal["longest", "shortest"]
    side: int = Field(gt=0)
    """Length in pixels of the longer or the shorter side."""
    multiple_of: int = Field(1, gt=0)
    """Both sides of the network input are multiples of this."""
    fit: Literal["stretch", "pad", "crop"] = "stretch"
    """``stretch`` to the nearest multiples, ``pad`` to the next ones, or ``crop`` to the previous
    ones; cropped borders of the view have no prediction.
    """
    enlarge: bool = True
    """Enlarge small images."""


class IntrinsicsInput(Options):
    """Tensor of the calibration matrix (1, 3, 3) of the image on the network input."""

    name: str
    first_pixel: float = Field(0.5, ge=0, le=0.5)
    """Coordinate of the center of the first pixel in the convention of the network."""


class ImageInput(Options):
    """Image tensor: ``(value * scale - mean) / std`` of values in 0..255.

    The result is rounded for integer types.
    """

    name: str | None = None
    """Name of the tensor; null: the first input of the model."""
    layout: Layout = "NCHW"
    channels: Literal["RGB", "BGR"] = "RGB"
    scale: float = 1.0
    mean: Triple = (0.0, 0.0, 0.0)
    std: Triple = (1.0, 1.0, 1.0)
    """Mean and std in the order of ``channels``."""
    pad_value: Triple = (0.0, 0.0, 0.0)
    """RGB in 0..255, before normalization."""
    interpolation: Literal["linear", "area", "cubic", "smooth-cubic", "lanczos"] = "area"
    """``area`` averages when shrinking and is linear when enlarging. ``linear`` and ``cubic`` do
    not average, as in OpenCV. ``smooth-cubic`` and ``lanczos`` average when shrinking, as in
    Pillow, and are cubic when enlarging.
    """
    size: Annotated[FixedSize | SideSize, Field(discriminator="mode")]
    intrinsics: IntrinsicsInput | None = None
    """Tensor of the intrinsics, for networks that use them."""
    rays: str | None = None
    """Tensor of the unit rays (1, 3, h, w) through the pixel centers of the input."""
    constants: dict[str, float] = Field(default_factory=dict)
    """Further inputs with a constant value."""


class DepthOutput(Options):
    """Depth tensor; its quantity is ``v = value * scale + shift``."""

    name: str
    output: Literal["depth", "disparity", "log-depth", "ray-length", "points"] = "depth"
    """``depth``, ``disparity``, ``log-depth``: depth is ``v``, ``1 / v`` or ``exp(v)``.
    ``ray-length``: ``v`` is the distance to the camera. ``points``: channels x, y, z with an
    unknown shift of z, which is estimated from the known camera. Pixels with ``v <= 0`` are
    invalid, except for log-depth.
    """
    channel: int = Field(0, ge=0)
    """Channel of the tensor, except for ``points``."""
    scale: float = 1.0
    shift: float = 0.0
    """Scale and shift convert the unit of the network to meters (or 1/m), or an affine disparity to
    a positive one.
    """
    metric: bool
    """True if depth is in meters, after the correction by ``canonical_focal``."""
    canonical_focal: float | None = Field(None, gt=0)
    """Focal length in input pixels for which the network predicts meters: depth is multiplied by
    ``focal / canonical_focal``, with the focal length of the resized image.
    """
    assumed_focal: str | None = None
    """Tensor with the horizontal focal length in input pixels that the network estimated: depth is
    multiplied by ``focal / assumed_focal``.
    """
    multiplier: str | None = None
    """Tensor with a factor that converts depth to meters."""
    valid_min: float = Field(0.0, ge=0)
    valid_max: float | None = Field(None, gt=0)
    """Valid range of depth before the canonical correction."""


class ConfidenceOutput(Options):
    """Tensor of the depth uncertainty."""

    name: str
    output: Literal["confidence", "std", "variance", "exp-std"]
    """``confidence`` c in [0, 1]: std = depth * (1 - c) (Metric3D). ``std``, ``variance`` and
    ``exp-std`` (log of the std): in the unit of the depth tensor, before the canonical correction.
    """


class MaskOutput(Options):
    """Tensor of the validity of depth and normals."""

    name: str
    minimum: float = 0.5
    """Threshold above which a pixel is valid."""


class NormalsOutput(Options):
    """Tensor of the normals; its first three channels are x, y, z."""

    name: str
    axes: tuple[Sign, Sign, Sign] = (1, 1, 1)
    """Signs that convert the axes of the network to x right, y down, z forward."""


class KappaOutput(Options):
    """Tensor of the angular uncertainty of normals."""

    name: str
    output: Literal["kappa", "angle"] = "kappa"
    """``kappa``: concentration as in DSINE and Metric3D. ``angle``: std about each axis in rad."""
    channel: int = Field(0, ge=0)
    """Channel of the tensor; 3 if it is the fourth channel of the normals."""


class Outputs(Options):
    """Outputs of the network: depth, normals, or both."""

    layout: Layout = "NCHW"
    depth: DepthOutput | None = None
    confidence: ConfidenceOutput | None = None
    normals: NormalsOutput | None = None
    kappa: KappaOutput | None = None
    mask: MaskOutput | None = None

    def names(self) -> set[str]:
        """Return the names of the tensors that a model must have."""
        described = [self.depth, self.normals, self.kappa, self.mask, self.confidence]
        return {tensor.name for tensor in described if tensor} | self.numbers()

    def numbers(self) -> set[str]:
        """Return the names of the tensors with a single number."""
        names = (self.depth.assumed_focal, self.depth.multiplier) if self.depth else ()
        return {name for name in names if name}

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
    """Download address of the model."""

    uri: str
    sha256: str | None = None
    size: int | None = None
    """Size in bytes, if known."""
    companions: tuple[str, ...] = ()
    """Further URIs of the same folder, for models with external data."""


class Description(Options):
    """Description of a network in an ONNX file."""

    name: str
    summary: str = ""
    license: str = "unknown"
    """License of the weights."""
    weights: Weights | None = None
    """Public file; null: the user names a local file."""
    input: ImageInput
    outputs: Outputs
    calibration: DepthCalibration = DepthCalibration()
    normals_calibration: NormalCalibration = NormalCalibration()

    def files(self, model: str | None = None, sha256: str | None = None) -> tuple[WeightsFile, ...]:
        """Return the files to load, the model last.

        Args:
            model: Path or URI of the user's file, or None for the public one.
            sha256: Expected hash of ``model``.

        Raises:
            WeightsError: There is no public file.
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
    """Return the names of the shipped descriptions."""
    return sorted(path.stem for path in _FOLDER.glob("*.yaml"))


def load_description(name: str) -> Description:
    """Load a shipped description by name, or one from a YAML file.

    Raises:
        ConfigError: The name is unknown, or the file is invalid; the message names file and key.
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
