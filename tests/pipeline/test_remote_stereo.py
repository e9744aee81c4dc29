"""Tests of the dense stage with an executor without workers, which runs all items in this process.

The plugins mpsfm-dask and mpsfm-ray have tests of the dense stage with worker processes.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import mpsfm_core
from mpsfm_core.data.errors import InputError, MpsfmError
from mpsfm_core.dense.densify import densify
from mpsfm_core.dense.options import DenseOptions
from mpsfm_core.extraction.cache import digest
from mpsfm_core.inputs.images import ImageSet
from mpsfm_core.pipeline.checkpoints import DenseCheckpoints
from mpsfm_core.pipeline.remote_stereo import MatchStereo, RemoteStereo
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing.posed_room import PosedRoom, make_posed_room
from tests.support.backwards_executor import Backwards

OPTIONS = DenseOptions()


class Killed(Exception):
    """Interrupts a run."""


@dataclass
class DenseRun:
    """Dense stage of a room whose images are files."""

    room: PosedRoom
    images: ImageSet
    cache: Path
    executor: Backwards = field(default_factory=Backwards)
    finished: list[tuple[int, int]] = field(default_factory=list)

    @property
    def step(self) -> MatchStereo:
        keys = [image.digest for image in self.images]
        checkpoints = DenseCheckpoints(self.cache, self.room.reconstruction, keys, OPTIONS)
        return MatchStereo(self.images, OPTIONS, checkpoints, threads=1)

    def densify(self, last: int | None = None) -> str:
        """Return the hash of the depth maps; ``last`` interrupts the run after some images."""

        def progress(done: int, total: int) -> None:
            self.finished.append((done, total))
            if done == last:
                raise Killed

        step, model = self.step, self.room.reconstruction
        remote = RemoteStereo(self.executor, model, step, progress)
        dense, _ = densify(
            model,
            self.images.view_of,
            OPTIONS,
            progress=progress,
            checkpoints=step.checkpoints,
            match_remotely=remote,
        )
        return digest(dense)

    def list_files(self) -> list[Path]:
        return [path for path in self.cache.rglob("*") if path.is_file()]


@pytest.fixture(scope="module")
def room() -> PosedRoom:
    return make_posed_room()


@pytest.fixture
def run(room: PosedRoom, tmp_path: Path) -> DenseRun:
    return DenseRun(room, room.write_images(tmp_path / "photos"), tmp_path / "cache")


@pytest.fixture(scope="module")
def expected(room: PosedRoom) -> str:
    return digest(densify(room.reconstruction, room.views.__getitem__, OPTIONS)[0])


def test_executor_gives_the_same_bits_and_checkpoints_of_all_images(
    run: DenseRun, expected: str
) -> None:
    assert run.densify() == expected
    assert run.finished == [(1, 4), (2, 4), (3, 4), (4, 4)]
    items = run.executor.items[MatchStereo]
    assert [name for name, _ in items] == run.images.names
    assert all(sources and name not in sources for name, sources in items)
    assert len(run.list_files()) == 4
    run.step.checkpoints.forget()
    assert not run.list_files()


def test_interrupted_run_matches_only_the_missing_images(run: DenseRun, expected: str) -> None:
    with pytest.raises(Killed):
        run.densify(last=2)
    finished = run.list_files()
    assert len(finished) == 2
    modified = [path.stat().st_mtime_ns for path in finished]
    assert run.densify() == expected
    assert [path.stat().st_mtime_ns for path in finished] == modified
    assert len(run.list_files()) == 4


def test_unreadable_image_error_names_the_image(run: DenseRun) -> None:
    changed = run.images[1].path
    cv2.imwrite(str(changed), np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(InputError, match=r"1\.png has changed its size"):
        run.densify()
    assert all(path.parent.parent.name == "dense" for path in run.list_files())


def test_unexpected_error_names_the_image(run: DenseRun) -> None:
    step = run.step
    path = step.inputs.path(step.input_key("2.png"))
    path.parent.mkdir(parents=True)
    path.write_bytes(b"no arrays")
    with pytest.raises(MpsfmError, match=r"stereo of image 2\.png failed on .*ValueError"):
        step(("2.png", ["1.png"]))


def test_worker_without_the_cache_folder_raises(run: DenseRun) -> None:
    with pytest.raises(InputError, match=r"does not see the cache .*runtime\.cache_dir"):
        run.step(("0.png", ["1.png"]))


def test_images_without_overlap_are_not_sent(run: DenseRun) -> None:
    images = run.room.reconstruction.images
    away = [replace(image, translation=100.0 * image.index + np.zeros(3)) for image in images]
    model = replace(run.room.reconstruction, images=tuple(away))
    remote = RemoteStereo(run.executor, model, run.step, lambda done, total: None)
    densify(model, run.images.view_of, OPTIONS, match_remotely=remote)
    assert run.executor.items[MatchStereo] == []


@pytest.mark.slow  # two reconstructions
def test_reconstruct_on_an_executor_gives_the_same_depth_maps(
    run: DenseRun, tmp_path: Path
) -> None:
    registry = Registry.discover()
    registry.register(run.executor, name="backwards")
    results = {}
    for executor in ("threads", "backwards"):
        settings = {"cache_dir": tmp_path / executor, "executor": executor, "checkpoint_s": "null"}
        result = mpsfm_core.reconstruct(
            tmp_path / "photos",
            config="sift",
            intrinsics=tmp_path / "intrinsics.yaml",
            depth="flat",
            normals="from-depth",
            overrides=[f"runtime.{key}={value}" for key, value in settings.items()],
            registry=registry,
        )
        results[executor] = digest(result.mapping.reconstructions)
    assert results["backwards"] == results["threads"]
    assert run.executor.items[MatchStereo] and run.executor.closed >= 2
    assert not list((tmp_path / "backwards").rglob("dense/**/*.npz"))
