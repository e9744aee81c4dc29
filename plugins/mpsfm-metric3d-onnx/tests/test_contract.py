"""Provider contract tests of one Metric3D size, because all sizes share the tested code."""

import pytest

from mpsfm_core.testing import contract_tests

pytestmark = pytest.mark.slow  # Metric3D's depth maps have 616 rows

test_depth = contract_tests("depth", "metric3d-v2-small")
test_normals = contract_tests("normals", "metric3d-v2-small")
