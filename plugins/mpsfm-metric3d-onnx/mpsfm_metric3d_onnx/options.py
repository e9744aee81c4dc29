"""Weights, options and calibration of each Metric3D size, importable without onnxruntime."""

from __future__ import annotations

from dataclasses import dataclass

from mpsfm_core import Options, WeightsFile
from mpsfm_core.providers import weights_from_option
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration

WEIGHTS_LICENSE = "CC0-1.0 (export; the authors name none for their weights)"

RELATIVE_STD_ALONE = 0.08
"""Std of depth relative to depth, for ONNX files without the output ``confidence``.

[assumed from the relative depth std of other networks, 0.079 and 0.0875 in the reference]
"""


def _file(repository: str, name: str) -> WeightsFile:
    return WeightsFile(f"hf://onnx-community/{repository}/onnx/{name}", license=WEIGHTS_LICENSE)


_SMALL = _file("metric3d-vit-small@672e63a9d45ee93c39a3f59cdfd0edf648187f37", "model.onnx")
_LARGE = _file("metric3d-vit-large@7d679e55ebc155d3f7c919371f0784080fb5f5bd", "model.onnx")
_GIANT2 = tuple(
    _file("metric3d-vit-giant2@bee0a79a684eaad2850904db5f790ad20abe921b", name)
    for name in ("model.onnx", "model.onnx_data")
)


class Metric3dOptions(Options):
    """Options that all sizes of Metric3D share."""

    weights: str
    """Path or URI of the ONNX file."""
    companions: tuple[str, ...] = ()
    """URIs of the external data files that an ONNX file of more than 2 GB needs."""
    sha256: str | None = None
    """Expected SHA-256 hash of the file ``weights``."""
    confidence: bool = False
    """Set to true if the ONNX file has the output ``confidence``. The depth variance is computed
    from this ``confidence``, and calibrated as in the reference. The public ONNX files have no
    output ``confidence``.
    """


class SmallOptions(Metric3dOptions):
    """Options of ViT-small."""

    weights: str = _SMALL.uri


class LargeOptions(Metric3dOptions):
    """Options of ViT-large."""

    weights: str = _LARGE.uri


class Giant2Options(Metric3dOptions):
    """Options of ViT-giant2."""

    weights: str = _GIANT2[0].uri
    companions: tuple[str, ...] = (_GIANT2[1].uri,)


@dataclass(frozen=True)
class Size:
    """Weights, options and calibration of one Metric3D size.

    The variance calibration is for ONNX files with the output ``confidence`` [reference].
    """

    name: str
    options: type[Metric3dOptions]
    weights: tuple[WeightsFile, ...]
    calibration: DepthCalibration

    def files(self, options: Metric3dOptions) -> tuple[WeightsFile, ...]:
        """Return the Metric3D weights files that the options select."""
        companions = (WeightsFile(uri, license=WEIGHTS_LICENSE) for uri in options.companions)
        return (*companions, *weights_from_option("weights", *self.weights)(options))

    @property
    def calibration_alone(self) -> DepthCalibration:
        """Return the depth calibration for ONNX files without the output ``confidence``."""
        return self.calibration.model_copy(update={"relative_std": RELATIVE_STD_ALONE})


SIZES = (
    Size("small", SmallOptions, (_SMALL,), DepthCalibration(std_scale=2.045, relative_std=0.0433)),
    Size("large", LargeOptions, (_LARGE,), DepthCalibration(std_scale=3.7757, relative_std=0.05)),
    Size("giant2", Giant2Options, _GIANT2, DepthCalibration(std_scale=3.33, relative_std=0.0263)),
)
