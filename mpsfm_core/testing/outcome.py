"""How a check ends other than well."""

from __future__ import annotations


class CheckFailed(Exception):
    """The provider breaks the contract; the message says how."""


class CheckSkipped(Exception):
    """The check has nothing to say about this provider; the message says why."""
