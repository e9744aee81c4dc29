"""Small ONNX network that replaces RoMa in the contract tests by comparing patches."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from mpsfm_onnx.stand_in import save_model

from mpsfm_core.testing import ContractSetup

_GRID = (42, 56)
_SIDE = 5
_VIEW = """
    patch_@ = Conv <pads = [6, 6, 6, 6], dilations = [3, 3]> (im_@, kernel)
    last_@ = Transpose <perm = [0, 2, 3, 1]> (patch_@)
    flat_@ = Reshape (last_@, rows)
    mean_@ = ReduceMean <axes = [1]> (flat_@)
    plain_@ = Sub (flat_@, mean_@)
    norm_@ = ReduceL2 <axes = [1]> (plain_@)
    safe_@ = Add (norm_@, small)
    unit_@ = Div (plain_@, safe_@)
"""
_MATCHING = """
roma (float[b,3,h,w] im_A, float[b,3,h,w] im_B) => (
    float[b,h,w2,4] warp, float[b,h,w2] certainty) {
    VIEWS
    turned_B = Transpose <perm = [1, 0]> (unit_B)
    similarity = MatMul (unit_A, turned_B)
    best_B = ArgMax <axis = 1, keepdims = 0> (similarity)
    best_A = ArgMax <axis = 0, keepdims = 0> (similarity)
    sure_A = ReduceMax <axes = [1], keepdims = 0> (similarity)
    sure_B = ReduceMax <axes = [0], keepdims = 0> (similarity)
    to_B = Gather <axis = 0> (grid, best_B)
    to_A = Gather <axis = 0> (grid, best_A)
    left = Concat <axis = 1> (grid, to_B)
    right = Concat <axis = 1> (to_A, grid)
    left_map = Reshape (left, map)
    right_map = Reshape (right, map)
    warp = Concat <axis = 2> (left_map, right_map)
    left_sure = Reshape (sure_A, single)
    right_sure = Reshape (sure_B, single)
    sure = Concat <axis = 2> (left_sure, right_sure)
    squared = Mul (sure, sure)
    certainty = Relu (squared)
}
"""


def dense(folder: Path) -> ContractSetup:
    """Write RoMa's symmetric replacement network, and match all positions of its coarse warp."""
    return ContractSetup(
        options={**_stand_in(folder), "cell": 1, "min_certainty": 0.5}, truth_source="image"
    )


def sparse(folder: Path) -> ContractSetup:
    """Write RoMa's replacement network, and match keypoints within 3 pixels of the warp."""
    return ContractSetup(
        options={**_stand_in(folder), "snap_px": 3.0, "min_certainty": 0.5},
        truth_source="image",
        expected_failures={
            "matcher-sizes": "comparing patches is not invariant to scale",
            "matcher-large-view": "the warp of the test network is too coarse to snap keypoints",
        },
    )


def _stand_in(folder: Path) -> dict[str, Any]:
    height, width = _GRID
    x, y = ((np.arange(n) + 0.5) / n * 2 - 1 for n in (width, height))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    dimensions = 3 * _SIDE**2
    kernel = np.eye(dimensions).reshape(dimensions, 3, _SIDE, _SIDE)
    shapes = {"rows": [-1, dimensions], "map": [1, height, width, 4], "single": [1, height, width]}
    text = _MATCHING.replace("VIEWS", "".join(_VIEW.replace("@", s) for s in "AB"))
    model = save_model(
        text,
        folder / "roma.onnx",
        kernel=kernel,
        grid=grid,
        small=[0.05],
        **{name: np.array(shape) for name, shape in shapes.items()},
    )
    return {"model": str(model), "height": height, "width": width}
