"""Tests of keypoints and matches from COLMAP databases and from files of hloc."""

from __future__ import annotations

from pathlib import Path

import cv2
import h5py
import numpy as np
import pycolmap
import pytest

from mpsfm_core.data import PinholeCamera
from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.colmap_database import read_database
from mpsfm_core.inputs.image_decoding import apply_orientation_to_pixels, orient
from mpsfm_core.inputs.images import ImageSet, load_images
from mpsfm_core.inputs.intrinsics import read_intrinsics
from mpsfm_core.inputs.matches import matches_from_database, matches_from_hloc
from mpsfm_core.testing.synthetic.scenes import arc_poses, project, room_scene

SIZE = (160, 120)
CAMERA = PinholeCamera(*SIZE, 140.0, 140.0, 80.0, 60.0)
POSES = arc_poses(3, 12.0)
NAMES = ["a/0.png", "a/1.png", "2.png"]


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> ImageSet:
    folder = tmp_path_factory.mktemp("photos")
    scene = room_scene()
    for name, pose in zip(NAMES, POSES, strict=True):
        (folder / name).parent.mkdir(exist_ok=True)
        bgr = cv2.cvtColor(scene.render(CAMERA, pose).rgb, cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(folder / name), bgr)
    intrinsics = folder / "intrinsics.yaml"
    intrinsics.write_text("1: {model: RADIAL, params: [140, 80, 60, 0.05, 0.01], images: all}\n")
    return load_images(folder, intrinsics, names=NAMES)


@pytest.fixture(scope="module")
def seen() -> list[np.ndarray]:
    """Return the pixels of the same forty surface points in each photo."""
    rng = np.random.default_rng(0)
    points = room_scene().sample(CAMERA, POSES[0], rng.uniform([50, 35], [110, 85], (40, 2))).points
    return [project(CAMERA, pose, points)[0] for pose in POSES]


def write_database(path: Path, seen: list[np.ndarray], *, verified_only: bool = False) -> Path:
    """Return keypoints in another order in each image, so that keypoint indices differ."""
    with pycolmap.Database.open(str(path)) as database:
        camera = pycolmap.Camera(
            model="SIMPLE_RADIAL", width=160, height=120, params=[140, 80, 60, 0]
        )
        camera_id = database.write_camera(camera)
        ids = []
        for number, (name, xy) in enumerate(zip(NAMES, seen, strict=True)):
            ids.append(database.write_image(pycolmap.Image(name=name, camera_id=camera_id)))
            shape = np.zeros((len(xy), 6), np.float32)
            shape[:, :2] = np.roll(xy, number, axis=0)
            database.write_keypoints(ids[-1], shape)
        rows = np.arange(40)
        for first, second in ((0, 1), (1, 2)):
            columns = [(rows + first) % 40, (rows + second) % 40]
            matches = np.stack(columns, axis=1).astype(np.uint32)
            if verified_only:
                geometry = pycolmap.TwoViewGeometry(inlier_matches=matches, config=2)
                database.write_two_view_geometry(ids[first], ids[second], geometry)
            else:
                database.write_matches(ids[first], ids[second], matches)
    return path


def check(imported, images: ImageSet, seen: list[np.ndarray]) -> None:
    assert sorted(imported.matches) == [(0, 1), (1, 2)]
    for (first, second), matches in imported.matches.items():
        assert len(matches) >= 30  # keypoints inside the undistorted views
        for side, index in enumerate((first, second)):
            xy = imported.keypoints[index][matches.indices[:, side]]
            original = images[index].original_pixels(xy)
            distance = np.linalg.norm(original[:, None] - seen[index][None], axis=2)
            assert distance.min(axis=1).max() < 0.02
            rows = distance.argmin(axis=1)
            other = images[first + second - index]
            there = imported.keypoints[first + second - index][matches.indices[:, 1 - side]]
            expected = seen[first + second - index][rows]
            assert np.abs(other.original_pixels(there) - expected).max() < 0.02


@pytest.mark.parametrize("verified_only", [False, True])
def test_database_gives_matches_of_the_same_points(
    images: ImageSet, seen, tmp_path: Path, verified_only: bool
) -> None:
    path = write_database(tmp_path / "m.db", seen, verified_only=verified_only)
    before = path.read_bytes()
    check(matches_from_database(path, images), images, seen)
    assert path.read_bytes() == before


def test_database_gives_cameras(seen, tmp_path: Path) -> None:
    intrinsics = read_intrinsics(write_database(tmp_path / "m.db", seen))
    camera = intrinsics.camera("a/1.png", SIZE)
    assert camera.model_name == "SIMPLE_RADIAL"
    assert camera.params.tolist() == [140, 80, 60, 0]


def test_database_written_by_colmap_is_read(images: ImageSet, tmp_path: Path) -> None:
    path = tmp_path / "colmap.db"
    with pycolmap.Database.open(str(path)):
        pass
    folder = images[0].path.parents[1]
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads, options.use_gpu = 1, False
    pycolmap.extract_features(str(path), str(folder), image_names=NAMES, extraction_options=options)
    database = read_database(path)
    assert sorted(database.images) == sorted(NAMES)
    with pycolmap.Database.open(str(path)) as opened:
        for number in database.images.values():
            xy = opened.read_keypoints(number)[:, :2]
            assert len(xy) > 20
            np.testing.assert_array_equal(database.keypoints[number], xy)


def write_hloc(folder: Path, seen: list[np.ndarray], separator: str = "/") -> tuple[Path, Path]:
    features, matches = folder / "feats.h5", folder / "matches.h5"
    with h5py.File(features, "w") as file:
        for name, xy in zip(NAMES, seen, strict=True):
            group = file.create_group(name)
            group.create_dataset("keypoints", data=xy - 0.5)
            group["keypoints"].attrs["uncertainty"] = 1.5
            group.create_dataset("image_size", data=np.array(SIZE))
            group.create_dataset("descriptors", data=np.zeros((4, len(xy)), np.float16))
    target = np.arange(40, dtype=np.int16)
    target[5] = -1
    with h5py.File(matches, "w") as file:
        for first, second in ((0, 1), (2, 1)):
            pair = separator.join(NAMES[n].replace("/", "-") for n in (first, second))
            group = file.create_group(pair)
            group.create_dataset("matches0", data=target)
            group.create_dataset("matching_scores0", data=np.full(40, 0.5, np.float16))
    return features, matches


@pytest.mark.parametrize("separator", ["/", "_"])
def test_hloc_files_give_matches_of_the_same_points(
    images: ImageSet, seen, tmp_path: Path, separator: str
) -> None:
    imported = matches_from_hloc(*write_hloc(tmp_path, seen, separator), images)
    check(imported, images, seen)
    assert set(imported.matches[0, 1].scores) == {0.5}
    assert imported.std_px[0] == pytest.approx(1.5, rel=0.2)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_keypoints_rotate_with_their_photo(orientation: int) -> None:
    stored = np.zeros((4, 6, 3), np.uint8)
    stored[1, 4] = 255
    upright = orient(stored, orientation)
    (x, y) = apply_orientation_to_pixels(np.array([[4.5, 1.5]]), (6, 4), orientation)[0]
    assert upright[int(y), int(x)].tolist() == [255] * 3


def test_matches_of_photos_of_another_size_are_refused(
    images: ImageSet, seen, tmp_path: Path
) -> None:
    features, matches = write_hloc(tmp_path, seen)
    with h5py.File(features, "a") as file:
        file[NAMES[1]]["image_size"][...] = (320, 240)
    with pytest.raises(InputError, match="320x240 pixels, but the photo 160x120"):
        matches_from_hloc(features, matches, images)


def test_matches_without_their_keypoints_are_refused(
    images: ImageSet, seen, tmp_path: Path
) -> None:
    path = write_database(tmp_path / "m.db", [seen[0], seen[1][:30], seen[2]])
    with pytest.raises(InputError, match=r"refers to keypoint 39 of 'a/1\.png', which has 30"):
        matches_from_database(path, images)


def test_database_of_other_photos_raises(images: ImageSet, tmp_path: Path) -> None:
    with pycolmap.Database.open(str(tmp_path / "m.db")):
        pass
    with pytest.raises(InputError, match="keypoints of none of the images"):
        matches_from_database(tmp_path / "m.db", images)
