"""Tests that cached results are computed again after the code of a provider has changed."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mpsfm_core import DepthPrior, ProviderSpec, Registry, View, load_config
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.events import NullExtractionEvents
from mpsfm_core.extraction.priors.raw_priors import RawPriors
from mpsfm_core.inputs.images import load_images

ROOT = Path(__file__).parents[2]
PHOTOS = ROOT / "examples" / "sample_scene" / "images"
PREDICT = """
import sys
from pathlib import Path
sys.path.insert(0, str(Path(sys.argv[1]) / "tests" / "extraction"))
from test_stale_results import median_depth
from mpsfm_core import Registry
print(median_depth(Registry.discover(), "edited", Path(sys.argv[2])))
"""
PLUGIN = {
    "edited_depth.py": """
import numpy as np
from mpsfm_core import DepthPrior, ProviderSpec, hookimpl

class Edited:
    def __init__(self, options, context):
        pass

    def predict(self, view):
        return DepthPrior.from_arrays(np.full((4, 6), 2.0))

@hookimpl
def mpsfm_providers():
    return [ProviderSpec("depth", "edited", "edited_depth:Edited")]
""",
    "edited_depth-1.0.dist-info/METADATA": "Name: edited-depth\nVersion: 1.0\n",
    "edited_depth-1.0.dist-info/entry_points.txt": "[mpsfm.plugins]\nedited = edited_depth\n",
}


class Flat:
    """Depth provider that predicts the same depth everywhere."""

    def __init__(self, depth: float) -> None:
        self.depth = depth

    def predict(self, view: View) -> DepthPrior:
        return DepthPrior.from_arrays(np.full((4, 6), self.depth))


def median_depth(registry: Registry, use: str, cache: Path) -> float:
    """Predict the depth of a photo with an on-disk cache."""
    settings = [f"runtime.cache_dir={cache}", f"depth.use={use}", "normals.use=from-depth"]
    config = load_config("sift", settings, registry)
    images = load_images(PHOTOS, names=["view_0.jpg"])
    context = ExtractionContext(images, config, registry, NullExtractionEvents())
    depth, _ = RawPriors(context).predict(0)
    return float(np.median(depth.depth))


def test_edited_plugin_is_computed_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, text in PLUGIN.items():
        path = tmp_path / "site" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "site"))

    def predict() -> float:
        run = [sys.executable, "-c", PREDICT, str(ROOT), str(tmp_path / "cache")]
        return float(subprocess.run(run, capture_output=True, text=True, check=True).stdout)

    assert predict() == 2.0
    plugin = tmp_path / "site" / "edited_depth.py"
    plugin.write_text(plugin.read_text().replace("2.0", "20.0"))
    assert predict() == 20.0
    assert len(list((tmp_path / "cache" / "extraction" / "depth").rglob("*.npz"))) == 2


def registry_with(factory: Any, version: str | None = None) -> Registry:
    registry = Registry.discover(environments=False)
    registry.add(ProviderSpec("depth", "flat-here", factory), version=version)
    return registry


def test_providers_of_one_name_in_a_process_get_their_own_results(tmp_path: Path) -> None:
    for depth in (1.0, 3.0):
        registry = registry_with(lambda options, context, depth=depth: Flat(depth))
        assert median_depth(registry, "flat-here", tmp_path) == depth
    assert not list((tmp_path / "run").iterdir())


def test_provider_with_version_is_cached(tmp_path: Path) -> None:
    for version, depth, expected in (("1", 1.0, 1.0), ("1", 3.0, 1.0), ("2", 3.0, 3.0)):
        factory = lambda options, context, depth=depth: Flat(depth)  # noqa: E731
        assert median_depth(registry_with(factory, version), "flat-here", tmp_path) == expected


def test_builtin_and_plugin_code_is_identified() -> None:
    registry = Registry.discover(environments=False)
    sift = registry.code_keys("features", "sift")
    assert sift is not None and set(sift) == {"mpsfm_core.providers.builtin.sift", "pycolmap"}
    assert all(sift.values())
    if "compact" in registry.names("depth"):
        compact = registry.code_keys("depth", "compact")
        assert compact is not None and all(compact.values())


def test_package_that_changes_after_import_is_not_identified(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Results of code in memory must not be stored under the hash of newer files."""
    (tmp_path / "changed_provider.py").write_text("class Provider: pass\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    registry = Registry()
    registry.add(ProviderSpec("depth", "changed", "changed_provider:Provider"))
    assert registry.code_keys("depth", "changed") is not None
    import changed_provider  # type: ignore[import-not-found]

    assert changed_provider.Provider
    assert registry.code_keys("depth", "changed") is None
    shutil.rmtree(tmp_path)
