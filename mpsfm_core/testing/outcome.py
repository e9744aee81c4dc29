"""Exceptions that end a contract check as failed or skipped."""

from __future__ import annotations


class CheckFailed(Exception):
    """The provider violates the contract; the message describes the violation."""


class CheckSkipped(Exception):
    """The check does not apply to this provider; the message gives the reason."""
