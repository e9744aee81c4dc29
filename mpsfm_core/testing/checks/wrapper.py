"""Contract checks of wrappers around a provider that returns the ground truth.

A wrapper has to pass the checks of this module and all checks of the provider kind that it wraps.
"""

from __future__ import annotations

import numpy as np

from mpsfm_core.testing.contract_case import ContractCase
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped


def check_wrapper_keeps_variance(case: ContractCase) -> None:
    """Require a variance if the wrapped provider returns a variance.

    The uncertainty calibration of the wrapped provider needs a variance.
    """
    if case.run(case.example).variance is None:
        raise CheckFailed("the wrapper drops the variance of the wrapped provider")


def check_wrapper_without_variance(case: ContractCase) -> None:
    """Require valid output of the wrapper if the wrapped provider returns no variance."""
    case.run(case.example, case.create_provider(variance=False))


def check_wrapper_keeps_unit(case: ContractCase) -> None:
    """Require that the wrapper keeps the flag ``metric`` of the wrapped provider's depth."""
    if case.kind != "depth":
        raise CheckSkipped("the check applies to depth only")
    for metric in (True, False):
        if case.run(case.example, case.create_provider(metric=metric)).metric != metric:
            raise CheckFailed(
                f"the wrapper returns depth with metric={not metric}, its provider with {metric}"
            )


def check_wrapper_uses_the_provider(case: ContractCase) -> str:
    """Require that the wrapper's depth is computed from the depth of the wrapped provider.

    If the wrapped provider returns twice the depth, the wrapper has to return twice the depth.
    """
    if case.kind != "depth":
        raise CheckSkipped("the check applies to depth only")
    once, twice = case.run(case.example), case.run(case.example, case.create_provider(scale=2.0))
    both = once.valid & twice.valid
    if not both.any():
        raise CheckFailed("no pixel is valid both for the original and for the doubled depth")
    factor = float(np.median(twice.depth[both] / once.depth[both]))
    if abs(factor - 2) > 0.05:
        raise CheckFailed(
            f"if the wrapped depth doubles, the wrapper's depth grows {factor:.2f} times"
        )
    return f"factor {factor:.2f}"


def check_wrapper_hands_on_depth(case: ContractCase) -> None:
    """Require that a wrapper of normals passes on the depth prior.

    The wrapped normals provider may need the depth prior, which it declares with ``needs-depth``.
    """
    if case.kind != "normals":
        raise CheckSkipped("the check applies to normals only")
    case.run(case.example, case.create_provider())
    given = case.received_depth()
    if not given or any(depth is None for depth in given):
        raise CheckFailed("the wrapper does not pass the depth prior to the wrapped provider")


CHECKS = (
    check_wrapper_keeps_variance,
    check_wrapper_without_variance,
    check_wrapper_keeps_unit,
    check_wrapper_uses_the_provider,
    check_wrapper_hands_on_depth,
)
