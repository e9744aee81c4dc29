"""Training losses."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn import functional

from training.batches import Batch
from training.samples import EMPTY, SURFACE, UNKNOWN

_WEIGHTS = {
    "shape": 1.0,
    "scale": 0.8,
    "edges": 0.6,
    "std": 0.3,
    "normals": 0.7,
    "angle": 0.2,
    "validity": 0.1,
}
"""Weight of each loss term. The weights give the gradients of all loss terms a similar initial norm
in shared layers.
"""
_EMPTY_WEIGHT = 3.0
"""Loss weight of pixels without a surface, which are rare."""


def losses(out: Mapping[str, Tensor], batch: Batch) -> dict[str, Tensor]:
    """Compute the weighted terms of the training loss.

    The depth terms are the absolute log-depth error after aligning the scale of each image, the
    log-scale error of metric samples, and the error of log-depth gradients. The term of the
    predicted std is the negative Laplace log-likelihood of residuals of measured depth. The std
    term has no gradient with respect to the predicted depth.
    """
    known = batch.known
    measured = known & (batch.kind == SURFACE)
    residual = torch.where(known, out["log_depth"] - batch.log_depth, 0.0)
    count = known.sum((1, 2, 3)).clamp(min=1)
    offset = residual.sum((1, 2, 3)) / count
    shape = torch.where(known, residual - offset[:, None, None, None], 0.0)
    error = shape.abs()
    log_std = out["log_std"]
    metric = batch.metric.float()
    parts = {
        "shape": _mean(error, known),
        "scale": (offset.abs() * metric).sum() / metric.sum().clamp(min=1),
        "edges": _edges(residual, measured),
        "std": _mean(error.detach() * torch.exp(-log_std) + log_std, measured),
    }
    seen = batch.normals.square().sum(1, keepdim=True) > 0.5
    truth = functional.normalize(batch.normals, dim=1)
    cosine = (out["normals"] * truth).sum(1, keepdim=True)
    angle = torch.acos(cosine.clamp(-0.9999, 0.9999))
    log_angle = out["log_angle"]
    parts["normals"] = _mean(angle, seen)
    parts["angle"] = _mean(angle.detach() * torch.exp(-log_angle) + 2 * log_angle, seen)
    empty = (batch.kind == EMPTY).float()
    cross = functional.binary_cross_entropy_with_logits(
        out["validity"], 1 - empty, reduction="none"
    )
    parts["validity"] = _mean(cross * (1 + (_EMPTY_WEIGHT - 1) * empty), batch.kind != UNKNOWN)
    return {name: _WEIGHTS[name] * part for name, part in parts.items()}


def _edges(residual: Tensor, known: Tensor) -> Tensor:
    total = residual.new_zeros(())
    for step in (1, 2, 4, 8):
        for axis in (2, 3):
            size = residual.shape[axis] - step
            a, b = residual.narrow(axis, 0, size), residual.narrow(axis, step, size)
            both = known.narrow(axis, 0, size) & known.narrow(axis, step, size)
            total = total + _mean((a - b).abs(), both) / 4
    return total


def _mean(values: Tensor, where: Tensor) -> Tensor:
    return torch.where(where, values, 0.0).sum() / where.sum().clamp(min=1)
