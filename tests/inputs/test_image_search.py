"""Tests of the search for images: links, formats, and pictures that are not read."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.image_search import find_images, find_videos, read_image_list
from mpsfm_core.inputs.images import load_images


def picture(seed: int = 0) -> Image.Image:
    y, x = np.mgrid[:48, :64]
    rgb = np.stack([x * 3 + seed, y * 4, (x + y) * 2], axis=-1).astype(np.uint8)
    return Image.fromarray(rgb)


def write(folder: Path, *names: str, **options: object) -> None:
    for seed, name in enumerate(names):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        picture(seed).save(path, **options)


def test_photos_behind_links_are_found(tmp_path: Path) -> None:
    write(tmp_path / "disk", "b.jpg", "deep/c.jpg")
    write(tmp_path / "photos", "a.jpg")
    write(tmp_path, "d.jpg")
    (tmp_path / "photos" / "linked").symlink_to(tmp_path / "disk")
    (tmp_path / "photos" / "d.jpg").symlink_to(tmp_path / "d.jpg")
    (tmp_path / "photos" / "broken.jpg").symlink_to(tmp_path / "none.jpg")
    names = find_images(tmp_path / "photos")
    assert names == ["a.jpg", "d.jpg", "linked/b.jpg", "linked/deep/c.jpg"]
    assert len(load_images(tmp_path / "photos")) == 4


def test_circular_links_are_followed_once(tmp_path: Path) -> None:
    write(tmp_path / "photos", "a.jpg", "deep/b.jpg")
    (tmp_path / "photos" / "deep" / "up").symlink_to(tmp_path / "photos")
    assert find_images(tmp_path / "photos") == ["a.jpg", "deep/b.jpg"]


def test_folder_that_two_names_reach_is_read_once(tmp_path: Path) -> None:
    write(tmp_path / "photos", "set/a.jpg", "set/b.jpg")
    (tmp_path / "photos" / "latest").symlink_to(tmp_path / "photos" / "set")
    assert find_images(tmp_path / "photos") == ["set/a.jpg", "set/b.jpg"]


def test_images_folder_may_be_a_link(tmp_path: Path) -> None:
    write(tmp_path / "disk", "a.jpg", "b.jpg")
    (tmp_path / "photos").symlink_to(tmp_path / "disk")
    assert find_images(tmp_path / "photos") == ["a.jpg", "b.jpg"]


def test_multi_picture_files_give_their_first_picture(tmp_path: Path) -> None:
    first, second = picture(0), picture(100)
    for name in ("a.MPO", "b.mpo"):
        first.save(tmp_path / name, format="MPO", save_all=True, append_images=[second])
    images = load_images(tmp_path)
    assert images.names == ["a.MPO", "b.mpo"]
    difference = images.view(0).image.astype(int) - np.asarray(first).astype(int)
    assert np.abs(difference).mean() < 6


@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_avif_is_read_upright(tmp_path: Path, orientation: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769)[0xA405] = 28
    turn = {1: None, 3: Image.Transpose.ROTATE_180, 6: Image.Transpose.ROTATE_90}[orientation]
    stored = picture() if turn is None else picture().transpose(turn)
    for name in ("a.avif", "b.AVIF"):
        stored.save(tmp_path / name, format="AVIF", quality=95, exif=exif.tobytes())
    images = load_images(tmp_path)
    assert images[0].original_size == (64, 48)
    assert images[0].focal_source == "exif"
    difference = images.view(0).image.astype(int) - np.asarray(picture()).astype(int)
    assert np.abs(difference).mean() < 6


def test_jfif_and_upper_case_names_are_photos(tmp_path: Path) -> None:
    write(tmp_path, "a.JPG", "b.JPEG", "c.PNG", "d.TIFF")
    picture().save(tmp_path / "e.jfif", format="JPEG")
    assert find_images(tmp_path) == ["a.JPG", "b.JPEG", "c.PNG", "d.TIFF", "e.jfif"]


def test_pictures_that_are_not_read_are_named(tmp_path: Path, caplog) -> None:
    write(tmp_path, "a.jpg", "b.jpg", "old.gif")
    (tmp_path / "GOPR0001.GPR").write_bytes(b"GPR")
    picture().save(tmp_path / "without_extension", format="JPEG")
    (tmp_path / "notes.txt").write_text("text")
    (tmp_path / "README").write_text("text")
    with caplog.at_level(logging.WARNING):
        assert find_images(tmp_path) == ["a.jpg", "b.jpg"]
    assert "their format is not supported" in caplog.text
    for name in ("old.gif", "GOPR0001.GPR", "without_extension"):
        assert name in caplog.text
    assert "notes.txt" not in caplog.text and "README" not in caplog.text


def test_folder_of_videos_says_how_to_use_one(tmp_path: Path) -> None:
    (tmp_path / "clip2.MP4").touch()
    (tmp_path / "clip10.mp4").touch()
    with pytest.raises(InputError, match=r"no images, but 2 videos.*reconstruct .*clip2\.MP4"):
        load_images(tmp_path)
    write(tmp_path, "a.jpg")
    with pytest.raises(InputError, match=r"only one image, 'a\.jpg', but 2 videos"):
        load_images(tmp_path)


def test_videos_of_a_folder_without_images_are_found(tmp_path: Path) -> None:
    clips = tmp_path / "clips"
    (clips / "day").mkdir(parents=True)
    (clips / "b.mp4").touch()
    assert find_videos(clips / "b.mp4") == {"": clips / "b.mp4"}
    assert find_videos(clips) == {"": clips / "b.mp4"}
    (clips / "day" / "a.MOV").touch()
    (clips / "out").mkdir()
    write(clips / "out", "frame.jpg")
    found = find_videos(clips, without=clips / "out")
    assert found == {"b": clips / "b.mp4", "day/a": clips / "day" / "a.MOV"}
    assert find_videos(clips) == {}  # a folder with an image is a folder of photos
    (clips / "b.avi").touch()
    with pytest.raises(InputError, match="two videos have the name 'b'"):
        find_videos(clips, without=clips / "out")


def test_image_list_with_byte_order_mark(tmp_path: Path) -> None:
    path = tmp_path / "list.txt"
    path.write_bytes("a.jpg\r\nb.jpg\r\n".encode("utf-8-sig"))
    assert read_image_list(path) == ["a.jpg", "b.jpg"]
