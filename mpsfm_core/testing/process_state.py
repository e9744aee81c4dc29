"""Global state of this process, which providers must not change."""

from __future__ import annotations

import gc
import locale
import logging
import multiprocessing
import os
import pickle
import random
import signal
import socket
import sys
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mpsfm_core.providers import ProviderContext

_SEED = 271828
"""Seed of the global random numbers during a check, which no provider's own seed reproduces."""
_ENVIRONMENT = "environment variables"
_THREADS = ("the threads of OpenCV", "the threads of torch")
"""Settings of the number of threads, which a provider may set to the number in its context."""
_NUM_THREADS = 3
_TEMPORARY_PREFIX = "mpsfm-temporary-"
"""Prefix of the temporary folder that an observed provider uses."""
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_TORCH_NUMBERS = "the random numbers of torch"
_BACKEND_FLAGS = (True, False, True, False)
"""Defaults of the flags that :func:`_backend_flags` returns."""
_PILLOW_LIMIT = 89478485
"""Default of ``PIL.Image.MAX_IMAGE_PIXELS``."""


@dataclass(frozen=True)
class ProcessSettings:
    """Values of the global process state, by the name that messages use."""

    values: dict[str, Any]
    environment: dict[str, str]
    """Environment variables of the process."""

    def changes(self, later: ProcessSettings, *, without_torch_numbers: bool = False) -> str:
        """Describe the first value that differs in a later process state, or return an empty text.

        Args:
            later: Values of the later process state.
            without_torch_numbers: True ignores torch's random numbers, because the constructors of
                torch's layers draw random weights.
        """
        for name, value in self.values.items():
            if without_torch_numbers and name == _TORCH_NUMBERS:
                continue
            now = later.values.get(name, value)
            if now != value and not (name in _THREADS and now == ProviderContext.threads):
                return name
        if _ENVIRONMENT in self.values:
            old, new = self.environment, later.environment
            names = [key for key in {**old, **new} if old.get(key) != new.get(key)]
            if names:
                return f"the environment variables {', '.join(sorted(names))}"
        return ""


def read_process_settings() -> ProcessSettings:
    """Read the global settings of the process that importing a library does not change."""
    torch: Any = sys.modules.get("torch")
    is_loaded = torch is not None and hasattr(torch, "is_grad_enabled")
    root = logging.getLogger()
    return ProcessSettings(
        {
            "the error handling of numpy": np.geterr(),
            "the print options of numpy": np.get_printoptions(),
            "the recursion limit": sys.getrecursionlimit(),
            "the working directory": str(Path.cwd()),
            "the level of the root logger": root.level,
            "the disabled levels of logging": logging.root.manager.disable,
            "the handlers of the root logger": list(map(id, root.handlers)),
            "the warning filters": [f for f in warnings.filters if _is_blanket(f)],
            "the gradient mode of torch": torch.is_grad_enabled() if is_loaded else True,
            "the inference mode of torch": (
                torch.is_inference_mode_enabled() if is_loaded else False
            ),
            "the default type of torch": (
                str(torch.get_default_dtype()) if is_loaded else "torch.float32"
            ),
            "the backend flags of torch": _backend_flags(torch) if is_loaded else _BACKEND_FLAGS,
            "the image limits of Pillow": _pillow_limits(),
            "the level of the logger of mpsfm_core": logging.getLogger("mpsfm_core").level,
            "the switch interval of threads": sys.getswitchinterval(),
            "standard output": id(sys.stdout),
            "standard error": id(sys.stderr),
            "the hook for uncaught exceptions": id(sys.excepthook),
            "the display of warnings": id(warnings.showwarning),
            "the default timeout of sockets": socket.getdefaulttimeout(),
            "the locale": locale.setlocale(locale.LC_ALL),
            "the garbage collection": gc.isenabled(),
            "the start method of processes": multiprocessing.get_start_method(allow_none=True),
            "the signal handlers": [id(signal.getsignal(s)) for s in _SIGNALS],
            "the matrix precision of torch": (
                torch.get_float32_matmul_precision() if is_loaded else "highest"
            ),
            "the deterministic mode of torch": (
                torch.are_deterministic_algorithms_enabled() if is_loaded else False
            ),
        },
        dict(os.environ),
    )


def read_process_state() -> ProcessSettings:
    """Read the global process state with random numbers, environment variables and files."""
    torch: Any = sys.modules.get("torch")
    cv2: Any = sys.modules.get("cv2")
    settings = read_process_settings()
    values = settings.values | {
        "the random numbers of numpy": pickle.dumps(np.random.get_state()),
        "the random numbers of Python": random.getstate(),
        "the files of the working directory": sorted(p.name for p in Path.cwd().iterdir()),
        "the module search path": list(sys.path),
        "the warning filters": list(warnings.filters),
        "the temporary files": _list_temporary_files(),
        _ENVIRONMENT: None,
    }
    if cv2 is not None:
        values["the threads of OpenCV"] = cv2.getNumThreads()
    if torch is not None and hasattr(torch, "get_rng_state"):
        values["the seed of torch"] = torch.initial_seed()
        values["the threads of torch"] = torch.get_num_threads()
        values[_TORCH_NUMBERS] = torch.get_rng_state().numpy().tobytes()
    return ProcessSettings(values, settings.environment)


@contextmanager
def known_process_state(before: ProcessSettings) -> Iterator[None]:
    """Reset environment and random numbers in a ``with`` block, so that changes are visible.

    Changes that a provider made before the block do not hide changes that the provider repeats in
    each call. The working directory in the block is an empty folder. Environment and random numbers
    are restored after the block.

    Args:
        before: Global settings before the provider was created.
    """
    environment, folder = dict(os.environ), Path.cwd()
    cv2: Any = sys.modules.get("cv2")
    numbers, python_numbers = np.random.get_state(), random.getstate()
    torch: Any = sys.modules.get("torch")
    with ExitStack() as stack:
        stack.enter_context(warnings.catch_warnings())
        warnings.resetwarnings()  # A repeated filter changes nothing.
        if torch is not None and hasattr(torch, "random"):
            stack.enter_context(torch.random.fork_rng(devices=[]))
            torch.manual_seed(_SEED)
            stack.callback(torch.set_num_threads, torch.get_num_threads())
            torch.set_num_threads(_NUM_THREADS)
        if cv2 is not None:
            stack.callback(cv2.setNumThreads, cv2.getNumThreads())
            cv2.setNumThreads(_NUM_THREADS)
        os.chdir(stack.enter_context(tempfile.TemporaryDirectory(prefix="mpsfm-state-")))
        stack.callback(setattr, tempfile, "tempdir", tempfile.tempdir)
        tempfile.tempdir = stack.enter_context(
            tempfile.TemporaryDirectory(prefix=_TEMPORARY_PREFIX)
        )
        for key in set(environment) - set(before.environment):
            del os.environ[key]
        np.random.seed(_SEED)
        random.seed(_SEED)
        try:
            yield
        finally:
            os.chdir(folder)
            os.environ.update(environment)
            np.random.set_state(numbers)
            random.setstate(python_numbers)


def _list_temporary_files() -> list[str]:
    """Return the names of temporary files if this process has a temporary folder of its own."""
    folder = Path(tempfile.gettempdir())
    return sorted(p.name for p in folder.iterdir()) if _TEMPORARY_PREFIX in folder.name else []


def _backend_flags(torch: Any) -> tuple[bool, ...]:
    """Return the flags of torch that choose algorithms and precision."""
    backends = torch.backends
    cudnn = backends.cudnn
    return cudnn.enabled, cudnn.benchmark, cudnn.allow_tf32, backends.cuda.matmul.allow_tf32


def _pillow_limits() -> tuple[Any, ...]:
    """Return the limits of Pillow for the size of images and for truncated files."""
    image, file = sys.modules.get("PIL.Image"), sys.modules.get("PIL.ImageFile")
    limit = getattr(image, "MAX_IMAGE_PIXELS", _PILLOW_LIMIT)
    return limit, getattr(file, "LOAD_TRUNCATED_IMAGES", False)


def _is_blanket(rule: Any) -> bool:
    """Return whether a warning filter applies to all warnings of all modules."""
    _, message, category, module, _ = rule
    return message is None and module is None and category is Warning
