"""Helpers for provider plugins that run torch networks.

Only provider modules may import this module, because it imports torch.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from mpsfm_core.providers import ProviderContext


def use_threads(context: ProviderContext) -> None:
    """Set the number of CPU threads of torch for the whole process."""
    torch.set_num_threads(context.threads)


@contextmanager
def inference() -> Iterator[None]:
    """Disable gradients and nondeterministic kernels of torch for a block of code."""
    with (
        torch.inference_mode(),
        torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True),
    ):
        yield
