"""Fixture of a rendered room with exact poses and inexact depth maps."""

from __future__ import annotations

import pytest

from mpsfm_core.testing.posed_room import PosedRoom, make_posed_room


@pytest.fixture(scope="session")
def room() -> PosedRoom:
    return make_posed_room()
