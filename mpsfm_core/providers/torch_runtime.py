"""Helpers for provider plugins that run torch networks.

Only modules with provider code may import this module, because it imports torch.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch.overrides import TorchFunctionMode

from mpsfm_core.providers import ProviderContext

_DETERMINISTIC = threading.Lock()
"""Lock of torch's process-wide switch for deterministic algorithms."""


def use_threads(context: ProviderContext) -> None:
    """Set torch's number of CPU threads for the whole process."""
    torch.set_num_threads(context.threads)


class SkipRandomWeights(TorchFunctionMode):
    """Context manager that leaves the weights of new layers uninitialized.

    Drawing random weights takes seconds for a large network, whose weights are then loaded from a
    file. The caller has to load all weights of the network.
    """

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Call a function of torch, unless the function fills a tensor with random numbers."""
        named = kwargs or {}
        if func.__name__.endswith(("uniform_", "normal_")):
            return args[0] if args else named["tensor"]
        return func(*args, **named)


@contextmanager
def inference() -> Iterator[None]:
    """Disable torch's gradients and nondeterministic cuDNN kernels in a ``with`` block."""
    with (
        torch.inference_mode(),
        torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True),
    ):
        yield


@contextmanager
def deterministic_algorithms() -> Iterator[None]:
    """Use torch's deterministic algorithms in a ``with`` block, in one thread at a time.

    Some functions of torch, such as ``scatter_add_``, add in any order on a GPU, and then repeated
    calls differ in the last bits.
    """
    with _DETERMINISTIC:
        enabled = torch.are_deterministic_algorithms_enabled()
        warn_only = torch.is_deterministic_algorithms_warn_only_enabled()
        torch.use_deterministic_algorithms(True, warn_only=True)
        try:
            yield
        finally:
            torch.use_deterministic_algorithms(enabled, warn_only=warn_only)
