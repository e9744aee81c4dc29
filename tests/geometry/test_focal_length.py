"""Tests of focal lengths as 35 mm equivalents."""

from __future__ import annotations

import pytest

from mpsfm_core.geometry.focal_length import compute_equivalent_mm, is_plausible_equivalent


def test_compute_equivalent_of_full_frame_width_is_36() -> None:
    assert compute_equivalent_mm(6000.0, 6000, 4000) == pytest.approx(36)


@pytest.mark.parametrize(
    ("equivalent_mm", "expected"), [(0, False), (8, True), (800, True), (65535, False)]
)
def test_is_plausible_equivalent_by_range(equivalent_mm: float, expected: bool) -> None:
    assert is_plausible_equivalent(equivalent_mm) == expected
