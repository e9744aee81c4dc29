"""RoMa matchers that run in torch instead of from an ONNX file."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import mpsfm_roma.matcher as roma
import numpy as np
from mpsfm_roma.network import WarpNetwork
from numpy.typing import NDArray
from PIL import Image

from mpsfm_core import ProviderContext, View
from mpsfm_core.providers.torch_runtime import inference
from mpsfm_vismatch.collection import get_inner_network, load, provide_imports
from mpsfm_vismatch.options import RomaNetwork


class TorchWarpNetwork(WarpNetwork):
    """RoMa network in torch, called by the authors' function ``match``.

    RoMa's function ``match`` resizes the images and runs both passes of the network. The images are
    written to files, because RoMa opens them again for the second pass.
    """

    def __init__(self, options: RomaNetwork, context: ProviderContext) -> None:
        self._matcher = load(options.network, context)
        self._network = get_inner_network(
            self._matcher, options.network, "roma_model", "matcher", "model"
        )
        self._device = context.device

    def answer(self, view_a: View, view_b: View) -> tuple[NDArray[Any], NDArray[Any], bool]:
        """Run RoMa in torch, see :class:`~mpsfm_roma.network.WarpNetwork`."""
        with tempfile.TemporaryDirectory(prefix="mpsfm-") as folder, inference():
            paths = []
            for side, view in zip("ab", (view_a, view_b), strict=True):
                paths.append(str(Path(folder, f"{side}.png")))
                Image.fromarray(view.image).save(paths[-1], compress_level=0)
            with provide_imports(self._matcher):
                warp, certainty = self._network.match(*paths, device=self._device)
        arrays = (np.squeeze(t.float().cpu().numpy()) for t in (warp, certainty))
        return *arrays, bool(self._network.symmetric)


class DenseMatcher(roma.DenseMatcher):
    """Dense RoMa matcher in torch, see :class:`mpsfm_roma.matcher.DenseMatcher`."""

    network = TorchWarpNetwork


class SparseMatcher(roma.SparseMatcher):
    """Sparse RoMa matcher in torch, see :class:`mpsfm_roma.matcher.SparseMatcher`."""

    network = TorchWarpNetwork
