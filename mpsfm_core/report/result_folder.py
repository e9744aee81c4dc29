"""A finished result folder, read back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap

from mpsfm_core.data import Bool, Float32, Float64, Int64, PinholeCamera, UInt8
from mpsfm_core.data.errors import InputError
from mpsfm_core.data.result_layout import DENSE, DEPTH, SUMMARY, VIEWS
from mpsfm_core.inputs.models import read_model
from mpsfm_core.results.depth_maps import load_depth_map
from mpsfm_core.results.ply import read_ply
from mpsfm_core.results.summary import read_summary
from mpsfm_core.results.views import MATCHES
from mpsfm_core.support.npz import read_npz

_UNREADABLE = (ValueError, KeyError, TypeError, IndexError)


@dataclass(frozen=True, eq=False)
class RefinedMap:
    """Refined depth of a registered image.

    ``depth``, ``relative_std``: (h, w) float32, z in units of the model and the std in shares of
    it. ``valid``: (h, w) bool. ``rotation`` (3, 3), ``translation`` (3,): ``cam_from_world``.
    """

    depth: Float32
    relative_std: Float32
    valid: Bool
    camera: PinholeCamera
    rotation: Float64
    translation: Float64


@dataclass(frozen=True, eq=False)
class PriorMaps:
    """What the mapper was given for an image.

    ``depth``, ``relative_std``: (h, w) float32, the prior in its own units and its std in shares
    of it. ``normals``: (h, w, 3) float32. ``valid``: (h, w) bool. ``camera``: of the whole view.
    """

    depth: Float32
    relative_std: Float32
    normals: Float32
    valid: Bool
    camera: PinholeCamera


@dataclass(frozen=True, eq=False)
class PairMatches:
    """Some of the verified matches of two images: (m, 2) float32 each, pixels of the views."""

    image_a: str
    image_b: str
    points_a: Float32
    points_b: Float32


@dataclass(frozen=True, eq=False)
class ResultFolder:
    """What a run left in a folder; arrays are read when asked for.

    ``summary``: of ``summary.json``.
    """

    path: Path
    summary: Mapping[str, Any] = field(repr=False)

    @classmethod
    def open(cls, path: Path) -> ResultFolder:
        """Raises :class:`InputError` when there is no summary that can be read."""
        summary = read_summary(path / SUMMARY)
        wanted = {"images", "pairs", "reconstructions", "stages", "providers"}
        if not wanted <= summary.keys():
            raise InputError(f"{path / SUMMARY}: is not the summary of a run")
        return cls(path, summary)

    @property
    def failed(self) -> bool:
        """Whether nothing was reconstructed; what else lies in the folder is an earlier run's."""
        return bool(self.summary["status"] != "success")

    @property
    def names(self) -> list[str]:
        """Of all images of the run."""
        return list(self.summary["images"]["details"])

    @cached_property
    def model(self) -> pycolmap.Reconstruction:
        """Of the original photos; empty after a failed run."""
        if self.failed:
            return pycolmap.Reconstruction()
        return read_model(self.path / "sparse")

    def dense_cloud(self) -> tuple[Float64, UInt8]:
        """World points (n, 3) and RGB colours (n, 3) of ``dense.ply``, empty if it is not there."""
        file = self.path / DENSE
        if self.failed or not file.is_file():
            return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
        return read_ply(file)

    def refined(self, name: str) -> RefinedMap | None:
        """Refined depth of an image, None if it was not written."""
        file = self.path / DEPTH / f"{name}.npz"
        if self.failed or not file.is_file():
            return None
        data = load_depth_map(file)
        try:
            depth, valid = data["depth"], data["valid"]
            height, width = depth.shape
            std = np.sqrt(data["variance"]) / np.where(valid, depth, 1)
            pose = data["cam_from_world"]
            camera = PinholeCamera(width, height, *map(float, data["camera"]))
            return RefinedMap(depth, std, valid, camera, pose[:, :3], pose[:, 3])
        except _UNREADABLE as error:
            raise InputError(f"{file}: is damaged: {error}") from error

    def prior(self, name: str) -> PriorMaps | None:
        """Priors of an image, None if they were not written."""
        file = self.path / VIEWS / f"{name}.npz"
        if not file.is_file():
            return None
        data = _load(file)
        try:
            width, height, *params = data["camera"].tolist()
            return PriorMaps(
                data["depth"],
                data["relative_std"].astype(np.float32),
                data["normals"].astype(np.float32),
                data["valid"],
                PinholeCamera(int(width), int(height), *params),
            )
        except _UNREADABLE as error:
            raise InputError(f"{file}: is damaged: {error}") from error

    def picture(self, name: str) -> UInt8 | None:
        """The small undistorted view, (h, w, 3) BGR, None if it was not written."""
        file = self.path / VIEWS / f"{name}.webp"
        if not file.is_file():
            return None
        picture = cv2.imdecode(np.frombuffer(file.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
        if picture is None:
            raise InputError(f"{file}: is damaged")
        return np.asarray(picture, np.uint8)

    def lines(self) -> list[PairMatches]:
        """Verified matches, none if they were not written."""
        file = self.path / VIEWS / MATCHES
        if not file.is_file():
            return []
        data = _load(file)
        try:
            starts: Int64 = data["starts"]
            return [
                PairMatches(
                    str(data["names"][a]),
                    str(data["names"][b]),
                    data["points_a"][starts[row] : starts[row + 1]],
                    data["points_b"][starts[row] : starts[row + 1]],
                )
                for row, (a, b) in enumerate(data["pairs"])
            ]
        except _UNREADABLE as error:
            raise InputError(f"{file}: is damaged: {error}") from error


def _load(file: Path) -> dict[str, Any]:
    try:
        return read_npz(file)
    except (OSError, ValueError) as error:
        raise InputError(f"{file}: is damaged: {error}") from error
