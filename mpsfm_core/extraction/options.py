"""Settings of the extraction room."""

from __future__ import annotations

from mpsfm_core.options import Options


class PairOptions(Options):
    """Which pairs of images are matched."""


class VerificationOptions(Options):
    """Two-view geometric verification of matches."""


class ExtractionOptions(Options):
    """Grid of the prior maps and the like."""
