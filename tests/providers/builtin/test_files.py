"""Tests of depth, normals and masks that are read from files of every format."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import cv2
import numpy as np
import pytest

from mpsfm_core.data import DepthPrior, PinholeCamera, View
from mpsfm_core.data.cameras import MapOrientation
from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.image_decoding import orient
from mpsfm_core.inputs.model_orientation import orientation_matrix
from mpsfm_core.providers import ProviderContext
from mpsfm_core.providers.builtin.files import DepthFiles, MaskFiles, NormalFiles
from mpsfm_core.providers.builtin.options import (
    DepthFileOptions,
    FileOptions,
    MaskFileOptions,
    NormalFileOptions,
)
from mpsfm_core.providers.registry import Registry
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration

CAMERA = PinholeCamera(40, 30, 40.0, 40.0, 20.0, 15.0)
VIEW = View("side/a.jpg", np.zeros((30, 40, 3), np.uint8), CAMERA)
DEPTH = np.linspace(0.5, 4.0, 30 * 40).reshape(30, 40).astype(np.float32)
NORMALS = np.dstack([np.full((30, 40), 0.6), np.zeros((30, 40)), np.full((30, 40), -0.8)])

needs_exr = pytest.mark.skipif(
    importlib.util.find_spec("OpenEXR") is None, reason="the package OpenEXR is not installed"
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "side").mkdir()
    return tmp_path


def write_exr(path: Path, channels: dict[str, np.ndarray]) -> None:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))


def depth_of(folder: Path, context: ProviderContext, **options: object) -> DepthPrior:
    settings = DepthFileOptions(directory=folder, **{"relative_std": 0.02, **options})
    return DepthFiles(settings, context).predict(VIEW)


def refused(folder: Path, context: ProviderContext, **options: object) -> str:
    with pytest.raises(InputError) as caught:
        depth_of(folder, context, **options)
    return str(caught.value)


@pytest.mark.parametrize("name", ["a", "a.jpg"])
@pytest.mark.parametrize(
    ("suffix", "tolerance"), [(".npy", 0), (".npz", 0), (".png", 6e-4), (".tif", 6e-4)]
)
def test_depth_of_every_format_is_read(
    name, suffix, tolerance, folder: Path, context: ProviderContext
) -> None:
    path = folder / "side" / f"{name}{suffix}"
    if suffix == ".npy":
        np.save(path, DEPTH)
    elif suffix == ".npz":
        np.savez(path, depth=DEPTH)
    else:
        cv2.imwrite(str(path), np.round(DEPTH * 1000).astype(np.uint16))
    scale = 0.001 if tolerance else 1.0
    prior = depth_of(folder, context, scale=scale)
    assert np.abs(prior.depth - DEPTH).max() <= tolerance
    assert prior.metric and prior.valid.all()
    assert np.allclose(np.sqrt(prior.variance), 0.02 * prior.depth, rtol=1e-5)


@needs_exr
@pytest.mark.parametrize("channels", [["Z"], ["Y"], ["custom"], ["Z", "A"], ["R", "G", "B"]])
def test_depth_of_exr_channels_is_read(channels, folder: Path, context: ProviderContext) -> None:
    write_exr(folder / "side" / "a.exr", dict.fromkeys(channels, DEPTH))
    assert np.array_equal(depth_of(folder, context).depth, DEPTH)


@needs_exr
def test_exr_without_a_depth_channel(folder: Path, context: ProviderContext) -> None:
    write_exr(folder / "side" / "a.exr", {"mist": DEPTH, "noise": DEPTH})
    assert "only unknown channels: mist, noise" in refused(folder, context)


def test_exr_without_the_package(
    folder: Path, context: ProviderContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "OpenEXR", None)
    (folder / "side" / "a.exr").write_bytes(b"v/1")
    assert "pip install OpenEXR" in refused(folder, context)


def test_invalid_pixels_of_stored_depth_are_invalid(folder: Path, context: ProviderContext) -> None:
    stored = DEPTH.copy()
    stored[0, :4] = [0, -1, np.nan, np.inf]
    valid = np.ones(stored.shape, dtype=np.bool_)
    valid[1, 0] = False
    np.savez(folder / "side" / "a.npz", depth=stored, valid=valid)
    prior = depth_of(folder, context)
    expected = valid.copy()
    expected[0, :4] = False
    assert np.array_equal(prior.valid, expected)


def test_suffix_option_selects_the_depth_file(folder: Path, context: ProviderContext) -> None:
    np.save(folder / "side" / "a_depth.npy", DEPTH)
    assert depth_of(folder, context, suffix="_depth.npy").valid.all()
    message = refused(folder, context)
    assert "depth of image 'side/a.jpg'" in message and "{.npz,.npy,.exr,.png" in message
    assert "a_wrong.npy" in refused(folder, context, suffix="_wrong.npy")


def test_stored_variance_and_declared_std(folder: Path, context: ProviderContext) -> None:
    variance = np.full(DEPTH.shape, 25.0, np.float32)  # mm^2
    np.savez(folder / "side" / "a.npz", depth=DEPTH * 1000, variance=variance)
    stored = depth_of(folder, context, scale=0.001, relative_std=None)
    assert np.allclose(stored.variance, 25e-6)
    larger = depth_of(folder, context, scale=0.001, relative_std=0.005, std_floor=0.004)
    expected = np.maximum(0.005, 0.005 * DEPTH)
    assert np.allclose(np.sqrt(larger.variance), expected, rtol=1e-4)


def test_variance_files(folder: Path, context: ProviderContext) -> None:
    np.save(folder / "side" / "a.npy", DEPTH)
    other = folder / "variance" / "side"
    other.mkdir(parents=True)
    np.save(other / "a.npy", np.full(DEPTH.shape, 0.01))
    options = FileOptions(directory=folder / "variance")
    prior = depth_of(folder, context, variance=options, relative_std=None)
    assert np.allclose(prior.variance, 0.01)
    np.save(other / "a.npy", np.full((15, 20), 0.01))
    assert "differ" in refused(folder, context, variance=options)


def test_undeclared_uncertainty_is_refused(folder: Path, context: ProviderContext) -> None:
    np.save(folder / "side" / "a.npy", DEPTH)
    assert "depth.options.relative_std=0.02" in refused(folder, context, relative_std=None)


def test_declared_std_survives_calibration(folder: Path, context: ProviderContext) -> None:
    np.save(folder / "side" / "a.npy", DEPTH)
    prior = depth_of(folder, context, relative_std=0.001)
    declared = Registry.discover().spec("depth", "files").calibration
    assert isinstance(declared, DepthCalibration)
    assert np.allclose(declared.apply(prior).variance, prior.variance, rtol=1e-6)


def test_unit_can_be_unknown(folder: Path, context: ProviderContext) -> None:
    np.save(folder / "side" / "a.npy", DEPTH)
    assert not depth_of(folder, context, metric=False).metric


def test_any_grid_that_covers_the_view(folder: Path, context: ProviderContext) -> None:
    np.save(folder / "side" / "a.npy", DEPTH[::2, ::2])
    assert depth_of(folder, context).shape == (15, 20)
    np.save(folder / "side" / "a.npy", DEPTH[:, :30])
    message = refused(folder, context)
    assert "does not cover image 'side/a.jpg'" in message and "the image (40x30)" in message


@pytest.mark.parametrize(
    ("content", "hint"),
    [
        (DEPTH[..., None].repeat(4, axis=2), "must have one channel"),
        (NORMALS, "is a color image"),
        (DEPTH[0], "must have one channel"),
    ],
)
def test_wrong_shapes_raise(content, hint, folder: Path, context: ProviderContext) -> None:
    np.save(folder / "side" / "a.npy", content)
    assert hint in refused(folder, context)


@pytest.mark.parametrize("suffix", [".npz", ".npy", ".png"])
def test_damaged_depth_files_raise(suffix, folder: Path, context: ProviderContext) -> None:
    (folder / "side" / f"a{suffix}").write_bytes(b"PK\x03\x04 damaged")
    assert f"a{suffix} cannot be read" in refused(folder, context)


def test_wrong_array_name(folder: Path, context: ProviderContext) -> None:
    np.savez(folder / "side" / "a.npz", distance=DEPTH)
    assert "no array 'depth', only distance" in refused(folder, context)


def normals_of(folder: Path, context: ProviderContext, **options: object):
    return NormalFiles(NormalFileOptions(directory=folder, **options), context).predict(VIEW)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_encoded_normals(dtype, folder: Path, context: ProviderContext) -> None:
    top = np.iinfo(dtype).max
    encoded = np.round((NORMALS / 2 + 0.5) * top).astype(dtype)
    encoded[0, 0] = top // 2  # unknown
    cv2.imwrite(str(folder / "side" / "a.png"), encoded[..., ::-1])
    prior = normals_of(folder, context, std_deg=5.0)
    assert not prior.valid[0, 0] and prior.valid.sum() == prior.valid.size - 1
    assert np.abs(prior.normals[1:] - NORMALS[1:]).max() < 2.0 / top
    assert np.allclose(np.degrees(np.sqrt(prior.variance[1:])), 5.0)


def test_normal_arrays_and_frames(folder: Path, context: ProviderContext) -> None:
    valid = np.ones((30, 40), dtype=np.bool_)
    valid[3] = False
    variance = np.full((30, 40), 0.01, np.float32)
    arrays = {"variance": variance, "valid": valid}
    np.savez(folder / "side" / "a.npz", normals=2 * NORMALS, **arrays)
    ours = normals_of(folder, context)
    assert np.array_equal(ours.valid, valid) and np.allclose(ours.normals[valid], [0.6, 0, -0.8])
    assert np.allclose(ours.variance[valid], 0.01)
    opengl = np.array([1, -1, -1]) * NORMALS
    np.save(folder / "side" / "a.npy", opengl)
    (folder / "side" / "a.npz").unlink()
    assert not normals_of(folder, context).valid.any()  # they look away
    turned = normals_of(folder, context, frame="opengl")
    assert turned.variance is None and np.allclose(turned.normals, NORMALS)


def test_missing_normals_raise(folder: Path, context: ProviderContext) -> None:
    with pytest.raises(InputError, match=r"normals of image 'side/a\.jpg'"):
        normals_of(folder, context)


def masks_of(folder: Path, context: ProviderContext, **options: object) -> np.ndarray:
    return MaskFiles(MaskFileOptions(directory=folder, **options), context).mask(VIEW)


def test_masks_are_resized_to_the_view(folder: Path, context: ProviderContext) -> None:
    drawn = np.zeros((15, 20), np.uint8)
    drawn[:, 10:] = 200
    cv2.imwrite(str(folder / "side" / "a.jpg.png"), drawn)
    expected = np.zeros((30, 40), dtype=np.bool_)
    expected[:, 20:] = True
    assert np.array_equal(masks_of(folder, context), expected)
    assert np.array_equal(masks_of(folder, context, invert=True), ~expected)
    cv2.imwrite(str(folder / "side" / "a.jpg.png"), np.repeat(drawn[..., None], 3, axis=2))
    assert np.array_equal(masks_of(folder, context), expected)
    with pytest.raises(InputError, match="does not cover"):
        cv2.imwrite(str(folder / "side" / "a.jpg.png"), drawn[:10])
        masks_of(folder, context)


@pytest.mark.parametrize("name", ["a.jpg.PNG", "A.JPG.png", "a.PNG"])
def test_mask_whose_name_differs_in_case_is_found(
    folder: Path, context: ProviderContext, name: str
) -> None:
    cv2.imwrite(str(folder / "mask.png"), np.full((15, 20), 255, np.uint8))
    (folder / "mask.png").rename(folder / "side" / name)
    assert masks_of(folder, context).all()


def test_black_mask_is_named(folder: Path, context: ProviderContext) -> None:
    cv2.imwrite(str(folder / "side" / "a.png"), np.zeros((15, 20), np.uint8))
    with pytest.raises(InputError, match=r"a\.png excludes every pixel.*invert"):
        masks_of(folder, context)
    assert masks_of(folder, context, invert=True).all()


def test_depth_of_shared_scene_is_read(shared_data: Path, context: ProviderContext) -> None:
    folder = shared_data / "data" / "hololens_room"
    name = sorted((folder / "images").iterdir())[0].name
    camera = PinholeCamera(540, 360, 495.5678, 495.482, 270.0029, 169.6941)
    view = View(name, np.zeros((360, 540, 3), np.uint8), camera)
    options = DepthFileOptions(directory=folder / "gt_depth", scale=0.001, relative_std=0.02)
    prior = DepthFiles(options, context).predict(view)
    assert 0.5 < np.median(prior.depth[prior.valid]) < 6


def rotated_view(flag: int, square: bool = False) -> tuple[View, np.ndarray, np.ndarray]:
    """Return the upright view of a photo with an EXIF flag, and its stored depth and normals."""
    depth, normals = DEPTH.copy(), NORMALS.copy()
    if square:
        depth, normals = depth[:, :30], normals[:, :30]
    height, width = orient(depth, flag).shape
    camera = PinholeCamera(width, height, 40.0, 40.0, width / 2, height / 2)
    pixels = np.zeros((height, width, 3), np.uint8)
    return View("side/a.jpg", pixels, camera, None, flag), depth, normals


@pytest.mark.parametrize("convention", ["auto", "stored"])
@pytest.mark.parametrize("flag", range(1, 9))
def test_maps_of_stored_photos_are_rotated_upright(
    folder: Path, context: ProviderContext, flag: int, convention: MapOrientation
) -> None:
    view, depth, normals = rotated_view(flag)
    np.savez(folder / "side/a.npz", depth=depth, variance=depth / 100, valid=depth > 1)
    options = DepthFileOptions(directory=folder, orientation=convention)
    prior = DepthFiles(options, context).predict(view)
    upright = orient(depth, flag)
    assert (prior.valid == (upright > 1)).all()
    np.testing.assert_array_equal(prior.depth[prior.valid], upright[prior.valid])
    np.testing.assert_allclose(prior.variance[prior.valid], upright[prior.valid] / 100)
    np.savez(folder / "side/a.npz", normals=normals)
    found = NormalFiles(NormalFileOptions(directory=folder, orientation=convention), context)
    expected = orientation_matrix(flag) @ normals[0, 0]
    np.testing.assert_allclose(found.predict(view).normals[5, 5], expected, atol=1e-6)
    cv2.imwrite(str(folder / "side/a.png"), (depth > 1).astype(np.uint8) * 255)
    (folder / "side/a.npz").unlink()
    mask = MaskFiles(MaskFileOptions(directory=folder, orientation=convention), context)
    np.testing.assert_array_equal(mask.mask(view), upright > 1)


@pytest.mark.parametrize(
    ("flag", "square", "convention"),
    [(6, False, "auto"), (8, False, "upright"), (3, False, "upright"), (6, True, "upright")],
)
def test_maps_of_upright_photos_stay(
    folder: Path, context: ProviderContext, flag: int, square: bool, convention: MapOrientation
) -> None:
    view, depth, _ = rotated_view(flag, square)
    np.save(folder / "side/a.npy", orient(depth, flag))
    options = DepthFileOptions(directory=folder, relative_std=0.02, orientation=convention)
    np.testing.assert_array_equal(
        DepthFiles(options, context).predict(view).depth, orient(depth, flag)
    )


def test_maps_that_fit_both_orientations_are_stored(folder: Path, context: ProviderContext) -> None:
    view, depth, _ = rotated_view(6, square=True)
    np.save(folder / "side/a.npy", depth)
    options = DepthFileOptions(directory=folder, relative_std=0.02)
    np.testing.assert_array_equal(
        DepthFiles(options, context).predict(view).depth, orient(depth, 6)
    )
