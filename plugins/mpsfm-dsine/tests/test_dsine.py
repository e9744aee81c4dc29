"""Tests of the DSINE provider with small ONNX networks that have DSINE's tensors."""

from __future__ import annotations

import numpy as np
import pytest
from mpsfm_dsine.options import DsineOptions
from mpsfm_dsine.provider import Dsine
from mpsfm_onnx.decode import compute_expected_angle

from mpsfm_core import PinholeCamera, View
from mpsfm_core.data.errors import ConfigError
from mpsfm_core.geometry import pixel_centers, rays

# Compute rays as DSINE does, with pixel centers and the principal point shifted by half a pixel.
# The predicted normals are the negative rays, so that every surface faces the camera, with
# concentration 12.
RAYS = """
dsine (float[b,3,h,w] image, float[b,3,3] intrins) => (float[b,4,h,w] normal) {
    shape = Shape (image)
    height = Gather <axis = 0> (shape, two)
    width = Gather <axis = 0> (shape, three)
    columns = Range (zero, width, one)
    rows = Range (zero, height, one)
    x_int = Cast <to = 1> (columns)
    y_int = Cast <to = 1> (rows)
    x_pixel = Add (x_int, half)
    y_pixel = Add (y_int, half)
    k = Reshape (intrins, nine)
    fx = Gather <axis = 0> (k, zero)
    cx_first = Gather <axis = 0> (k, two)
    fy = Gather <axis = 0> (k, four)
    cy_first = Gather <axis = 0> (k, five)
    cx = Add (cx_first, half)
    cy = Add (cy_first, half)
    x_off = Sub (x_pixel, cx)
    y_off = Sub (y_pixel, cy)
    x_row = Div (x_off, fx)
    y_flat = Div (y_off, fy)
    y_column = Unsqueeze (y_flat, last)
    blank = Gather <axis = 1> (image, first)
    nothing = Mul (blank, none)
    nx = Add (nothing, x_row)
    ny = Add (nothing, y_column)
    nz = Add (nothing, unit)
    kappa = Add (nothing, twelve)
    normal = Concat <axis = 1> (nx, ny, nz, kappa)
}
"""


@pytest.fixture
def model(write_onnx):
    whole = {"zero": 0, "one": 1, "two": 2, "three": 3, "four": 4, "five": 5}
    arrays = {name: np.array(value) for name, value in whole.items()}
    arrays |= {"nine": np.array([9]), "last": np.array([-1]), "first": np.array([0])}
    return str(write_onnx(RAYS, half=0.5, none=[0.0], unit=[1.0], twelve=[12.0], **arrays))


def view_of(width, height, camera=None, colour=(0, 0, 0)):
    image = np.full((height, width, 3), colour, dtype=np.uint8)
    return View("a.png", image, camera or PinholeCamera(width, height, 90.0, 90.0, 30.0, 20.0))


@pytest.mark.parametrize("size", [1200, 64])
def test_intrinsics_follow_resizing_and_padding(model, size, context):
    """Check an image that is padded to multiples of 32 pixels, at full size and when shrunk."""
    view = view_of(150, 90, PinholeCamera(150, 90, 110.0, 120.0, 70.0, 48.0))
    prior = Dsine(DsineOptions(model=model, size=size), context).predict(view)
    height, width = prior.shape
    assert (height, width) == ((90, 150) if size == 1200 else (38, 64))
    expected = -rays(view.camera.resized(width, height), pixel_centers(width, height))
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    assert prior.valid.all()
    np.testing.assert_allclose(prior.normals, expected, atol=1e-5)
    np.testing.assert_allclose(
        prior.variance, compute_expected_angle(np.array(12.0)) ** 2, rtol=1e-5
    )


def test_black_padding_before_normalisation(write_onnx, context):
    """Check DSINE's padding color with a network that returns the corner pixel as x of normals."""
    text = """
    dsine (float[b,3,h,w] image, float[b,3,3] intrins) => (float[b,4,h,w] normal) {
        nothing = Mul (image, none)
        plane = Gather <axis = 1> (nothing, first)
        corner = Slice (image, start, stop, axes)
        x = Add (plane, corner)
        y = Identity (plane)
        z = Add (plane, ten)
        normal = Concat <axis = 1> (x, y, z, z)
    }
    """
    places = {"first": [0], "start": [0, 0, 0], "stop": [1, 1, 1], "axes": [1, 2, 3]}
    arrays = {name: np.array(value) for name, value in places.items()}
    model = str(write_onnx(text, none=[0.0], ten=[10.0], **arrays))
    view = view_of(60, 40, colour=(200, 200, 200))
    normal = Dsine(DsineOptions(model=model), context).predict(view).normals[20, 30]
    assert normal[0] / normal[2] == pytest.approx((0 - 0.485) / 0.229 / 10, rel=1e-4)
    assert normal[2] < 0


def test_export_without_intrinsics_raises(write_onnx, context):
    text = "dsine (float[b,3,h,w] image) => (float[b,3,h,w] normal) { normal = Identity (image) }"
    with pytest.raises(ConfigError, match=r"needs inputs \['image', 'intrins'\]"):
        Dsine(DsineOptions(model=str(write_onnx(text))), context)
