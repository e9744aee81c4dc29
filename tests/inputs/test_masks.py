"""Tests of masks: names, orientation, formats and errors."""

from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.image_decoding import orient
from mpsfm_core.inputs.images import ImageSet, load_images
from mpsfm_core.inputs.masks import decode_mask, find_masks
from mpsfm_core.inputs.options import InputOptions

WIDTH, HEIGHT = 64, 48
INVERSE = {1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 6: 8, 7: 7, 8: 6}
"""EXIF orientation of the inverse transform, by EXIF orientation."""


def upright_mask(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Mask that allows only the upper left corner, which no flip or rotation maps to itself."""
    mask = np.zeros((height, width), np.uint8)
    mask[: height // 3, : width // 4] = 255
    return mask


def write_photo(path: Path, orientation: int = 1, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(sum(map(ord, path.name)))
    upright = rng.integers(0, 255, (*size[::-1], 3)).astype(np.uint8)
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(orient(upright, INVERSE[orientation])).save(path, exif=exif)


def write_mask(path: Path, mask: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    written = path if path.suffix.islower() else path.with_suffix(path.suffix.lower())
    Image.fromarray(mask).save(written)
    written.rename(path)


def load(photos: Path, masks: Path, **options: object) -> ImageSet:
    return load_images(photos, options=InputOptions(masks=masks, **options))  # type: ignore[arg-type]


def check_masked(images: ImageSet, expected: np.ndarray, *indices: int) -> None:
    for index in indices:
        mask = images.view(index).mask
        assert mask is not None
        np.testing.assert_array_equal(mask, expected > 0)


@pytest.mark.parametrize(
    "name",
    [
        "a.JPG.png", "a.jpg.PNG", "a.png", "a.JPG", "a.tif", "A.PNG", "a_mask.png", "a_mask.JPG",
        "a-mask.png", "a.mask.png", "a.JPG_mask.png", "mask_a.png", "dynamic_mask_a.png", "a.bmp",
    ],
)  # fmt: skip
def test_mask_names_in_use_are_found(tmp_path: Path, name: str) -> None:
    for photo in ("a.JPG", "b.JPG"):
        write_photo(tmp_path / "photos" / photo)
    write_mask(tmp_path / "masks" / name, upright_mask())
    write_mask(tmp_path / "masks" / name.replace("a", "b", 1).replace("mbsk", "mask"),
               upright_mask())  # fmt: skip
    if name.startswith(("mask_", "dynamic")):
        write_mask(tmp_path / "masks" / name.replace("_a.", "_b."), upright_mask())
    images = load(tmp_path / "photos", tmp_path / "masks")
    if name.lower().endswith((".jpg", ".jpeg")):  # compression blurs borders
        mask = images.view(0).mask
        assert mask is not None
        assert (mask == (upright_mask() > 0)).mean() > 0.95
        assert not mask[HEIGHT // 2 :].any()
    else:
        check_masked(images, upright_mask(), 0)


def test_masks_of_photos_in_subfolders_may_be_in_a_tree_or_flat(tmp_path: Path) -> None:
    for photo in ("left/a.jpg", "right/b.jpg"):
        write_photo(tmp_path / "photos" / photo)
    write_mask(tmp_path / "masks" / "left" / "a.png", upright_mask())
    write_mask(tmp_path / "masks" / "b_mask.png", upright_mask())
    check_masked(load(tmp_path / "photos", tmp_path / "masks"), upright_mask(), 0, 1)


def test_flat_mask_of_two_photos_with_one_name_is_not_used(tmp_path: Path) -> None:
    (tmp_path / "a.png").touch()
    (tmp_path / "b.png").touch()
    masks = find_masks(tmp_path, ["left/a.jpg", "right/a.jpg", "b.jpg"], tmp_path / "photos")
    assert masks == {"b.jpg": tmp_path / "b.png"}


def test_exact_name_precedes_other_names(tmp_path: Path) -> None:
    for name in ("a.png", "a.jpg.png", "a_mask.png", "a.jpg"):
        (tmp_path / name).touch()
    masks = find_masks(tmp_path, ["a.jpg"], tmp_path / "photos")
    assert masks == {"a.jpg": tmp_path / "a.jpg.png"}


def test_masks_inside_of_the_photos_are_not_photos(tmp_path: Path, caplog) -> None:
    for photo in ("a.jpg", "b.jpg"):
        write_photo(tmp_path / photo)
        write_mask(tmp_path / "masks" / f"{photo}.png", upright_mask())
    images = load(tmp_path, tmp_path / "masks")
    assert images.names == ["a.jpg", "b.jpg"]
    check_masked(images, upright_mask(), 0, 1)


def test_masks_next_to_the_photos_are_named_and_can_be_used(tmp_path: Path, caplog) -> None:
    for photo in ("a", "b"):
        write_photo(tmp_path / f"{photo}.jpg")
        write_mask(tmp_path / f"{photo}_mask.png", upright_mask())
    with caplog.at_level(logging.WARNING):
        images = load_images(tmp_path)
    assert images.names == ["a.jpg", "b.jpg"]
    assert "are not reconstructed" in caplog.text and "a_mask.png" in caplog.text
    assert f"--set inputs.masks={tmp_path}" in caplog.text
    check_masked(load(tmp_path, tmp_path), upright_mask(), 0, 1)


def test_masks_of_no_photo_are_an_error(tmp_path: Path) -> None:
    for photo in ("a.jpg", "b.jpg"):
        write_photo(tmp_path / "photos" / photo)
    write_mask(tmp_path / "masks" / "other.png", upright_mask())
    with pytest.raises(InputError, match=r"no file is the mask.*other\.png.*a\.jpg\.png"):
        load(tmp_path / "photos", tmp_path / "masks")
    (tmp_path / "masks" / "other.png").unlink()
    with pytest.raises(InputError, match="has no image files"):
        load(tmp_path / "photos", tmp_path / "masks")


def test_missing_masks_are_named(tmp_path: Path, caplog) -> None:
    for photo in ("a.jpg", "b.jpg", "c.jpg"):
        write_photo(tmp_path / "photos" / photo)
    write_mask(tmp_path / "masks" / "a.png", upright_mask())
    with caplog.at_level(logging.WARNING):
        images = load(tmp_path / "photos", tmp_path / "masks")
    assert "2 of 3 images have no mask and are used in full: b.jpg, c.jpg" in caplog.text
    assert images.mask(1) is None


def test_black_mask_names_the_mask(tmp_path: Path, caplog) -> None:
    for photo in ("a.jpg", "b.jpg", "c.jpg"):
        write_photo(tmp_path / "photos" / photo)
        write_mask(tmp_path / "masks" / f"{photo}.png", upright_mask())
    black = tmp_path / "masks" / "c.jpg.png"
    write_mask(black, np.zeros((HEIGHT, WIDTH), np.uint8))
    with caplog.at_level(logging.WARNING):
        images = load(tmp_path / "photos", tmp_path / "masks")
    assert images.names == ["a.jpg", "b.jpg"]
    assert f"mask {black} is all black" in images.left_out["c.jpg"]
    assert f"mask {black} is all black" in caplog.text
    with pytest.raises(InputError, match="all black"):
        load(tmp_path / "photos", tmp_path / "masks", strict=True)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("stored", [True, False])
def test_masks_of_all_orientations_are_upright(
    tmp_path: Path, orientation: int, stored: bool
) -> None:
    for photo in ("a.jpg", "b.jpg"):
        write_photo(tmp_path / "photos" / photo, orientation)
        mask = orient(upright_mask(), INVERSE[orientation]) if stored else upright_mask()
        write_mask(tmp_path / "masks" / f"{photo}.png", mask)
    # The size decides for flags 5 to 8; 2 to 4 need the convention when masks are upright.
    convention = "auto" if stored or orientation > 4 else "upright"
    images = load(tmp_path / "photos", tmp_path / "masks", mask_orientation=convention)
    check_masked(images, upright_mask(), 0, 1)


@pytest.mark.parametrize("stored", [True, False])
def test_masks_that_fit_both_follow_the_others(tmp_path: Path, stored: bool) -> None:
    for photo, orientation in (("a.jpg", 3), ("b.jpg", 6)):
        write_photo(tmp_path / "photos" / photo, orientation)
        mask = orient(upright_mask(), INVERSE[orientation]) if stored else upright_mask()
        write_mask(tmp_path / "masks" / f"{photo}.png", mask)
    check_masked(load(tmp_path / "photos", tmp_path / "masks"), upright_mask(), 0, 1)


def test_orientation_that_nothing_decides_is_said(tmp_path: Path, caplog) -> None:
    for photo in ("a.jpg", "b.jpg"):
        write_photo(tmp_path / "photos" / photo, 3)
        write_mask(tmp_path / "masks" / f"{photo}.png", upright_mask()[::-1, ::-1])
    with caplog.at_level(logging.WARNING):
        load(tmp_path / "photos", tmp_path / "masks")
    assert "inputs.mask_orientation=upright" in caplog.text


def test_mask_with_an_orientation_of_its_own_is_turned_by_that(tmp_path: Path) -> None:
    for photo in ("a.jpg", "b.jpg"):
        write_photo(tmp_path / "photos" / photo, 3)
        exif = Image.Exif()
        exif[0x0112] = 3
        (tmp_path / "masks").mkdir(exist_ok=True)
        stored = Image.fromarray(np.ascontiguousarray(upright_mask()[::-1, ::-1]))
        stored.save(tmp_path / "masks" / f"{photo}.png", exif=exif)
    check_masked(load(tmp_path / "photos", tmp_path / "masks"), upright_mask(), 0, 1)


def test_values_of_many_formats(tmp_path: Path) -> None:
    expected = upright_mask() > 0
    ones = (upright_mask() > 0).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "ones.png"), ones)
    cv2.imwrite(str(tmp_path / "sixteen.png"), upright_mask().astype(np.uint16) * 257)
    Image.fromarray(ones * 255).convert("1").save(tmp_path / "bilevel.png")
    palette = Image.fromarray(ones, "P")
    palette.putpalette([0, 0, 0, 128, 0, 0])
    palette.save(tmp_path / "palette.png")
    alpha = np.dstack([np.full((HEIGHT, WIDTH, 3), 255, np.uint8), upright_mask()])
    Image.fromarray(alpha).save(tmp_path / "alpha.png")
    opaque = np.dstack([np.repeat(upright_mask()[..., None], 3, 2), np.full_like(ones, 255)])
    Image.fromarray(opaque).save(tmp_path / "opaque.png")
    for path in sorted(tmp_path.iterdir()):
        np.testing.assert_array_equal(decode_mask(path, 10_000), expected, err_msg=path.name)


def test_noise_of_lossy_formats_is_black(tmp_path: Path) -> None:
    noisy = np.where(upright_mask() > 0, 250, 6).astype(np.uint8)
    Image.fromarray(noisy).save(tmp_path / "a.jpg", quality=60)
    mask = decode_mask(tmp_path / "a.jpg", 10_000)
    assert not mask[HEIGHT // 2 :].any() and mask[4, 4]
