"""Read hloc's HDF5 files of features and matches with h5py."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mpsfm_core.data import Float32, Float64, Int64
from mpsfm_core.data.errors import InputError

_TO_COLMAP = 0.5
"""Offset in pixels from hloc to COLMAP keypoints, because hloc's first pixel center is (0, 0)."""


class HlocFiles:
    """Reader of a features file and an optional matches file of hloc.

    All methods raise an :class:`InputError` that names the missing or damaged file or dataset.
    """

    def __init__(self, features: Path, matches: Path | None = None) -> None:
        self.features = _Hdf5(features)
        self.matches = None if matches is None else _Hdf5(matches)

    def names(self) -> list[str]:
        """Return the names of the images that have keypoints."""
        suffix = "/keypoints"
        return [n.removesuffix(suffix) for n in self.features.datasets() if n.endswith(suffix)]

    def keypoints(self, name: str) -> tuple[Float64, float]:
        """Read the keypoints of an image and their standard deviation.

        Returns:
            (n, 2) float64 keypoints in COLMAP pixels before EXIF rotation, and their standard
            deviation in pixels.
        """
        values, attributes = self.features.read(f"{name}/keypoints")
        where = f"{self.features.path}, keypoints of {name!r}"
        if values.ndim != 2 or values.shape[1] != 2 or not _finite(values):
            raise InputError(
                f"{where}: keypoints must be finite and of shape (n, 2), not {values.shape}"
            )
        std = attributes.get("uncertainty", 1.0)
        if not isinstance(std, (int, float, np.number)) or not 0 < float(std) < np.inf:
            raise InputError(
                f"{where}: the keypoint uncertainty {std!r} is not a positive number of pixels"
            )
        return values.astype(np.float64) + _TO_COLMAP, float(std)

    def descriptors(self, name: str) -> tuple[Float32, Float32 | None]:
        """Read the descriptors (n, d) of an image, and the scores (n,) of its keypoints."""
        where = f"{self.features.path}, descriptors of {name!r}"
        values = self.features.read(f"{name}/descriptors")[0]
        if values.ndim != 2 or not _finite(values):
            raise InputError(
                f"{where}: the array must be finite and of shape (d, n), not {values.shape}"
            )
        if not self.features.has(f"{name}/scores"):
            return values.T.astype(np.float32), None
        scores = self.features.read(f"{name}/scores")[0].ravel()
        if scores.shape != (values.shape[1],) or not _finite(scores):
            raise InputError(f"{where}: scores must be finite and as many as descriptors")
        return np.ascontiguousarray(values.T, np.float32), scores.astype(np.float32)

    def size(self, name: str) -> tuple[int, int] | None:
        """Return (width, height) of an image before EXIF rotation, None if the file has no size."""
        if not self.features.has(f"{name}/image_size"):
            return None
        values = self.features.read(f"{name}/image_size")[0].ravel()
        if values.shape != (2,) or not _finite(values):
            raise InputError(
                f"{self.features.path}, {name!r}: the dataset image_size is not (width, height)"
            )
        return int(values[0]), int(values[1])

    def pairs(self, names: list[str]) -> Iterator[tuple[str, str, Int64, Float32]]:
        """Yield image names, keypoint indices (m, 2) and scores (m,) in [0, 1] of each pair."""
        assert self.matches is not None
        written = {name.replace("/", "-"): name for name in names}
        suffix = "/matches0"
        for dataset in self.matches.datasets():
            pair = dataset.removesuffix(suffix)
            if pair == dataset:
                continue
            images = _split_pair_name(pair, written)
            if images is None:
                continue
            indices, scores = self._matches(pair)
            yield (*images, indices, scores)

    def _matches(self, pair: str) -> tuple[Int64, Float32]:
        assert self.matches is not None
        where = f"{self.matches.path}, pair {pair!r}"
        target = self.matches.read(f"{pair}/matches0")[0]
        if target.ndim != 1 or not np.issubdtype(target.dtype, np.integer):
            raise InputError(f"{where}: the dataset matches0 must be a vector of keypoint indices")
        scores = np.ones(len(target), np.float32)
        if self.matches.has(f"{pair}/matching_scores0"):
            scores = self.matches.read(f"{pair}/matching_scores0")[0]
        if scores.shape != target.shape or not _finite(scores):
            raise InputError(f"{where}: matching_scores0 must be finite and as long as matches0")
        rows = np.flatnonzero(target >= 0)
        indices = np.stack([rows, target[rows]], axis=1).astype(np.int64)
        return indices, np.clip(scores[rows], 0, 1).astype(np.float32)


class _Hdf5:
    """HDF5 file that is open only during a read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._h5py: Any = importlib.import_module("h5py")
        except ImportError as error:
            raise InputError(
                f"{path}: reading HDF5 needs h5py: pip install 'mpsfm-core[hloc]'"
            ) from error
        if not path.is_file():
            raise InputError(f"HDF5 file {path} does not exist; check the path")

    def datasets(self) -> list[str]:
        """Return the full names of all datasets in the HDF5 file."""
        names: list[str] = []

        def visit(name: str, item: object) -> None:
            if isinstance(item, self._h5py.Dataset):
                names.append(name)

        with self._open() as file:
            self._guarded("the file", lambda: file.visititems(visit))
        return names

    def has(self, name: str) -> bool:
        """Return whether the HDF5 file has a dataset or group of this name."""
        with self._open() as file:
            return bool(self._guarded(name, lambda: name in file))

    def read(self, name: str) -> tuple[Any, dict[str, Any]]:
        """Read the values and attributes of an HDF5 dataset."""
        with self._open() as file:
            return (
                np.asarray(self._guarded(name, lambda: file[name][()])),
                dict(self._guarded(name, lambda: list(file[name].attrs.items()))),
            )

    def _open(self) -> Any:
        return self._guarded("the file", lambda: self._h5py.File(str(self.path), "r"))

    def _guarded(self, what: str, act: Any) -> Any:
        try:
            return act()
        except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
            raise InputError(f"{self.path}: {what} is damaged or not HDF5: {error}") from error


def _split_pair_name(pair: str, written: dict[str, str]) -> tuple[str, str] | None:
    """Split hloc's pair name ``A/B`` (``A_B`` in old files) into image names, None if unknown."""
    for cut, letter in enumerate(pair):
        if letter in "/_" and pair[:cut] in written and pair[cut + 1 :] in written:
            return written[pair[:cut]], written[pair[cut + 1 :]]
    return None


def _finite(values: Any) -> bool:
    return bool(np.issubdtype(values.dtype, np.number) and np.isfinite(values).all())
