"""What crosses a boundary: frozen, validated containers of numpy arrays.

Everything a provider receives or returns, and everything the mapper is given, is one of these.
Constructors check shape, dtype and range and raise :class:`~mpsfm_core.errors.DataError`; arrays
are stored as read-only views, so nobody can change what somebody else holds.

Conventions: camera x right, y down, z forward; depth is z; normals are unit, in the camera frame,
and face the camera (``n . ray < 0`` for the ray through their pixel); pixels are COLMAP's (centre
of the first pixel is (0.5, 0.5)); uncertainty is a variance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.errors import DataError

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
UInt8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]
Pose = tuple[Float64, Float64]
"""Rotation (3, 3) and translation (3,) float64: ``y = R x + t``; of an image ``cam_from_world``."""

UNIT_NORMAL_TOLERANCE = 1e-3
"""Allowed deviation of a normal's length from 1 (float16 storage keeps about 5e-4)."""


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics of an undistorted view: size in pixels, focal lengths and principal point.

    ``cx, cy`` are in COLMAP pixels: the image centre of a W x H view is ``(W / 2, H / 2)``.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise DataError("camera", f"size must be positive, got {self.width}x{self.height}")
        if not (np.isfinite([self.fx, self.fy, self.cx, self.cy]).all() and self.fx > 0):
            raise DataError("camera", "intrinsics must be finite and focal lengths positive")
        if self.fy <= 0:
            raise DataError("camera", "focal lengths must be positive")

    @property
    def matrix(self) -> Float64:
        """The 3 x 3 calibration matrix K, float64."""
        return np.array(
            [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]], dtype=np.float64
        )

    @property
    def params(self) -> Float64:
        """``(fx, fy, cx, cy)``, float64 (4,)."""
        return np.array([self.fx, self.fy, self.cx, self.cy], dtype=np.float64)

    @property
    def size(self) -> tuple[int, int]:
        """``(width, height)`` in pixels."""
        return self.width, self.height

    def resized(self, width: int, height: int) -> PinholeCamera:
        """The same camera on a grid of another size (exact in the (0.5, 0.5) convention)."""
        sx, sy = width / self.width, height / self.height
        return PinholeCamera(width, height, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy)


@dataclass(frozen=True, eq=False)
class View:
    """One undistorted image as a provider sees it.

    ``name``: path of the original image below the images folder, with forward slashes.
    ``image``: (H, W, 3) uint8, RGB. ``mask``: (H, W) bool, True where the pixel may be used
    (False: outside of the undistorted area or masked by the user), or None for all True.
    """

    name: str
    image: UInt8
    camera: PinholeCamera
    mask: Bool | None = None

    def __post_init__(self) -> None:
        height, width = self.camera.height, self.camera.width
        _array(self, "image", np.uint8, (height, width, 3))
        if self.mask is not None:
            _array(self, "mask", np.bool_, (height, width))


@dataclass(frozen=True, eq=False)
class DepthPrior:
    """A depth map with its uncertainty on a grid of any size that covers the whole view.

    ``depth``: (h, w) float32, z along the optical axis, > 0 where valid; metres if ``metric``,
    else in an unknown unit. ``variance``: (h, w) float32 in depth units squared, > 0 where valid,
    or None when the network gives none (a calibration then declares it). ``valid``: (h, w) bool.
    Values at invalid pixels are finite and meaningless.
    """

    depth: Float32
    variance: Float32 | None
    valid: Bool
    metric: bool = True

    def __post_init__(self) -> None:
        _array(self, "depth", np.float32, (None, None))
        shape = self.depth.shape
        _array(self, "valid", np.bool_, shape)
        _finite(self, "depth")
        _positive_where_valid(self.depth, self.valid, "depth")
        if self.variance is not None:
            _array(self, "variance", np.float32, shape)
            _finite(self, "variance")
            _positive_where_valid(self.variance, self.valid, "variance")

    @classmethod
    def from_arrays(
        cls,
        depth: NDArray[Any],
        variance: NDArray[Any] | None = None,
        valid: NDArray[Any] | None = None,
        *,
        metric: bool = True,
    ) -> DepthPrior:
        """Build from raw arrays: pixels that are not finite and positive become invalid (0)."""
        depth = np.asarray(depth, dtype=np.float32)
        usable = np.isfinite(depth) & (depth > 0)
        if valid is not None:
            usable &= np.asarray(valid, dtype=np.bool_)
        if variance is not None:
            variance = np.asarray(variance, dtype=np.float32)
            usable &= np.isfinite(variance) & (variance > 0)
            variance = np.where(usable, variance, np.float32(0))
        return cls(np.where(usable, depth, np.float32(0)), variance, usable, metric)

    @property
    def shape(self) -> tuple[int, int]:
        """``(rows, columns)`` of the map's grid."""
        return self.depth.shape[0], self.depth.shape[1]


@dataclass(frozen=True, eq=False)
class NormalPrior:
    """A surface normal map with its uncertainty on a grid of any size that covers the view.

    ``normals``: (h, w, 3) float32, unit, camera frame, where valid. They face the camera: their
    dot product with the ray through the pixel is negative (off the axis ``n_z`` may be positive,
    as on a floor at the lower border). The constructor knows no camera, so the validator checks
    that. ``variance``: (h, w) float32, rad^2, the angular variance along each of the two tangent
    directions, > 0 where valid, or None when the network gives none. ``valid``: (h, w) bool.
    """

    normals: Float32
    variance: Float32 | None
    valid: Bool

    def __post_init__(self) -> None:
        _array(self, "normals", np.float32, (None, None, 3))
        shape = self.normals.shape[:2]
        _array(self, "valid", np.bool_, shape)
        _finite(self, "normals")
        length = np.linalg.norm(self.normals[self.valid], axis=-1)
        if length.size and np.abs(length - 1).max() > UNIT_NORMAL_TOLERANCE:
            raise DataError("normals", "must have unit length where valid")
        if self.variance is not None:
            _array(self, "variance", np.float32, shape)
            _finite(self, "variance")
            _positive_where_valid(self.variance, self.valid, "variance")

    @classmethod
    def from_arrays(
        cls,
        normals: NDArray[Any],
        variance: NDArray[Any] | None = None,
        valid: NDArray[Any] | None = None,
        *,
        camera: PinholeCamera | None = None,
    ) -> NormalPrior:
        """Build from raw arrays: normalises lengths; pixels that are not finite or have no length
        become invalid (0), and with the view's ``camera`` those that do not face it."""
        raw = np.asarray(normals, dtype=np.float32)
        finite = np.where(np.isfinite(raw).all(axis=-1, keepdims=True), raw, np.float32(0))
        length = np.linalg.norm(finite, axis=-1)
        usable = length > 1e-6
        if camera is not None:
            usable &= along_rays(camera, finite) < 0
        if valid is not None:
            usable &= np.asarray(valid, dtype=np.bool_)
        if variance is not None:
            variance = np.asarray(variance, dtype=np.float32)
            usable &= np.isfinite(variance) & (variance > 0)
            variance = np.where(usable, variance, np.float32(0))
        unit = finite / np.where(usable, length, np.float32(1))[..., None]
        return cls(np.where(usable[..., None], unit, np.float32(0)), variance, usable)

    @property
    def shape(self) -> tuple[int, int]:
        """``(rows, columns)`` of the map's grid."""
        return self.normals.shape[0], self.normals.shape[1]


@dataclass(frozen=True, eq=False)
class Features:
    """Sparse local features of one view.

    ``keypoints``: (n, 2) float64, COLMAP pixels of the view. ``descriptors``: (n, d) float32.
    ``scores``: (n,) float32 detection scores, higher is better, or None. ``scales``: (n,) float32
    keypoint scales in pixels, or None. ``std_px``: localisation noise of a keypoint in pixels.
    """

    keypoints: Float64
    descriptors: Float32
    scores: Float32 | None = None
    scales: Float32 | None = None
    std_px: float = 1.0

    def __post_init__(self) -> None:
        _array(self, "keypoints", np.float64, (None, 2))
        count = len(self.keypoints)
        _array(self, "descriptors", np.float32, (count, None))
        _finite(self, "keypoints")
        _finite(self, "descriptors")
        for name in ("scores", "scales"):
            if getattr(self, name) is not None:
                _array(self, name, np.float32, (count,))
                _finite(self, name)
        if not (np.isfinite(self.std_px) and self.std_px > 0):
            raise DataError("std_px", "must be positive")

    def __len__(self) -> int:
        return len(self.keypoints)


@dataclass(frozen=True, eq=False)
class SparseMatches:
    """Matches between the features of two views.

    ``indices``: (m, 2) int64, rows of the two feature sets, each used at most once.
    ``scores``: (m,) float32 in [0, 1], confidence of each match; mapping weighs matches by it.
    """

    indices: Int64
    scores: Float32

    def __post_init__(self) -> None:
        _array(self, "indices", np.int64, (None, 2))
        _array(self, "scores", np.float32, (len(self.indices),))
        _unit_interval(self.scores, "scores")
        if (self.indices < 0).any():
            raise DataError("indices", "must not be negative")
        for column in self.indices.T:
            if len(np.unique(column)) != len(column):
                raise DataError("indices", "must use each feature at most once")

    @classmethod
    def from_arrays(cls, indices: NDArray[Any], scores: NDArray[Any]) -> SparseMatches:
        """Build from raw arrays of any number type; scores are clipped to [0, 1]."""
        certain = np.clip(scores, 0, 1).astype(np.float32)
        return cls(indices.astype(np.int64), certain)

    @classmethod
    def best_first(cls, indices: NDArray[Any], scores: NDArray[Any]) -> SparseMatches:
        """As :meth:`from_arrays`; of several matches of one feature the most certain stays."""
        order = np.argsort(-scores, kind="stable")
        for column in (0, 1):
            order = order[np.sort(np.unique(indices[order, column], return_index=True)[1])]
        return cls.from_arrays(indices[order], scores[order])

    def __len__(self) -> int:
        return len(self.indices)


@dataclass(frozen=True, eq=False)
class DenseMatches:
    """Matches between free positions of two views (no detector involved).

    ``points_a``, ``points_b``: (m, 2) float64, COLMAP pixels of the two views. ``scores``: (m,)
    float32 in [0, 1]. ``std_px``: localisation noise of a match in pixels.
    """

    points_a: Float64
    points_b: Float64
    scores: Float32
    std_px: float = 1.0

    def __post_init__(self) -> None:
        _array(self, "points_a", np.float64, (None, 2))
        _array(self, "points_b", np.float64, (len(self.points_a), 2))
        _array(self, "scores", np.float32, (len(self.points_a),))
        _finite(self, "points_a")
        _finite(self, "points_b")
        _unit_interval(self.scores, "scores")

    def __len__(self) -> int:
        return len(self.points_a)


@dataclass(frozen=True, eq=False)
class PairDepth:
    """Depth of both views of a pair as a two-view network sees it (MASt3R-style)."""

    depth_a: DepthPrior
    depth_b: DepthPrior


@dataclass(frozen=True, eq=False)
class PairMatches:
    """What a matcher returns for two views: sparse or dense matches or both, maybe depth."""

    sparse: SparseMatches | None = None
    dense: DenseMatches | None = None
    depth: PairDepth | None = None

    def __post_init__(self) -> None:
        if self.sparse is None and self.dense is None:
            raise DataError("matches", "a matcher must return sparse or dense matches")


@dataclass(frozen=True, eq=False)
class GroupPrior:
    """What a multi-view network sees in a group of n views: all of it in one frame and one unit.

    ``depth``: one prior a view, in the order of the views. They share one unit: metres if
    ``metric``, else an unknown one. ``poses``: (n, 3, 4) float64, ``cam_from_group`` of each view
    for a frame of the group's own, lengths in the unit of depth; or None. ``intrinsics``: (n, 4)
    float64, fx, fy, cx, cy in COLMAP pixels of each view, or None. Both are proposals, which
    matches judge.
    """

    depth: tuple[DepthPrior, ...]
    poses: Float64 | None = None
    intrinsics: Float64 | None = None

    def __post_init__(self) -> None:
        count = len(self.depth)
        if len({prior.metric for prior in self.depth}) > 1:
            raise DataError("depth", "must be metric in all views of a group or in none")
        if self.poses is not None:
            _array(self, "poses", np.float64, (count, 3, 4))
            _finite(self, "poses")
            rotations = self.poses[:, :, :3]
            if not np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3), atol=1e-3):
                raise DataError("poses", "must be rotations and translations (n, 3, 4)")
            if (np.linalg.det(rotations) < 0).any():
                raise DataError("poses", "must not mirror")
        if self.intrinsics is not None:
            _array(self, "intrinsics", np.float64, (count, 4))
            _finite(self, "intrinsics")
            if (self.intrinsics[:, :2] <= 0).any():
                raise DataError("intrinsics", "must have positive focal lengths")


@dataclass(frozen=True, eq=False)
class MappingImage:
    """One image as the mapper sees it.

    ``keypoints``: (n, 2) float64, COLMAP pixels of the undistorted camera; dense matches add
    theirs behind the sparse ones. ``depth`` has a variance; ``depth`` and ``normals`` share one
    grid. ``keypoint_std_px``: localisation noise of keypoints as they were found, by which wrong
    matches are told from right ones. ``keypoint_std_factor``: (n,) float64, > 0, what adjustment
    left of it in each keypoint, None for all of it. ``focal_known``: False when the focal length is
    a guess that bundle adjustment may refine; images of equal camera then share it.
    ``known_pose``: ``cam_from_world``, when the user brought one. ``depth_group``: images of equal
    number have depth in one unit, so that they share one scale; None for a scale of its own.
    ``proposed_pose``: ``cam_from_group`` for a frame that the images of the group share, lengths in
    the unit of their depth.
    """

    name: str
    camera: PinholeCamera
    keypoints: Float64
    depth: DepthPrior
    normals: NormalPrior
    keypoint_std_px: float = 1.0
    keypoint_std_factor: Float64 | None = None
    focal_known: bool = True
    known_pose: Pose | None = None
    depth_group: int | None = None
    proposed_pose: Pose | None = None

    def __post_init__(self) -> None:
        _array(self, "keypoints", np.float64, (None, 2))
        if self.keypoint_std_factor is not None:
            _array(self, "keypoint_std_factor", np.float64, (len(self.keypoints),))
            if not (self.keypoint_std_factor > 0).all():
                raise DataError("keypoint_std_factor", "must be positive")
        if self.depth.variance is None:
            raise DataError("depth", "the mapper needs a variance (calibrate the prior)")
        if self.normals.variance is None:
            raise DataError("normals", "the mapper needs a variance (calibrate the prior)")
        if self.depth.shape != self.normals.shape:
            raise DataError("normals", "must be on the grid of the depth map")


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image that has a place, as viewers see it.

    ``rotation`` (3, 3), ``translation`` (3,) float64: ``cam_from_world``. ``depth``: in world
    units on a grid of any size that covers the view, None where there is none.
    """

    name: str
    camera: PinholeCamera
    rotation: Float64
    translation: Float64
    depth: DepthPrior | None = None


@dataclass(frozen=True, eq=False)
class SceneState:
    """What is reconstructed so far. ``points``: (p, 3) float64, world units."""

    images: tuple[PosedImage, ...]
    points: Float64


@dataclass(frozen=True, eq=False)
class VerifiedPair:
    """Geometrically verified matches of two images.

    ``image_a < image_b``: positions in :attr:`MappingProblem.images`. ``matches``: (m, 2) int64
    keypoint rows, all inliers. ``scores``: (m,) float32 in [0, 1]. ``rotation`` (3, 3) and
    ``translation`` (3,) float64: ``cam_b_from_cam_a`` up to the translation's length, from the
    essential matrix or homography. ``calibrated``: the pair's configuration has parallax and
    known intrinsics (COLMAP's CALIBRATED), else planar, panoramic or uncalibrated.
    """

    image_a: int
    image_b: int
    matches: Int64
    scores: Float32
    rotation: Float64
    translation: Float64
    calibrated: bool = True

    def __post_init__(self) -> None:
        if not 0 <= self.image_a < self.image_b:
            raise DataError("image_a", "must be smaller than image_b")
        _array(self, "matches", np.int64, (None, 2))
        _array(self, "scores", np.float32, (len(self.matches),))
        _unit_interval(self.scores, "scores")
        _array(self, "rotation", np.float64, (3, 3))
        _array(self, "translation", np.float64, (3,))

    def __len__(self) -> int:
        return len(self.matches)


@dataclass(frozen=True, eq=False)
class MappingProblem:
    """Everything the mapper needs: images with priors, and verified pairs between them."""

    images: tuple[MappingImage, ...]
    pairs: tuple[VerifiedPair, ...] = field(default=())

    def __post_init__(self) -> None:
        for pair in self.pairs:
            if pair.image_b >= len(self.images):
                raise DataError("pairs", f"image {pair.image_b} does not exist")
            for image, column in ((pair.image_a, 0), (pair.image_b, 1)):
                rows = pair.matches[:, column]
                if len(rows) and not 0 <= rows.min() <= rows.max() < self.num_keypoints(image):
                    raise DataError("pairs", f"matches exceed the keypoints of image {image}")

    def num_keypoints(self, image: int) -> int:
        """Number of keypoints of an image."""
        return len(self.images[image].keypoints)

    def subset(self, names: list[str]) -> MappingProblem:
        """The problem restricted to the named images, in the order they have here."""
        keep = [i for i, image in enumerate(self.images) if image.name in set(names)]
        position = {old: new for new, old in enumerate(keep)}
        pairs = tuple(
            replace(pair, image_a=position[pair.image_a], image_b=position[pair.image_b])
            for pair in self.pairs
            if pair.image_a in position and pair.image_b in position
        )
        return MappingProblem(tuple(self.images[i] for i in keep), pairs)

    def with_poses(self, poses: Mapping[str, Pose]) -> MappingProblem:
        """The problem with these poses, by name, as known; other images have none."""
        images = (replace(image, known_pose=poses.get(image.name)) for image in self.images)
        return replace(self, images=tuple(images))


def along_rays(camera: PinholeCamera, normals: NDArray[Any]) -> Float64:
    """Dot products (h, w) of a map of vectors (h, w, 3) that covers the camera's view, on a grid
    of any size, with the unit rays through its pixels: negative where a normal faces the camera."""
    height, width = normals.shape[:2]
    grid = camera.resized(width, height)
    x = (np.arange(width) + 0.5 - grid.cx) / grid.fx
    y = ((np.arange(height) + 0.5 - grid.cy) / grid.fy)[:, None]
    along: Float64 = normals[..., 0] * x + normals[..., 1] * y + normals[..., 2]
    return along / np.sqrt(1 + x**2 + y**2)


def _array(owner: object, name: str, dtype: Any, shape: tuple[int | None, ...]) -> None:
    value = getattr(owner, name)
    if not isinstance(value, np.ndarray):
        raise DataError(name, f"must be a numpy array, got {type(value).__name__}")
    if value.dtype != np.dtype(dtype):
        raise DataError(name, f"must have dtype {np.dtype(dtype)}, got {value.dtype}")
    matches = value.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, value.shape, strict=False)
    )
    if not matches:
        wanted = "(" + ", ".join("any" if s is None else str(s) for s in shape) + ")"
        raise DataError(name, f"must have shape {wanted}, got {value.shape}")
    view = value.view()
    view.flags.writeable = False
    object.__setattr__(owner, name, view)


def _finite(owner: object, name: str) -> None:
    if not np.isfinite(getattr(owner, name)).all():
        raise DataError(name, "must be finite")


def _positive_where_valid(values: Float32, valid: Bool, name: str) -> None:
    if ((values <= 0) & valid).any():
        raise DataError(name, "must be positive where valid")


def _unit_interval(values: Float32, name: str) -> None:
    if values.size and not (values.min() >= 0 and values.max() <= 1):
        raise DataError(name, "must lie in [0, 1]")
