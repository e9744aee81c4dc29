"""Calibration files: values of an uncertainty model and their provenance.

A file is YAML or JSON. It contains either the bare values or a :class:`CalibrationFile`, as
``mpsfm calibrate`` writes it. A configuration refers to it by ``depth.calibration: FILE``. A plugin
declares it by ``ProviderSpec(calibration=load_calibration(path))``.
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
"""Version of calibration files."""

CalibratedKind = Literal["depth", "normals"]
CALIBRATIONS: Mapping[str, type[DepthCalibration] | type[NormalCalibration]] = {
    "depth": DepthCalibration,
    "normals": NormalCalibration,
}


class Provenance(Options):
    """Origin of a calibration: provider, data and quality of the fit."""

    provider: str
    distribution: str
    """Package and version of the provider."""
    wrappers: tuple[str, ...] = ()
    options: dict[str, Any] = Field(default_factory=dict)
    """Options of the provider; files by name only."""
    weights: dict[str, str] = Field(default_factory=dict)
    """SHA-256 of each file that the provider loaded, by name or URI."""
    truth: str
    """Source of the true values."""
    data: str
    """Images of the fit."""
    date: str
    """Date of the fit, ISO 8601."""
    core: str
    """Version of mpsfm-core."""
    images: int
    """Number of images of the fit."""
    pixels: int
    """Number of pixels of the fit."""
    intervals_95: dict[str, tuple[float, float]] = Field(default_factory=dict)
    """Confidence interval of each value, 95 %."""
    metrics: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """coverage, z_mad, nll and ause on held-out images, ``before`` and ``after`` the fit."""
    warnings: tuple[str, ...] = ()


class CalibrationFile(Options):
    """Calibration with its provenance."""

    kind: CalibratedKind
    calibration: DepthCalibration | NormalCalibration
    provenance: Provenance

    @model_validator(mode="before")
    @classmethod
    def _by_kind(cls, values: Any) -> Any:
        """Select the calibration class by kind, because both classes share field names."""
        if isinstance(values, Mapping) and isinstance(values.get("calibration"), Mapping):
            model = CALIBRATIONS.get(values.get("kind", ""))
            if model is not None:
                values = {**values, "calibration": model.model_validate(values["calibration"])}
        return values

    def write(self, path: Path) -> None:
        """Write the file as JSON if its name ends with ``.json``, else as YAML."""
        content = {VERSION: FORMAT, **self.model_dump(mode="json")}
        is_json = path.suffix == ".json"
        text = json.dumps(content, indent=2) + "\n" if is_json else write_yaml(content)
        write_file(path, text)


def read_values(path: Path, kind: str) -> Mapping[str, Any]:
    """Read the values of a calibration file without validation.

    Args:
        path: The file.
        kind: Kind of the provider.

    Returns:
        Values by name.

    Raises:
        ConfigError: The file cannot be read, is not a mapping, has a newer version, or is for
            another
            kind.
    """
    try:
        content = parse_yaml(path.read_text(encoding="utf-8"), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"calibration file {str(path)!r} cannot be read: {error}") from error
    if not isinstance(content, Mapping):
        raise ConfigError(f"{path} does not hold a mapping")
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
    """Load the calibration of a file.

    Args:
        path: The file.
        kind: Kind of the provider.

    Returns:
        The calibration.

    Raises:
        ConfigError: See :func:`read_values`, or a value is wrong.
    """
    try:
        return parse_settings(CALIBRATIONS[kind], read_values(path, kind))
    except SettingsError as error:
        raise ConfigError(f"{path}: {error}") from error
