"""Settings of the inputs room."""

from __future__ import annotations

from mpsfm_core.options import Options


class InputOptions(Options):
    """How photos become views."""
