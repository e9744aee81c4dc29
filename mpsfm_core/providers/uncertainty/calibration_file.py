"""Calibration files: the values of an uncertainty model and their provenance.

A calibration file is YAML or JSON. The file contains either the bare values or a
:class:`CalibrationFile`, as ``mpsfm calibrate`` writes it. A configuration refers to the file by
``depth.calibration: FILE``. A plugin declares the file by
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
    """Provenance of a calibration: provider, data and quality of the fit."""

    provider: str
    distribution: str
    """Distribution package and version of the provider."""
    wrappers: tuple[str, ...] = ()
    options: dict[str, Any] = Field(default_factory=dict)
    """Options of the provider; paths of files are reduced to their names."""
    weights: dict[str, str] = Field(default_factory=dict)
    """SHA-256 of each weights file that the provider loaded, by file name or URI."""
    truth: str
    """Source of the ground truth."""
    data: str
    """Names of the images that were used for the fit."""
    date: str
    """Date of the fit in ISO 8601."""
    core: str
    """Version of mpsfm-core."""
    images: int
    """Number of images that were used for the fit."""
    pixels: int
    """Number of pixels that were used for the fit."""
    intervals_95: dict[str, tuple[float, float]] = Field(default_factory=dict)
    """95 % confidence interval of each fitted value."""
    metrics: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """Quality metrics coverage, z_mad, nll and ause on held-out images, ``before`` and ``after``
    the fit."""
    warnings: tuple[str, ...] = ()


class CalibrationFile(Options):
    """Values of an uncertainty model with their provenance."""

    kind: CalibratedKind
    calibration: DepthCalibration | NormalCalibration
    provenance: Provenance

    @model_validator(mode="before")
    @classmethod
    def _by_kind(cls, values: Any) -> Any:
        """Select the calibration class by provider kind, because both classes share field names."""
        if isinstance(values, Mapping) and isinstance(values.get("calibration"), Mapping):
            model = CALIBRATIONS.get(values.get("kind", ""))
            if model is not None:
                values = {**values, "calibration": model.model_validate(values["calibration"])}
        return values

    def write(self, path: Path) -> None:
        """Write the calibration as JSON if the file name ends with ``.json``, else as YAML."""
        content = {VERSION: FORMAT, **self.model_dump(mode="json")}
        is_json = path.suffix == ".json"
        text = json.dumps(content, indent=2) + "\n" if is_json else write_yaml(content)
        write_file(path, text)


def read_values(path: Path, kind: str) -> Mapping[str, Any]:
    """Read the values of a calibration file without validation.

    Args:
        path: The file.
        kind: Kind of the provider, such as ``depth``.

    Returns:
        Values by name.

    Raises:
        ConfigError: The file cannot be read, is not a mapping, has a newer format version, or is
            for another provider kind.
    """
    try:
        content = parse_yaml(path.read_text(encoding="utf-8"), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"calibration file {str(path)!r} cannot be read: {error}") from error
    if not isinstance(content, Mapping):
        raise ConfigError(f"{path} does not contain a mapping")
    check_version(content, FORMAT, path, ConfigError)
    if "provenance" not in content:
        return {key: value for key, value in content.items() if key != VERSION}
    if content.get("kind") != kind:
        raise ConfigError(f"{path} is a calibration of {content.get('kind')}, not of {kind}")
    values = content.get("calibration")
    if not isinstance(values, Mapping):
        raise ConfigError(f"{path}: calibration: must be a mapping")
    return values


def load_calibration(path: Path, kind: CalibratedKind = "depth") -> Calibration:
    """Load the uncertainty model of a calibration file.

    Args:
        path: The file.
        kind: Kind of the provider, such as ``depth``.

    Returns:
        The calibration.

    Raises:
        ConfigError: The file is unreadable (see :func:`read_values`), or a value is wrong.
    """
    try:
        return parse_settings(CALIBRATIONS[kind], read_values(path, kind))
    except SettingsError as error:
        raise ConfigError(f"{path}: {error}") from error
