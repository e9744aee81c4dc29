"""Correct providers of every kind without weights, for the tests of the contract kit.

Some tests derive faulty providers from these classes. Depth, normals and masks are decoded from
painted views, as a tiny test network would do.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any

import numpy as np

from mpsfm_core.data import (
    Bool,
    DenseMatches,
    DepthPrior,
    Features,
    Float32,
    Float64,
    MultiViewPrior,
    NormalPrior,
    PairDepth,
    PairMatches,
    PinholeCamera,
    View,
)
from mpsfm_core.data.options import Options
from mpsfm_core.geometry import pixel_centers, resize_map
from mpsfm_core.providers import ProviderContext
from mpsfm_core.support.npz import read_npz
from mpsfm_core.testing.examples import Example, indoor_example
from mpsfm_core.testing.painted_views import NORMALS_STD, RELATIVE_STD, read_depth, read_normals

_THUMBNAIL = 8
_GRID_PX = 12


class PaintedDepth:
    """Depth provider with variance on the grid of the view, and with joint normals."""

    def __init__(self, options: Any, context: ProviderContext) -> None:
        self.options = options

    def predict(self, view: View) -> DepthPrior:
        """Return the depth that is painted into the view."""
        return depth_prior(read_depth(view.image))

    def predict_joint(self, view: View) -> tuple[DepthPrior, NormalPrior]:
        """Return the depth and normals that are painted into the view."""
        return self.predict(view), normal_prior(read_normals(view.image), view)

    def estimate_focal(self, view: View) -> float:
        """Return the focal length of the painted views, independent of the camera of the view."""
        return 0.75 * max(view.camera.size)


class PaintedNormals:
    """Normals provider with variance on the grid of the view."""

    def __init__(self, options: Any, context: ProviderContext) -> None:
        self.options = options

    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        """Return the normals that are painted into the view."""
        return normal_prior(read_normals(view.image), view)


class PaintedMask:
    """Mask provider that accepts pixels with a surface."""

    def __init__(self, options: Any, context: ProviderContext) -> None:
        self.options = options

    def mask(self, view: View) -> Bool:
        """Return the mask of the pixels into which a depth is painted."""
        return np.asarray(read_depth(view.image) > 0)


class Thumbnail:
    """Retrieval provider that describes a view by a thumbnail without its mean, of unit length."""

    def __init__(self, options: Any, context: ProviderContext) -> None:
        self.options = options

    def describe(self, view: View) -> Float32:
        """Return the thumbnail as a vector, or the zero vector for a view without content."""
        small = resize_map(view.image, _THUMBNAIL, _THUMBNAIL).ravel()
        small = small - small.mean()
        vector: Float32 = small / max(float(np.linalg.norm(small)), 1.0)
        return vector


class ToldOptions(Options):
    """Options with the folder of the prepared ground truth."""

    folder: Path
    """Folder to which :func:`tell` writes the ground truth."""


def tell(folder: Path, example: Example) -> None:
    """Write the ground truth of an indoor view for :class:`ToldMatcher`."""
    name = _name(example.view)
    np.savez(folder / name, pose=example.pose, camera=astuple(example.camera))


class ToldMatcher:
    """Dense matcher with depth of both views, which reads the prepared ground truth of indoor
    views."""

    def __init__(self, options: ToldOptions, context: ProviderContext) -> None:
        self.options = options

    def match(
        self,
        view_a: View,
        view_b: View,
        features_a: Features | None = None,
        features_b: Features | None = None,
    ) -> PairMatches:
        """Return exact matches of a grid of pixels, or no match for views without prepared
        truth."""
        a, b = self.recall(view_a), self.recall(view_b)
        if a is None or b is None:
            nothing = DenseMatches(np.empty((0, 2)), np.empty((0, 2)), np.empty(0, np.float32))
            return PairMatches(dense=nothing, depth=PairDepth(_unknown(), _unknown()))
        points = pixel_centers(*a.camera.size)[::_GRID_PX, ::_GRID_PX].reshape(-1, 2)
        found = a.correspondences(b, points)
        points, true = points[found.visible], found.xy_b[found.visible]
        return PairMatches(dense=self.matches(points, true), depth=self.depths(a, b))

    def recall(self, view: View) -> Example | None:
        """Return the synthetic view with prepared truth, or None."""
        path = self.options.folder / f"{_name(view)}.npz"
        if not path.exists():
            return None
        stored = read_npz(path)
        width, height, *intrinsics = stored["camera"].tolist()
        camera = PinholeCamera(int(width), int(height), *intrinsics)
        return replace(indoor_example("textured"), pose=stored["pose"], camera=camera)

    def matches(self, points_a: Float64, points_b: Float64) -> DenseMatches:
        """Return matches between exact positions."""
        return DenseMatches(points_a, points_b, np.ones(len(points_a), np.float32))

    def depths(self, a: Example, b: Example) -> PairDepth:
        """Return the depth of both views."""
        return PairDepth(*(depth_prior(example.truth().depth) for example in (a, b)))


def tell_group(folder: Path, example: Example) -> None:
    """Write the ground truth of a synthetic view for :class:`ToldGroup`."""
    truth = example.truth()
    np.savez(
        folder / f"group-{_name(example.view)}.npz",
        depth=truth.depth,
        pose=example.pose,
        intrinsics=example.camera.params,
    )


class ToldGroup:
    """Multi-view provider that reads prepared depth, poses and intrinsics."""

    def __init__(self, options: ToldOptions, context: ProviderContext) -> None:
        self.options = options

    def predict_group(self, views: Sequence[View]) -> MultiViewPrior:
        """Return the ground truth, or a plane one meter in front of the origin without prepared
        truth."""
        depth, poses, intrinsics = zip(*(self.recall(view) for view in views), strict=True)
        return MultiViewPrior(
            tuple(depth_prior(values) for values in depth), np.array(poses), np.array(intrinsics)
        )

    def recall(self, view: View) -> tuple[Float64, Float64, Float64]:
        """Return depth (H, W), pose (3, 4) and intrinsics (4,) of a view."""
        path = self.options.folder / f"group-{_name(view)}.npz"
        if not path.exists():
            return np.ones(view.image.shape[:2]), np.eye(3, 4), view.camera.params
        stored = read_npz(path)
        return stored["depth"], stored["pose"], stored["intrinsics"]


class Wrapper:
    """Wrapper that returns the output of the wrapped provider unchanged."""

    def __init__(self, inner: Any, options: Any, context: ProviderContext) -> None:
        self.inner = inner

    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        """Return the output of the wrapped provider."""
        return self.inner.predict(view) if depth is None else self.inner.predict(view, depth)


def depth_prior(depth: Float64) -> DepthPrior:
    """Metric depth provider with the std that the contract kit expects of test networks."""
    return DepthPrior.from_arrays(depth, (RELATIVE_STD * depth) ** 2)


def normal_prior(normals: Float64, view: View) -> NormalPrior:
    """Normals provider with the std that the contract kit expects of test networks."""
    variance = np.full(normals.shape[:2], NORMALS_STD**2)
    return NormalPrior.from_arrays(normals, variance, camera=view.camera)


def _name(view: View) -> str:
    return hashlib.sha256(view.image.tobytes() + str(view.image.shape).encode()).hexdigest()


def _unknown() -> DepthPrior:
    return DepthPrior.from_arrays(np.zeros((1, 1)), np.zeros((1, 1)))
