"""Providers of an environment as specifications of the registry, and as objects that are asked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict

from mpsfm_core.data import (
    Bool,
    DepthPrior,
    Features,
    Float32,
    MultiViewPrior,
    NormalPrior,
    PairMatches,
    View,
)
from mpsfm_core.data.errors import ProviderError
from mpsfm_core.data.options import Options
from mpsfm_core.providers import Kind, ProviderContext, ProviderSpec, WeightsFile, hookimpl
from mpsfm_core.providers.environments.environment import Environment
from mpsfm_core.providers.environments.worker_process import Worker, WorkerLost
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, NormalCalibration

_CREATING_S = 1800.0
"""Large weights from a slow disk, to a GPU; downloads are waited for without limit."""
_ANSWERING_S = 600.0
"""For one view or pair: minutes on a CPU are possible, hours mean that it hangs."""


@dataclass(frozen=True)
class ProviderLocation:
    """Where a provider lives: environment, kind and name there."""

    environment: Environment
    kind: Kind
    name: str

    def ask(self, do: str, **request: Any) -> Any:
        """The answer to a question about the provider."""
        return self.environment.ask(do=do, kind=self.kind, name=self.name, **request)


class RemoteOptions(Options):
    """Options whose class is in the other environment, which checks them there."""

    model_config = ConfigDict(
        frozen=True, extra="allow", protected_namespaces=(), ser_json_inf_nan="constants"
    )
    home: ClassVar[ProviderLocation]
    defaults: ClassVar[Mapping[str, Any]]

    @classmethod
    def model_validate(cls, values: Any, **_: Any) -> Any:  # type: ignore[override]
        """As pydantic's; raises :class:`~mpsfm_core.data.options.SettingsError`."""
        return cls._holding(cls.home.ask("options", values=dict(values)))

    @classmethod
    def model_construct(  # type: ignore[override]
        cls, _fields_set: Any = None, **values: Any
    ) -> Any:
        """As pydantic's."""
        return cls._holding({**cls.defaults, **values})

    @classmethod
    def _holding(cls, values: Mapping[str, Any]) -> Any:
        return super().model_construct(**values)

    def __reduce__(self) -> Any:
        return _options, (self.home, dict(self.defaults), self.model_dump())


def _options_class(home: ProviderLocation, defaults: Mapping[str, Any]) -> type[RemoteOptions]:
    return type("RemoteOptions", (RemoteOptions,), {"home": home, "defaults": defaults})


def _options(
    home: ProviderLocation, defaults: Mapping[str, Any], values: Mapping[str, Any]
) -> RemoteOptions:
    holding: RemoteOptions = _options_class(home, defaults)._holding(values)
    return holding


class RemoteProvider:
    """A provider in a worker process. It has the methods of all kinds; which of them can be asked
    is said by its specification.

    A worker that crashed, hung or ran out of memory fails the call; the next one starts another.
    """

    def __init__(
        self, home: ProviderLocation, options: Mapping[str, Any], context: ProviderContext
    ) -> None:
        self._home = home
        self._options = dict(options)
        self._context = context
        self._worker: Worker | None = None
        self._running()

    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        """Depth, or normals."""
        given = (view,) if self._home.kind == "depth" else (view, depth)
        return self._call("predict", *given)

    def predict_joint(self, view: View) -> tuple[DepthPrior, NormalPrior]:
        """Depth and normals of one pass."""
        depth, normals = self._call("predict_joint", view)
        return depth, normals

    def estimate_focal(self, view: View) -> float | None:
        """In pixels of the view."""
        focal: float | None = self._call("estimate_focal", view)
        return focal

    def predict_group(self, views: Sequence[View]) -> MultiViewPrior:
        """Depth of a group of views."""
        group: MultiViewPrior = self._call("predict_group", tuple(views))
        return group

    def extract(self, view: View) -> Features:
        """Features."""
        features: Features = self._call("extract", view)
        return features

    def match(
        self,
        view_a: View,
        view_b: View,
        features_a: Features | None = None,
        features_b: Features | None = None,
    ) -> PairMatches:
        """Matches."""
        matches: PairMatches = self._call("match", view_a, view_b, features_a, features_b)
        return matches

    def describe(self, view: View) -> Float32:
        """Global descriptor."""
        descriptor: Float32 = self._call("describe", view)
        return descriptor

    def mask(self, view: View) -> Bool:
        """Pixels that may be used."""
        mask: Bool = self._call("mask", view)
        return mask

    def _call(self, method: str, *arguments: Any) -> Any:
        request = {"do": "call", "method": method, "arguments": list(arguments)}
        return self._running().ask(request, _ANSWERING_S)

    def _running(self) -> Worker:
        """The worker with the provider, made if there is none (any more)."""
        if self._worker is None or not self._worker.alive:
            worker, context = self._home.environment.start(), self._context
            request = {
                "do": "create",
                "kind": self._home.kind,
                "name": self._home.name,
                "options": self._options,
                "device": context.device,
                "threads": context.threads,
                "seed": context.seed,
            }
            try:
                worker.ask(request, _CREATING_S, context.resolve_weights)
            except WorkerLost as error:
                raise ProviderError(f"{self._home.name}: {error}") from error
            except BaseException:
                worker.close()
                raise
            self._worker = worker
        return self._worker


@dataclass(frozen=True)
class _Factory:
    home: ProviderLocation

    def __call__(self, options: Options | None, context: ProviderContext) -> RemoteProvider:
        values = {} if options is None else options.model_dump()
        return RemoteProvider(self.home, values, context)


@dataclass(frozen=True)
class _Weights:
    home: ProviderLocation

    def __call__(self, options: Options | None) -> tuple[WeightsFile, ...]:
        values = {} if options is None else options.model_dump()
        return tuple(self.home.ask("weights", values=values))


@dataclass(frozen=True)
class RemoteSpec:
    """A provider of an environment for the registry."""

    home: ProviderLocation
    spec: ProviderSpec
    distribution: str
    version: str
    fault: str = ""
    hint: str = ""


def remote_providers(environment: Environment) -> list[RemoteSpec]:
    """What an environment brings, as it was described when it was made; starts nothing.

    Their names are ``NAME@ENVIRONMENT``.
    """
    found = []
    for entry in environment.describe():
        home = ProviderLocation(environment, entry["kind"], entry["name"])
        defaults = entry["defaults"]
        spec = ProviderSpec(
            kind=home.kind,
            name=f"{home.name}@{environment.name}",
            factory=_Factory(home),
            options=None if defaults is None else _options_class(home, defaults),
            capabilities=frozenset(entry["capabilities"]),
            summary=entry["summary"],
            code_license=entry["code_license"],
            weights_license=entry["weights_license"],
            weights=_Weights(home) if entry["has_weights"] else (),
            accuracy=entry["accuracy"],
            tags=tuple(entry["tags"]),
            contract=_Contract(home),
        )
        origin = f"{entry['distribution']} in {environment.label}"
        found.append(
            RemoteSpec(home, spec, origin, entry["version"], entry["fault"], entry["hint"])
        )
    return found


@dataclass(frozen=True)
class _Contract:
    """For the contract kit: the fields of the setup that the plugin gives there."""

    home: ProviderLocation

    def __call__(self, folder: Path) -> Mapping[str, Any]:
        setup: Mapping[str, Any] = self.home.ask("setup", folder=folder)
        return setup


class EnvironmentHooks:
    """The hooks of a registry that answer for providers of environments."""

    def __init__(self, remotes: Sequence[RemoteSpec]) -> None:
        self._homes: dict[tuple[str, str], ProviderLocation] = {
            (r.spec.kind, r.spec.name): r.home for r in remotes
        }

    @hookimpl
    def mpsfm_calibration(
        self, kind: str, provider: str, options: BaseModel | None
    ) -> DepthCalibration | NormalCalibration | None:
        """What the plugin declares there, for these options."""
        home = self._homes.get((kind, provider))
        if home is None:
            return None
        values = {} if options is None else options.model_dump()
        found: DepthCalibration | NormalCalibration | None = home.ask("calibration", values=values)
        return found
