"""Tests of the separation of user settings from expert settings."""

from __future__ import annotations

import yaml

from mpsfm_core.config import Config, RuntimeOptions
from mpsfm_core.config.settings import count_user_settings, user_settings
from mpsfm_core.extraction.options import PairOptions, VerificationOptions
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.support.format_versions import VERSION


def make_config(**changes: object) -> Config:
    depth, normals = ProviderConfig(use="flat"), ProviderConfig(use="from-depth")
    return Config(depth=depth, normals=normals, **changes)


def test_user_settings_hides_expert_defaults_and_empty_blocks() -> None:
    settings = user_settings(make_config())
    assert "verification" not in settings
    assert "quadratic" not in settings["pairs"] and "mode" in settings["pairs"]
    assert "checkpoint_s" not in settings["runtime"] and "seed" in settings["runtime"]


def test_user_settings_shows_expert_settings_that_differ_from_their_default() -> None:
    config = make_config(
        runtime=RuntimeOptions(checkpoint_s=None), pairs=PairOptions(quadratic=True)
    )
    settings = user_settings(config)
    assert settings["runtime"]["checkpoint_s"] is None
    assert settings["pairs"]["quadratic"] is True


def test_to_yaml_without_expert_settings_loads_the_same_configuration() -> None:
    config = make_config(verification=VerificationOptions(max_error_px=2.0))
    values = yaml.safe_load(config.to_yaml(expert_settings=False))
    del values[VERSION]
    assert Config(**values) == config


def test_number_of_user_settings_stays_small() -> None:
    blocks = [name for name in Config.model_fields if name not in ("mapping", "description")]
    options = [Config.model_fields[name].annotation for name in blocks]
    counts = [count_user_settings(o) for o in options if hasattr(o, "model_fields")]
    assert sum(counts) - 2 * count_user_settings(ProviderConfig) <= 30
