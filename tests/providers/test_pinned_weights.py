"""Check that the weights of first-party plugins have a known hash or a fixed commit."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from mpsfm_core.data.errors import InputError
from mpsfm_core.providers.first_party import PLUGIN_PROVIDERS
from mpsfm_core.providers.registry import Registry

NOT_PINNED = {
    # These releases publish no hash, so the hash of the first download is recorded.
    *("dedode", "lightglue-dedode"),
    *("superpoint", "disk-onnx", "lightglue-superpoint", "lightglue-disk-onnx"),
    # The URI denotes the newest version of a repository.
    *("sky", "transformers", "superpoint-hub", "lightglue-superpoint-hub", "superglue"),
    *("efficient-loftr", "dino", "depth-anything-3"),
}
"""Providers whose weights have no known hash yet; the list must not grow."""


def test_downloads_have_a_pinned_hash() -> None:
    registry = Registry.discover()
    ours = {name.partition("[")[0] for name in PLUGIN_PROVIDERS}
    found = set()
    for line in registry.status():
        if line.distribution not in ours or not line.available or line.kind == "plugin":
            continue
        try:
            options = registry.default_options(line.kind, line.name)
            files = registry.weights(line.kind, line.name, options)
        except InputError:  # The user has to name the weights file.
            continue
        for file in files:
            remote = file.uri.startswith(("https://", "hf://"))
            if remote and not file.sha256 and not re.search(r"@[0-9a-f]{40}/", file.uri):
                found.add(line.name)
    if not any(line.distribution == "mpsfm-kornia" for line in registry.status()):
        pytest.skip("needs the first-party plugins")
    assert found <= NOT_PINNED


def test_security_policy_lists_unpinned_providers() -> None:
    told = (Path(__file__).parents[2] / "SECURITY.md").read_text(encoding="utf-8")
    assert [name for name in sorted(NOT_PINNED) if f"`{name}`" not in told] == []
    assert f"except for {len(NOT_PINNED)} providers" in " ".join(told.split())
