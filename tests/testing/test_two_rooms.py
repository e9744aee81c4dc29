"""Tests of the synthetic mapping problem with two similar rooms."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.geometry import camera_center
from mpsfm_core.testing.synthetic.two_rooms import make_twin_room_poses

WARDROBE = (2.0, 3.2, 0.0), (4.6, 4.0, 1.9)
BOOKSHELF = (5.2, 0.6, 0.0), (6.0, 2.4, 2.1)


@pytest.mark.parametrize("seed", [0, 4, 6])
def test_nobody_stands_inside_the_furniture(seed: int) -> None:
    poses, room = make_twin_room_poses(seed)
    centers = np.array([camera_center(pose[:, :3], pose[:, 3]) for pose in poses])
    for low, high in (WARDROBE, BOOKSHELF):
        assert not ((centers > low) & (centers < high)).all(axis=1).any()
    # Cameras that are moved out of furniture are still inside the room.
    inside = (centers[:, 1] > 0) & (centers[:, 1] < 4)
    assert inside[np.array(room) >= 0].all()
