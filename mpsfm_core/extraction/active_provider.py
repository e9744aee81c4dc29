"""The chosen providers while they are in use: what identifies them, and an instance a thread."""

from __future__ import annotations

import importlib
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

from mpsfm_core.config import RuntimeOptions
from mpsfm_core.data.errors import ProviderRunError
from mpsfm_core.providers import API_VERSION, Capability, Kind, ProviderContext, ProviderSpec
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.registry import Registry
from mpsfm_core.providers.weights import WeightStore, file_sha256, is_remote
from mpsfm_core.support.threads import count_cores

T = TypeVar("T")

_MAX_WORKERS = 4
"""Automatic: every worker has its own copy of a network; more cores become its threads."""
_LONGEST_URI = 1000


@dataclass
class Usage:
    """How often a provider was asked, how often the cache answered, and its time in seconds."""

    computed: int = 0
    cached: int = 0
    seconds: float = 0.0


class ActiveProvider:
    """A provider chosen in the configuration.

    It is constructed when the first result is computed, once in each thread: a run that finds
    everything in the cache loads no network.
    """

    def __init__(
        self, kind: Kind, backend: ProviderConfig, registry: Registry, runtime: RuntimeOptions
    ) -> None:
        self.kind = kind
        self.backend = backend
        self.spec: ProviderSpec = registry.spec(kind, backend.use)
        self.usage = Usage()
        self._registry = registry
        self._runtime = runtime
        self._store = WeightStore(runtime.cache_dir, True if runtime.offline else None)
        self._local = threading.local()
        self._lock = threading.Lock()
        self._identity: dict[str, Any] | None = None
        self._known: set[str] = set()

    def can(self, capability: Capability) -> bool:
        """Whether the provider declares a capability."""
        return capability in self.spec.capabilities

    @property
    def identity(self) -> dict[str, Any]:
        """All that its output depends on besides its input, as plain data."""
        with self._lock:
            if self._identity is None:
                self._identity = self._identify()
            return self._identity

    @property
    def instance(self) -> Any:
        """The provider, this thread's own."""
        if not hasattr(self._local, "provider"):
            with self._lock:  # imports and downloads once, not in every thread at the same time
                self._local.provider = self._create()
        return self._local.provider

    @property
    def workers(self) -> int:
        """How many threads may use it: one with a GPU."""
        return 1 if _device(self._runtime, self.spec) == "cuda" else worker_count(self._runtime)

    def timed(self, key: str, compute: Callable[[Any], T], timeout_s: float | None = None) -> T:
        """Compute the result named ``key`` with this thread's instance, on the provider's clock.

        Raises :class:`ProviderRunError` when it takes longer than ``timeout_s``. A thread cannot be
        killed: it stays behind, and another instance answers from then on.
        """
        provider = self.instance
        started = time.perf_counter()
        try:
            result = run_with_timeout(timeout_s, lambda: compute(provider))
        except TimeoutError as error:
            del self._local.provider
            raise ProviderRunError(
                f"provider {self.spec.name!r}: no answer run_with_timeout {timeout_s:g} s; raise "
                f"runtime.timeout_s if it is that slow"
            ) from error
        seconds = time.perf_counter() - started
        with self._lock:
            self._known.add(key)
            self.usage.computed += 1
            self.usage.seconds += seconds
        return result

    def count_cached(self, key: str) -> None:
        """Note that a result came from the cache; counts once, not when it is loaded again."""
        with self._lock:
            self.usage.cached += key not in self._known
            self._known.add(key)

    def _create(self) -> Any:
        backend = self.backend
        context = ProviderContext(
            resolve_weights=self._store.resolve,
            device=_device(self._runtime, self.spec),
            threads=thread_count(self._runtime),
            seed=self._runtime.seed,
        )
        return self._registry.create(self.kind, backend.use, backend.options, context, backend.wrap)

    def _identify(self) -> dict[str, Any]:
        blocks = [(self.kind, self.backend), *(("wrapper", w) for w in self.backend.wrap)]
        described = []
        for kind, backend in blocks:
            options = self._registry.validate_options(kind, backend.use, backend.options)
            values = options.model_dump(mode="json") if options else {}
            described.append(
                {
                    "kind": kind,
                    "name": backend.use,
                    "version": self._registry.version(kind, backend.use),
                    "options": values,
                    "files": self._hashes(kind, backend.use, values),
                }
            )
        return {"api": API_VERSION, "seed": self._runtime.seed, "providers": described}

    def _hashes(self, kind: Kind, name: str, values: dict[str, Any]) -> dict[str, str]:
        """SHA-256 of the files that options name, and of the weights that these mean.

        What has to be downloaded is downloaded first, by constructing the provider.
        """
        named = [uri for uri in _texts(values) if is_remote(uri) or self._store.locate(uri)]
        meant = [file.uri for file in self._registry.weights(kind, name, values)]
        uris = list(dict.fromkeys((*named, *meant)))
        if any(is_remote(uri) and self._store.locate(uri) is None for uri in uris):
            self._local.provider = self._create()
        found = {uri: self._store.locate(uri) for uri in uris}
        return {uri: file_sha256(path) for uri, path in found.items() if path is not None}


def run_with_timeout(seconds: float | None, compute: Callable[[], T]) -> T:
    """The result of a computation; :class:`TimeoutError` when it is not there in time."""
    if seconds is None:
        return compute()
    outcome: list[Any] = []

    def work() -> None:
        try:
            outcome.append((compute(), None))
        except BaseException as error:
            outcome.append((None, error))

    thread = threading.Thread(target=work, name="mpsfm provider", daemon=True)
    thread.start()
    thread.join(seconds)
    if not outcome:
        raise TimeoutError
    result, error = outcome[0]
    if error is not None:
        raise error
    return cast(T, result)


def worker_count(runtime: RuntimeOptions) -> int:
    """Threads that a stage runs on."""
    return runtime.workers or min(_MAX_WORKERS, count_cores())


def thread_count(runtime: RuntimeOptions) -> int:
    """Threads that one provider may use itself."""
    if runtime.workers is not None:
        return runtime.threads
    return max(runtime.threads, count_cores() // worker_count(runtime))


def _device(runtime: RuntimeOptions, spec: ProviderSpec) -> str:
    """``cuda`` where it is asked for, or automatically where the provider's library can use it."""
    if runtime.device != "auto":
        return runtime.device
    if not _may_have_gpu():
        return "cpu"
    if "torch" in spec.requires:
        available = importlib.import_module("torch").cuda.is_available()
    elif "onnxruntime" in spec.requires:
        names = importlib.import_module("onnxruntime").get_available_providers()
        available = "CUDAExecutionProvider" in names
    else:
        available = False
    return "cuda" if available else "cpu"


def _may_have_gpu() -> bool:
    """Without NVIDIA's driver there is none, and no library need be imported to ask for it."""
    return Path("/dev/nvidiactl").exists() or shutil.which("nvidia-smi") is not None


def _texts(values: object) -> Iterator[str]:
    """All texts in plain data that can be a file's name or URI."""
    if isinstance(values, dict):
        values = list(values.values())
    if isinstance(values, list):
        for value in values:
            yield from _texts(value)
    elif isinstance(values, str) and 0 < len(values) <= _LONGEST_URI and values.isprintable():
        yield values
