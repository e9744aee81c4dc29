"""Exceptions that end a contract check as failed or skipped."""

from __future__ import annotations


class CheckFailed(Exception):
    """The provider under test violates the contract in the way that the message describes."""


class CheckSkipped(Exception):
    """The contract check does not apply to the provider, for the reason in the message."""
