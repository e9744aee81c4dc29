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
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any


class MpsfmError(Exception):
    """Base class of all errors that the package raises on purpose."""

    exit_code = 1
    """Exit code of the command line for this error class."""

    def __reduce__(self) -> tuple[Any, ...]:
        # Default pickling fails, because the constructors have other parameters than `args`. Worker
        # processes return pickled errors.
        return _restore_error, (type(self), self.args, self.__dict__)


class InputError(MpsfmError):
    """Error in the user's input: images, intrinsics, configuration, weights or options."""

    exit_code = 2
    """Exit code of the command line for this error class."""


class ConfigError(InputError):
    """Error for a wrong configuration key, value or name, with file and YAML path."""


class ProviderError(InputError):
    """Error for a provider that cannot be found, imported or constructed."""


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
    """Error for provider output that violates the provider contract.

    Attributes:
        provider: Name of the provider.
        image: Name of the image that the provider processed.
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
    """Exception of a provider on an image, chained to the original exception."""


class OutputError(MpsfmError):
    """Error for results that cannot be written because the disk is full or fails.

    The results of earlier runs are unchanged.
    """


class ReconstructionError(MpsfmError):
    """Error if valid input cannot be reconstructed.

    Attributes:
        summary: Content of `summary.json`, with the reasons for each image and pair.
    """

    exit_code = 3
    """Exit code of the command line for this error class."""

    def __init__(self, message: str, summary: Mapping[str, Any] | None = None) -> None:
        super().__init__(message)
        self.summary = dict(summary or {})


def _restore_error(
    kind: type[MpsfmError], args: tuple[Any, ...], state: dict[str, Any]
) -> MpsfmError:
    """Recreate a pickled error without its constructor."""
    error = kind.__new__(kind, *args)
    error.__dict__.update(state)
    return error


def did_you_mean(name: str, candidates: Iterable[str]) -> str:
    """Return a suffix for "unknown NAME" messages: the closest candidate, or all candidates."""
    known = sorted(set(candidates))
    closest = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    if closest:
        return f"; did you mean {closest[0]!r}?"
    return f"; valid are: {', '.join(known)}" if known else ""
