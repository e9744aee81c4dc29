"""The contract of one size, on a stand-in that reads painted views; the sizes differ in nothing
but their weights and numbers."""

import pytest

from mpsfm_core.testing import contract_tests

pytestmark = pytest.mark.slow  # its grid has 616 rows

test_depth = contract_tests("depth", "metric3d-v2-small")
test_normals = contract_tests("normals", "metric3d-v2-small")
