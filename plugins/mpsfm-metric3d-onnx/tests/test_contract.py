"""Contract tests of one size; the sizes differ only in weights and calibration."""

import pytest

from mpsfm_core.testing import contract_tests

pytestmark = pytest.mark.slow  # its grid has 616 rows

test_depth = contract_tests("depth", "metric3d-v2-small")
test_normals = contract_tests("normals", "metric3d-v2-small")
