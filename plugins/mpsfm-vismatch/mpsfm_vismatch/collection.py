"""Loading of the matching networks of vismatch by name."""

from __future__ import annotations

import importlib
from contextlib import AbstractContextManager, nullcontext
from typing import Any

from mpsfm_core import ProviderContext
from mpsfm_core.data.errors import ConfigError, did_you_mean
from mpsfm_core.providers.torch_runtime import use_threads


def load(name: str, context: ProviderContext, max_keypoints: int = 2048) -> Any:
    """Load a vismatch matcher by name, or a class ``package.module:Class``.

    vismatch downloads weights to the cache folders of the Hugging Face Hub and of torch.

    Raises:
        ConfigError: vismatch has no matcher of this name.
    """
    use_threads(context)
    if ":" in name:
        module, _, attribute = name.partition(":")
        make = getattr(importlib.import_module(module), attribute)
        return make(device=context.device, max_num_keypoints=max_keypoints)
    import vismatch

    if name not in vismatch.available_models:
        hint = did_you_mean(name, vismatch.available_models)
        raise ConfigError(f"vismatch {vismatch.__version__} has no matcher {name!r}{hint}")
    return vismatch.get_matcher(name, device=context.device, max_num_keypoints=max_keypoints)


def provide_imports(matcher: Any) -> AbstractContextManager[Any]:
    """Return a context manager that sets the import path for the code of a vismatch matcher."""
    home = type(matcher).__module__
    if not home.startswith("vismatch."):
        return nullcontext()
    from vismatch.import_sandbox import ImportSandbox

    sandbox: AbstractContextManager[Any] = ImportSandbox.get(home)
    return sandbox


def get_inner_network(matcher: Any, name: str, *attributes: str) -> Any:
    """Return the network inside a vismatch matcher: its first attribute in ``attributes``."""
    for attribute in attributes:
        if hasattr(matcher, attribute):
            return getattr(matcher, attribute)
    raise ConfigError(
        f"the matcher {name!r} has none of the attributes {', '.join(attributes)}: choose another "
        f"network for this provider"
    )
