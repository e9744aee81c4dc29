"""Tests of the content-addressed cache of provider results."""

from __future__ import annotations

import errno
import logging
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest

from mpsfm_core.data import (
    DenseMatches,
    DepthPrior,
    Features,
    NormalPrior,
    PairDepth,
    PairMatches,
    SparseMatches,
)
from mpsfm_core.data.errors import OutputError
from mpsfm_core.extraction.cache import Cache, content_key, digest, pack
from mpsfm_core.extraction.matching.verification import TwoViewGeometry
from mpsfm_core.extraction.priors.raw_priors import JointPrior

RNG = np.random.default_rng(0)
KEY = content_key("entry")


def depth(metric: bool = True) -> DepthPrior:
    values = RNG.uniform(1, 2, (6, 8))
    return DepthPrior.from_arrays(values, values**2, values > 1.2, metric=metric)


def examples() -> dict[str, object]:
    keypoints = RNG.uniform(0, 9, (5, 2))
    descriptors = RNG.normal(size=(5, 3)).astype(np.float32)
    scores = np.linspace(0, 1, 5, dtype=np.float32)
    sparse = SparseMatches(np.stack([np.arange(5), np.arange(5)[::-1]], axis=1), scores)
    dense = DenseMatches(keypoints, keypoints + 1, scores, std_px=2.5)
    normals = NormalPrior.from_arrays(np.tile([0.0, 0.6, -0.8], (4, 5, 1)))
    return {
        "features": Features(keypoints, descriptors, scores, None, std_px=1.5),
        "all features": Features(keypoints, descriptors, scores, scores),
        "sparse": PairMatches(sparse),
        "everything": PairMatches(sparse, dense, PairDepth(depth(), depth(metric=False))),
        "depth": DepthPrior.from_arrays(np.ones((3, 4))),
        "joint": JointPrior(depth(), normals),
        "two-view": TwoViewGeometry("", "planar", 3, np.arange(3), np.eye(3), np.zeros(3)),
        "vector": RNG.normal(size=7).astype(np.float32),
        "mask": RNG.uniform(size=(4, 4)) > 0.5,
    }


@pytest.mark.parametrize("name", examples())
def test_cache_store_then_load_returns_equal_object(name: str, tmp_path: Path) -> None:
    value = examples()[name]
    cache = Cache(tmp_path)
    assert cache.load("kind", KEY, type(value)) is None
    cache.store("kind", KEY, value)
    found = cache.load("kind", KEY, type(value))
    assert type(found) is type(value)
    before, after = pack(value), pack(found)
    assert before.keys() == after.keys()
    for path in before:
        assert before[path].dtype == after[path].dtype
        assert np.array_equal(before[path], after[path])
    assert digest(found) == digest(value)


def test_digest_changes_with_any_array() -> None:
    prior = depth()
    changed = prior.depth.copy()
    changed[0, 0] = np.nextafter(changed[0, 0], 9)
    others = [
        DepthPrior(changed, prior.variance, prior.valid),
        DepthPrior(prior.depth, None, prior.valid),
        DepthPrior(prior.depth, prior.variance, prior.valid, metric=False),
        DepthPrior(prior.depth.T.copy(), prior.variance.T.copy(), prior.valid.T.copy()),
    ]
    assert len({digest(prior), *map(digest, others)}) == 5
    assert digest(prior) == digest(DepthPrior(prior.depth, prior.variance, prior.valid))


def test_content_key_ignores_order_of_dictionary() -> None:
    assert content_key({"a": 1, "b": [2]}) == content_key({"b": [2], "a": 1})
    assert content_key({"a": 1}) != content_key({"a": 1.5}) != content_key(["a", 1.5])
    assert content_key("a", "b") != content_key("ab")


DAMAGES = {
    "empty": lambda data: b"",
    "cut": lambda data: data[: len(data) // 2],
    "text": lambda data: b"hello",
    "flipped": lambda data: data[:300] + bytes([data[300] ^ 1]) + data[301:],
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_entry_is_computed_again(
    damage: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cache = Cache(tmp_path)
    cache.store("depth", KEY, depth())
    (path,) = tmp_path.rglob("*.npz")
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    with caplog.at_level(logging.WARNING):
        assert cache.load("depth", KEY, DepthPrior) is None
    assert "damaged" in caplog.text and path.name in caplog.text
    cache.store("depth", KEY, depth())
    assert cache.load("depth", KEY, DepthPrior) is not None


def test_cache_entry_of_another_class_is_computed_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cache = Cache(tmp_path)
    cache.store("depth", KEY, depth())
    assert cache.load("depth", KEY, Features) is None
    assert "damaged" in caplog.text


def test_cache_store_on_full_disk_raises_output_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(file: BinaryIO, **arrays: object) -> None:
        file.write(b"PK")
        raise OSError(errno.ENOSPC, "No space left on device")

    cache = Cache(tmp_path)
    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OutputError, match=r"disk is full.*runtime\.cache_dir"):
        cache.store("depth", KEY, depth())
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_cache_store_below_a_file_raises_output_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="cannot write to the cache"):
        Cache(tmp_path / "file").store("depth", KEY, depth())


def test_cache_folder_default_and_environment_variable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MPSFM_CACHE", str(tmp_path / "environment"))
    assert Cache().folder == tmp_path / "environment" / "extraction"
    assert Cache(tmp_path).folder == tmp_path / "extraction"


WRITER = """
import sys
from pathlib import Path
import numpy as np
from mpsfm_core.data import DepthPrior
from mpsfm_core.extraction.cache import Cache, content_key
cache = Cache(Path(sys.argv[1]))
for number in range(10_000):
    values = np.full((400, 400), 1.0 + number)
    cache.store("depth", content_key(number), DepthPrior.from_arrays(values))
"""


@pytest.mark.skipif(os.name == "nt", reason="needs SIGKILL")
def test_killed_writer_leaves_only_complete_entries(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cache = Cache(tmp_path)
    with subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path)]) as process:
        deadline = time.monotonic() + 60
        while len(list(cache.folder.rglob("*.npz"))) < 5 and time.monotonic() < deadline:
            time.sleep(0.01)
        process.kill()
    written = len(list(cache.folder.rglob("*.npz")))
    assert written >= 5
    found = 0
    for number in range(written + 1):
        entry = cache.load("depth", content_key(number), DepthPrior)
        if entry is not None:
            assert (entry.depth == 1.0 + number).all()
            found += 1
    assert found == written and not caplog.records
