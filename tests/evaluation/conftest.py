"""Fixture of a scene folder with rendered images, true poses and true depth."""

from __future__ import annotations

from pathlib import Path

import cv2
import pycolmap
import pytest

from mpsfm_core.data import PinholeCamera
from mpsfm_core.evaluation.prior_quality import write_depth
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(320, 240, 280.0, 280.0, 160.0, 120.0)
POSES = arc_poses(5, 14.0)
NAMES = [f"{number:04d}.png" for number in range(len(POSES))]

SETS = """
all:
- images: [0000, 0001, 0002, 0003, 0004]
triplets:
  20-40:
  - [0000, 0001, 0002]
  - [0002, 0003, 0004]
"""


@pytest.fixture(scope="session")
def scene_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a scene folder with five images on an arc; tests must not change the folder."""
    folder = tmp_path_factory.mktemp("scenes") / "room"
    for name in ("images", "gt"):
        (folder / name).mkdir(parents=True)
    room, model = room_scene(), pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="PINHOLE", width=320, height=240, params=CAMERA.params, camera_id=1
    )
    model.add_camera_with_trivial_rig(camera)
    for number, (name, pose) in enumerate(zip(NAMES, POSES, strict=True)):
        rendering = room.render(CAMERA, pose)
        cv2.imwrite(str(folder / "images" / name), rendering.rgb[..., ::-1])
        write_depth(folder / "gt_depth" / name, rendering.depth)
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=name, camera_id=1, image_id=number + 1), pycolmap.Rigid3d(pose)
        )
    model.write_text(str(folder / "gt"))
    (folder / "testsets.yaml").write_text(SETS)
    return folder
