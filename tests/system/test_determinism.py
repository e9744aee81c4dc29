"""Tests of the reproducibility of results across workers, caches and processors."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import mpsfm_core
from mpsfm_core.evaluation import read_poses
from mpsfm_core.geometry import camera_center, rotation_angle_deg
from tests.support.result_files import content

pytestmark = pytest.mark.slow

MOST = {"computed": (1e-6, 1e-7), "cached": (1e-8, 1e-9)}
"""Maximum pose differences between processors according to docs/robustness.md, for computed and for
cached extraction: degrees, and ratio to the longest baseline."""


def run(photo_scene, output: Path, workers: int = 1, cache: Path | None = None) -> dict[str, str]:
    """Return the result folder of a run with an empty or the given cache."""
    mpsfm_core.reconstruct(
        photo_scene.images,
        output,
        config=photo_scene.config,
        intrinsics=photo_scene.intrinsics,
        overrides=[
            f"runtime.workers={workers}",
            f"runtime.cache_dir={cache or output.with_name('cache')}",
        ],
    )
    return content(output)


@pytest.fixture(scope="module")
def alone(photo_scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Result of a run with one worker; the cache is next to the result folder."""
    output = tmp_path_factory.mktemp("alone") / "out"
    run(photo_scene, output)
    assert len(read_poses(output)) == 5
    return output


@pytest.mark.parametrize("workers", [2, 4])
def test_result_does_not_depend_on_workers(
    photo_scene, alone: Path, tmp_path: Path, workers: int
) -> None:
    assert run(photo_scene, tmp_path / "out", workers) == content(alone)


def test_result_does_not_depend_on_cache(photo_scene, alone: Path, tmp_path: Path) -> None:
    cache = alone.with_name("cache")
    assert run(photo_scene, tmp_path / "out", cache=cache) == content(alone)


def test_result_does_not_depend_on_file_order(
    photo_scene, alone: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def reversed_listing(name: str):
        listed = getattr(Path, name)

        def listing(self: Path, *arguments: str) -> Iterator[Path]:
            found = sorted(listed(self, *arguments), reverse=True)
            asked.append(found)
            return iter(found)

        return listing

    for name in ("iterdir", "glob", "rglob"):
        monkeypatch.setattr(Path, name, reversed_listing(name))
    found = run(photo_scene, tmp_path / "out")
    monkeypatch.undo()
    assert any(paths[0].name > paths[-1].name for paths in asked if paths)
    assert found == content(alone)


KERNELS = {
    "OpenBLAS for Haswell": {"OPENBLAS_CORETYPE": "Haswell"},
    "OpenBLAS for Sandy Bridge": {"OPENBLAS_CORETYPE": "Sandybridge"},
    "numpy for any processor": {
        "NPY_DISABLE_CPU_FEATURES": " ".join(
            np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
        )
    },
    "numba for Sandy Bridge": {"NUMBA_CPU_NAME": "sandybridge"},
}


@pytest.mark.skipif(platform.machine() != "x86_64", reason="kernels of x86-64 processors")
@pytest.mark.parametrize("kernels", KERNELS)
@pytest.mark.parametrize("extraction", MOST)
def test_kernels_of_other_processor_change_poses_by_rounding(
    photo_scene, mpsfm, alone: Path, tmp_path: Path, kernels: str, extraction: str
) -> None:
    cache = alone.with_name("cache") if extraction == "cached" else tmp_path / "cache"
    output = tmp_path / "out"
    setting = ("--set", f"runtime.cache_dir={cache}")
    ended = mpsfm(*photo_scene.arguments, "--output", output, *setting, extra=KERNELS[kernels])
    assert ended.code == 0, ended.err
    expected, found = read_poses(alone), read_poses(output)
    assert found.keys() == expected.keys()
    centers = np.array([camera_center(*pose) for pose in expected.values()])
    moved = np.array([camera_center(*found[name]) for name in expected]) - centers
    baseline = np.linalg.norm(centers[:, None] - centers, axis=2).max()
    turned = max(rotation_angle_deg(found[n][0] @ expected[n][0].T) for n in expected)
    most_deg, most_of_baseline = MOST[extraction]
    assert turned < most_deg
    assert np.linalg.norm(moved, axis=1).max() < most_of_baseline * baseline
