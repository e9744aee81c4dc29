"""Mapping problem that tests of several modules reconstruct."""

from __future__ import annotations

import pytest

from mpsfm_core.data import MappingProblem, PinholeCamera
from mpsfm_core.testing.synthetic.problems import SyntheticNoise, make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 160.0, 120.0)


@pytest.fixture(scope="module")
def problem() -> MappingProblem:
    """Return the mapping problem of four views on an arc."""
    return make_mapping_problem(
        room_scene(), CAMERA, arc_poses(4, 21.0), noise=SyntheticNoise(keypoints_px=0.3, depth=0.01)
    )
