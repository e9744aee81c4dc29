"""Small ONNX network that replaces MASt3R in the contract tests by comparing patches."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from mpsfm_onnx.stand_in import save_model

from mpsfm_core.testing import ContractSetup

_SIDE = 5
_VIEW = """
    patch_@ = Conv <pads = [6, 6, 6, 6], dilations = [3, 3]> (img@, kernel)
    last_@ = Transpose <perm = [0, 2, 3, 1]> (patch_@)
    mean_@ = ReduceMean <axes = [3]> (last_@)
    plain_@ = Sub (last_@, mean_@)
    norm_@ = ReduceL2 <axes = [3]> (plain_@)
    safe_@ = Add (norm_@, small)
    desc_@ = Div (plain_@, safe_@)
    desc_conf_@ = Squeeze (safe_@, three)
    pts3d_@ = Transpose <perm = [0, 2, 3, 1]> (img@)
    conf_@ = Add (desc_conf_@, one)
"""
_TENSORS = (
    "float[b,h@,w@,3] pts3d_@, float[b,h@,w@] conf_@, float[b,h@,w@,d] desc_@, "
    "float[b,h@,w@] desc_conf_@"
)


def dense(folder: Path) -> ContractSetup:
    """Write MASt3R's replacement network, with small inputs to compare all pixels quickly."""
    return ContractSetup(options={**_stand_in(folder), "subsample": 8}, truth_source="image")


def sparse(folder: Path) -> ContractSetup:
    """Write MASt3R's replacement network for matching the keypoints of any detector."""
    return ContractSetup(
        options=_stand_in(folder),
        truth_source="image",
        expected_failures={"matcher-sizes": "comparing patches is not invariant to scale"},
    )


def _stand_in(folder: Path) -> dict[str, Any]:
    text = "mast3r (float[b,3,h1,w1] img1, float[b,3,h2,w2] img2) => (OUT) { BODY }"
    text = text.replace("OUT", ", ".join(_TENSORS.replace("@", side) for side in "12"))
    text = text.replace("BODY", "".join(_VIEW.replace("@", side) for side in "12"))
    dimensions = 3 * _SIDE**2
    kernel = np.eye(dimensions).reshape(dimensions, 3, _SIDE, _SIDE)
    arrays: dict[str, Any] = {
        "kernel": kernel,
        "small": [0.05],
        "one": [1.0],
        "three": np.array([3]),
    }
    model = save_model(text, folder / "mast3r.onnx", **arrays)
    return {"model": str(model), "size": 128}
