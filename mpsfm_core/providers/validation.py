"""Rules for the values of providers, and errors that name provider and image.

Each module of :mod:`mpsfm_core.providers.kinds` has functions ``run_*``, which call a provider and
validate its return value. Any exception of a provider becomes an
:class:`~mpsfm_core.data.errors.MpsfmError` that names provider and image. The functions
``validate_*`` only validate a given return value of a provider. Return values are instances of the
classes in :mod:`mpsfm_core.data`, which validate themselves on construction. The functions
``validate_*`` validate a returned instance again, because a provider may have changed its arrays.
The functions ``validate_*`` also compare the return value with the image size and with the declared
capabilities of the provider.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Float64, PinholeCamera
from mpsfm_core.data.decisions import HookReason
from mpsfm_core.data.errors import DataError, MpsfmError, ProviderOutputError, ProviderRunError
from mpsfm_core.providers.protocols import ProviderSpec

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Checked = TypeVar("Checked", bound="DataclassInstance")


def validate_filtered_pairs(
    answer: object, pairs: Sequence[tuple[str, str]]
) -> tuple[list[tuple[str, str]], dict[HookReason, str]]:
    """Validate the image pairs that a plugin's hook ``mpsfm_filter_pairs`` selects.

    Args:
        answer: Return value of the plugin's hook ``mpsfm_filter_pairs``.
        pairs: Candidate pairs of image names that the plugin received.

    Returns:
        Selected pairs of image names, and a sentence for each reason to distrust the selection. The
        selected pairs may contain pairs that are no candidates, which the caller ignores.

    Raises:
        TypeError: The hook's return value is not an iterable of pairs of image names.
        ValueError: The plugin selects image pairs, but none of the selected pairs is a candidate
            pair.
    """
    if not isinstance(answer, Iterable):
        raise TypeError(f"the hook must return pairs of image names, got {type_name(answer)}")
    filtered: list[tuple[str, str]] = []
    for pair in answer:
        if not (isinstance(pair, Sequence) and len(pair) == 2):
            raise TypeError(f"the hook must return pairs of image names, got {pair!r}")
        first, second = pair
        if not (isinstance(first, str) and isinstance(second, str)):
            raise TypeError(f"the hook must return pairs of image names, got {pair!r}")
        filtered.append((first, second))
    candidates = {frozenset(pair) for pair in pairs}
    ignored = [pair for pair in filtered if frozenset(pair) not in candidates]
    example = (
        f"for example {ignored[0]!r}: image names have their folder and extension, such as "
        f"{pairs[0] if pairs else ('a.jpg', 'b.jpg')!r}"
        if ignored
        else ""
    )
    if filtered and len(ignored) == len(filtered):
        raise ValueError(f"the hook returns no candidate pair, {example}")
    doubts = {}
    if ignored:
        count = f"{len(ignored)} of {len(filtered)} selected pairs are no candidates"
        doubts[HookReason.PAIRS_IGNORED] = f"{count} and are ignored, {example}"
    if pairs and not filtered:
        doubts[HookReason.NO_PAIRS] = f"the hook selects none of {len(pairs)} candidate pairs"
    return filtered, doubts


@contextmanager
def provider_errors(spec: ProviderSpec, image: str) -> Iterator[None]:
    """Convert any exception of a provider to an MP-SfM error that names provider and image.

    Subclasses of MpsfmError, such as WeightsError for missing weights, are not converted, because
    their messages already name the next step.

    Args:
        spec: Specification of the provider, with its capabilities.
        image: Name of the image that the provider processes, or names of several images.

    Raises:
        ProviderRunError: The provider raised an exception.
        ProviderOutputError: The return value of the provider violates a rule of the interface.
    """
    with name_violations(spec, image):
        try:
            yield
        except MpsfmError:
            raise
        except MemoryError as error:
            raise ProviderRunError(
                f"provider {spec.name!r}, image {image!r}: out of memory; reduce the image size or "
                f"the number of workers"
            ) from error
        except (Exception, SystemExit) as error:
            text = f"provider {spec.name!r}, image {image!r}: {type(error).__name__}: {error}"
            raise ProviderRunError(text) from error


@contextmanager
def name_violations(spec: ProviderSpec, image: str) -> Iterator[None]:
    """Convert a DataError about a provider's output to an error that names provider and image."""
    try:
        yield
    except DataError as error:
        raise ProviderOutputError(spec.name, image, error.field, error.rule) from error


def revalidate(output: object, expected: type[Checked], field: str) -> Checked:
    """Require that a provider's output has the expected type, and validate its values again."""
    if not isinstance(output, expected):
        raise DataError(field, f"the output must be a {expected.__name__}, got {type_name(output)}")
    return replace(output)  # The constructor validates the field values again.


def require_undeclared(spec: ProviderSpec, capability: str, field: str) -> None:
    """Raise DataError if the provider declares the capability of a field that is None."""
    if capability in spec.capabilities:
        raise DataError(field, f"the output lacks the declared capability {capability!r}")


def require_inside(points: Float64, camera: PinholeCamera, field: str) -> None:
    """Raise DataError if a point (x, y) in pixels is outside of the image of a camera."""
    outside = ((points < 0) | (points > camera.size)).any(axis=1)
    if outside.any():
        x, y = points[outside][0]
        size = f"{camera.width}x{camera.height}"
        raise DataError(
            field, f"points must lie inside of the {size} image, got ({x:.2f}, {y:.2f})"
        )


def require_not_empty(shape: tuple[int, ...], field: str) -> None:
    """Raise DataError if a dimension of an array has the length 0."""
    if 0 in shape:
        raise DataError(field, f"the array must not be empty, but has shape {shape}")


def require_array(
    output: object, field: str, dtype: np.dtype[Any], dimensions: int
) -> NDArray[Any]:
    """Return a provider's output, or raise DataError unless it is an array of the given type."""
    if not isinstance(output, np.ndarray):
        raise DataError(field, f"the output must be a numpy array, got {type_name(output)}")
    if output.dtype != dtype or output.ndim != dimensions:
        expected = f"{dimensions}-dimensional {dtype}"
        raise DataError(
            field, f"the output must be a {expected} array, got {output.dtype} {output.shape}"
        )
    return output


def type_name(value: object) -> str:
    """Return the class name of a value, for error messages."""
    return type(value).__name__
