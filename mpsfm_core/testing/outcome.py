"""Exceptions that end a contract check as failed or skipped."""

from __future__ import annotations


class CheckFailed(Exception):
    """The provider under test violates the contract in the way that the message describes."""


class CheckUndecided(CheckFailed):
    """The provider's output does not suffice for a contract check, which counts as a failure.

    A plugin declares a legitimate failure and its reason in ``ContractSetup.expected_failures``.
    """

    def __init__(self, reason: str) -> None:
        super().__init__(f"cannot tell: {reason}")


class CheckSkipped(Exception):
    """The contract check does not apply to the provider, for the reason in the message."""


class CheckUnmeasured(CheckSkipped):
    """The contract check applies, but the ground truth is not known for this provider."""
