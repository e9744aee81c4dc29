"""Exceptions of the package; each message states what is wrong, where, and the next step.

MpsfmError
  InputError                 exit code 2
    ConfigError
      SettingsError          (mpsfm_core.data.options)
    ProviderError
    WeightsError
  DataError                  also a ValueError
  ProviderOutputError
  ProviderRunError
  OutputError
  ReconstructionError        exit code 3
  Cancelled                  exit code 130
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any


class MpsfmError(Exception):
    """Base class of all exceptions that MP-SfM raises on purpose."""

    exit_code = 1
    """Exit code of the command line for this error class."""

    def __reduce__(self) -> tuple[Any, ...]:
        # Worker processes return pickled exceptions. Default pickling fails for exceptions whose
        # constructor has other parameters than `args`.
        return _restore_error, (type(self), self.args, self.__dict__)


class Cancelled(MpsfmError):
    """Exception that a callback ``on_event`` raises to end a run.

    A repeated call of ``reconstruct`` with the same arguments continues from the last checkpoint.
    """

    exit_code = 130
    """Exit code of the command line for this error class."""


class InputError(MpsfmError):
    """Error in the user's input: images, intrinsics, configuration, weights or options."""

    exit_code = 2
    """Exit code of the command line for this error class."""


class ConfigError(InputError):
    """Error for a wrong configuration key, value or name, with file and YAML path."""


class ProviderError(InputError):
    """Error for a plugin's network (provider) that cannot be found, imported or constructed."""


class WeightsError(InputError):
    """Error for network weights that are missing, not downloadable, or have a wrong hash."""


class DataError(MpsfmError, ValueError):
    """Error for a value that violates a rule of the data classes in :mod:`mpsfm_core.data`.

    Attributes:
        field: Name of the invalid field.
        rule: The violated rule.
    """

    def __init__(self, field: str, rule: str) -> None:
        super().__init__(f"{field}: {rule}")
        self.field = field
        self.rule = rule


class ProviderOutputError(MpsfmError):
    """Error for the output of a network (provider) that has a wrong shape, dtype or value.

    Attributes:
        provider: Name of the provider.
        image: Name of the image that the network processed.
        field: Name of the invalid field.
        rule: The violated rule.
    """

    def __init__(self, provider: str, image: str, field: str, rule: str) -> None:
        super().__init__(f"provider {provider!r}, image {image!r}: {field}: {rule}")
        self.provider = provider
        self.image = image
        self.field = field
        self.rule = rule


class ProviderRunError(MpsfmError):
    """Error for an exception of a network (provider) that processes an image."""


class OutputError(MpsfmError):
    """Error for results that cannot be written, for example because the disk is full.

    The results of earlier runs are unchanged.
    """


class ReconstructionError(MpsfmError):
    """Error for valid input images from which no reconstruction can be computed.

    Attributes:
        summary: Content of `summary.json`, with the reason why each image and image pair failed.
    """

    exit_code = 3
    """Exit code of the command line for this error class."""

    def __init__(self, message: str, summary: Mapping[str, Any] | None = None) -> None:
        super().__init__(message)
        self.summary = dict(summary or {})


def _restore_error(
    kind: type[MpsfmError], args: tuple[Any, ...], state: dict[str, Any]
) -> MpsfmError:
    """Recreate a pickled exception without a call of its constructor."""
    error = kind.__new__(kind, *args)
    error.__dict__.update(state)
    return error


def did_you_mean(name: str, candidates: Iterable[str]) -> str:
    """Return a message suffix that suggests the closest valid name, or lists all valid names."""
    known = sorted(set(candidates))
    closest = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    if closest:
        return f"; did you mean {closest[0]!r}?"
    return f"; valid are: {', '.join(known)}" if known else ""
