"""Configuration of a run: typed options from YAML files and ``--set`` overrides."""

from mpsfm_core.config.loading import (
    check_provider_config,
    combination_problems,
    describe_shipped,
    load_config,
    shipped_configs,
)
from mpsfm_core.config.model import BLOCKS, FORMAT, Config, FastPass, RuntimeOptions

__all__ = [
    "BLOCKS",
    "FORMAT",
    "Config",
    "FastPass",
    "RuntimeOptions",
    "check_provider_config",
    "combination_problems",
    "describe_shipped",
    "load_config",
    "shipped_configs",
]
