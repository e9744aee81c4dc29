"""Settings of the results room."""

from __future__ import annotations

from mpsfm_core.options import Options


class ResultOptions(Options):
    """What is written."""
