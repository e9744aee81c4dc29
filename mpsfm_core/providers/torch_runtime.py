"""What plugins with networks in torch share. Imports torch: for their heavy modules only."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from mpsfm_core.providers import ProviderContext


def use_threads(context: ProviderContext) -> None:
    """Give torch the context's threads. This setting is torch's, for the whole process."""
    torch.set_num_threads(context.threads)


@contextmanager
def inference() -> Iterator[None]:
    """No gradients, and the same result for the same input."""
    with (
        torch.inference_mode(),
        torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True),
    ):
        yield
