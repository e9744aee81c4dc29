"""Base class of all options, and error messages for wrong settings.

:class:`Options` is the base class of the options of providers and of all packages.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from mpsfm_core.data.errors import ConfigError, did_you_mean


class Options(BaseModel):
    """Base class of immutable options; unknown keys are errors."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        protected_namespaces=(),
        ser_json_inf_nan="constants",
        defer_build=True,
    )


def expert(default: Any, **constraints: Any) -> Any:
    """Declare an expert option, which help texts and configuration templates may hide.

    Args:
        default: Default value of the option.
        constraints: Keyword arguments of :func:`pydantic.Field`, such as ``ge`` and ``gt``.
    """
    return Field(default, json_schema_extra={"expert": True}, **constraints)


SettingPath = tuple[str | int, ...]
"""Keys and list indices that lead to a setting of a configuration."""


@dataclass(frozen=True)
class SettingProblem:
    """Description of a wrong or missing setting."""

    path: SettingPath
    """Path of the setting, such as ``("depth", "options", "scale")``."""
    text: str
    """Rule that the setting violates, as text for the user."""
    missing: bool = False
    """True if a required setting is absent."""

    def __str__(self) -> str:
        return f"{dotted(self.path)}: {self.text}" if self.path else self.text


class SettingsError(ConfigError):
    """Error for settings that an options class rejects.

    Attributes:
        problems: All wrong settings.
    """

    def __init__(self, problems: tuple[SettingProblem, ...]) -> None:
        super().__init__("; ".join(map(str, problems)))
        self.problems = problems


AnyModel = TypeVar("AnyModel", bound=BaseModel)


def parse_settings(
    model: type[AnyModel], values: Mapping[str, Any], path: SettingPath = ()
) -> AnyModel:
    """Validate settings with an options class.

    Args:
        model: Options class.
        values: Settings by key.
        path: Path of the validated settings in the configuration, for error messages.

    Raises:
        SettingsError: A setting has a wrong value or an unknown key, or is missing. The error
            message gives the path and problem of each wrong setting, and the closest valid key for
            each unknown key.
    """
    try:
        return model.model_validate(dict(values))
    except SettingsError as error:
        # A plugin in another Python environment validates its options and raises SettingsError.
        raise SettingsError(
            tuple(replace(problem, path=(*path, *problem.path)) for problem in error.problems)
        ) from error
    except ValidationError as error:
        problems = tuple(
            SettingProblem(
                (*path, *_keys(details)), _explain(model, details), details["type"] == "missing"
            )
            for details in error.errors(include_url=False)
        )
        raise SettingsError(problems) from error


def dotted(path: SettingPath) -> str:
    """Format a setting path as a user writes the path, such as ``masks.0.use``."""
    return ".".join(map(str, path))


def _keys(details: ErrorDetails) -> SettingPath:
    """Return the setting path of a pydantic error, without union tags such as ``dict[str,any]``."""
    return tuple(part for part in details["loc"] if isinstance(part, int) or "[" not in part)


def _explain(model: type[BaseModel], details: ErrorDetails) -> str:
    """Describe a pydantic validation error of a setting in words for users."""
    if details["type"] == "missing":
        return "is required"
    if details["type"] == "extra_forbidden":
        key = str(details["loc"][-1])
        return f"unknown key{did_you_mean(key, _fields_at(model, details['loc'][:-1]))}"
    message = details["msg"].removeprefix("Value error, ")
    given = repr(details["input"])
    return f"{message} (got {given if len(given) <= 60 else given[:57] + '...'})"


def _fields_at(model: type[BaseModel], path: SettingPath) -> list[str]:
    """Return the valid setting keys at a path below an options class."""
    current = [model]
    for part in path:
        if isinstance(part, int):
            continue
        annotations = [m.model_fields[part].annotation for m in current if part in m.model_fields]
        current = [inner for annotation in annotations for inner in _models_in(annotation)]
    return [info.alias or name for inner in current for name, info in inner.model_fields.items()]


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the pydantic models in a type annotation."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models_in(argument)
