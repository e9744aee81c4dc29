"""Provider contract tests of the smallest Depth Anything 3 network with random weights."""

import pytest

from mpsfm_core.testing import contract_tests

pytest.importorskip("depth_anything_3", reason="pip install --no-deps depth-anything-3")

test_contract = contract_tests("multiview", "depth-anything-3")
