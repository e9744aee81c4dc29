"""MASt3R matchers that run in torch instead of from an ONNX file."""

from __future__ import annotations

from typing import Any

import mpsfm_mast3r.matcher as mast3r
import torch
from mpsfm_mast3r.network import PairNetwork, Tensors

from mpsfm_core import ProviderContext
from mpsfm_core.data import Float32
from mpsfm_core.providers.torch_runtime import inference
from mpsfm_vismatch.collection import get_inner_network, load, provide_imports


class TorchPairNetwork(PairNetwork):
    """MASt3R network in torch, called with both views."""

    def __init__(self, options: Any, context: ProviderContext) -> None:
        super().__init__(options.size)
        self._matcher = load(options.network, context)
        self._network = get_inner_network(self._matcher, options.network, "model").eval()
        self._device = context.device

    def answer(self, first: Float32, second: Float32) -> tuple[Tensors, Tensors]:
        """Run MASt3R in torch, see :class:`~mpsfm_mast3r.network.PairNetwork`."""
        views = [
            {
                "img": torch.from_numpy(image).to(self._device),
                "true_shape": torch.tensor([image.shape[2:]]),
                "idx": side,
                "instance": [str(side)],
            }
            for side, image in enumerate((first, second))
        ]
        with inference(), provide_imports(self._matcher):
            one, two = self._network(*views)
        in_first = ("pts3d", "pts3d_in_other_view")
        return _tensors(one, in_first[0]), _tensors(two, in_first[1])


def _tensors(answer: dict[str, torch.Tensor], points: str) -> Tensors:
    names = (points, "conf", "desc", "desc_conf")
    return [answer[name][0].float().cpu().numpy() for name in names]


class DenseMatcher(mast3r.DenseMatcher):
    """Dense MASt3R matcher in torch, see :class:`mpsfm_mast3r.matcher.DenseMatcher`."""

    network = TorchPairNetwork


class SparseMatcher(mast3r.SparseMatcher):
    """Sparse MASt3R matcher in torch, see :class:`mpsfm_mast3r.matcher.SparseMatcher`."""

    network = TorchPairNetwork
