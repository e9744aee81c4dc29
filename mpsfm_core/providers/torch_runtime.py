"""Helpers for provider plugins that run torch networks.

Only modules with provider code may import this module, because it imports torch.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from mpsfm_core.providers import ProviderContext


def use_threads(context: ProviderContext) -> None:
    """Set torch's number of CPU threads for the whole process."""
    torch.set_num_threads(context.threads)


@contextmanager
def inference() -> Iterator[None]:
    """Disable torch's gradients and nondeterministic cuDNN kernels in a ``with`` block."""
    with (
        torch.inference_mode(),
        torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True),
    ):
        yield
