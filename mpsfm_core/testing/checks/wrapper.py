"""Contract checks of wrappers around a provider that returns the ground truth.

A wrapper has to pass the checks of this module and all checks of the provider kind that it wraps.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from mpsfm_core.data.errors import ProviderRunError
from mpsfm_core.testing.accuracy import compare_with_truth, require_local_depth
from mpsfm_core.testing.contract_case import ContractCase
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped

_STD_RANGE = (0.5, 4.0)
"""Accepted range of the ratio between the std of the wrapper and of the wrapped provider. The mean
of two predictions can halve the variance, and the difference of two predictions increases the
variance."""
_MAX_STD_SPREAD = 1.7
"""Largest accepted ratio between the 90 % and 10 % quantiles of the std ratio of wrapper and
wrapped provider. The std of the wrapped provider varies by a factor of 3."""
_MAX_LOG_FACTOR = 0.03
"""Largest accepted logarithm of the ratio between the change of the wrapper's depth and that of the
wrapped depth."""
_MAX_FILLED_RATIO = 0.05
"""Largest accepted ratio of pixels without a value that a wrapper makes valid."""


def check_wrapper_keeps_variance(case: ContractCase) -> None:
    """Require a variance if the wrapped provider returns a variance.

    The uncertainty calibration of the wrapped provider needs a variance.
    """
    if case.run(case.example).variance is None:
        raise CheckFailed("the wrapper drops the variance of the wrapped provider")


def check_wrapper_without_variance(case: ContractCase) -> None:
    """Require valid output of the wrapper if the wrapped provider returns no variance.

    Pixels where the wrapped provider has no value have to be invalid.
    """
    answer = case.run(case.example, case.create_provider(variance=False))
    _require_same_holes(_run_inner(case), answer)


def check_wrapper_keeps_unit(case: ContractCase) -> None:
    """Require the same flag ``metric`` in the depth of the wrapper and of the wrapped provider."""
    if case.kind != "depth":
        raise CheckSkipped("the check applies to depth only")
    for metric in (True, False):
        if case.run(case.example, case.create_provider(metric=metric)).metric != metric:
            raise CheckFailed(
                f"the wrapper returns depth with metric={not metric}, its provider with {metric}"
            )


def check_wrapper_uses_the_provider(case: ContractCase) -> str:
    """Require that the wrapper's depth is computed from the depth of the wrapped provider.

    If the wrapped provider returns 0.1, 2 or 9 times the depth, the depth of the wrapper has to
    change by the same factor at each pixel.
    """
    if case.kind != "depth":
        raise CheckSkipped("the check applies to depth only")
    once = case.run(case.example)
    for scale in (2.0, 0.1, 9.0):
        scaled = case.run(case.example, case.create_provider(scale=scale))
        both = once.valid & scaled.valid
        if not both.any():
            raise CheckFailed(f"no pixel is valid if the wrapped depth is {scale:g} times as large")
        factors = scaled.depth[both] / once.depth[both] / scale
        low, factor, high = np.quantile(factors, (0.02, 0.5, 0.98))
        if max(abs(np.log([low, factor, high]))) > _MAX_LOG_FACTOR:
            raise CheckFailed(
                f"if the wrapped depth grows {scale:g} times, the wrapper's depth grows "
                f"{low * scale:.2f} to {high * scale:.2f} times"
            )
    return f"factor {factor:.2f}"


def check_wrapper_stacked(case: ContractCase) -> str:
    """Require accurate output of the wrapper around itself.

    The configuration of a run may name several wrappers, the first of which wraps the provider.
    """
    answer = case.run(case.example, case.create_provider(num_wrappers=2))
    if answer.variance is None:
        raise CheckFailed("two wrappers drop the variance of the wrapped provider")
    return compare_with_truth(case, case.example, answer)


def check_wrapper_hands_on_depth(case: ContractCase) -> None:
    """Require that a wrapper passes its depth prior to the wrapped normals provider.

    A normals provider that declares ``needs-depth`` requires the depth prior.
    """
    if case.kind != "normals":
        raise CheckSkipped("the check applies to normals only")
    case.received_depth().clear()
    case.run(case.example, case.create_provider())
    given = case.received_depth()
    if not (given and all(given)):
        raise CheckFailed("the wrapper does not pass the depth prior to the wrapped provider")


def check_wrapper_variance(case: ContractCase) -> str:
    """Require a variance in the unit and at the pixels of the wrapped provider's variance.

    A wrapper may increase the variance, but the pattern of the wrapped provider's variance has to
    remain visible.
    """
    inner, answer = _run_inner(case), case.run(case.example)
    if answer.variance is None or answer.shape != inner.shape:
        raise CheckSkipped("the wrapper returns no variance of the wrapped map's size")
    both = answer.valid & inner.valid & case.example.truth(inner.shape).smooth
    ratio = np.sqrt(answer.variance[both].astype(np.float64) / inner.variance[both])
    low, factor, high = map(float, np.quantile(ratio, (0.1, 0.5, 0.9)))
    if not _STD_RANGE[0] < factor < _STD_RANGE[1]:
        raise CheckFailed(f"the std is {factor:.2g} times the std of the wrapped provider")
    if high > _MAX_STD_SPREAD * low:
        raise CheckFailed(
            f"the std is {low:.2g} to {high:.2g} times the std of the wrapped provider: the "
            "variance belongs to other pixels or is averaged"
        )
    return f"std {factor:.2f} times that of the wrapped provider"


def check_wrapper_low_resolution(case: ContractCase) -> str:
    """Require accurate output if the wrapped provider returns maps of half the size."""
    return compare_with_truth(
        case, case.example, case.run(case.example, case.create_provider(reduction=2))
    )


def check_wrapper_validity(case: ContractCase) -> str:
    """Require invalid pixels in the wrapper's map where the wrapped provider has no value.

    If the wrapped provider has a value in the view or in the mirrored view only, the wrapper may
    use this value, but no mean with the meaningless other value.
    """
    inner, answer = _run_inner(case), case.run(case.example)
    if answer.shape != inner.shape:
        raise CheckSkipped("the map of the wrapper has another size")
    text = _require_same_holes(inner, answer)
    # A wrapper may use the mirrored view, for which a network rejects other pixels.
    other = case.run(case.example, case.create_provider(mirrored_hole=True))
    if case.kind == "depth":
        require_local_depth(case, case.example, other)
    return text


def check_wrapper_inputs(case: ContractCase) -> None:
    """Require that the wrapped provider receives camera, mask and depth prior of its input view.

    If a wrapper mirrors, rotates, crops or resizes the view, the intrinsics, the mask and the depth
    prior have to change in the same way. The wrapper may drop the mask, and must not modify the
    prior of the wrapped provider. The check uses a landscape
    and a portrait view, because a wrapper may rotate only one of them.
    """
    provider = case.create_provider()
    width, height = case.example.camera.size
    for example in (case.example, case.example.sized(height, width)):
        case.wrong_inputs().clear()
        mask = np.ones(example.view.image.shape[:2], np.bool_)
        mask[: height // 2, : width // 3] = False
        case.prepare(example)
        with case.received_mask(mask):
            case.run_on_view(replace(example.view, mask=mask), example, provider)
        wrong = case.wrong_inputs()
        if wrong:
            raise CheckFailed(f"the wrapped provider receives a wrong input: {wrong[0]}")


def check_wrapper_errors(case: ContractCase) -> None:
    """Require an error of the wrapper if the wrapped provider raises an error.

    The run reports errors of single images. A map in place of an error looks like a prediction.
    """
    provider = case.create_provider(fails=True)
    try:
        case.run(case.example, provider)
    except ProviderRunError:
        return
    raise CheckFailed("the wrapper returns a map although the wrapped provider raises an error")


CHECKS = (
    check_wrapper_keeps_variance,
    check_wrapper_without_variance,
    check_wrapper_keeps_unit,
    check_wrapper_uses_the_provider,
    check_wrapper_hands_on_depth,
    check_wrapper_variance,
    check_wrapper_low_resolution,
    check_wrapper_validity,
    check_wrapper_inputs,
    check_wrapper_errors,
    check_wrapper_stacked,
)


def _require_same_holes(inner: Any, answer: Any) -> str:
    """Require that pixels without a value in the wrapped provider's map stay invalid."""
    if answer.shape != inner.shape:
        return ""
    wrong = float(answer.valid[~inner.valid].mean())
    if wrong > _MAX_FILLED_RATIO:
        raise CheckFailed(f"{wrong:.0%} of the invalid pixels of the wrapped provider are valid")
    return f"{wrong:.1%} of the invalid pixels are valid"


def _run_inner(case: ContractCase) -> Any:
    """Return the output of the wrapped provider itself."""
    case.prepare(case.example)
    return case.run_inner(case.example.view)
