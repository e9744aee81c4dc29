"""Tests from an image folder to views: found, refused, loaded and cached images."""

from __future__ import annotations

import json
import logging
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from mpsfm_core.data.camera_models import CameraModel
from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs import images as module
from mpsfm_core.inputs.image_search import check_output_folder, find_images
from mpsfm_core.inputs.images import ImageSet, load_images
from mpsfm_core.inputs.options import InputOptions

INTRINSICS = "1: {params: [70, 70, 40, 30], images: all}"
DISTORTED = "1: {model: SIMPLE_RADIAL, params: [70, 40, 30, 0.2], images: all}"


@pytest.fixture
def folder(tmp_path: Path, write_image) -> Path:
    write_image("img10.png")
    write_image("img2.jpg")
    write_image("side/A.PNG".lower())
    (tmp_path / "images" / "notes.txt").write_text("no image")
    (tmp_path / "images" / ".hidden.png").write_bytes(b"no image either")
    return tmp_path / "images"


@pytest.fixture
def intrinsics(tmp_path: Path) -> Path:
    path = tmp_path / "intrinsics.yaml"
    path.write_text(INTRINSICS)
    return path


def refused(*arguments: object) -> str:
    with pytest.raises(InputError) as caught:
        load_images(*arguments)
    return str(caught.value)


def write_list(tmp_path: Path, *names: str) -> Path:
    path = tmp_path / "list.txt"
    path.write_text("# a comment\n\n" + "\n".join(names) + "\n")
    return path


def test_load_images_sorts_names_naturally(folder: Path, intrinsics: Path) -> None:
    found = load_images(folder, intrinsics)
    assert found.names == ["img2.jpg", "img10.png", "side/a.png"]
    assert [image.focal_source for image in found] == ["intrinsics"] * 3
    assert all(image.focal_known for image in found)
    assert found[0].pinhole.params.tolist() == [70, 70, 40, 30]


def test_image_list_determines_the_order(folder: Path, intrinsics: Path, tmp_path: Path) -> None:
    chosen = write_list(tmp_path, "side/a.png", "img2.jpg")
    assert load_images(folder, intrinsics, chosen).names == ["side/a.png", "img2.jpg"]


def test_invalid_image_lists_raise(folder: Path, intrinsics: Path, tmp_path: Path) -> None:
    message = refused(folder, intrinsics, write_list(tmp_path, "img2.jpg", "img10.pmg"))
    assert "list.txt" in message and "'img10.pmg'" in message and "'img10.png'" in message
    twice = write_list(tmp_path, "img2.jpg", "img10.png", "img2.jpg")
    assert "'img2.jpg' is listed twice" in refused(folder, intrinsics, twice)
    assert "only one image" in refused(folder, intrinsics, write_list(tmp_path, "img2.jpg"))
    assert "no images" in refused(folder, intrinsics, write_list(tmp_path))
    assert "cannot be read" in refused(folder, intrinsics, tmp_path / "absent.txt")


def test_invalid_image_folders_raise(tmp_path: Path, write_image) -> None:
    assert "does not exist" in refused(tmp_path / "absent")
    (tmp_path / "images").mkdir()
    assert "no images" in refused(tmp_path / "images")
    write_image("one.png")
    message = refused(tmp_path / "images")
    assert "only one image, 'one.png'" in message and "two or more" in message


def test_damaged_photos_are_left_out_with_their_reasons(
    folder: Path, intrinsics: Path, caplog: pytest.LogCaptureFixture
) -> None:
    whole = load_images(folder, intrinsics).names
    (folder / "broken.jpg").write_bytes(b"hello")
    (folder / "empty.png").write_bytes(b"")
    found = load_images(folder, intrinsics)
    assert found.names == whole
    assert found.left_out.keys() == {"broken.jpg", "empty.png"}
    assert "is empty" in found.left_out["empty.png"]
    assert "broken.jpg" in caplog.text and "empty.png" in caplog.text
    assert found.with_focals({}).left_out == found.left_out
    with pytest.raises(InputError, match=r"broken\.jpg.*empty\.png"):
        load_images(folder, intrinsics, options=InputOptions(strict=True))


@pytest.mark.parametrize("share", [0.3, 0.9])
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp", ".bmp", ".jp2"])
def test_truncated_photo_is_left_out(
    tmp_path: Path, write_image, suffix: str, share: float
) -> None:
    for name in ("a.png", "b.png", "c.png", f"cut{suffix}"):
        write_image(name)
    path = tmp_path / "images" / f"cut{suffix}"
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    found = load_images(tmp_path / "images")
    assert list(found.left_out) == [path.name]


def test_more_than_half_damaged_ends_the_run(folder: Path, intrinsics: Path) -> None:
    count = len(load_images(folder, intrinsics))
    for number in range(count + 1):
        (folder / f"broken{number}.jpg").write_bytes(b"hello")
    text = refused(folder, intrinsics)
    assert f"{count + 1} of {2 * count + 1} photos cannot be used" in text
    assert "broken0.jpg" in text


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp", ".bmp", ".jp2", ".ppm"])
def test_too_many_pixels_are_refused_before_decoding(
    tmp_path: Path, write_image, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    write_image(f"a{suffix}")
    write_image(f"b{suffix}")
    monkeypatch.setattr("cv2.imdecode", None)
    with pytest.raises(InputError, match=r"inputs\.max_pixels=1024"):
        load_images(tmp_path / "images", options=InputOptions(max_pixels=1024))


def test_results_below_the_photo_folder_are_not_read(folder: Path) -> None:
    names = find_images(folder)
    inner = folder / "out" / "undistorted" / "images"
    inner.mkdir(parents=True)
    shutil.copy(folder / names[0], inner)
    assert len(find_images(folder)) == len(names) + 1
    assert find_images(folder, folder / "out") == names
    with pytest.raises(InputError, match="and has 1 photo,"):
        check_output_folder(folder / "out", folder)
    (folder / "out" / "summary.json").write_text("{}")
    assert find_images(folder) == names
    check_output_folder(folder / "out", folder)
    check_output_folder(folder / "new", folder)
    check_output_folder(folder.parent / "elsewhere", folder)
    with pytest.raises(InputError, match="the folder of the photos"):
        check_output_folder(folder / ".", folder)


def test_focal_length_from_exif(tmp_path: Path, write_image) -> None:
    for name in ("a.jpg", "b.jpg"):
        write_image(name, tags={0xA405: 36})
    found = load_images(tmp_path / "images")
    assert found[0].focal_source == "exif" and not found[0].focal_known
    assert found[0].camera.focal_length == pytest.approx(36 / 43.2666 * 100, rel=1e-5)
    assert found[0].camera.camera_id == found[1].camera.camera_id == 1


def test_default_focal_length_warns_once(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        found = load_images(folder)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "3 of 3 images" in caplog.text and "1.2 times" in caplog.text
    assert found[0].camera.focal_length == pytest.approx(1.2 * 80)
    assert not found[0].focal_known and found[0].focal_source == "default"


def test_replaced_default_focal_lengths_change_the_cameras(folder: Path, intrinsics: Path) -> None:
    options = InputOptions(max_image_size=40)
    found = load_images(folder, options=options).with_focals({1: 70.0, 2: 90.0})
    assert all(image.focal_source == "provider" and not image.focal_known for image in found)
    assert [image.camera.focal_length for image in found] == [70.0, 70.0, 90.0]
    assert found.view(0).camera.fx == found[0].pinhole.fx == 35.0
    known = load_images(folder, intrinsics)
    assert known.with_focals({1: 70.0})[0] is known[0]


def partial_model(path: Path, **focals: float) -> Path:
    """Write a ``transforms.json`` of photos of 80 x 60 pixels."""
    frames = [
        {
            "file_path": f"images/{stem}.jpg",
            "transform_matrix": np.eye(4).tolist(),
            **{"w": 80, "h": 60, "fl_x": focal},
        }
        for stem, focal in focals.items()
    ]
    path.write_text(json.dumps({"frames": frames}))
    return path


def test_model_gives_cameras_to_its_images(folder: Path, tmp_path: Path) -> None:
    model = partial_model(tmp_path / "transforms.json", img2=70.0)
    found = load_images(folder, model=model)
    assert [image.camera.focal_length_x for image in found] == [70.0] * 3
    assert {image.camera.camera_id for image in found} == {1}
    assert all(image.focal_known for image in found)


def test_model_with_several_cameras_gives_none_to_other_images(
    folder: Path, tmp_path: Path
) -> None:
    model = partial_model(tmp_path / "transforms.json", img2=70.0, img10=75.0)
    found = {image.name: image for image in load_images(folder, model=model)}
    side = found.pop("side/a.png")
    assert {name: image.camera.focal_length_x for name, image in found.items()} == {
        "img2.jpg": 70.0,
        "img10.png": 75.0,
    }
    assert side.focal_source == "default"
    assert side.camera.camera_id not in {image.camera.camera_id for image in found.values()}


def test_given_intrinsics_override_those_of_a_model(
    folder: Path, intrinsics: Path, tmp_path: Path
) -> None:
    model = partial_model(tmp_path / "transforms.json", img2=90.0)
    found = load_images(folder, intrinsics, model=model)
    assert {image.camera.focal_length_x for image in found} == {70.0}


def test_a_model_of_photos_of_another_size_is_refused(folder: Path, tmp_path: Path) -> None:
    model = partial_model(tmp_path / "transforms.json", img2=70.0)
    model.write_text(model.read_text().replace('"w": 80', '"w": 160'))
    with pytest.raises(InputError, match=r"img2\.jpg.*are for 160x60 pixels"):
        load_images(folder, model=model)


def test_rotated_photo_is_upright(tmp_path: Path, write_image, photo) -> None:
    for name in ("a.png", "b.png"):
        write_image(name, tags={0x0112: 6, 0xA405: 36})
    found = load_images(tmp_path / "images")
    assert found[0].original_size == (60, 80) == found[0].pinhole.size
    expected = cv2.rotate(photo, cv2.ROTATE_90_CLOCKWISE)
    assert np.array_equal(found.view(0).image, expected)


def test_view_of_pinhole_camera_has_unchanged_pixels(folder: Path, intrinsics: Path, photo) -> None:
    view = load_images(folder, intrinsics).view(1)
    assert (view.name, view.mask) == ("img10.png", None)
    assert np.array_equal(view.image, photo)
    assert view.camera.size == (80, 60)


def test_view_above_max_image_size_is_reduced(folder: Path, intrinsics: Path, photo) -> None:
    found = load_images(folder, intrinsics, None, InputOptions(max_image_size=40))
    view = found.view(1)
    assert view.camera.size == (40, 30) and view.camera.params.tolist() == [35, 35, 20, 15]
    quarters = photo.reshape(30, 2, 40, 2, 3).mean(axis=(1, 3))
    assert np.abs(view.image - quarters).max() <= 1
    assert found[1].original_pixels(np.array([[20.0, 15.0]])).tolist() == [[40.0, 30.0]]


def test_pixels_of_undistorted_view_map_back_to_the_photo(
    folder: Path, tmp_path: Path, photo
) -> None:
    path = tmp_path / "distorted.yaml"
    path.write_text(DISTORTED)
    found = load_images(folder, path)
    view, source = found.view(1), found[1]
    xy = np.array([[10.5, 8.5], [view.camera.cx, view.camera.cy], [60.5, 40.5]])
    original = source.original_pixels(xy)
    assert np.allclose(original[1], [40, 30])
    for (u, v), (x, y) in zip(xy, original, strict=True):
        here = view.image[int(v), int(u)].astype(float)
        patch = cv2.getRectSubPix(photo, (1, 1), (x - 0.5, y - 0.5))[0, 0]
        assert np.abs(here - patch).max() <= 2


def test_masks_are_resized_with_their_views(folder: Path, intrinsics: Path, tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    (masks / "side").mkdir(parents=True)
    drawn = np.full((60, 80), 255, np.uint8)
    drawn[:, :20] = 0
    cv2.imwrite(str(masks / "img2.jpg.png"), drawn)
    cv2.imwrite(str(masks / "side" / "a.png"), drawn[:, ::-1])
    found = load_images(folder, intrinsics, None, InputOptions(masks=masks, max_image_size=40))
    left, none, right = (found.view(i).mask for i in range(3))
    assert none is None and found.mask(1) is None
    assert left is not None and right is not None
    assert not left[:, :10].any() and left[:, 10:].all()
    assert right[:, :30].all() and not right[:, 30:].any()


def test_invalid_masks_raise(folder: Path, intrinsics: Path, tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    assert "does not exist" in refused(folder, intrinsics, None, InputOptions(masks=masks))
    masks.mkdir()
    cv2.imwrite(str(masks / "img2.jpg.png"), np.zeros((5, 5), np.uint8))
    text = refused(folder, intrinsics, None, InputOptions(masks=masks))
    assert "img2.jpg.png has 5x5 pixels" in text


def keys(folder: Path, text: str, tmp_path: Path, **options: object) -> list[str]:
    path = tmp_path / "keys.yaml"
    path.write_text(text)
    found = load_images(folder, path, None, InputOptions(**options))
    return [found.pixel_key(index) for index in range(len(found))]


def test_pixel_key_changes_exactly_with_the_view(folder: Path, tmp_path: Path, photo) -> None:
    plain = keys(folder, INTRINSICS, tmp_path)
    assert plain == keys(folder, INTRINSICS, tmp_path)
    # Pixels of a pinhole image do not depend on the intrinsics, those of a distorted one do.
    assert plain == keys(folder, INTRINSICS.replace("70", "75"), tmp_path)
    distorted = keys(folder, DISTORTED, tmp_path)
    assert not set(distorted) & set(plain)
    assert not set(distorted) & set(keys(folder, DISTORTED.replace("0.2", "0.1"), tmp_path))
    assert not set(plain) & set(keys(folder, INTRINSICS, tmp_path, max_image_size=40))
    (folder / "img10.png").write_bytes((folder / "img2.jpg").read_bytes())
    changed = keys(folder, INTRINSICS, tmp_path)
    assert [a == b for a, b in zip(plain, changed, strict=True)] == [True, False, True]


def test_pixel_key_knows_the_mask(folder: Path, tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    path = masks / "img2.jpg.png"
    cv2.imwrite(str(path), np.full((60, 80), 255, np.uint8))
    first = keys(folder, INTRINSICS, tmp_path, masks=masks)
    cv2.imwrite(str(path), np.eye(60, 80, dtype=np.uint8))
    second = keys(folder, INTRINSICS, tmp_path, masks=masks)
    assert [a == b for a, b in zip(first, second, strict=True)] == [False, True, True]


def test_views_are_decoded_once_and_forgotten(
    folder: Path, intrinsics: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded: list[str] = []
    load = ImageSet._load
    monkeypatch.setattr(
        ImageSet, "_load", lambda self, image: decoded.append(image.name) or load(self, image)
    )
    monkeypatch.setattr(module, "CACHED_BYTES", 2 * 60 * 80 * 3)
    found = load_images(folder, intrinsics)
    for index in (0, 1, 0, 1, 2, 0):
        found.view(index)
    assert decoded == ["img2.jpg", "img10.png", "side/a.png", "img2.jpg"]
    found.release_views()
    found.view(0)
    assert decoded[4:] == ["img2.jpg"]


def test_photo_that_changes_its_size_raises(
    folder: Path, intrinsics: Path, write_image, photo
) -> None:
    found = load_images(folder, intrinsics)
    write_image("img10.png", photo[:30])
    with pytest.raises(InputError, match="changed"):
        found.view(1)


def test_images_of_shared_scene_are_loaded(shared_data: Path) -> None:
    kitchen = shared_data / "data" / "kitchen_example"
    found = load_images(kitchen / "images", kitchen / "intrinsics.yaml")
    assert len(found) == 6  # PNG data in files named .JPG
    assert found.view(0).image.shape == (793, 1393, 3)


def test_camera_model_is_that_of_guessed_cameras_only(folder: Path, tmp_path: Path) -> None:
    options = InputOptions(camera_model=CameraModel.OPENCV_FISHEYE)
    guessed = load_images(folder, options=options)
    for image in guessed:
        assert image.camera_model == CameraModel.OPENCV_FISHEYE
        assert image.camera.model_name == "OPENCV_FISHEYE"
        assert image.pinhole.fx == image.camera.focal_length_x
        # the view of an equidistant camera is cropped to valid pixels
        assert image.pinhole.width >= image.camera.width
    path = tmp_path / "given.yaml"
    path.write_text(DISTORTED)
    for image in load_images(folder, path, options=options):
        assert image.camera_model == CameraModel.SIMPLE_RADIAL
        assert image.camera.model_name == "SIMPLE_RADIAL"
