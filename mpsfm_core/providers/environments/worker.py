"""The other side of :mod:`mpsfm_core.providers.environments`: serves the providers of this
environment to a main process, one question after the other. ``python -m
mpsfm_core.providers.environments.worker FOLDER``."""

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
    """Answers the questions of a main process."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._registry: Registry | None = None
        self._provider: Any = None
        self._threads: int | None = None
        self._limit, self._limited_with = ExitStack(), 0

    def serve(self) -> None:
        """Greet, and answer until the main process is gone."""
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
        what = request["do"]
        if what == "call":
            self._limit_threads()
            return getattr(self._provider, request["method"])(*request["arguments"])
        registry = self._registry or Registry.discover(environments=False)
        self._registry = registry
        if what == "describe":
            return _description(registry)
        kind, name = request["kind"], request["name"]
        if what == "create":
            context = ProviderContext(
                resolve_weights=self._resolve,
                device=request["device"],
                threads=request["threads"],
                seed=request["seed"],
            )
            self._threads = context.threads
            self._provider = registry.create(kind, name, request["options"] or None, context)
            return None
        if what == "setup":
            return _setup(registry, kind, name, request["folder"])
        values = request["values"]
        if what == "options":
            options = registry.validate_options(kind, name, values, ())
            return {} if options is None else options.model_dump()
        if what == "weights":
            return registry.weights(kind, name, values)
        if what == "calibration":
            return registry.calibration(kind, ProviderConfig(use=name, options=values))
        raise ProviderError(f"nobody here can {what!r}")

    def _limit_threads(self) -> None:
        """To be done again, which takes a millisecond, when libraries may have come since."""
        if self._limited_with != len(sys.modules):
            self._limit.close()
            self._limit.enter_context(limit_threads(self._threads))
            self._limited_with = len(sys.modules)

    def _resolve(self, uri: str, sha256: str | None) -> Path:
        """The main process finds and fetches weights for all."""
        self._channel.send({"resolve": [uri, sha256]})
        answer = self._channel.receive()
        if "error" in answer:
            raise decode_error(answer["error"])
        path: Path = answer["value"]
        return path


def _description(registry: Registry) -> list[dict[str, Any]]:
    """The providers of installed plugins; those of the core are wherever it is, and a wrapper
    belongs to the process of what it wraps."""
    found = []
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
        found.append(entry)
    return found


def _setup(registry: Registry, kind: Any, name: str, folder: Path) -> dict[str, Any]:
    """What the contract kit needs to know, without what would have to be told here."""
    from mpsfm_core.testing.contract_case import load_setup

    setup = load_setup(registry.spec(kind, name), folder)
    if setup.prepare is not None:
        raise ProviderError(
            f"the stand-in of {name!r} is told about views by a function, which cannot be done "
            f"from another environment: check it in its own"
        )
    return {
        "options": dict(setup.options),
        "truth_source": setup.truth_source,
        "expected_failures": dict(setup.expected_failures),
    }


def main() -> None:
    """Serve over stdin and stdout; what providers print goes to stderr."""
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
