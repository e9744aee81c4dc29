"""Tests that a changed input recomputes exactly the dependent provider results."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from mpsfm_core.config import RuntimeOptions
from mpsfm_core.extraction.options import ExtractionOptions, VerificationOptions
from mpsfm_core.providers.provider_config import ProviderConfig

FULL = {"features": 4, "depth": 4, "normals": 4}


@pytest.fixture
def done(world):
    """Scene whose provider results are all in the cache."""
    world.extract()
    assert world.asked() == FULL
    return world


def again(world, **changes) -> Counter[str]:
    extraction = world.extract(**changes)
    matcher = next(p for p in extraction.report["providers"] if p["kind"] == "matcher")
    return world.asked() + Counter(matcher=matcher["computed"])


def test_unchanged_run_computes_nothing(done) -> None:
    done.made.clear()
    assert not again(done)
    assert not done.made  # no provider is created


@pytest.mark.parametrize(
    "changes",
    [
        {"extraction": ExtractionOptions(integration_size=80, edge_ratio=None)},
        {"verification": VerificationOptions(max_error_px=2.0)},
        {"depth": ProviderConfig(use="truth", calibration={"relative_std": 0.1})},
    ],
)
def test_changed_options_after_providers_compute_nothing(done, changes) -> None:
    assert not again(done, **changes)


@pytest.mark.parametrize("runtime", [{"workers": 1}, {"workers": 3, "threads": 2}])
def test_changed_runtime_computes_nothing(done, runtime) -> None:
    assert not again(done, runtime=RuntimeOptions(cache_dir=done.cache, **runtime))


def test_changed_feature_options_recompute_features_and_matches(done) -> None:
    changed = ProviderConfig(use="truth", options={"flavour": 1})
    assert again(done, features=changed) == {"features": 4, "matcher": 6}
    assert not again(done, features=changed)
    assert not again(done)  # the earlier results are still cached


def test_changed_matcher_options_recompute_matches(done) -> None:
    matcher = ProviderConfig(use="mutual-nearest", options={"ratio": 0.7})
    assert again(done, matcher=matcher) == {"matcher": 6}


def test_changed_depth_options_recompute_normals_from_depth(world) -> None:
    normals = ProviderConfig(use="from-depth")
    first = world.extract(normals=normals)
    assert world.asked() == {"features": 4, "depth": 4}

    def normals_computed(extraction) -> int:
        return extraction.report["providers"][-1]["computed"]

    assert normals_computed(first) == 4
    assert normals_computed(world.extract(normals=normals)) == 0
    calibrated = ProviderConfig(use="truth", calibration={"relative_std": 0.1})
    assert normals_computed(world.extract(normals=normals, depth=calibrated)) == 4
    # Normals depend on the depth values, not on the depth provider.
    same = world.extract(normals=normals, depth=ProviderConfig(use="truth", options={"flavour": 1}))
    assert world.asked()["depth"] == 4 and normals_computed(same) == 0


def test_changed_weights_recompute_results(world) -> None:
    weights = world.root / "network.bin"
    weights.write_bytes(b"first")
    depth = ProviderConfig(use="truth", options={"weights": str(weights)})
    world.extract(depth=depth)
    assert world.asked() == FULL
    assert not again(world, depth=depth)
    weights.write_bytes(b"second")
    assert again(world, depth=depth) == {"depth": 4}
    moved = weights.rename(world.root / "other.bin")
    elsewhere = ProviderConfig(use="truth", options={"weights": str(moved)})
    assert again(world, depth=elsewhere) == {"depth": 4}


def test_changed_pixels_recompute_results_of_the_image(done) -> None:
    done.write("view2.png", done.truth.renderings["view2.png"].rgb // 2)
    assert again(done) == {"features": 1, "depth": 1, "normals": 1, "matcher": 3}


def test_changed_intrinsics_recompute_intrinsics_aware_providers(done) -> None:
    intrinsic = ProviderConfig(use="intrinsic")
    again(done, depth=intrinsic)
    (done.root / "intrinsics.yaml").write_text("1: {params: [141, 140, 80, 60], images: all}")
    assert not again(done)
    assert again(done, depth=intrinsic) == {"depth": 4}


def test_changed_masks_recompute_all_providers(done) -> None:
    masks = (ProviderConfig(use="left"),)
    assert again(done, masks=masks) == {"mask": 4, **FULL, "matcher": 6}
    assert not again(done, masks=masks)
    wider = (ProviderConfig(use="left", options={"flavour": 5}),)
    assert again(done, masks=wider) == {"mask": 4, **FULL, "matcher": 6}
    same = (ProviderConfig(use="left"), ProviderConfig(use="left", options={"flavour": 9}))
    # The intersection of the two masks equals the earlier mask, so views are unchanged.
    assert again(done, masks=same) == {"mask": 4}


def test_changed_plugin_version_recomputes_results(done) -> None:
    """Results of a provider with another version are recomputed."""
    entries = done.registry._entries
    for number, entry in enumerate(entries):
        if (entry.spec.kind, entry.spec.name) == ("depth", "truth"):
            entries[number] = type(entry)(entry.spec, entry.distribution, "2")
    assert again(done) == {"depth": 4}


def test_changed_seed_recomputes_results(done) -> None:
    assert again(done, runtime=RuntimeOptions(cache_dir=done.cache, seed=1)) == {
        **FULL,
        "matcher": 6,
    }


def test_uncached_providers_read_files_again(world) -> None:
    folder = world.root / "depth"
    folder.mkdir()
    for name in world.names:
        np.save(folder / f"{name}.npy", np.full((30, 40), 2.0))
    depth = ProviderConfig(use="files", options={"directory": str(folder), "relative_std": 0.02})
    first = world.extract(depth=depth).problem.images[0].depth.depth
    np.save(folder / f"{world.names[0]}.npy", np.full((30, 40), 3.0))
    second = world.extract(depth=depth).problem.images[0].depth.depth
    assert (np.median(first), np.median(second)) == pytest.approx((2.0, 3.0))


def test_damaged_cache_entry_is_recomputed(done, caplog: pytest.LogCaptureFixture) -> None:
    path = sorted((done.cache / "extraction" / "depth").rglob("*.npz"))[0]
    path.write_bytes(path.read_bytes()[:-100])
    assert again(done) == {"depth": 1}
    assert "damaged" in caplog.text
    assert not again(done)


def test_provider_failure_keeps_cached_results(world) -> None:
    def stop() -> None:
        raise KeyboardInterrupt

    world.break_on["depth", "view3.png"] = stop
    with pytest.raises(KeyboardInterrupt):
        world.extract(runtime=RuntimeOptions(cache_dir=world.cache, workers=1))
    assert world.asked() == {"features": 4, "depth": 4}
    world.break_on.clear()
    assert again(world) == {"depth": 1, "normals": 4}


SCRIPT = """
import sys
from pathlib import Path
from mpsfm_core.config import Config, RuntimeOptions
from mpsfm_core.extraction.runner import extract
from mpsfm_core.inputs.images import load_images
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.registry import Registry

root = Path(sys.argv[1])
depth = {"directory": str(root / "depth"), "relative_std": 0.02}
config = Config(
    features=ProviderConfig(use="sift"),
    matcher=ProviderConfig(use="mutual-nearest"),
    depth=ProviderConfig(use="files", options=depth),
    normals=ProviderConfig(use="from-depth"),
    runtime=RuntimeOptions(cache_dir=root / "cache", workers=2),
)
report = extract(
    load_images(root / "images", root / "intrinsics.yaml"), config, Registry.discover()
).report
for provider in report["providers"]:
    print(provider["kind"], provider["computed"])
"""


def start(root: Path) -> subprocess.Popen[str]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", SCRIPT, str(root)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="needs SIGKILL")
@pytest.mark.parametrize("name", ["SIGKILL", "SIGINT"])
def test_stopped_run_continues_from_cache(world, name: str) -> None:
    (world.root / "depth").mkdir()
    for image in world.names:
        np.save(world.root / "depth" / f"{image}.npy", world.truth.renderings[image].depth)
    entries = world.cache / "extraction"
    with start(world.root) as process:
        deadline = time.monotonic() + 120
        while not list(entries.rglob("*.npz")) and process.poll() is None:
            assert time.monotonic() < deadline
            time.sleep(0.002)
        process.send_signal(getattr(signal, name))
    kept = Counter(path.parts[-3] for path in entries.rglob("*.npz"))
    assert process.returncode != 0 and kept["features"] >= 1
    with start(world.root) as process:
        output, _ = process.communicate(timeout=240)
    computed = dict(line.split() for line in output.splitlines())
    assert int(computed["features"]) == 4 - kept["features"]
    assert int(computed["matcher"]) == 6 - kept["matcher"]
    assert int(computed["normals"]) == 4 - kept["normals"]
