"""Loading of Hub models from safetensors and configuration, without executing their code."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import torch
from transformers.utils import logging as hub_logging

from mpsfm_core import ProviderContext
from mpsfm_core.data.errors import WeightsError
from mpsfm_core.providers.torch_runtime import use_threads
from mpsfm_transformers.options import CONFIG, FILES, PROCESSOR, WEIGHTS, HubOptions


class LoadedModel:
    """Model in evaluation mode and float32, on the device of the provider context.

    ``network`` is the module that ``family.from_pretrained`` returns. ``preprocessor`` is the
    content of ``preprocessor_config.json``. The context manager ``folder()`` provides all files in
    one folder.

    Raises:
        WeightsError: A model file is missing or damaged, belongs to another architecture, or
            requires code of the model repository.
    """

    def __init__(
        self, family: Any, options: HubOptions, context: ProviderContext, **config: Any
    ) -> None:
        use_threads(context)
        hashes = (None, None, options.sha256)
        self._name = options.model
        self._paths = [
            context.resolve_weights(uri, sha256)
            for uri, sha256 in zip(options.uris(), hashes, strict=True)
        ]
        self.device = context.device
        text = self._paths[FILES.index(PROCESSOR)].read_text(encoding="utf-8")
        self.preprocessor: dict[str, Any] = json.loads(text)
        with self.folder() as folder, _explained(options.model), quiet():
            network, report = family.from_pretrained(
                folder,
                local_files_only=True,
                use_safetensors=True,
                dtype=torch.float32,
                trust_remote_code=False,
                output_loading_info=True,
                **config,
            )
        missing = sorted(report["missing_keys"])
        if missing:
            raise WeightsError(
                f"{options.model}: {WEIGHTS} does not fit {CONFIG}: tensor {missing[0]!r} and "
                f"{len(missing) - 1} more are missing"
            )
        self.network = network.eval().to(context.device)

    @contextmanager
    def folder(self) -> Iterator[Path]:
        """Provide a folder in which the model files have their original names."""
        with ExitStack() as stack:
            folder = self._paths[0].parent
            if any(path != folder / name for path, name in zip(self._paths, FILES, strict=True)):
                folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="mpsfm-hub-")))
                for path, name in zip(self._paths, FILES, strict=True):
                    (folder / name).symlink_to(path.absolute())
            yield folder

    def processor(self, family: Any) -> Any:
        """Return the model's image processor in its PIL version, which needs no torchvision."""
        with self.folder() as folder, _explained(self._name), quiet():
            return family.from_pretrained(
                folder, local_files_only=True, backend="pil", trust_remote_code=False
            )


@contextmanager
def _explained(model: str) -> Iterator[None]:
    """Convert all errors of the library transformers to :class:`WeightsError`."""
    try:
        yield
    except Exception as error:  # the errors of transformers share no base class
        reason = str(error).strip().splitlines() or [""]
        raise WeightsError(
            f"the model {model} cannot be loaded by transformers: "
            f"{type(error).__name__}: {reason[0]}"
        ) from error


@contextmanager
def quiet() -> Iterator[None]:
    """Disable progress bars and warnings of the library transformers."""
    level, bars = hub_logging.get_verbosity(), hub_logging.is_progress_bar_enabled()
    hub_logging.set_verbosity_error()
    hub_logging.disable_progress_bar()
    try:
        yield
    finally:
        hub_logging.set_verbosity(level)
        if bars:
            hub_logging.enable_progress_bar()
