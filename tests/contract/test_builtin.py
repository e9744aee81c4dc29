"""Contract tests of the built-in providers."""

from __future__ import annotations

import pytest

from mpsfm_core.providers.builtin.plugin import mpsfm_providers
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing import contract_tests

BUILTIN = Registry()
BUILTIN.add(*mpsfm_providers())

test_sift = contract_tests("features", "sift", registry=BUILTIN)
test_mutual_nearest = contract_tests("matcher", "mutual-nearest", registry=BUILTIN)
test_depth_files = contract_tests("depth", "files", registry=BUILTIN)
test_flat_depth = contract_tests("depth", "flat", registry=BUILTIN)
test_depth_of_matcher = contract_tests("depth", "matcher", registry=BUILTIN)
test_depth_of_multiview = pytest.mark.slow(contract_tests("depth", "multiview", registry=BUILTIN))
test_normal_files = contract_tests("normals", "files", registry=BUILTIN)
test_normals_from_depth = contract_tests("normals", "from-depth", registry=BUILTIN)
test_mask_files = contract_tests("mask", "files", registry=BUILTIN)


def test_all_of_them_are_here() -> None:
    tested = {
        ("features", "sift"),
        ("matcher", "mutual-nearest"),
        ("depth", "files"),
        ("depth", "flat"),
        ("depth", "matcher"),
        ("depth", "multiview"),
        ("normals", "files"),
        ("normals", "from-depth"),
        ("mask", "files"),
    }
    assert {(spec.kind, spec.name) for spec in mpsfm_providers()} == tested
