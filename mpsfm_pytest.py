"""Pytest plugin for ``pytest --mpsfm-plugin NAME``, which runs contract checks.

This module is outside of the package mpsfm_core, because pytest imports it at every start in every
environment with mpsfm-core. This module therefore imports nothing until the option is used.
"""

from __future__ import annotations

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the pytest options ``--mpsfm-plugin`` and ``--mpsfm-options``."""
    group = parser.getgroup("mpsfm", "contract of MP-SfM plugins")
    group.addoption(
        "--mpsfm-plugin",
        action="append",
        default=[],
        metavar="NAME",
        help="run the contract of a provider (onnx, depth/onnx) or of all of a distribution",
    )
    group.addoption(
        "--mpsfm-options",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="options of the provider, instead of those of its contract setup",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Register the collection of contract checks if the command line names a plugin."""
    names = config.getoption("--mpsfm-plugin")
    if names:
        from mpsfm_core.testing.pytest_items import ContractCollection

        collection = ContractCollection(names, config.getoption("--mpsfm-options"))
        config.pluginmanager.register(collection, "mpsfm-contract")
        if config.args_source != pytest.Config.ArgsSource.ARGS:
            config.args = []  # No path was given on the command line, so run only these checks.
