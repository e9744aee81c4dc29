"""Helpers for plugins with torch networks. Imports torch: only for their heavy modules."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from mpsfm_core.providers import ProviderContext


def use_threads(context: ProviderContext) -> None:
    """Set the number of threads of torch, which applies to the whole process."""
    torch.set_num_threads(context.threads)


@contextmanager
def inference() -> Iterator[None]:
    """Disable gradients and nondeterministic kernels of torch."""
    with (
        torch.inference_mode(),
        torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True),
    ):
        yield
