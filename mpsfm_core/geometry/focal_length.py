"""Focal lengths in pixels and as 35 mm equivalents."""

from __future__ import annotations

import math

DIAGONAL_35MM = math.hypot(36.0, 24.0)
"""Diagonal in mm of 35 mm film, the reference of equivalent focal lengths. [CIPA DCG-001]"""
MIN_EQUIVALENT_MM = 8.0
"""Shortest 35 mm equivalent focal length of existing lenses, in mm. [ours]"""
MAX_EQUIVALENT_MM = 800.0
"""Longest 35 mm equivalent focal length of existing lenses, in mm. [ours]"""


def compute_equivalent_mm(focal_px: float, width: int, height: int) -> float:
    """Convert a focal length in pixels to its 35 mm equivalent in mm, by the image diagonal."""
    return focal_px / math.hypot(width, height) * DIAGONAL_35MM


def is_plausible_equivalent(equivalent_mm: float) -> bool:
    """Return True if a 35 mm equivalent focal length in mm is that of an existing lens."""
    return MIN_EQUIVALENT_MM <= equivalent_mm <= MAX_EQUIVALENT_MM
