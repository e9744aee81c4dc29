"""Tests of COLMAP models of photos with EXIF orientation: cameras, poses, exports."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from mpsfm_core.data import Float64, Pose
from mpsfm_core.geometry import rotation_angle_deg
from mpsfm_core.inputs.images import load_images
from mpsfm_core.inputs.models import read_poses
from mpsfm_core.results.exports.formats import export

NAMES = [f"000{number}.jpg" for number in range(2, 7)]
"""Photos of the fountain, reduced to 640 pixels."""
TURNS = {
    3: Image.Transpose.ROTATE_180,
    6: Image.Transpose.ROTATE_90,
    8: Image.Transpose.ROTATE_270,
}
"""Function by EXIF orientation that converts upright pixels to stored pixels."""

pytestmark = pytest.mark.slow


def write_photos(fountain: Path, folder: Path, flag: int) -> Path:
    folder.mkdir()
    for name in NAMES:
        with Image.open(fountain / "images" / name) as photo:
            photo.thumbnail((640, 640))
            exif = Image.Exif()
            exif[0x0112] = flag
            stored = photo.transpose(TURNS[flag]) if flag in TURNS else photo
            stored.save(folder / name, exif=exif, quality=95)
    return folder


def map_with_colmap(photos: Path, output: Path) -> Path:
    """Reconstruct with COLMAP, which ignores the orientation."""
    database = output.with_suffix(".db")
    mode = pycolmap.CameraMode.SINGLE
    pycolmap.extract_features(database, photos, camera_mode=mode)
    pycolmap.match_exhaustive(database)
    models = pycolmap.incremental_mapping(database, photos, output)
    best = max(models, key=lambda number: models[number].num_reg_images())
    return output / str(best)


def relative_rotations(poses: dict[str, Pose]) -> Float64:
    first = poses[NAMES[0]][0]
    return np.stack([poses[name][0] @ first.T for name in NAMES])


@pytest.fixture(scope="module")
def fountain(shared_data: Path) -> Path:
    return shared_data / "data" / "fountain"


@pytest.fixture(scope="module")
def upright(fountain: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Pose]:
    folder = tmp_path_factory.mktemp("upright")
    photos = write_photos(fountain, folder / "photos", 1)
    return read_poses(map_with_colmap(photos, folder / "model"), photos)


@pytest.mark.parametrize("flag", TURNS)
def test_colmap_model_of_rotated_photos_equals_that_of_upright_ones(
    fountain: Path, upright: dict[str, Pose], tmp_path: Path, flag: int
) -> None:
    photos = write_photos(fountain, tmp_path / "photos", flag)
    folder = map_with_colmap(photos, tmp_path / "model")
    poses = read_poses(folder, photos)
    assert set(poses) == set(upright) == set(NAMES)
    truth = np.swapaxes(relative_rotations(upright), 1, 2)
    assert rotation_angle_deg(relative_rotations(poses) @ truth).max() < 0.2
    for source in (folder, tmp_path / "model.db"):
        width, height = load_images(photos, source)[0].original_size
        assert width > height
    export(folder, "gsplat", tmp_path / "out", photos=photos)
    check_colors(tmp_path / "out")


def check_colors(folder: Path) -> None:
    """The photos have the colors of the model's 3D points at the projections of the points."""
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    for image in model.images.values():
        with Image.open(folder / "images" / image.name) as picture:
            rgb = np.asarray(picture).astype(int)
        points = [point for point in image.points2D if point.has_point3D()]
        xy = np.array([point.xy for point in points]).astype(int)
        colors = np.array([model.points3D[point.point3D_id].color for point in points])
        assert np.abs(rgb[xy[:, 1], xy[:, 0]] - colors).mean() < 15
