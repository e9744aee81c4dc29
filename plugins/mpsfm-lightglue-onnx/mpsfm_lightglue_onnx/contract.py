"""Small ONNX blob detector and nearest-neighbor matcher for the provider contract tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from mpsfm_onnx.stand_in import save_model

from mpsfm_core.data import Float64
from mpsfm_core.testing import ContractSetup

_SIDE = 11
_DETECTOR = """
detector (float[b,CHANNELS,h,w] image) => (
    int64[b,n,2] keypoints, float[b,n] scores, float[b,n,d] descriptors) {
    gray = ReduceMean <axes = [1]> (image)
    around = Pad <mode = "edge"> (gray, border)
    smooth = Conv (around, narrow)
    wide = Conv (around, broad)
    response = Sub (smooth, wide)
    strength = Abs (response)
    largest = MaxPool <kernel_shape = [7, 7], pads = [3, 3, 3, 3]> (strength)
    is_largest = Equal (strength, largest)
    strong = Greater (strength, threshold)
    found = And (is_largest, strong)
    places = NonZero (found)
    rows_columns = Gather <axis = 0> (places, last_two)
    yx = Transpose <perm = [1, 0]> (rows_columns)
    xy = Gather <axis = 1> (yx, swapped)
    keypoints = Unsqueeze (xy, first)
    indices = Transpose <perm = [1, 0]> (places)
    strengths = GatherND (strength, indices)
    scores = Unsqueeze (strengths, first)
    patch = Conv <pads = [PAD, PAD, PAD, PAD], dilations = [2, 2]> (smooth, kernel)
    last = Transpose <perm = [0, 2, 3, 1]> (patch)
    at = Gather <axis = 1> (indices, without_channel)
    raw = GatherND (last, at)
    mean = ReduceMean <axes = [1]> (raw)
    plain = Sub (raw, mean)
    norm = ReduceL2 <axes = [1]> (plain)
    safe = Add (norm, small)
    unit = Div (plain, safe)
    descriptors = Unsqueeze (unit, first)
}
"""
_MATCHER = """
lightglue (float[b,n,2] kpts0, float[b,m,2] kpts1, float[b,n,d] desc0, float[b,m,d] desc1) => (
    int64[b,n] matches0, float[b,n] mscores0) {
    turned = Transpose <perm = [0, 2, 1]> (desc1)
    similarity = MatMul (desc0, turned)
    there = ArgMax <axis = 2, keepdims = 0> (similarity)
    back = ArgMax <axis = 1, keepdims = 0> (similarity)
    best = ReduceMax <axes = [2], keepdims = 0> (similarity)
    again = GatherElements <axis = 1> (back, there)
    shape = Shape (desc0)
    length = Gather <axis = 0> (shape, one)
    rows = Range (zero, length, one_step)
    same = Equal (again, rows)
    sure = Greater (best, enough)
    mutual = And (same, sure)
    matches0 = Where (mutual, there, none)
    positive = Relu (best)
    mscores0 = Mul (positive, positive)
    unused0 = ReduceSum (kpts0)
    unused1 = ReduceSum (kpts1)
}
"""


def superpoint(folder: Path) -> ContractSetup:
    """Write a blob detector for gray images, with SuperPoint's tensors."""
    return ContractSetup(options=_detector(folder, 1), truth_source="image")


def disk(folder: Path) -> ContractSetup:
    """Write a blob detector for color images, with DISK's tensors."""
    return ContractSetup(options=_detector(folder, 3), truth_source="image")


def lightglue(folder: Path) -> ContractSetup:
    """Write a mutual nearest-neighbor matcher for patch descriptors, with LightGlue's tensors."""
    numbers = {"one": 1, "zero": 0, "one_step": 1, "none": -1}
    model = save_model(
        _MATCHER,
        folder / "lightglue.onnx",
        enough=[0.5],
        **{name: np.array(value) for name, value in numbers.items()},
    )
    return ContractSetup(options={"model": str(model)}, truth_source="image")


def _detector(folder: Path, channels: int) -> dict[str, str]:
    text = _DETECTOR.replace("CHANNELS", str(channels)).replace("PAD", str(_SIDE - 1))
    kernel = np.eye(_SIDE**2).reshape(_SIDE**2, 1, _SIDE, _SIDE)
    model = save_model(
        text,
        folder / f"detector_{channels}.onnx",
        narrow=_gaussian(1.0, 13),
        broad=_gaussian(2.5, 13),
        kernel=kernel,
        threshold=[0.01],
        small=[1e-3],
        last_two=np.array([2, 3]),
        border=np.array([0, 0, 6, 6, 0, 0, 6, 6]),
        swapped=np.array([1, 0]),
        first=np.array([0]),
        without_channel=np.array([0, 2, 3]),
    )
    return {"model": str(model)}


def _gaussian(sigma: float, side: int) -> Float64:
    x = np.arange(side) - side // 2
    row = np.exp(-0.5 * (x / sigma) ** 2)
    kernel: Float64 = np.outer(row, row)[np.newaxis, np.newaxis]
    kernel /= kernel.sum()
    return kernel
