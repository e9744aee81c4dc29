"""Separation of user settings from expert settings."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo


def is_expert(field: FieldInfo) -> bool:
    """Check whether an option is declared with :func:`mpsfm_core.data.options.expert`."""
    extra = field.json_schema_extra
    return isinstance(extra, dict) and extra.get("expert") is True


def user_settings(options: BaseModel) -> dict[str, Any]:
    """Return settings as plain data; expert settings with default values are omitted.

    Configuration blocks that contain only expert settings with default values are omitted.
    """
    values = options.model_dump(mode="json")
    settings = {}
    for name, field in type(options).model_fields.items():
        value = getattr(options, name)
        if is_expert(field) and value == field.get_default(call_default_factory=True):
            continue
        if isinstance(value, BaseModel):
            nested = user_settings(value)
            if nested:
                settings[name] = nested
        else:
            settings[name] = values[name]
    return settings


def count_user_settings(options: type[BaseModel]) -> int:
    """Count the non-expert settings of an options class and its nested options classes."""
    count = 0
    for field in options.model_fields.values():
        if is_expert(field):
            continue
        nested = field.annotation
        is_block = isinstance(nested, type) and issubclass(nested, BaseModel)
        count += count_user_settings(nested) if is_block else 1  # type: ignore[arg-type]
    return count
