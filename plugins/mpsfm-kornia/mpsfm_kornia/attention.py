"""Memory-efficient cross attention for LightGlue on CPUs.

On a GPU, kornia computes LightGlue's attention by ``scaled_dot_product_attention``. On a CPU,
kornia builds the attention matrix between all keypoints of both images for each head and layer, and
spends most of the time on memory transfers.
"""

from __future__ import annotations

import torch
from kornia.feature import LightGlue
from kornia.feature.lightglue import CrossBlock
from torch import nn
from torch.nn.functional import scaled_dot_product_attention


class FusedCrossBlock(nn.Module):
    """Replacement of kornia's cross-attention block with the same layers and layer names."""

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
        """Apply cross attention to the descriptors (b, m, d) and (b, n, d) of two images."""
        qk0, qk1 = self._by_head(self.to_qk(x0)), self._by_head(self.to_qk(x1))
        v0, v1 = self._by_head(self.to_v(x0)), self._by_head(self.to_v(x1))
        m0 = scaled_dot_product_attention(qk0, qk1, v1)
        m1 = scaled_dot_product_attention(qk1, qk0, v0)
        return self._updated(x0, m0), self._updated(x1, m1)

    def _by_head(self, x: torch.Tensor) -> torch.Tensor:
        """Reshape a tensor from (b, n, d) to (b, heads, n, d / heads)."""
        return x.unflatten(-1, (self._heads, -1)).transpose(1, 2)

    def _updated(self, x: torch.Tensor, message: torch.Tensor) -> torch.Tensor:
        heard: torch.Tensor = self.to_out(message.transpose(1, 2).flatten(start_dim=-2))
        updated: torch.Tensor = x + self.ffn(torch.cat([x, heard], -1))
        return updated


def fuse_cross_attention(network: LightGlue) -> None:
    """Replace the cross-attention blocks of a LightGlue network, with unchanged weights."""
    for layer in network.transformers:
        layer.cross_attn = FusedCrossBlock(layer.cross_attn)
