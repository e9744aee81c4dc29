"""Provider contract tests with patch matchers, and with vismatch if it is installed."""

from dataclasses import replace

import pytest

pytest.importorskip("torch")

from mpsfm_vismatch.plugin import mpsfm_providers

from mpsfm_core.providers.builtin import plugin as builtin
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing import contract_tests

registry = Registry()
registry.register(builtin)
registry.add(*(replace(spec, requires=("torch",)) for spec in mpsfm_providers()))

test_dense = contract_tests("matcher", "vismatch", registry=registry)
test_sparse = contract_tests("matcher", "vismatch-sparse", registry=registry)
test_roma = pytest.mark.slow(contract_tests("matcher", "vismatch-roma", registry=registry))
test_roma_sparse = pytest.mark.slow(
    contract_tests("matcher", "vismatch-roma-sparse", registry=registry)
)
test_mast3r = pytest.mark.slow(contract_tests("matcher", "vismatch-mast3r", registry=registry))
test_mast3r_sparse = contract_tests("matcher", "vismatch-mast3r-sparse", registry=registry)
