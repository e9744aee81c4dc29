"""Tests of inputs from public issues of other programs, which docs/tested-inputs.md lists."""

from __future__ import annotations

import json
import re
from copy import copy
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pycolmap
import pytest
import tifffile
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.image_search import find_images
from mpsfm_core.inputs.images import ImageSet, load_images
from mpsfm_core.inputs.matches import matches_from_hloc
from mpsfm_core.inputs.models import read_poses
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.results.exports.formats import export
from mpsfm_core.results.original_images import export_view

SIZE = (96, 64)
NAMES = ("a.jpg", "b.jpg", "c.jpg")


def picture(number: int = 0) -> Image.Image:
    rng = np.random.default_rng(number)
    return Image.fromarray(rng.integers(0, 256, (*SIZE[::-1], 3), np.uint8)).convert("RGB")


def write_photos(folder: Path, names: tuple[str, ...] = ("a.jpg", "b.jpg"), **save: Any) -> Path:
    for number, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        picture(number).save(folder / name, **save)
    return folder


def write_model(folder: Path, cameras: dict[str, pycolmap.Camera]) -> Path:
    """Write a COLMAP model of images that face +z from (-1, 0, 0), (-2, 0, 0), ... by name."""
    reconstruction = pycolmap.Reconstruction()
    for number, (name, camera) in enumerate(cameras.items(), start=1):
        camera.camera_id = number
        reconstruction.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=name, camera_id=number, image_id=number)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), [number, 0, 0])
        reconstruction.add_image_with_trivial_frame(image, pose)
    for point in np.random.default_rng(0).uniform(3, 5, (30, 3)):
        reconstruction.add_point3D(point, pycolmap.Track(), np.zeros(3, np.uint8))
    folder.mkdir()
    reconstruction.write_binary(str(folder))
    return folder


def create_camera(model: str, size: tuple[int, int] = SIZE) -> pycolmap.Camera:
    return pycolmap.Camera.create_from_model_name(1, model, 90.0, *size)


def exif(main: dict[int, Any] | None = None, **directories: dict[int, Any]) -> Image.Exif:
    tags = Image.Exif()
    tags.update(main or {})
    tags.get_ifd(0x8769).update(directories.get("photo", {}))
    tags.get_ifd(0x8825).update(directories.get("gps", {}))
    return tags


def load(folder: Path, **options: Any) -> ImageSet:
    images = load_images(folder, **options)
    for index in range(len(images)):
        assert images.view(index).image.shape[:2] == images[index].pinhole.size[::-1]
    return images


@pytest.mark.parametrize("orientation", [0, 9, 255])
def test_unknown_exif_orientation_is_upright(tmp_path: Path, orientation: int) -> None:
    """colmap/colmap#4322: orientation 0 in EXIF ends the program."""
    photos = write_photos(tmp_path, exif=exif({0x112: orientation}))
    assert {image.original_size for image in load(photos)} == {SIZE}


def test_exif_size_of_another_orientation_does_not_change_the_size(tmp_path: Path) -> None:
    """colmap/colmap#1316: images are imported with transposed dimensions."""
    tags = exif(photo={0xA002: SIZE[1], 0xA003: SIZE[0], 0xA405: 30})
    images = load(write_photos(tmp_path, exif=tags))
    assert images[0].original_size == SIZE and images[0].focal_source == "exif"


@pytest.mark.parametrize("model", ["EUCM", "FULL_OPENCV", "SIMPLE_RADIAL_FISHEYE"])
def test_cameras_of_rare_models_are_undistorted(tmp_path: Path, model: str) -> None:
    """colmap/colmap#4557 and nerfstudio-project/gsplat#813: camera models are not supported."""
    camera = pycolmap.Camera.create_from_model_name(1, model, 90.0, *SIZE)
    text = f"1:\n  model: {model}\n  params: {camera.params.tolist()}\n  images: all\n"
    (tmp_path / "camera.yaml").write_text(text)
    photos = write_photos(tmp_path / "photos")
    images = load(photos, intrinsics=tmp_path / "camera.yaml")
    assert images[0].camera.model_name == model
    assert images[0].pinhole.fx == pytest.approx(90, rel=0.05)


@pytest.mark.parametrize("flag", [1, 6])
@pytest.mark.parametrize("suffix", [".png", ".webp"])
def test_transparent_pixels_of_photos_are_masked(tmp_path: Path, suffix: str, flag: int) -> None:
    """colmap/colmap#3806: Transparent pixels of PNG photos are not read."""
    pixels = np.dstack([np.asarray(picture()), np.full(SIZE[::-1], 255, np.uint8)])
    for name, top in (("a", 0), ("b", 255), ("c", 255)):
        pixels[:20, :, 3] = top
        saved = Image.fromarray(pixels if name != "c" else pixels * np.uint8([1, 1, 1, 0]))
        saved.save(
            tmp_path / f"{name}{suffix}", lossless=True, exact=True, exif=exif({0x112: flag})
        )
    images = load(tmp_path)
    expected = np.ones(SIZE[::-1], np.bool_)
    expected[:20] = False
    expected = expected if flag == 1 else np.rot90(expected, -1)
    np.testing.assert_array_equal(images.mask(0), expected)
    np.testing.assert_array_equal(images.view(0).mask, expected)
    assert images.mask(1) is None and images.mask(2) is None  # all or no pixels are opaque
    (tmp_path / "masks").mkdir()
    Image.new("L", SIZE, 255).save(tmp_path / "masks" / "a.png")
    masked = load(tmp_path, options=InputOptions(masks=tmp_path / "masks"))
    assert masked.view(0).mask is not None and masked.view(0).mask.all()


def test_one_mask_for_a_folder_of_photos_is_not_guessed(tmp_path: Path) -> None:
    """colmap/colmap#1251: one mask for all images of a camera."""
    photos = write_photos(tmp_path / "photos", ("front/a.jpg", "front/b.jpg"))
    (tmp_path / "masks").mkdir()
    Image.new("L", SIZE, 255).save(tmp_path / "masks" / "front.png")
    with pytest.raises(InputError, match=r"no file is the mask of an image.*front/a\.jpg\.png"):
        load(photos, options=InputOptions(masks=tmp_path / "masks"))


def test_query_lists_of_hloc_are_intrinsics(tmp_path: Path) -> None:
    """cvg/Hierarchical-Localization#80: cameras in a list of queries with intrinsics."""
    photos = write_photos(tmp_path / "photos", ("day/a.jpg", "b.jpg"))
    lines = ["day/a.jpg SIMPLE_RADIAL 96 64 90 48 32 0.01", "b.jpg PINHOLE 96 64 80 81 48 32"]
    (tmp_path / "queries.txt").write_text("\n".join(lines))
    images = load(photos, intrinsics=tmp_path / "queries.txt")
    cameras = {image.name: image.camera for image in images}
    assert cameras["day/a.jpg"].params.tolist() == [90, 48, 32, 0.01]
    assert cameras["b.jpg"].params.tolist() == [80, 81, 48, 32]
    (tmp_path / "queries.txt").write_text("day/a.jpg SIMPLE_RADIAL 96 64 90 48 32 0.01")
    with pytest.raises(InputError, match=r"no camera for image 'b\.jpg'"):
        load(photos, intrinsics=tmp_path / "queries.txt")


def test_thumbnails_and_system_files_are_no_photos(tmp_path: Path) -> None:
    """nerfstudio-project/nerfstudio#738 and Fyusion/LLFF#36: small files between the photos."""
    names = ("._a.jpg", ".DS_Store", "crmeta.db", "Thumbs.db", "desktop.ini", "a.json")
    write_photos(tmp_path, ("a.jpg", "b.jpg", "@eaDir/a.jpg/THUMB.jpg", ".thumbnails/a.jpg"))
    (tmp_path / "__MACOSX").mkdir()
    for name in (*names, "__MACOSX/a.jpg"):
        (tmp_path / name).write_bytes(b"?")
    assert find_images(tmp_path) == ["a.jpg", "b.jpg"]


def test_extensions_sizes_and_periods_may_be_mixed(tmp_path: Path) -> None:
    """nerfstudio-project/nerfstudio#3024, #3468, #1648: extensions, sizes, periods in names."""
    photos = write_photos(tmp_path, ("a.jpg", "b.PNG", "c.problem.d.jpg"))
    picture(3).resize((48, 32)).save(tmp_path / "e.JPEG")
    images = load(photos)
    assert images.names == ["a.jpg", "b.PNG", "c.problem.d.jpg", "e.JPEG"]
    assert images[3].original_size == (48, 32)


def test_masks_of_one_bit_between_the_photos_are_no_photos(tmp_path: Path, caplog) -> None:
    """nerfstudio-project/nerfstudio#1278: masks are processed as photos."""
    photos = write_photos(tmp_path)
    for stem in "ab":
        Image.new("1", SIZE, 1).save(tmp_path / f"{stem}_mask.png")
    assert find_images(photos) == ["a.jpg", "b.jpg"]
    assert "--set inputs.masks=" in caplog.text


@pytest.mark.parametrize(
    ("gps", "expected"),
    [
        ({1: "N", 2: (0.0, 0.0, 0.0), 3: "E", 4: (0.0, 0.0, 0.0)}, None),
        ({2: (47.0, 30.0, 0.0), 4: (8.0, 15.0, 0.0)}, (47.5, 8.25)),
    ],
)
def test_gps_of_drones_with_zeros_or_without_references(
    tmp_path: Path, gps: dict[int, Any], expected: tuple[float, float] | None
) -> None:
    """OpenDroneMap/ODM#1412 and #1465: without references the position is north and east."""
    (first, _) = load(write_photos(tmp_path, exif=exif(gps=gps)))
    found = None if first.gps is None else (first.gps.latitude, first.gps.longitude)
    assert found == expected


@pytest.mark.parametrize(
    "photo",
    [{0x920A: 0.0}, {0x920A: float("nan"), 0xA405: 0}, {0x927C: b"DJI\x00" + bytes(range(60))}],
)
def test_damaged_exif_of_drones_gives_the_default_focal_length(
    tmp_path: Path, photo: dict[int, Any]
) -> None:
    """WebODM/WebODM#150, OpenDroneMap/ODM#2077: zero denominators and MakerNote."""
    images = load(write_photos(tmp_path, exif=exif(photo=photo)))
    assert images[0].focal_source == "default"


def test_damaged_photos_are_left_out(tmp_path: Path, caplog) -> None:
    """OpenDroneMap/ODM#1349, #402: a cut-off JPEG and a file that is not an image."""
    photos = write_photos(tmp_path, ("a.jpg", "b.jpg", "c.jpg", "d.jpg"))
    (tmp_path / "a.jpg").write_bytes((tmp_path / "a.jpg").read_bytes()[:900])
    (tmp_path / "test.JPG").write_bytes(b"no image")
    images = load(photos)
    assert images.names == ["b.jpg", "c.jpg", "d.jpg"]
    assert set(images.left_out) == {"a.jpg", "test.JPG"} and "Copy the image" in caplog.text


def test_bands_of_16_bits_next_to_photos_are_photos(tmp_path: Path) -> None:
    """OpenDroneMap/ODM#1238: 8-bit JPEG and 16-bit TIFF files of the same names."""
    photos = write_photos(tmp_path)
    for stem in "ab":
        band = np.full(SIZE[::-1], 25700, np.uint16)
        Image.fromarray(band).save(tmp_path / f"{stem}.tif")
    images = load(photos)
    assert images.names == ["a.jpg", "a.tif", "b.jpg", "b.tif"]
    assert (images.view(1).image == 100).all()


def test_exif_of_rendered_tiffs_is_read(tmp_path: Path) -> None:
    """alicevision/Meshroom#601: TIFF files of a renderer contain a focal length."""
    for name in ("a.tif", "b.tif"):
        tags = [(0xA405, "H", 1, 36, True)]
        tifffile.imwrite(tmp_path / name, np.asarray(picture()), extratags=tags)
    images = load(tmp_path)
    diagonal = np.hypot(*SIZE) / np.hypot(36, 24)
    assert images[0].focal_source == "exif"
    assert images[0].pinhole.fx == pytest.approx(36 * diagonal, rel=1e-3)


def test_raw_extension_of_another_image_is_one_message(tmp_path: Path, caplog) -> None:
    """nerfstudio-project/nerfstudio#2119: raw files, here one that is a TIFF."""
    photos = write_photos(tmp_path, ("a.jpg", "b.jpg", "c.jpg", "d.tif"))
    (tmp_path / "d.tif").rename(tmp_path / "d.CR2")
    assert load(photos).names == ["a.jpg", "b.jpg", "c.jpg"]
    assert "d.CR2 cannot be decoded" in caplog.text


@pytest.mark.parametrize(
    "folder", ["za\u017c\u00f3\u0142\u0107", "\u5199\u771f \u30d5\u30a9\u30c8"]
)
def test_folders_of_other_scripts(tmp_path: Path, folder: str) -> None:
    """alicevision/Meshroom#1971: a letter that is not English in the folder name."""
    assert load(write_photos(tmp_path / folder)).names == ["a.jpg", "b.jpg"]


def test_progressive_jpeg_with_color_profile(tmp_path: Path) -> None:
    """alicevision/Meshroom#2065: photos of a phone are not opened."""
    photos = write_photos(tmp_path, progressive=True, icc_profile=b"\0" * 200)
    assert len(load(photos)) == 2


def test_portrait_photos_keep_their_pixels_and_intrinsics(tmp_path: Path) -> None:
    """facebookresearch/vggt#99, #297, naver/mast3r#71: crops and sizes of the network."""
    for name in ("a.png", "b.png"):
        picture().resize((54, 96)).save(tmp_path / name)
    (tmp_path / "k.yaml").write_text("1:\n  params: [90, 91, 27, 48]\n  images: all\n")
    (first, _) = load(tmp_path, intrinsics=tmp_path / "k.yaml")
    assert first.original_size == first.pinhole.size == (54, 96)
    assert first.pinhole.params.tolist() == [90, 91, 27, 48]


def test_equirectangular_photos_name_a_remedy(tmp_path: Path) -> None:
    """cvg/mpsfm#10: photos of 360 degrees."""
    xmp = b'<rdf:Description GPano:ProjectionType="equirectangular"/>'
    with pytest.raises(InputError, match=r"panorama \(equirectangular\).*--projection"):
        load(write_photos(tmp_path, xmp=xmp))


def test_one_photo_is_too_few(tmp_path: Path) -> None:
    """naver/dust3r#27: too few photos."""
    with pytest.raises(InputError, match="needs two or more images"):
        load(write_photos(tmp_path, ("a.PNG",)))


def test_camera_of_some_photos_names_the_others(tmp_path: Path) -> None:
    """cvg/mpsfm#13: intrinsics of each photo."""
    photos = write_photos(tmp_path / "photos")
    (tmp_path / "k.yaml").write_text("1:\n  params: [90, 90, 48, 32]\n  images: [a.jpg]\n")
    with pytest.raises(InputError, match=r"no camera for image 'b\.jpg'.*images: all"):
        load(photos, intrinsics=tmp_path / "k.yaml")
    images = load(photos)
    assert {image.focal_source for image in images} == {"default"}


def test_depth_of_a_frame_is_matched_by_name_not_by_order(tmp_path: Path) -> None:
    """facebookresearch/vggt#42: images are saved to the wrong cameras."""
    names = ("10.jpg", "9.jpg", "100.jpg")
    frames = [
        {"file_path": n, "transform_matrix": np.eye(4).tolist(), "fl_x": 50.0 + len(n)}
        for n in names
    ]
    (tmp_path / "t.json").write_text(json.dumps({"w": 96, "h": 64, "frames": frames}))
    images = load(write_photos(tmp_path / "p", names), intrinsics=tmp_path / "t.json")
    assert images.names == ["9.jpg", "10.jpg", "100.jpg"]
    assert [image.pinhole.fx for image in images] == [55, 56, 57]


def test_matches_with_photos_that_are_not_there_are_skipped(tmp_path: Path) -> None:
    """cvg/Hierarchical-Localization#277: a pair names a photo that is not reconstructed."""
    files = tmp_path / "features.h5", tmp_path / "matches.h5"
    with h5py.File(files[0], "w") as features, h5py.File(files[1], "w") as matches:
        for stem in "abx":
            features[f"{stem}.jpg/keypoints"] = np.full((20, 2), 9, np.float32)
        for first, second in ("ab", "ax"):
            matches[f"{first}.jpg/{second}.jpg/matches0"] = np.arange(20)
    imported = matches_from_hloc(*files, load(write_photos(tmp_path / "photos")))
    assert [len(xy) for xy in imported.keypoints] == [20, 20]
    assert list(imported.matches) == [(0, 1)]


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "SIMPLE_RADIAL_FISHEYE"])
def test_exports_for_splatting_have_pinhole_cameras(tmp_path: Path, model: str) -> None:
    """nerfstudio-project/gsplat#813, WebODM/OpenSplat#72: camera type not supported."""
    photos = write_photos(tmp_path / "photos", NAMES)
    camera = create_camera(model)
    camera.params = [90, 48, 32, 0.02]
    write_model(tmp_path / "model", {name: copy(camera) for name in NAMES})
    export(tmp_path / "model", "gsplat", tmp_path / "out", photos=photos)
    exported = pycolmap.Reconstruction(str(tmp_path / "out" / "sparse" / "0"))
    assert {camera.model_name for camera in exported.cameras.values()} == {"PINHOLE"}
    for name, pinhole in ((image.name, image.camera) for image in exported.images.values()):
        with Image.open(tmp_path / "out" / "images" / name) as image:
            assert image.size == (pinhole.width, pinhole.height)


@pytest.mark.parametrize("flag", [1, 6])
def test_undistorted_photos_keep_their_exposure(tmp_path: Path, flag: int) -> None:
    """MrNeRF/LichtFeld-Studio#1783: undistorted copies of photos have no exposure in EXIF."""
    exposure = {0x829A: IFDRational(1, 250), 0x829D: IFDRational(2.8), 0x8827: 200}
    tags = exif({0x112: flag, 0x10F: "maker"}, photo={**exposure, 0x920A: 4.2})
    images = load_images(write_photos(tmp_path / "photos", exif=tags))
    export_view(images, 0, tmp_path / "copied.jpg")
    path = tmp_path / "camera.yaml"
    size = list(SIZE if flag == 1 else SIZE[::-1])
    path.write_text(
        f"1:\n  model: SIMPLE_RADIAL\n  params: [90, {size[0] / 2}, {size[1] / 2}, 0.1]\n"
        f"  width: {size[0]}\n  height: {size[1]}\n  images: all\n"
    )
    export_view(load_images(tmp_path / "photos", intrinsics=path), 0, tmp_path / "undistorted.jpg")
    for name in ("copied.jpg", "undistorted.jpg"):
        with Image.open(tmp_path / name) as exported:
            written = exported.getexif()
        directory = written.get_ifd(0x8769)
        for tag, value in exposure.items():
            assert float(directory[tag]) == pytest.approx(float(value))
        assert written.get(0x112, 1) == 1


def test_photos_without_exposure_are_exported_without_exif(tmp_path: Path) -> None:
    images = load_images(write_photos(tmp_path / "photos", exif=exif({0x112: 6})))
    export_view(images, 0, tmp_path / "upright.jpg")
    with Image.open(tmp_path / "upright.jpg") as exported:
        assert exported.size == SIZE[::-1] and not exported.getexif()


def test_models_without_rigs_and_frames_are_read(tmp_path: Path) -> None:
    """cvg/mpsfm#34: models of COLMAP before version 3.12 have no frames."""
    photos = write_photos(tmp_path / "photos", NAMES)
    write_model(tmp_path / "model", {n: create_camera("SIMPLE_PINHOLE") for n in NAMES})
    for name in ("rigs.bin", "frames.bin"):
        (tmp_path / "model" / name).unlink()
    images = load_images(photos, intrinsics=tmp_path / "model")
    assert [image.pinhole.fx for image in images] == [90, 90, 90]
    poses = read_poses(tmp_path / "model")
    assert [poses[image.name][1][0] for image in images] == [1, 2, 3]


def test_photos_of_different_sizes_are_exported_in_their_sizes(tmp_path: Path) -> None:
    """graphdeco-inria/gaussian-splatting#947: all images should have the same size."""
    sizes = {"a.jpg": (96, 64), "b.jpg": (64, 96), "c.jpg": (48, 32)}
    (tmp_path / "photos").mkdir()
    for name, size in sizes.items():
        picture().resize(size).save(tmp_path / "photos" / name)
    cameras = {name: create_camera("SIMPLE_PINHOLE", size) for name, size in sizes.items()}
    write_model(tmp_path / "model", cameras)
    export(tmp_path / "model", "gsplat", tmp_path / "out", photos=tmp_path / "photos")
    exported = pycolmap.Reconstruction(str(tmp_path / "out" / "sparse" / "0"))
    written = {image.name: image.camera for image in exported.images.values()}
    for name, size in sizes.items():
        assert (written[name].width, written[name].height) == size
        with Image.open(tmp_path / "out" / "images" / name) as image:
            assert image.size == size


def test_page_of_tested_inputs_names_existing_tests() -> None:
    tests = Path(__file__).parents[1]
    page = (tests.parent / "docs" / "tested-inputs.md").read_text(encoding="utf-8")
    sources = "".join(path.read_text(encoding="utf-8") for path in tests.rglob("test_*.py"))
    named = set(re.findall(r"`(test_\w+)`", page))
    assert len(named) > 60
    assert not [name for name in named if f"def {name}(" not in sources]
