"""Input of the incremental mapper, and intermediate reconstructions for live viewers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from mpsfm_core.data.camera_models import NO_DISTORTION, CameraModel, Distortion
from mpsfm_core.data.cameras import PinholeCamera
from mpsfm_core.data.errors import DataError
from mpsfm_core.data.priors import DepthPrior, NormalPrior
from mpsfm_core.data.rigs import Rig, find_frames


@dataclass(frozen=True, eq=False)
class MappingImage:
    """Image with keypoints, depth prior and normal prior, as input of the mapper."""

    name: str
    """Path of the image below the images folder, with forward slashes."""
    camera: PinholeCamera
    """Intrinsics of the undistorted view."""
    keypoints: Float64
    """(n, 2) float64 keypoints in COLMAP pixels of the undistorted view. Sparse keypoints come
    first, then dense keypoints."""
    depth: DepthPrior
    """Depth prior with variance, at the resolution of the normal prior."""
    normals: NormalPrior
    """Normal prior with variance, at the resolution of the depth prior."""
    keypoint_std_px: float = 1.0
    """Std of the keypoint detector's localization noise in pixels, which scales inlier
    thresholds."""
    keypoint_std_factor: Float64 | None = None
    """(n,) float64 > 0, std of each adjusted keypoint relative to ``keypoint_std_px`` (None: 1)."""
    focal_known: bool = True
    """False if the focal length is a guess for bundle adjustment to refine."""
    camera_id: int = 0
    """Number of the physical camera that took the image. Images with equal camera number and equal
    intrinsics share a guessed focal length."""
    focal_log_std: float = 0.7
    """Prior std of the logarithm of a guessed focal length."""
    focal_guess_px: float | None = None
    """Prior mean of ``fx`` in pixels of the undistorted view (None means ``camera.fx``)."""
    depth_focal_px: float | None = None
    """Focal length ``fx`` in pixels with which a network predicted metric depth. The depth is
    proportional to this focal length. None if depth does not depend on the focal length."""
    camera_model: CameraModel = CameraModel.SIMPLE_RADIAL
    """COLMAP camera model whose parameters self-calibration estimates for a guessed camera."""
    distortion: Distortion = NO_DISTORTION
    """Distortion coefficients k1, k2, p1, p2 of OPENCV, or k1, k2, k3, k4 of OPENCV_FISHEYE, that
    were removed from the undistorted view.

    Bundle adjustment refines the distortion together with a guessed focal length."""
    initial_distortion: Distortion | None = None
    """Distortion coefficients of a guessed camera with which the mapper starts (None means
    :attr:`distortion`). The keypoints are not undistorted with them."""
    known_pose: Pose | None = None
    """Known camera pose ``cam_from_world`` that the user provides, or None."""
    depth_group: int | None = None
    """Group number of the image; images of a group share one unknown depth scale. Without group
    number (None), the depth map of the image has its own scale."""
    proposed_pose: Pose | None = None
    """Pose ``cam_from_group`` that a multi-view network predicts, in the unit of its depth maps."""
    duplicate_of: str | None = None
    """Name of an earlier image with the same view (a copy, an exposure bracket or a frame of a
    camera at rest), which has the same keypoints, or None."""

    def __post_init__(self) -> None:
        require_array(self, "keypoints", np.float64, (None, 2))
        if self.keypoint_std_factor is not None:
            require_array(self, "keypoint_std_factor", np.float64, (len(self.keypoints),))
            if not (self.keypoint_std_factor > 0).all():
                raise DataError("keypoint_std_factor", "must be positive")
        if not self.focal_log_std > 0:
            raise DataError("focal_log_std", "must be positive")
        if self.depth.variance is None:
            raise DataError("depth", "depth prior has no variance; calibrate the prior")
        if self.normals.variance is None:
            raise DataError("normals", "normal prior has no variance; calibrate the prior")
        if self.depth.shape != self.normals.shape:
            raise DataError("normals", "normal map must have the size of the depth map")

    @property
    def shared_camera(self) -> tuple[int, PinholeCamera]:
        """Camera number and intrinsics, which are equal for images that share a focal length."""
        return self.camera_id, self.camera

    def with_camera(self, camera: PinholeCamera) -> MappingImage:
        """Return a copy of the image with another focal length and the same focal length prior.

        The distortion that was removed from the view stays the same in pixels, so its coefficients
        are multiplied by powers of the ratio of new to old focal length. A fisheye image keeps its
        camera, because its view depends on the focal length.
        """
        if self.camera_model.is_fisheye:
            return self
        ratio = camera.fx / self.camera.fx
        initial = self.initial_distortion
        return replace(
            self,
            camera=camera,
            focal_guess_px=self.focal_prior_px,
            distortion=_scale_distortion(self.distortion, ratio),
            initial_distortion=initial and _scale_distortion(initial, ratio),
        )

    @property
    def focal_prior_px(self) -> float:
        """Prior mean of ``fx`` in pixels of the undistorted view."""
        return self.camera.fx if self.focal_guess_px is None else self.focal_guess_px


def _scale_distortion(distortion: Distortion, ratio: float) -> Distortion:
    """Return the OPENCV coefficients of the same distortion in pixels at another focal length.

    Args:
        distortion: Coefficients k1, k2, p1, p2.
        ratio: Ratio of new to old focal length.
    """
    k1, k2, p1, p2 = distortion
    return k1 * ratio**2, k2 * ratio**4, p1 * ratio, p2 * ratio


@dataclass(frozen=True, eq=False)
class PosedImage:
    """Registered image with pose and depth map, for live viewers."""

    name: str
    """Path of the image below the images folder, with forward slashes."""
    camera: PinholeCamera
    """Intrinsics of the undistorted view."""
    rotation: Float64
    """(3, 3) float64 rotation of ``cam_from_world``."""
    translation: Float64
    """(3,) float64 translation of ``cam_from_world``, world units."""
    depth: DepthPrior | None = None
    """Depth map in world units at any resolution of the whole view (None without depth)."""


@dataclass(frozen=True, eq=False)
class SceneState:
    """Intermediate reconstruction with registered images and 3D points, for live viewers."""

    images: tuple[PosedImage, ...]
    """Registered images."""
    points: Float64
    """(p, 3) float64 3D points, world frame."""


@dataclass(frozen=True, eq=False)
class VerifiedPair:
    """Geometrically verified matches of two images.

    Examples:
        >>> matches = np.array([[0, 3], [1, 2]])
        >>> scores, direction = np.ones(2, np.float32), np.array([1.0, 0.0, 0.0])
        >>> len(VerifiedPair(0, 1, matches, scores, np.eye(3), direction))
        2
    """

    image_a: int
    """Index of the first image in :attr:`MappingProblem.images`, smaller than ``image_b``."""
    image_b: int
    """Index of the second image in :attr:`MappingProblem.images`."""
    matches: Int64
    """(m, 2) int64 keypoint indices of the inlier matches in both images."""
    scores: Float32
    """(m,) float32 confidence of each match in [0, 1]."""
    rotation: Float64
    """(3, 3) float64 rotation of ``cam_b_from_cam_a``, from the essential matrix or homography."""
    translation: Float64
    """(3,) float64 translation of ``cam_b_from_cam_a``, up to scale."""
    calibrated: bool = True
    """True if the relative pose comes from an essential matrix, False if it comes from a homography
    or a fundamental matrix."""

    def __post_init__(self) -> None:
        if not 0 <= self.image_a < self.image_b:
            raise DataError("image_a", "image index must be smaller than image_b")
        require_array(self, "matches", np.int64, (None, 2))
        require_array(self, "scores", np.float32, (len(self.matches),))
        require_unit_interval(self.scores, "scores")
        require_array(self, "rotation", np.float64, (3, 3))
        require_array(self, "translation", np.float64, (3,))

    def __len__(self) -> int:
        return len(self.matches)


@dataclass(frozen=True, eq=False)
class MappingProblem:
    """Complete input of the incremental mapper, with images and verified image pairs."""

    images: tuple[MappingImage, ...]
    """Images with keypoints and priors."""
    pairs: tuple[VerifiedPair, ...] = field(default=())
    """Verified pairs of images."""
    rigs: tuple[Rig, ...] = ()
    """Rigs, whose frames register as a unit. Names of images that are not part of the mapping
    problem are ignored."""

    def __post_init__(self) -> None:
        names = [name for rig in self.rigs for name in rig.image_names]
        if len(set(names)) < len(names):
            raise DataError("rigs", "an image must belong to one frame of one rig")
        for pair in self.pairs:
            if pair.image_b >= len(self.images):
                raise DataError("pairs", f"a pair has image {pair.image_b}, which does not exist")
            for image, column in ((pair.image_a, 0), (pair.image_b, 1)):
                rows = pair.matches[:, column]
                if len(rows) and not 0 <= rows.min() <= rows.max() < self.num_keypoints(image):
                    raise DataError("pairs", f"match indices exceed the keypoints of image {image}")

    def num_keypoints(self, image: int) -> int:
        """Return the number of keypoints of an image."""
        return len(self.images[image].keypoints)

    @property
    def originals(self) -> dict[int, int]:
        """Index of the original image by index of the duplicate."""
        row_of = {image.name: row for row, image in enumerate(self.images)}
        return {
            row: row_of[image.duplicate_of]
            for row, image in enumerate(self.images)
            if image.duplicate_of in row_of
        }

    @property
    def distinct_pairs(self) -> tuple[VerifiedPair, ...]:
        """Verified pairs without the pairs that contain a duplicate."""
        originals = self.originals
        return tuple(
            p for p in self.pairs if p.image_a not in originals and p.image_b not in originals
        )

    def frame_of_images(self, rigs: Sequence[Rig] | None = None) -> Int64:
        """Return the frame (n,) of each image, as the index of the first image of the frame.

        Args:
            rigs: Rigs whose frames are used, by default those of the problem.
        """
        names = [image.name for image in self.images]
        return find_frames(names, self.rigs if rigs is None else rigs)

    def pairs_between_frames(self) -> tuple[VerifiedPair, ...]:
        """Return the verified pairs whose images are not of the same frame of a rig."""
        if not self.rigs:
            return self.pairs
        frame_of = self.frame_of_images()
        return tuple(p for p in self.pairs if frame_of[p.image_a] != frame_of[p.image_b])

    def subset(self, names: list[str]) -> MappingProblem:
        """Return the mapping problem restricted to the named images and their pairs."""
        chosen = set(names)
        indices = [i for i, image in enumerate(self.images) if image.name in chosen]
        position = {old: new for new, old in enumerate(indices)}
        pairs = tuple(
            replace(pair, image_a=position[pair.image_a], image_b=position[pair.image_b])
            for pair in self.pairs
            if pair.image_a in position and pair.image_b in position
        )
        return MappingProblem(tuple(self.images[i] for i in indices), pairs, self.rigs)

    def with_poses(self, poses: Mapping[str, Pose]) -> MappingProblem:
        """Return the mapping problem with the given ``cam_from_world`` poses, by image name."""
        images = (replace(image, known_pose=poses.get(image.name)) for image in self.images)
        return replace(self, images=tuple(images))
