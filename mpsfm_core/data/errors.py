"""The errors a user can meet. Each message says what is wrong, where, and what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any


class MpsfmError(Exception):
    """Base of every error raised on purpose; ``exit_code`` is what the command line returns."""

    exit_code = 1

    def __reduce__(self) -> tuple[Any, ...]:
        # as it is, whatever its constructor asks for: it may come from another process
        return _restored, (type(self), self.args, self.__dict__)


class InputError(MpsfmError):
    """The user's input is wrong: images, intrinsics, configuration, weights, options."""

    exit_code = 2


class ConfigError(InputError):
    """A configuration key, value or name is wrong; the message gives file and YAML path."""


class ProviderError(InputError):
    """A provider cannot be found, imported or constructed."""


class WeightsError(InputError):
    """Weights are missing, cannot be fetched, or do not have the expected hash."""


class DataError(MpsfmError, ValueError):
    """A value breaks a rule of the boundary types in :mod:`mpsfm_core.data`.

    ``field`` names the offending field, ``rule`` the rule in words.
    """

    def __init__(self, field: str, rule: str) -> None:
        super().__init__(f"{field}: {rule}")
        self.field = field
        self.rule = rule


class ProviderOutputError(MpsfmError):
    """A provider returned something that breaks the contract.

    The message names provider, image, field and rule, so that the plugin's author can act on it.
    """

    def __init__(self, provider: str, image: str, field: str, rule: str) -> None:
        super().__init__(f"provider {provider!r}, image {image!r}: {field}: {rule}")
        self.provider = provider
        self.image = image
        self.field = field
        self.rule = rule


class ProviderRunError(MpsfmError):
    """A provider failed on an image; the message names both, the cause is chained."""


class OutputError(MpsfmError):
    """Results cannot be written: the disk is full or fails. Earlier results are unchanged."""


class ReconstructionError(MpsfmError):
    """The input is fine, but no reconstruction was possible.

    ``summary``: what ``summary.json`` says, with the reasons for each image and pair.
    """

    exit_code = 3

    def __init__(self, message: str, summary: Mapping[str, Any] | None = None) -> None:
        super().__init__(message)
        self.summary = dict(summary or {})


def _restored(kind: type[MpsfmError], args: tuple[Any, ...], state: dict[str, Any]) -> MpsfmError:
    error = kind.__new__(kind, *args)
    error.__dict__.update(state)
    return error


def did_you_mean(name: str, candidates: Iterable[str]) -> str:
    """What to append to "unknown NAME": the nearest candidate, or all when none is near."""
    known = sorted(set(candidates))
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    if near:
        return f"; did you mean {near[0]!r}?"
    return f"; valid are: {', '.join(known)}" if known else ""
