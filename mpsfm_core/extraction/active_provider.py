"""Providers of a run: one instance per thread, and the identity of a provider in cache keys."""

from __future__ import annotations

import importlib
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from mpsfm_core.config import RuntimeOptions
from mpsfm_core.data.errors import ProviderRunError
from mpsfm_core.providers import API_VERSION, Capability, Kind, ProviderContext, ProviderSpec
from mpsfm_core.providers.instances import ProviderInstance
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.registry import Registry
from mpsfm_core.providers.weights import WeightStore, file_sha256, is_remote
from mpsfm_core.support.threads import count_cores
from mpsfm_core.support.timed_thread import TimedThread, TimeLimitError

T = TypeVar("T")

_MAX_WORKERS = 4
"""Maximum number of workers if the option ``runtime.workers`` is not set. Each worker loads its own
copy of a network, so further CPU cores become threads of the workers."""
_MAX_URI_LENGTH = 1000


@dataclass
class Usage:
    """Number of results and computing time of a provider in a run."""

    computed: int = 0
    """Number of results that the provider computed in the run."""
    cached: int = 0
    """Number of results that were loaded from the cache."""
    seconds: float = 0.0
    """Computing time in seconds, summed over all workers."""


class ActiveProvider:
    """Runs a configured provider and counts its results.

    A thread creates its provider instance when it computes its first result. A run whose results
    are all in the cache therefore loads no network.
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
        """Check whether the provider declares a capability."""
        return capability in self.spec.capabilities

    @property
    def identity(self) -> dict[str, Any]:
        """Names, code, versions, options, seed and files that identify provider and wrappers."""
        with self._lock:
            if self._identity is None:
                self._identity = self._identify()
            return self._identity

    @property
    def is_reusable(self) -> bool:
        """True if the provider's code can be hashed, so that later runs may reuse its results."""
        return all(block["code"] is not None for block in self.identity["providers"])

    @property
    def is_cached(self) -> bool:
        """True if all results of the provider are in the cache for later runs and workers."""
        return self.is_reusable and not self.can("uncached")

    @property
    def instance(self) -> Any:
        """Provider instance of the calling thread."""
        if not hasattr(self._local, "provider"):
            # The lock makes one thread import libraries and download weights, not all threads.
            with self._lock:
                self._local.provider = self._create()
        return self._local.provider

    @property
    def _thread(self) -> TimedThread:
        """Thread that runs the provider for the calling thread, so that calls can time out."""
        if not hasattr(self._local, "thread"):
            self._local.thread = TimedThread("mpsfm provider")
        thread: TimedThread = self._local.thread
        return thread

    @property
    def workers(self) -> int:
        """Number of threads that run the provider, 1 on a GPU or for an instance of the caller."""
        if isinstance(self.spec.factory, ProviderInstance):
            return 1
        return 1 if _device(self._runtime, self.spec) == "cuda" else worker_count(self._runtime)

    def compute_timed(
        self, key: str, compute: Callable[[Any], T], timeout_s: float | None = None
    ) -> T:
        """Compute a result with the provider instance of this thread, and measure the time.

        A thread that exceeds the timeout cannot be killed. The thread keeps its provider instance,
        and a new instance computes further results.

        Args:
            key: Key of the provider result in the cache.
            compute: Function that computes the result with a provider instance.
            timeout_s: Time limit of the computation in seconds, or None for no limit.

        Raises:
            ProviderRunError: the computation exceeds the time limit.
        """
        provider = self.instance
        started = time.perf_counter()
        try:
            if timeout_s is None:
                result = compute(provider)
            else:
                result = self._thread.run(lambda: compute(provider), timeout_s)
        except TimeLimitError as error:
            del self._local.provider, self._local.thread
            raise ProviderRunError(
                f"provider {self.spec.name!r}: no answer within {timeout_s:g} s; raise "
                f"runtime.timeout_s for a slow provider"
            ) from error
        seconds = time.perf_counter() - started
        with self._lock:
            self._known.add(key)
            self.usage.computed += 1
            self.usage.seconds += seconds
        return result

    def count_cached(self, key: str) -> None:
        """Count a provider result that was read from the cache, once per cache key."""
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
                    "code": self._registry.code_keys(kind, backend.use),
                    "options": values,
                    "files": self._hashes(kind, backend.use, values),
                }
            )
        return {"api": API_VERSION, "seed": self._runtime.seed, "providers": described}

    def _hashes(self, kind: Kind, name: str, values: dict[str, Any]) -> dict[str, str]:
        """Return the SHA-256 of the weight files and of the files named in options.

        Missing weights are downloaded first, by creating a provider instance.
        """
        named = [uri for uri in _texts(values) if is_remote(uri) or self._store.locate(uri)]
        weights = [file.uri for file in self._registry.weights(kind, name, values)]
        uris = list(dict.fromkeys((*named, *weights)))
        if any(is_remote(uri) and self._store.locate(uri) is None for uri in uris):
            self._local.provider = self._create()
        paths = {uri: self._store.locate(uri) for uri in uris}
        return {uri: file_sha256(path) for uri, path in paths.items() if path is not None}


def worker_count(runtime: RuntimeOptions) -> int:
    """Return the number of parallel worker threads of an extraction stage."""
    return runtime.workers or min(_MAX_WORKERS, count_cores())


def thread_count(runtime: RuntimeOptions) -> int:
    """Return the number of threads that a provider may use per worker."""
    if runtime.workers is not None:
        return runtime.threads
    return max(runtime.threads, count_cores() // worker_count(runtime))


def _device(runtime: RuntimeOptions, spec: ProviderSpec) -> str:
    """Return the configured device, or ``cuda`` if the provider's library can use a GPU."""
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
    """Check for NVIDIA's driver, which is faster than importing a GPU library."""
    return Path("/dev/nvidiactl").exists() or shutil.which("nvidia-smi") is not None


def _texts(values: object) -> Iterator[str]:
    """Yield all strings in nested plain data that can be a file name or URI."""
    if isinstance(values, dict):
        values = list(values.values())
    if isinstance(values, list):
        for value in values:
            yield from _texts(value)
    elif isinstance(values, str) and 0 < len(values) <= _MAX_URI_LENGTH and values.isprintable():
        yield values
