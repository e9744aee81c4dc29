"""Reading and writing of calibration files, which store an uncertainty model.

A calibration file in YAML or JSON contains either only the values of an uncertainty model or a
:class:`CalibrationFile`, which ``mpsfm calibrate`` writes. The option ``depth.calibration`` of a
configuration may be the path of a calibration file. A plugin loads a calibration file by
``ProviderSpec(calibration=load_calibration(path))``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from mpsfm_core.data.errors import ConfigError
from mpsfm_core.data.options import Options, SettingsError, parse_settings
from mpsfm_core.providers.uncertainty.calibration import (
    Calibration,
    DepthCalibration,
    NormalCalibration,
)
from mpsfm_core.support.files import write_file
from mpsfm_core.support.format_versions import VERSION, check_version
from mpsfm_core.support.yaml_text import parse_yaml, write_yaml

FORMAT = 1
"""Format version of calibration files."""

CalibratedKind = Literal["depth", "normals"]
CALIBRATIONS: Mapping[str, type[DepthCalibration] | type[NormalCalibration]] = {
    "depth": DepthCalibration,
    "normals": NormalCalibration,
}


class Provenance(Options):
    """Provenance of a calibration, with the provider, the images and the quality of the fit."""

    provider: str
    distribution: str
    """Pip package and version of the calibrated provider."""
    wrappers: tuple[str, ...] = ()
    options: dict[str, Any] = Field(default_factory=dict)
    """Options of the calibrated provider, with file names instead of file paths."""
    weights: dict[str, str] = Field(default_factory=dict)
    """SHA-256 of each weights file that the calibrated provider loaded, by file name or URI."""
    truth: str
    """Source of the ground-truth depth or normals."""
    data: str
    """Names of the images to which the uncertainty model was fitted."""
    date: str
    """Date of the calibration in ISO 8601."""
    core: str
    """Version of mpsfm-core that fitted the uncertainty model."""
    images: int
    """Number of images to which the uncertainty model was fitted."""
    pixels: int
    """Number of pixels to which the uncertainty model was fitted."""
    intervals_95: dict[str, tuple[float, float]] = Field(default_factory=dict)
    """95 % confidence interval of each fitted value of the uncertainty model."""
    metrics: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """Quality metrics of the uncertainty on held-out images, ``before`` and ``after`` the fit, such
    as the negative log likelihood ``nll``."""
    warnings: tuple[str, ...] = ()


class CalibrationFile(Options):
    """Values of an uncertainty model with their provenance."""

    kind: CalibratedKind
    calibration: DepthCalibration | NormalCalibration
    provenance: Provenance

    @model_validator(mode="before")
    @classmethod
    def _by_kind(cls, values: Any) -> Any:
        """Select the uncertainty model's class by ``kind``, because both classes share fields."""
        if isinstance(values, Mapping) and isinstance(values.get("calibration"), Mapping):
            model = CALIBRATIONS.get(values.get("kind", ""))
            if model is not None:
                values = {**values, "calibration": model.model_validate(values["calibration"])}
        return values

    def write(self, path: Path) -> None:
        """Write the calibration file as JSON if its name ends with ``.json``, else as YAML."""
        content = {VERSION: FORMAT, **self.model_dump(mode="json")}
        is_json = path.suffix == ".json"
        text = json.dumps(content, indent=2) + "\n" if is_json else write_yaml(content)
        write_file(path, text)


def read_values(path: Path, kind: str) -> Mapping[str, Any]:
    """Read the uncertainty model's values from a calibration file without validation.

    Args:
        path: Path of the calibration file.
        kind: Kind of the provider, such as ``depth``.

    Returns:
        Values of the uncertainty model by name.

    Raises:
        ConfigError: The calibration file cannot be read, is not a mapping, has a newer format
            version, or is for another provider kind.
    """
    try:
        content = parse_yaml(path.read_text(encoding="utf-8"), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"calibration file {str(path)!r} cannot be read: {error}") from error
    if not isinstance(content, Mapping):
        raise ConfigError(f"calibration file {path} does not contain a mapping")
    check_version(content, FORMAT, path, ConfigError)
    if "provenance" not in content:
        return {key: value for key, value in content.items() if key != VERSION}
    if content.get("kind") != kind:
        raise ConfigError(f"file {path} is a calibration of {content.get('kind')}, not of {kind}")
    values = content.get("calibration")
    if not isinstance(values, Mapping):
        raise ConfigError(f"{path}: the key calibration must be a mapping")
    return values


def load_calibration(path: Path, kind: CalibratedKind = "depth") -> Calibration:
    """Load the uncertainty model that a calibration file contains.

    Args:
        path: Path of the calibration file.
        kind: Kind of the provider, such as ``depth``.

    Returns:
        The calibration.

    Raises:
        ConfigError: The calibration file is unreadable (see :func:`read_values`) or has a wrong
            value.
    """
    try:
        return parse_settings(CALIBRATIONS[kind], read_values(path, kind))
    except SettingsError as error:
        raise ConfigError(f"{path}: {error}") from error
