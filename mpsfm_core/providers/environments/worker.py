"""Worker process that runs the providers of its Python environment, one request at a time.

The client starts the worker process with the command ``python -m
mpsfm_core.providers.environments.worker FOLDER``, where FOLDER is for shared memory files.
"""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from mpsfm_core.data.errors import ProviderError
from mpsfm_core.providers import API_VERSION, ProviderContext
from mpsfm_core.providers.environments.channel import Channel, ChannelClosed
from mpsfm_core.providers.environments.worker_process import PROTOCOL, decode_error, encode_error
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.registry import CORE, Registry, core_version
from mpsfm_core.support.threads import limit_threads


class ProviderServer:
    """Server that runs the providers of this Python environment for one client process."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._registry: Registry | None = None
        self._provider: Any = None
        self._threads: int | None = None
        self._limit, self._num_limited_modules = ExitStack(), 0

    def serve(self) -> None:
        """Send the protocol version, then answer requests until the client process has ended."""
        self._channel.send(
            {
                "protocol": PROTOCOL,
                "api": API_VERSION,
                "core": core_version(),
                "python": platform.python_version(),
            }
        )
        while True:
            request = self._channel.receive()
            try:
                answer = {"value": self._answer(request)}
                del request
                self._channel.send(answer)
            except ChannelClosed:
                raise
            except Exception as error:
                self._channel.send({"error": encode_error(error)})

    def _answer(self, request: Mapping[str, Any]) -> Any:
        """Execute one request of the client and return the reply."""
        action = request["do"]
        if action == "call":
            self._limit_threads()
            return getattr(self._provider, request["method"])(*request["arguments"])
        registry = self._registry or Registry.discover(environments=False)
        self._registry = registry
        if action == "describe":
            return _description(registry)
        kind, name = request["kind"], request["name"]
        if action == "create":
            context = ProviderContext(
                resolve_weights=self._resolve,
                device=request["device"],
                threads=request["threads"],
                seed=request["seed"],
            )
            self._threads = context.threads
            self._provider = registry.create(kind, name, request["options"] or None, context)
            return None
        if action == "setup":
            return _setup(registry, kind, name, request["folder"])
        if action == "code_keys":
            return registry.code_keys(kind, name)
        values = request["values"]
        if action == "options":
            options = registry.validate_options(kind, name, values, ())
            return {} if options is None else options.model_dump()
        if action == "weights":
            return registry.weights(kind, name, values)
        if action == "calibration":
            return registry.calibration(kind, ProviderConfig(use=name, options=values))
        raise ProviderError(f"unknown request {action!r}")

    def _limit_threads(self) -> None:
        """Limit the threads of native libraries again if new modules were imported."""
        if self._num_limited_modules != len(sys.modules):
            self._limit.close()
            self._limit.enter_context(limit_threads(self._threads))
            self._num_limited_modules = len(sys.modules)

    def _resolve(self, uri: str, sha256: str | None) -> Path:
        """Request the path of a weights file from the client, which may download the file."""
        self._channel.send({"resolve": [uri, sha256]})
        answer = self._channel.receive()
        if "error" in answer:
            raise decode_error(answer["error"])
        path: Path = answer["value"]
        return path


def _description(registry: Registry) -> list[dict[str, Any]]:
    """Describe the providers of the plugins that are installed in this environment.

    The description omits built-in providers, because every environment has them. The description
    also omits wrapper providers, because a wrapper has to run in the process of the provider that
    it wraps.
    """
    entries = []
    for line in registry.status():
        if line.kind in ("plugin", "wrapper") or line.distribution == CORE:
            continue
        entry: dict[str, Any] = {
            "kind": line.kind,
            "name": line.name,
            "distribution": line.distribution,
            "version": line.version,
            "capabilities": list(line.capabilities),
            "summary": line.summary,
            "code_license": line.code_license,
            "weights_license": line.weights_license,
            "fault": line.reason,
            "hint": line.install_hint,
            "accuracy": "",
            "tags": [],
            "defaults": None,
            "has_weights": False,
        }
        if line.available and line.kind != "plugin":
            spec = registry.spec(line.kind, line.name)
            entry["accuracy"], entry["tags"] = spec.accuracy, list(spec.tags)
            entry["has_weights"] = bool(spec.weights)
            if spec.options is not None:
                entry["defaults"] = registry.default_options(line.kind, line.name)
        entries.append(entry)
    return entries


def _setup(registry: Registry, kind: Any, name: str, folder: Path) -> dict[str, Any]:
    """Return the fields of a provider's ContractSetup that can be sent to the client process."""
    from mpsfm_core.testing.contract_case import load_setup

    setup = load_setup(registry.spec(kind, name), folder)
    if setup.prepare is not None:
        raise ProviderError(
            f"the ContractSetup of {name!r} has a prepare function, which cannot be sent to "
            f"another process: run the contract tests in the provider's own environment"
        )
    return {
        "options": dict(setup.options),
        "truth_source": setup.truth_source,
        "expected_failures": dict(setup.expected_failures),
    }


def main() -> None:
    """Answer requests from stdin on stdout and redirect the output of providers to stderr."""
    reader = os.fdopen(os.dup(0), "rb")
    writer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    folder = Path(sys.argv[1])
    try:
        ProviderServer(Channel(reader, writer, folder, "worker", "main")).serve()
    except ChannelClosed:
        return


if __name__ == "__main__":
    main()
