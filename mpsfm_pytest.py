"""``pytest --mpsfm-plugin NAME``: the contract of an installed plugin, as tests.

A module of its own, outside of the package: pytest loads it at every start, wherever the core is
installed, so it imports nothing until it is asked to.
"""

from __future__ import annotations

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    """Two options."""
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
        help="options of the provider, instead of those of its stand-in without weights",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Register what collects the checks, if there is something to check."""
    names = config.getoption("--mpsfm-plugin")
    if names:
        from mpsfm_core.testing.pytest_items import ContractCollection

        collection = ContractCollection(names, config.getoption("--mpsfm-options"))
        config.pluginmanager.register(collection, "mpsfm-contract")
        if config.args_source != pytest.Config.ArgsSource.ARGS:
            config.args = []  # no path was named: these checks and nothing else
