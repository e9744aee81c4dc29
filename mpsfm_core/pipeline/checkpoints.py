"""Checkpoints of mapping and of the dense stage in the cache folder.

Mapping writes one checkpoint file per run, the dense stage one file per image. A checkpoint is only
used for the same problem, options, code and numerical libraries. A resumed run therefore gives the
same result as an uninterrupted run.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import json
import logging
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import Any, Protocol, TypeVar, cast

import numpy as np

from mpsfm_core.data import MappingProblem
from mpsfm_core.data.errors import DataError, OutputError
from mpsfm_core.dense.options import DenseOptions
from mpsfm_core.dense.stereo import StereoDepth
from mpsfm_core.extraction.cache import Cache, cache_folder, content_key, digest
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.mapping.state import CheckpointArrays
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.providers.registry import core_version
from mpsfm_core.support.files import remove_temporary_files, write_file
from mpsfm_core.support.npz import read_npz

_log = logging.getLogger(__name__)

FORMAT = 1
"""Version of the checkpoint format; raising the number invalidates all checkpoints."""

_HEADER = "header"
_MAX_SAVING_RATIO = 0.02
"""Maximum ratio of the time for computing and writing checkpoints to the run time."""
_MAX_AGE_S = 30 * 24 * 3600.0
"""Age above which unused checkpoints are deleted, in seconds (30 days)."""
_DISK_ERROR = "no checkpoints from now on: %s"
_WARNING_LOCK = Lock()
"""Lock of the warning about a disk error, because several threads store depth maps."""
_LIBRARIES = ("numpy", "scipy", "numba", "pycolmap", "cv2")
_NUMERICS = (
    "data",
    "support/jit.py",
    "geometry",
    "optimize",
    "mapping",
    "dense",
)


class StageCheckpoints(Protocol):
    """Checkpoints of one stage."""

    def forget(self) -> None:
        """Delete the checkpoints."""


C = TypeVar("C", bound=StageCheckpoints)


class RunCheckpoints:
    """All checkpoints of one run.

    Args:
        fresh: If true, checkpoints of an interrupted run are deleted before they are used.
    """

    def __init__(self, *, fresh: bool) -> None:
        self.fresh = fresh
        self._stages: list[StageCheckpoints] = []

    def add(self, checkpoints: C) -> C:
        """Add the checkpoints of a stage, and delete them first if the run starts again."""
        if self.fresh:
            checkpoints.forget()
        self._stages.append(checkpoints)
        return checkpoints

    def delete(self) -> None:
        """Delete all checkpoints of a completed run."""
        for checkpoints in self._stages:
            checkpoints.forget()


class MappingCheckpoints:
    """Checkpoint of the mapper for one mapping problem (images, priors and verified matches).

    Implements :class:`mpsfm_core.mapping.checkpoints.CheckpointStore`.

    Args:
        cache_dir: Cache folder, or None for the platform's cache folder.
        problem: Input of the mapper (images, priors and verified matches).
        options: Options of the mapper.
        stages: Receiver of messages to the user.
        every_s: Minimum seconds between checkpoints; the interval is extended if saving is slow.
        problem_digest: Digest of the problem, or None to compute it.
    """

    def __init__(
        self,
        cache_dir: Path | None,
        problem: MappingProblem,
        options: MapperOptions,
        stages: Stages,
        every_s: float,
        problem_digest: str | None = None,
    ) -> None:
        self._folder = cache_folder(cache_dir) / "mapping"
        key = content_key(problem_digest or digest(problem), options.model_dump(mode="json"))
        self._path = self._folder / f"{key}.npz"
        self._stages = stages
        self._every_s = self._wait_s = every_s
        self._total = len(problem.images)
        self._last = time.monotonic()
        self._failed = False

    def forget(self) -> None:
        """Delete the checkpoint file."""
        with suppress(OSError):
            self._path.unlink()

    def load(self) -> CheckpointArrays | None:
        """Load the mapper state, or return None if the checkpoint is missing or invalid."""
        self._clear_up()
        if not self._path.is_file():
            return None
        try:
            header, arrays = read_checkpoint(self._path)
        except DataError as error:
            self.unreadable(str(error))
            return None
        if header.get("code") != code_key():
            self.unreadable(
                f"it was written by other code (version {header.get('version')} or other libraries)"
            )
            return None
        placed = f"{header['registered']} of {self._total} images registered in the last component"
        self._stages.notice(
            f"mapping continues from a checkpoint of {header['time']}: {placed} "
            "(--fresh starts again)"
        )
        return arrays

    def unreadable(self, reason: str) -> None:
        """Report to the user why the checkpoint is not used."""
        self._stages.notice(
            f"the checkpoint of this mapping is not used: {reason}; mapping starts again"
        )

    def due(self) -> bool:
        """Check whether the next checkpoint should be written."""
        return not self._failed and time.monotonic() - self._last >= self._wait_s

    def save(self, collect: Callable[[], CheckpointArrays], registered: int) -> None:
        """Write a checkpoint; after a disk error, warn once and disable checkpoints."""
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
        arrays = cast(Any, {_HEADER: text, **collect()})
        try:
            write_file(self._path, lambda file: np.savez(file, **arrays), self._unfinished)
        except OSError as error:
            _log.warning(_DISK_ERROR, error)
            self._failed = True
        self._last = time.monotonic()
        self._wait_s = max(self._every_s, (self._last - started) / _MAX_SAVING_RATIO)

    @property
    def _unfinished(self) -> Path:
        return self._folder / "unfinished"

    def _clear_up(self) -> None:
        remove_temporary_files(self._unfinished)
        for path in self._folder.glob("*.npz"):
            with suppress(OSError):
                if time.time() - path.stat().st_mtime > _MAX_AGE_S:
                    path.unlink()


class DenseCheckpoints:
    """Checkpoints of the dense stage for the images of one reconstruction.

    Implements :class:`mpsfm_core.dense.densify.StereoCheckpoints`.

    Args:
        cache_dir: Cache folder, or None for the platform's cache folder.
        reconstruction: Reconstruction whose depth maps the dense stage computes.
        image_keys: Content hashes of all images.
        options: Options of the dense stage.
    """

    def __init__(
        self,
        cache_dir: Path | None,
        reconstruction: Reconstruction,
        image_keys: Sequence[str],
        options: DenseOptions,
    ) -> None:
        self.cache = cache_folder(cache_dir)
        self._cache = Cache(self.cache)
        self._reconstruction_key = content_key(
            digest(reconstruction),
            list(image_keys),
            options.model_dump(mode="json"),
        )
        self._names = [image.name for image in reconstruction.images]
        self._failed = False

    def load(self, name: str) -> StereoDepth | None:
        """Load the stereo depth map of an image, or None if no map is stored."""
        return self._cache.load("dense", self._key(name), StereoDepth)

    def save(self, name: str, depth: StereoDepth) -> None:
        """Store the stereo depth of an image; after a disk error, warn once and store no more."""
        if self._failed:
            return
        try:
            self.store(name, depth)
        except OutputError as error:
            with _WARNING_LOCK:
                if not self._failed:
                    _log.warning(_DISK_ERROR, error)
                self._failed = True

    def store(self, name: str, depth: StereoDepth) -> None:
        """Store the stereo depth of an image.

        Raises:
            OutputError: the checkpoint cannot be written.
        """
        self._cache.store("dense", self._key(name), depth)

    def forget(self) -> None:
        """Delete the stored stereo depth of all images."""
        for name in self._names:
            self._cache.forget("dense", self._key(name))

    def _key(self, name: str) -> str:
        # Workers with other code compute another key, so that their results are not used.
        return content_key(code_key(), self.input_key(name))

    def input_key(self, name: str) -> str:
        """Return the hash of all inputs of the stereo depth of an image, without the code."""
        return content_key(self._reconstruction_key, name)


def read_checkpoint(path: Path) -> tuple[Mapping[str, Any], CheckpointArrays]:
    """Read header and mapper state of a checkpoint file.

    Raises:
        DataError: the checkpoint file is damaged or incomplete.
    """
    try:
        arrays = read_npz(path)
        header = json.loads(arrays.pop(_HEADER).tobytes())
        missing = {"code", "version", "registered", "time"} - header.keys()
        if missing:
            raise ValueError(f"no {', '.join(missing)}")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DataError("checkpoint", f"the checkpoint file is damaged ({error})") from error
    return header, arrays


@functools.cache
def code_key() -> str:
    """Return a hash of the code and library versions that determine the exact result."""
    package = Path(__file__).parents[1]
    sha256 = hashlib.sha256()
    for name in _NUMERICS:
        path = package / name
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            sha256.update(f"{file.relative_to(package)}\n".encode() + file.read_bytes())
    versions = [importlib.import_module(name).__version__ for name in _LIBRARIES]
    return content_key(FORMAT, sha256.hexdigest(), versions, platform.machine())
