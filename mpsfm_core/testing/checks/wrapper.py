"""Checks of wrappers: what they do to the provider they are put around.

They are put around an oracle, which knows the truth, and have to pass all checks of the kind they
wrap besides these.
"""

from __future__ import annotations

import numpy as np

from mpsfm_core.testing.contract_case import ContractCase
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped


def check_wrapper_keeps_variance(case: ContractCase) -> None:
    """Around a provider with a variance, the wrapper gives one too: it was promised to the
    calibration."""
    if case.run(case.example).variance is None:
        raise CheckFailed("drops the variance of the provider it wraps")


def check_wrapper_without_variance(case: ContractCase) -> None:
    """A provider without a variance can be wrapped too."""
    case.run(case.example, case.create_provider(variance=False))


def check_wrapper_keeps_unit(case: ContractCase) -> None:
    """Depth in metres stays depth in metres, and other depth is not called metric."""
    if case.kind != "depth":
        raise CheckSkipped("is about depth")
    for metric in (True, False):
        if case.run(case.example, case.create_provider(metric=metric)).metric != metric:
            raise CheckFailed(f"calls depth metric={not metric} that the provider calls {metric}")


def check_wrapper_uses_the_provider(case: ContractCase) -> str:
    """The answer follows the wrapped provider: twice the depth inside is twice the depth
    outside."""
    if case.kind != "depth":
        raise CheckSkipped("is about depth")
    once, twice = case.run(case.example), case.run(case.example, case.create_provider(scale=2.0))
    both = once.valid & twice.valid
    if not both.any():
        raise CheckFailed("has no pixel that is valid both times")
    factor = float(np.median(twice.depth[both] / once.depth[both]))
    if abs(factor - 2) > 0.05:
        raise CheckFailed(f"twice the depth inside is {factor:.2f} times the depth outside")
    return f"factor {factor:.2f}"


def check_wrapper_hands_on_depth(case: ContractCase) -> None:
    """A wrapper of normals hands on the depth it is given: the provider inside may need it."""
    if case.kind != "normals":
        raise CheckSkipped("is about normals")
    case.run(case.example, case.create_provider())
    given = case.received_depth()
    if not given or any(depth is None for depth in given):
        raise CheckFailed("does not hand on the depth prior to the provider it wraps")


CHECKS = (
    check_wrapper_keeps_variance,
    check_wrapper_without_variance,
    check_wrapper_keeps_unit,
    check_wrapper_uses_the_provider,
    check_wrapper_hands_on_depth,
)
