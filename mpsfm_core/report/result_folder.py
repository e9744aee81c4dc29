"""Read summary, model, depth maps, priors and matches of a finished result folder."""

from __future__ import annotations

import logging
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
from mpsfm_core.data.result_layout import DENSE, DEPTH, MESH_OBJ, MESH_PLY, SUMMARY, VIEWS
from mpsfm_core.dense.texture import TexturedMesh
from mpsfm_core.inputs.models import read_model
from mpsfm_core.results.depth_maps import load_depth_map
from mpsfm_core.results.held_out import evaluate_held_out
from mpsfm_core.results.obj import read_obj
from mpsfm_core.results.ply import read_ply
from mpsfm_core.results.summary import read_summary
from mpsfm_core.results.trajectory import find_trajectories, read_trajectory_rows
from mpsfm_core.results.views import MATCHES
from mpsfm_core.support.npz import read_npz

_log = logging.getLogger(__name__)
_UNREADABLE = (ValueError, KeyError, TypeError, IndexError)


@dataclass(frozen=True, eq=False)
class RefinedMap:
    """Refined depth of a registered image."""

    depth: Float32
    """(h, w) float32 z-depth in units of the COLMAP model."""
    relative_std: Float32
    """(h, w) float32 standard deviation of the depth divided by the depth."""
    valid: Bool
    """(h, w) bool mask of valid depth."""
    camera: PinholeCamera
    """Pinhole camera of the grid of the depth map."""
    rotation: Float64
    """(3, 3) rotation ``cam_from_world`` of the image."""
    translation: Float64
    """(3,) translation ``cam_from_world`` of the image."""


@dataclass(frozen=True, eq=False)
class PriorMaps:
    """Depth prior and normal prior of an image."""

    depth: Float32
    """(h, w) float32 z-depth in units of the depth provider."""
    relative_std: Float32
    """(h, w) float32 standard deviation of the depth divided by the depth."""
    normals: Float32
    """(h, w, 3) float32 unit normals in the camera frame."""
    valid: Bool
    """(h, w) bool mask of valid depth."""
    camera: PinholeCamera
    """Camera of the undistorted image at full resolution, not of the grid of the prior."""


@dataclass(frozen=True, eq=False)
class MatchLines:
    """Random subset of the verified matches of two images, in pixels of the undistorted images."""

    image_a: str
    image_b: str
    points_a: Float32
    """(m, 2) float32 keypoints in image a."""
    points_b: Float32
    """(m, 2) float32 keypoints in image b, in the order of the keypoints in image a."""


@dataclass(frozen=True, eq=False)
class ResultFolder:
    """Results of a run, whose arrays are read on demand."""

    path: Path
    """Result folder."""
    summary: Mapping[str, Any] = field(repr=False)
    """Content of ``summary.json``."""

    @classmethod
    def open(cls, path: Path) -> ResultFolder:
        """Open a result folder; raise :class:`InputError` for a missing or damaged summary."""
        summary = read_summary(path / SUMMARY)
        required = {"images", "pairs", "reconstructions", "stages", "providers"}
        if not required <= summary.keys():
            raise InputError(f"{path / SUMMARY} is not the summary of a run")
        return cls(path, summary)

    @property
    def failed(self) -> bool:
        """True if the run failed, so that models in the folder are from an earlier run."""
        return bool(self.summary["status"] != "success")

    @property
    def names(self) -> list[str]:
        """Names of all images of the run."""
        return list(self.summary["images"]["details"])

    @cached_property
    def model(self) -> pycolmap.Reconstruction:
        """COLMAP model of the original images, empty after a failed run."""
        if self.failed:
            return pycolmap.Reconstruction()
        return read_model(self.path / "sparse")

    def trajectories(self) -> dict[str, Float64]:
        """Read the poses of all frames of each video, see :func:`read_trajectory_rows`."""
        found = {} if self.failed else find_trajectories(self.path)
        return {name: read_trajectory_rows(path) for name, path in found.items()}

    def dense_cloud(self) -> tuple[Float64, UInt8]:
        """Read points (n, 3) and RGB colors (n, 3) of ``dense.ply``, empty without this file."""
        file = self.path / DENSE
        if self.failed or not file.is_file():
            return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
        return read_ply(file)

    def textured_mesh(self) -> TexturedMesh | None:
        """Read ``mesh.obj``, None without this file."""
        file = self.path / MESH_OBJ
        return None if self.failed or not file.is_file() else read_obj(file)

    def held_out_renderings(self) -> dict[str, dict[str, Any]]:
        """Compare renderings of the best geometry with the held-out photos.

        Returns:
            Name of the rendered file (``geometry``), ratio of covered pixels (``covered``),
            ``psnr`` in dB and ``ssim`` by image name; empty without held-out photos, photo files or
            geometry.
        """
        names = self.summary["images"].get("held_out")
        files = [name for name in (MESH_OBJ, MESH_PLY, DENSE) if (self.path / name).is_file()]
        if self.failed or not names or not files:
            return {}
        best = files[0]
        try:
            report = evaluate_held_out(self.path, names=names, geometry=self.path / best)
        except InputError as error:
            _log.info("%s", error)
            return {}
        metrics = ("covered", "psnr", "ssim")
        return {
            name: {"geometry": best, **{metric: image[metric] for metric in metrics}}
            for name, image in report["geometries"][best]["per_image"].items()
        }

    def refined(self, name: str) -> RefinedMap | None:
        """Read the refined depth of an image, None if the run wrote no depth map."""
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
            raise InputError(f"depth map file {file} is damaged: {error}") from error

    def prior(self, name: str) -> PriorMaps | None:
        """Read the priors of an image, None if the run wrote no priors."""
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
            raise InputError(f"prior file {file} is damaged: {error}") from error

    def picture(self, name: str) -> UInt8 | None:
        """Read the downscaled undistorted image, (h, w, 3) BGR, None if the run wrote no image."""
        file = self.path / VIEWS / f"{name}.webp"
        if not file.is_file():
            return None
        picture = cv2.imdecode(np.frombuffer(file.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
        if picture is None:
            raise InputError(f"image {file} is damaged")
        return np.asarray(picture, np.uint8)

    def matches(self) -> list[MatchLines]:
        """Read the sampled verified matches of all image pairs, empty if not written."""
        file = self.path / VIEWS / MATCHES
        if not file.is_file():
            return []
        data = _load(file)
        try:
            starts: Int64 = data["starts"]
            return [
                MatchLines(
                    str(data["names"][a]),
                    str(data["names"][b]),
                    data["points_a"][starts[row] : starts[row + 1]],
                    data["points_b"][starts[row] : starts[row + 1]],
                )
                for row, (a, b) in enumerate(data["pairs"])
            ]
        except _UNREADABLE as error:
            raise InputError(f"match file {file} is damaged: {error}") from error


def _load(file: Path) -> dict[str, Any]:
    try:
        return read_npz(file)
    except (OSError, ValueError) as error:
        raise InputError(f"result file {file} is damaged: {error}") from error
