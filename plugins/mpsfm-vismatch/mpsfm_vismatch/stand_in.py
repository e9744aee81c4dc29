"""Small matchers that compare patches and replace vismatch networks in the contract tests."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from PIL import Image
from torch.nn.functional import normalize, unfold

_SIDE, _REACH = 5, 3
_STEP = 3
"""Step in pixels between the positions that :class:`Matching` matches. An odd step avoids a bias of
positions in half-size images.
"""
_GRID = (42, 56)
"""Rows and columns of the warp that :class:`Warping` returns."""
_FLAT = 0.05
"""Contrast of a patch at which its descriptor has half of the unit length."""


def _described(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute patch descriptors (h * w, d) and contrast (h * w,) of an image (1, 3, h, w).

    Patch descriptors have nearly unit length, and less in flat regions.
    """
    around = unfold(image, _SIDE, dilation=_REACH, padding=_SIDE // 2 * _REACH)[0].T
    around = around - around.mean(dim=1, keepdim=True)
    contrast = around.norm(dim=1) + _FLAT
    return around / contrast[:, None], contrast


class Warping:
    """Replacement of vismatch's RoMa matcher and of the RoMa network inside this matcher."""

    symmetric = True

    def __init__(self, device: str = "cpu", max_num_keypoints: int = 2048) -> None:
        self.roma_model = self

    def match(self, path_a: str, path_b: str, device: str) -> tuple[torch.Tensor, torch.Tensor]:
        """Compute warps in both directions and their certainty, on a coarse grid of both images."""
        height, width = _GRID
        a, b = (_described(_opened(path, (width, height)))[0] for path in (path_a, path_b))
        similarity = a @ b.T
        x, y = (torch.linspace(-1 + 1 / n, 1 - 1 / n, n) for n in (width, height))
        grid = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 2)
        there, back = similarity.max(dim=1), similarity.max(dim=0)
        maps = [
            torch.cat(pair, dim=1).reshape(height, width, 4)
            for pair in ((grid, grid[there.indices]), (grid[back.indices], grid))
        ]
        sure = [found.values.clamp(0, 1).reshape(height, width) ** 2 for found in (there, back)]
        return torch.cat(maps, dim=1), torch.cat(sure, dim=1)


class Pointing:
    """Replacement of vismatch's MASt3R matcher, whose 3D points are shifted pixel colors."""

    def __init__(self, device: str = "cpu", max_num_keypoints: int = 2048) -> None:
        self.model = torch.nn.Module()
        self.model.forward = self.forward  # type: ignore[method-assign]

    def forward(self, *views: dict[str, Any]) -> list[dict[str, torch.Tensor]]:
        """Compute MASt3R's outputs for both views: points, descriptors and confidences."""
        answers = []
        for view, name in zip(views, ("pts3d", "pts3d_in_other_view"), strict=True):
            image = view["img"]
            shape = (1, *image.shape[2:])
            described, contrast = _described(image)
            answers.append(
                {
                    name: image.permute(0, 2, 3, 1) + 2,
                    "conf": contrast.reshape(shape) + 1,
                    "desc": normalize(described, dim=1).reshape(*shape, -1),
                    "desc_conf": contrast.reshape(shape),
                }
            )
        return answers


class Matching:
    """Replacement of any vismatch matcher, by mutual nearest neighbors of patches on a grid."""

    def __init__(self, device: str = "cpu", max_num_keypoints: int = 2048) -> None:
        self._most = max_num_keypoints

    def __call__(self, image_a: torch.Tensor, image_b: torch.Tensor) -> dict[str, Any]:
        """Match two images, and return matches in a dictionary of vismatch's format."""
        a, b = (_described(image[None])[0] for image in (image_a, image_b))
        width = image_a.shape[2]
        columns, rows = torch.meshgrid(
            torch.arange(0, width, _STEP), torch.arange(0, image_a.shape[1], _STEP), indexing="xy"
        )
        cells = (rows * width + columns).reshape(-1)
        similarity, there = (a[cells] @ b.T).max(dim=1)
        back = (b[there] @ a.T).argmax(dim=1)
        kept = torch.nonzero(back == cells)[: self._most, 0]
        cells, there = cells[kept], there[kept]
        return {
            "all_kpts0": np.empty((0, 2)),
            "matched_kpts0": _positions(cells, width),
            "matched_kpts1": _positions(there, image_b.shape[2]),
            "matched_confidences": similarity[kept].numpy(),
        }


def _positions(cells: torch.Tensor, width: int) -> np.ndarray[Any, Any]:
    return torch.stack([cells % width, cells // width], dim=1).double().numpy()


def _opened(path: str, size: tuple[int, int]) -> torch.Tensor:
    image = Image.open(path).resize(size, Image.Resampling.BICUBIC)
    return torch.from_numpy(np.array(image)).permute(2, 0, 1)[None] / 127.5 - 1
