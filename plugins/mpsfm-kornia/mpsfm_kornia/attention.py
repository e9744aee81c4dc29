"""LightGlue's cross attention without its matrix, for CPUs.

On a GPU kornia runs it by ``scaled_dot_product_attention``. On a CPU it builds the matrix between
all keypoints of both images, twice the softmax and a transposed copy of it for each head and layer:
at 4096 keypoints and 4 heads 268 MB each, and most of the time is spent moving them.
"""

from __future__ import annotations

import torch
from kornia.feature import LightGlue
from kornia.feature.lightglue import CrossBlock
from torch import nn
from torch.nn.functional import scaled_dot_product_attention


class FusedCrossBlock(nn.Module):
    """Computes what a :class:`CrossBlock` does with that block's own layers and their names."""

    def __init__(self, block: CrossBlock) -> None:
        super().__init__()
        self._heads = block.heads
        self.to_qk, self.to_v, self.to_out, self.ffn = (
            block.to_qk,
            block.to_v,
            block.to_out,
            block.ffn,
        )

    def forward(self, x0: torch.Tensor, x1: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Descriptors (b, m, d) and (b, n, d) of two images after looking at each other."""
        qk0, qk1 = self._by_head(self.to_qk(x0)), self._by_head(self.to_qk(x1))
        v0, v1 = self._by_head(self.to_v(x0)), self._by_head(self.to_v(x1))
        m0 = scaled_dot_product_attention(qk0, qk1, v1)
        m1 = scaled_dot_product_attention(qk1, qk0, v0)
        return self._updated(x0, m0), self._updated(x1, m1)

    def _by_head(self, x: torch.Tensor) -> torch.Tensor:
        """(b, n, d) as (b, heads, n, d / heads)."""
        return x.unflatten(-1, (self._heads, -1)).transpose(1, 2)

    def _updated(self, x: torch.Tensor, message: torch.Tensor) -> torch.Tensor:
        heard: torch.Tensor = self.to_out(message.transpose(1, 2).flatten(start_dim=-2))
        updated: torch.Tensor = x + self.ffn(torch.cat([x, heard], -1))
        return updated


def fuse_cross_attention(network: LightGlue) -> None:
    """Replace the cross blocks of this network (not of kornia's classes); weights stay its own."""
    for layer in network.transformers:
        layer.cross_attn = FusedCrossBlock(layer.cross_attn)
