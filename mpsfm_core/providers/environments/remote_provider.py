"""Specifications and clients of providers that are installed in other Python environments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict

from mpsfm_core.data.errors import ProviderError
from mpsfm_core.data.options import Options
from mpsfm_core.providers import (
    PROVIDER_KINDS,
    Kind,
    ProviderContext,
    ProviderSpec,
    WeightsFile,
    hookimpl,
)
from mpsfm_core.providers.environments.environment import Environment
from mpsfm_core.providers.environments.worker_process import Worker, WorkerLost
from mpsfm_core.providers.kinds import required_methods
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, NormalCalibration

_CONSTRUCTION_TIMEOUT_S = 1800.0
"""Time limit in seconds for constructing a provider, which may load large weights from a slow disk
to a GPU."""
_CALL_TIMEOUT_S = 600.0
"""Time limit in seconds for a provider to process one image or image pair. Networks on a CPU may
need minutes."""


@dataclass(frozen=True)
class ProviderLocation:
    """Location of a provider in another Python environment."""

    environment: Environment
    kind: Kind
    name: str

    def ask(self, do: str, **request: Any) -> Any:
        """Send a request about the provider to a worker of its environment and return the reply."""
        return self.environment.ask(do=do, kind=self.kind, name=self.name, **request)


class RemoteOptions(Options):
    """Options of a provider in another environment, whose worker process validates them."""

    model_config = ConfigDict(
        frozen=True, extra="allow", protected_namespaces=(), ser_json_inf_nan="constants"
    )
    location: ClassVar[ProviderLocation]
    defaults: ClassVar[Mapping[str, Any]]

    @classmethod
    def model_validate(cls, values: Any, **_: Any) -> Any:  # type: ignore[override]
        """Validate option values in the provider's environment, or raise SettingsError."""
        return cls._from_values(cls.location.ask("options", values=dict(values)))

    @classmethod
    def model_construct(  # type: ignore[override]
        cls, _fields_set: Any = None, **values: Any
    ) -> Any:
        """Construct the options of a remote provider without validation (pydantic's method)."""
        return cls._from_values({**cls.defaults, **values})

    @classmethod
    def _from_values(cls, values: Mapping[str, Any]) -> Any:
        """Create an options instance from validated option values."""
        return super().model_construct(**values)

    def __reduce__(self) -> Any:
        return _options, (self.location, dict(self.defaults), self.model_dump())


def _options_class(location: ProviderLocation, defaults: Mapping[str, Any]) -> type[RemoteOptions]:
    return type("RemoteOptions", (RemoteOptions,), {"location": location, "defaults": defaults})


def _options(
    location: ProviderLocation, defaults: Mapping[str, Any], values: Mapping[str, Any]
) -> RemoteOptions:
    instance: RemoteOptions = _options_class(location, defaults)._from_values(values)
    return instance


class RemoteProvider:
    """Client that forwards calls to a provider in a worker process.

    The client has the methods of the provider's kind. If the worker crashes, hangs or runs out of
    memory, the current call fails and the next call starts another worker.
    """

    def __init__(
        self, location: ProviderLocation, options: Mapping[str, Any], context: ProviderContext
    ) -> None:
        self._location = location
        self._options = dict(options)
        self._context = context
        self._worker: Worker | None = None
        self._running()

    def __getattr__(self, method: str) -> Any:
        """Return a function that calls a method of the provider in the worker process."""
        if method.startswith("_"):
            raise AttributeError(method)
        kind = PROVIDER_KINDS[self._location.kind]
        if method not in required_methods(kind.name, frozenset(kind.capabilities)):
            raise AttributeError(f"the {kind.name} provider has no method {method}()")
        return partial(self._call, method)

    def _call(self, method: str, *arguments: Any) -> Any:
        request = {"do": "call", "method": method, "arguments": list(arguments)}
        return self._running().ask(request, _CALL_TIMEOUT_S)

    def _running(self) -> Worker:
        """Return a worker process that has constructed the provider, starting it if necessary."""
        if self._worker is None or not self._worker.alive:
            worker, context = self._location.environment.start(), self._context
            request = {
                "do": "create",
                "kind": self._location.kind,
                "name": self._location.name,
                "options": self._options,
                "device": context.device,
                "threads": context.threads,
                "seed": context.seed,
            }
            try:
                worker.ask(request, _CONSTRUCTION_TIMEOUT_S, context.resolve_weights)
            except WorkerLost as error:
                raise ProviderError(f"{self._location.name}: {error}") from error
            except BaseException:
                worker.close()
                raise
            self._worker = worker
        return self._worker


@dataclass(frozen=True)
class _Factory:
    """Picklable factory of the client of a provider in another environment."""

    location: ProviderLocation

    def __call__(self, options: Options | None, context: ProviderContext) -> RemoteProvider:
        values = {} if options is None else options.model_dump()
        return RemoteProvider(self.location, values, context)

    def code_keys(self) -> dict[str, str] | None:
        """Return hashes of the remote provider's code, as :meth:`Registry.code_keys` does."""
        keys: dict[str, str] | None = self.location.ask("code_keys")
        return keys


@dataclass(frozen=True)
class _Weights:
    """Picklable function that lists the weights files of a provider in another environment."""

    location: ProviderLocation

    def __call__(self, options: Options | None) -> tuple[WeightsFile, ...]:
        values = {} if options is None else options.model_dump()
        return tuple(self.location.ask("weights", values=values))


@dataclass(frozen=True)
class RemoteSpec:
    """Specification of a provider in another environment, with its location and origin."""

    location: ProviderLocation
    spec: ProviderSpec
    distribution: str
    version: str
    fault: str = ""
    hint: str = ""


def remote_providers(environment: Environment) -> list[RemoteSpec]:
    """List the provider specifications of an environment from its description file.

    Listing the providers starts no worker process. The names of the listed providers have the form
    ``NAME@ENVIRONMENT``.

    Args:
        environment: Python environment that contains the providers.

    Returns:
        Provider specifications, each with its pip package and the reason if the provider is
        unusable.
    """
    specs: list[RemoteSpec] = []
    for entry in environment.describe():
        location = ProviderLocation(environment, entry["kind"], entry["name"])
        defaults = entry["defaults"]
        spec = ProviderSpec(
            kind=location.kind,
            name=f"{location.name}@{environment.name}",
            factory=_Factory(location),
            options=None if defaults is None else _options_class(location, defaults),
            capabilities=frozenset(entry["capabilities"]),
            summary=entry["summary"],
            code_license=entry["code_license"],
            weights_license=entry["weights_license"],
            weights=_Weights(location) if entry["has_weights"] else (),
            accuracy=entry["accuracy"],
            tags=tuple(entry["tags"]),
            contract=_Contract(location),
        )
        origin = f"{entry['distribution']} in {environment.label}"
        specs.append(
            RemoteSpec(location, spec, origin, entry["version"], entry["fault"], entry["hint"])
        )
    return specs


@dataclass(frozen=True)
class _Contract:
    """Function that fetches the setup of a provider's contract tests from another environment."""

    location: ProviderLocation

    def __call__(self, folder: Path) -> Mapping[str, Any]:
        setup: Mapping[str, Any] = self.location.ask("setup", folder=folder)
        return setup


class EnvironmentHooks:
    """Plugin hooks of providers in other environments, which the registry calls."""

    def __init__(self, remotes: Sequence[RemoteSpec]) -> None:
        self._locations: dict[tuple[str, str], ProviderLocation] = {
            (r.spec.kind, r.spec.name): r.location for r in remotes
        }

    @hookimpl
    def mpsfm_calibration(
        self, kind: str, provider: str, options: BaseModel | None
    ) -> DepthCalibration | NormalCalibration | None:
        """Return the uncertainty model that a plugin in another environment declares."""
        location = self._locations.get((kind, provider))
        if location is None:
            return None
        values = {} if options is None else options.model_dump()
        found: DepthCalibration | NormalCalibration | None = location.ask(
            "calibration", values=values
        )
        return found
