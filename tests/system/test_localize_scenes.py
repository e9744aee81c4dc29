"""Test of localization on real photos."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

import mpsfm_core
from mpsfm_core.geometry import camera_center, rotation_angle_deg
from mpsfm_core.inputs.models import reconstruction_poses


@pytest.mark.slow
def test_photos_of_a_fountain_are_localized_in_a_model_of_three_photos(
    shared_data: Path, tmp_path: Path
) -> None:
    scene = shared_data / "data" / "fountain"
    truth = pycolmap.Reconstruction(str(scene / "gt"))
    poses = reconstruction_poses(truth)
    model, queries = ("0003.jpg", "0005.jpg", "0007.jpg"), ("0004.jpg", "0006.jpg")
    for image in list(truth.images.values()):
        if str(image.name) not in model:
            truth.deregister_frame(image.frame_id)
    for folder in ("model", "photos"):
        (tmp_path / folder).mkdir()
    truth.write(str(tmp_path / "model"))
    for name in queries:
        (tmp_path / "photos" / name).symlink_to((scene / "images" / name).resolve())
    result = mpsfm_core.localize(
        tmp_path / "model",
        tmp_path / "photos",
        config="sift",
        images=scene / "images",
        intrinsics=scene / "intrinsics.yaml",
        overrides=[
            "depth.use=flat",
            "normals.use=from-depth",
            "features.options.max_keypoints=1500",
            f"runtime.cache_dir={tmp_path / 'cache'}",
        ],
    )
    assert sorted(result.photos) == list(queries)
    for name, photo in result.photos.items():
        rotation, translation = poses[name]
        assert rotation_angle_deg(photo.pose[0] @ rotation.T) < 0.2
        assert np.linalg.norm(photo.center - camera_center(rotation, translation)) < 0.03
