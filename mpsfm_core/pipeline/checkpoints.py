"""What mapping and the dense stage have found, on disk, so that a run that was killed goes on.

Of the mapper its state, one file a problem; of the dense stage a file an image; both in the cache.
They count for the same problem and options and the same code and numerical libraries; anything else
is a new start, as results are to be those of a run that was never disturbed.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import json
import logging
import platform
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import Any, cast

import numpy as np

from mpsfm_core.data import MappingProblem
from mpsfm_core.data.errors import DataError, OutputError
from mpsfm_core.dense.options import DenseOptions
from mpsfm_core.dense.stereo import StereoDepth
from mpsfm_core.extraction.cache import Cache, cache_folder, content_key
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.mapping.state import CheckpointArrays, fingerprint
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.providers.registry import core_version
from mpsfm_core.support.files import remove_temporary_files, write_file
from mpsfm_core.support.npz import read_npz

_log = logging.getLogger(__name__)

FORMAT = 1
"""Raised when the meaning of the files changes."""

_HEADER = "header"
_SHARE = 0.02
"""Of the time of a run that saving may take (ours)."""
_KEPT_S = 30 * 24 * 3600.0
"""Checkpoints that nobody came back to are taken away then (ours)."""
_GIVEN_UP = "no checkpoints from now on: %s"
_LIBRARIES = ("numpy", "scipy", "numba", "pycolmap", "cv2")
_NUMERICS = (
    "data",
    "support/jit.py",
    "geometry",
    "optimize",
    "mapping",
    "dense",
)


class MappingCheckpoints:
    """The checkpoints of one problem.

    ``every_s``: seconds between two of them at least; more where writing takes long.
    """

    def __init__(
        self,
        cache_dir: Path | None,
        problem: MappingProblem,
        options: MapperOptions,
        stages: Stages,
        every_s: float,
    ) -> None:
        self._folder = cache_folder(cache_dir) / "mapping"
        self._path = self._folder / f"{fingerprint((problem, options))}.npz"
        self._stages = stages
        self._every_s = self._wait_s = every_s
        self._total = len(problem.images)
        self._last = time.monotonic()
        self._failed = False

    def forget(self) -> None:
        """Start anew next time: the run is finished, or that is wanted."""
        with suppress(OSError):
            self._path.unlink()

    def load(self) -> CheckpointArrays | None:
        """As :class:`mpsfm_core.mapping.checkpoints.CheckpointStore`."""
        self._clear_up()
        if not self._path.is_file():
            return None
        try:
            header, arrays = read_checkpoint(self._path)
        except DataError as error:
            self.unreadable(str(error))
            return None
        if header.get("code") != code_key():
            self.unreadable(f"it is of other code ({header.get('version')}, format or libraries)")
            return None
        placed = f"{header['registered']} of {self._total} images placed in the last group"
        self._stages.notice(
            f"mapping goes on from a checkpoint of {header['time']}: {placed} (--fresh starts anew)"
        )
        return arrays

    def unreadable(self, reason: str) -> None:
        """As :class:`mpsfm_core.mapping.checkpoints.CheckpointStore`."""
        self._stages.notice(f"the checkpoint of this mapping is not used: {reason}; starting anew")

    def due(self) -> bool:
        """As :class:`mpsfm_core.mapping.checkpoints.CheckpointStore`."""
        return not self._failed and time.monotonic() - self._last >= self._wait_s

    def save(self, state: CheckpointArrays, registered: int) -> None:
        """As :class:`mpsfm_core.mapping.checkpoints.CheckpointStore`.

        A disk that is full ends no run: it goes on without checkpoints, and says so.
        """
        if self._failed:
            return
        started = time.monotonic()
        header = {
            "code": code_key(),
            "version": core_version(),
            "registered": registered,
            "time": time.strftime("%Y-%m-%d %H:%M:%S"),
        }
        text = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
        arrays = cast(Any, {_HEADER: text, **state})
        try:
            write_file(self._path, lambda file: np.savez(file, **arrays), self._unfinished)
        except OSError as error:
            _log.warning(_GIVEN_UP, error)
            self._failed = True
        self._last = time.monotonic()
        self._wait_s = max(self._every_s, (self._last - started) / _SHARE)

    @property
    def _unfinished(self) -> Path:
        return self._folder / "unfinished"

    def _clear_up(self) -> None:
        remove_temporary_files(self._unfinished)
        for path in self._folder.glob("*.npz"):
            with suppress(OSError):
                if time.time() - path.stat().st_mtime > _KEPT_S:
                    path.unlink()


class DenseCheckpoints:
    """What the dense stage has found for the images of a reconstruction.

    ``photos``: names the content of the photos of all images.
    """

    def __init__(
        self,
        cache_dir: Path | None,
        reconstruction: Reconstruction,
        photos: Sequence[str],
        options: DenseOptions,
    ) -> None:
        self._cache = Cache(cache_dir)
        self._all = content_key(
            code_key(), fingerprint(reconstruction), list(photos), options.model_dump(mode="json")
        )
        self._names = [image.name for image in reconstruction.images]
        self._failed, self._telling = False, Lock()

    def load(self, name: str) -> StereoDepth | None:
        """As :class:`mpsfm_core.dense.densify.StereoCheckpoints`."""
        return self._cache.load("dense", self._key(name), StereoDepth)

    def save(self, name: str, depth: StereoDepth) -> None:
        """Store the depth of an image; after a disk error, warn once and store no more."""
        if self._failed:
            return
        try:
            self._cache.store("dense", self._key(name), depth)
        except OutputError as error:
            with self._telling:  # images are saved by several threads
                if not self._failed:
                    _log.warning(_GIVEN_UP, error)
                self._failed = True

    def forget(self) -> None:
        """The run is finished."""
        for name in self._names:
            self._cache.forget("dense", self._key(name))

    def _key(self, name: str) -> str:
        return content_key(self._all, name)


def read_checkpoint(path: Path) -> tuple[Mapping[str, Any], CheckpointArrays]:
    """Header and state of a file; raises :class:`DataError` when it is damaged."""
    try:
        arrays = read_npz(path)
        header = json.loads(arrays.pop(_HEADER).tobytes())
        missing = {"code", "version", "registered", "time"} - header.keys()
        if missing:
            raise ValueError(f"no {', '.join(missing)}")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DataError("checkpoint", f"it is damaged ({error})") from error
    return header, arrays


@functools.cache
def code_key() -> str:
    """Names the code that decides what mapper and dense stage find to the last bit."""
    package = Path(__file__).parents[1]
    found = hashlib.sha256()
    for name in _NUMERICS:
        path = package / name
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            found.update(f"{file.relative_to(package)}\n".encode() + file.read_bytes())
    versions = [importlib.import_module(name).__version__ for name in _LIBRARIES]
    return content_key(FORMAT, found.hexdigest(), versions, platform.machine())
