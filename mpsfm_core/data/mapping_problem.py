"""The input of the mapper, and the scene state that viewers see."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from mpsfm_core.data.arrays import (
    Float32,
    Float64,
    Int64,
    Pose,
    require_array,
    require_unit_interval,
)
from mpsfm_core.data.cameras import PinholeCamera
from mpsfm_core.data.errors import DataError
from mpsfm_core.data.priors import DepthPrior, NormalPrior


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
        require_array(self, "keypoints", np.float64, (None, 2))
        if self.keypoint_std_factor is not None:
            require_array(self, "keypoint_std_factor", np.float64, (len(self.keypoints),))
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
        require_array(self, "matches", np.int64, (None, 2))
        require_array(self, "scores", np.float32, (len(self.matches),))
        require_unit_interval(self.scores, "scores")
        require_array(self, "rotation", np.float64, (3, 3))
        require_array(self, "translation", np.float64, (3,))

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
