"""The base of everything a user can set: a provider's options and the options of each room."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Options(BaseModel):
    """Immutable settings; unknown keys are errors; each field has a default and its source."""

    model_config = ConfigDict(frozen=True, extra="forbid", protected_namespaces=())
