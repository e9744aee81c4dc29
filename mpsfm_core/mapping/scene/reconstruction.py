"""Data classes of the reconstruction that the mapper returns."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from mpsfm_core.data import (
    Bool,
    DepthPrior,
    Float64,
    Int64,
    MappingProblem,
    PinholeCamera,
    Pose,
    Rig,
    VerifiedPair,
)
from mpsfm_core.data.camera_models import NUM_DISTORTION, CameraModel, IntrinsicParameter
from mpsfm_core.data.decisions import CameraReason, Reason, reason_from_json
from mpsfm_core.mapping.problem_state import rig_from_state, rig_to_state
from mpsfm_core.mapping.scene.depth_map import LazyDepth
from mpsfm_core.mapping.scene.estimated_intrinsics import (
    CalibrationOutcome,
    IntrinsicEstimate,
)
from mpsfm_core.mapping.state import StateDict, reasons_from_json, reasons_to_json
from mpsfm_core.support.disk_arrays import current_store, store_fields
from mpsfm_core.support.threads import parallel_map

_NO_ROWS = np.zeros(0, np.int64)
VIEW_PARAMETERS = (
    IntrinsicParameter.ASPECT_RATIO,
    IntrinsicParameter.PRINCIPAL_POINT_X,
    IntrinsicParameter.PRINCIPAL_POINT_Y,
)
"""Intrinsic parameters without distortion whose refinement changes the undistorted view."""
_REASON_FIELDS = ("image_reasons", "pair_reasons")


@dataclass(frozen=True)
class CalibratedParameter:
    """Result of self-calibration for one intrinsic parameter of a registered image."""

    estimate: IntrinsicEstimate
    """Outcome, estimated value and standard deviation of the intrinsic parameter."""
    reason: Reason | None = None
    """Reason (``CameraReason``) why the parameter is not refined, or None if it is refined or
    known."""

    @property
    def is_refined(self) -> bool:
        """True if the camera takes the estimated value of the parameter."""
        return self.estimate.outcome == CalibrationOutcome.REFINED

    @property
    def std(self) -> float | None:
        """Standard deviation with predicted systematic errors, or None if neither is known."""
        return self.estimate.std if np.isfinite(self.estimate.std) else None

    def state_dict(self) -> StateDict:
        """Return the state of the parameter for a checkpoint."""
        outcome, value, std = self.estimate
        reason = self.reason and self.reason.to_json()
        return {"outcome": int(outcome), "value": value, "std": std, "reason": reason}

    @classmethod
    def from_state_dict(cls, state: StateDict) -> CalibratedParameter:
        """Restore a parameter from a checkpoint."""
        outcome = CalibrationOutcome(state["outcome"])
        reason = state["reason"] and reason_from_json(CameraReason, state["reason"])
        return cls(IntrinsicEstimate(outcome, state["value"], state["std"]), reason)


@dataclass(frozen=True, eq=False)
class RegisteredImage:
    """One registered image."""

    index: int
    """Index in :attr:`mpsfm_core.data.MappingProblem.images`."""
    name: str
    camera: PinholeCamera
    """Intrinsics of the undistorted image, with the refined focal length."""
    rotation: Float64
    """(3, 3) float64 rotation of ``cam_from_world``."""
    translation: Float64
    """(3,) float64 translation of ``cam_from_world``, in world units."""
    point_ids: Int64
    """(n,) int64 row in :attr:`Reconstruction.points` of the point that each keypoint observes, or
    -1."""
    depth: DepthPrior
    """Refined depth map in world units on the pixel grid of the depth prior, with its relative
    variance."""
    scale: float
    """Scale of the depth prior, in world units per unit of the prior."""
    confirmed: bool = True
    """False if the image was registered tentatively, without verification."""
    held_out: bool = False
    """True if the dense stage ignores the image, so that the image can evaluate the geometry."""
    pose_error_deg: float | None = None
    """Predicted root mean square of the relative pose error with other images in degrees, or None
    without a prediction."""
    camera_model: CameraModel = CameraModel.SIMPLE_RADIAL
    """COLMAP camera model whose parameters self-calibration estimates."""
    distortion: Float64 = field(default_factory=lambda: np.zeros(NUM_DISTORTION))
    """(4,) float64 distortion coefficients of the original image, as in
    :attr:`mpsfm_core.data.MappingImage.distortion`. The keypoints were undistorted with initial
    coefficients, which the mapper refines."""
    calibration: Mapping[IntrinsicParameter, CalibratedParameter] = field(
        default_factory=lambda: dict.fromkeys(
            IntrinsicParameter, CalibratedParameter(IntrinsicEstimate())
        )
    )
    """Result of self-calibration for each intrinsic parameter."""

    @property
    def changes_view(self) -> bool:
        """True if the undistorted view differs with the refined camera by more than its scale."""
        refined = any(
            self.calibration[p].is_refined for p in VIEW_PARAMETERS if p in self.calibration
        )
        return self.camera_model.is_fisheye or bool(self.distortion.any()) or refined

    def state_dict(self) -> StateDict:
        """Return the fields of the image as nested dictionaries, for a checkpoint."""
        depth = {item.name: getattr(self.depth, item.name) for item in fields(self.depth)}
        parts: StateDict = {"camera": {**vars(self.camera)}, "depth": depth}
        parts["camera_model"] = self.camera_model.value
        calibration = {p.name: result.state_dict() for p, result in self.calibration.items()}
        return {**vars(self), **parts, "calibration": calibration}

    @classmethod
    def from_state_dict(cls, state: StateDict) -> RegisteredImage:
        """Restore a registered image from a checkpoint."""
        parts: StateDict = {
            "camera": PinholeCamera(**state["camera"]),
            "depth": store_fields(DepthPrior(**state["depth"]), current_store()),
            "camera_model": CameraModel(state["camera_model"]),
        }
        calibration = {
            IntrinsicParameter[name]: CalibratedParameter.from_state_dict(result)
            for name, result in state["calibration"].items()
        }
        return cls(**{**state, **parts, "calibration": calibration})


@dataclass(frozen=True)
class MetricScale:
    """Estimate of meters per world unit, from the scales of metric depth priors or from GPS."""

    metres_per_unit: float
    """Estimated meters per world unit of the mapper, with which the reconstruction was scaled if
    ``trusted``."""
    spread: float
    """Robust relative standard deviation (1.4826 MAD) of the metric scales estimated by the
    images."""
    num_images: int
    """Number of images, or of frames of rigs, that estimate the metric scale."""
    trusted: bool
    """True if the coordinates of the reconstruction are in meters."""
    by: str = "depth maps"
    """Source of the metric scale, for the report."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Registered images and points of one component."""

    images: tuple[RegisteredImage, ...]
    """Registered images, sorted by index in the mapping problem."""
    points: Float64
    """(p, 3) float64 points in world coordinates."""
    errors_px: Float64
    """(p,) float64 mean reprojection error of each point, in pixels."""
    metric: MetricScale | None = None
    """Estimate of meters per world unit, or None without metric depth priors."""
    rigs: tuple[Rig, ...] = ()
    """Rigs of the registered images, with translations in world units."""

    @property
    def poses(self) -> dict[str, Pose]:
        """Poses ``cam_from_world`` as (rotation (3, 3), translation (3,)), by image name."""
        return {image.name: (image.rotation, image.translation) for image in self.images}

    def num_multi_view_points(self) -> Int64:
        """Count the points (n,) of each image that at least three images observe."""
        observed = [np.unique(image.point_ids[image.point_ids >= 0]) for image in self.images]
        num_views = np.bincount(np.concatenate([*observed, _NO_ROWS]), minlength=len(self.points))
        return np.array([(num_views[rows] >= 3).sum() for rows in observed], dtype=np.int64)

    @property
    def confirmed_images(self) -> tuple[RegisteredImage, ...]:
        """Images whose registration was verified, without tentatively registered images."""
        return tuple(image for image in self.images if image.confirmed)

    @property
    def dense_images(self) -> tuple[RegisteredImage, ...]:
        """Images that contribute to densification, the dense cloud and the mesh.

        Images with unconfirmed poses and held-out images do not contribute.
        """
        return tuple(image for image in self.confirmed_images if not image.held_out)

    def state_dict(self) -> StateDict:
        """Return the reconstruction for a checkpoint; pending depth maps are computed."""
        images = parallel_map(RegisteredImage.state_dict, self.images)
        return {
            **vars(self),
            "images": images,
            "metric": self.metric and {**vars(self.metric)},
            "rigs": [rig_to_state(rig) for rig in self.rigs],
        }

    @classmethod
    def from_state_dict(cls, state: StateDict) -> Reconstruction:
        """Restore a reconstruction from a checkpoint."""
        images = tuple(RegisteredImage.from_state_dict(image) for image in state["images"])
        metric = state["metric"] and MetricScale(**state["metric"])
        rigs = tuple(rig_from_state(rig) for rig in state["rigs"])
        return cls(**{**state, "images": images, "metric": metric, "rigs": rigs})


@dataclass(frozen=True)
class MappingReport:
    """Report of the mapper, for ``summary.json``."""

    image_reasons: Mapping[str, Reason] = field(default_factory=dict)
    """Reason why each unregistered image is not registered, by image name."""
    pair_reasons: Mapping[str, Reason] = field(default_factory=dict)
    """Reason why an image pair could not initialize a component, by ``"name_a name_b"``."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Run time of each mapper step in seconds, summed over all mapper runs."""
    counts: Mapping[str, int] = field(default_factory=dict)
    """Number of calls of each mapper step, summed over all mapper runs."""
    runs: int = 1
    """Number of mapper runs with different seeds."""

    def state_dict(self) -> StateDict:
        """Return the mapper report for a checkpoint."""
        reasons = {name: reasons_to_json(getattr(self, name)) for name in _REASON_FIELDS}
        return {**vars(self), **reasons}

    @classmethod
    def from_state_dict(cls, state: StateDict) -> MappingReport:
        """Restore a mapper report from a checkpoint."""
        reasons = {name: reasons_from_json(state[name]) for name in _REASON_FIELDS}
        return cls(**{**state, **reasons})


@dataclass(frozen=True, eq=False)
class MappingResult:
    """Result of the mapper."""

    reconstructions: tuple[Reconstruction, ...]
    """Disconnected components, the largest first, or an empty tuple if no initialization
    succeeded."""
    report: MappingReport


def compute_depth_maps(
    reconstructions: Iterable[Reconstruction],
) -> tuple[Reconstruction, ...]:
    """Compute and store the depth maps of reconstructions in parallel threads.

    Args:
        reconstructions: Reconstructions, whose depth maps are computed when they are first read.

    Returns:
        The reconstructions with stored depth maps.
    """

    def compute(image: RegisteredImage) -> RegisteredImage:
        if isinstance(image.depth, LazyDepth):
            image.depth.compute()
            return image
        return replace(image, depth=store_fields(image.depth, current_store()))

    return tuple(
        replace(part, images=tuple(parallel_map(compute, part.images))) for part in reconstructions
    )


def hold_out(mapping: MappingResult, every: int | None) -> MappingResult:
    """Mark every n-th registered image of each component as held out, in alphabetical order.

    Args:
        mapping: Result of the mapper.
        every: Distance n between held-out images; None holds out no image.
    """
    if every is None:
        return mapping
    parts = tuple(hold_out_images(part, every) for part in mapping.reconstructions)
    return replace(mapping, reconstructions=parts)


def hold_out_images(reconstruction: Reconstruction, every: int) -> Reconstruction:
    """Mark every n-th registered image as held out, in alphabetical order."""
    names = set(sorted(image.name for image in reconstruction.confirmed_images)[::every])
    images = (replace(image, held_out=image.name in names) for image in reconstruction.images)
    return replace(reconstruction, images=tuple(images))


def find_explained_matches(
    images: Sequence[RegisteredImage], problem: MappingProblem
) -> Iterator[tuple[VerifiedPair, Bool]]:
    """Yield each pair of registered images with a mask of its explained matches.

    A match is explained if both keypoints observe the same 3D point. Pairs of images of one frame
    of a rig are left out, because any pose of the frame explains their matches.

    Args:
        images: Registered images of a reconstruction.
        problem: Mapping problem with images and verified pairs.

    Yields:
        The image pair, and a (m,) bool mask of its explained matches.
    """
    point_ids = {image.index: image.point_ids for image in images}
    for pair in problem.pairs_between_frames():
        if pair.image_a in point_ids and pair.image_b in point_ids:
            points_a = point_ids[pair.image_a][pair.matches[:, 0]]
            points_b = point_ids[pair.image_b][pair.matches[:, 1]]
            yield pair, (points_a >= 0) & (points_a == points_b)


def transform_reconstruction(
    reconstruction: Reconstruction,
    scale: float,
    rotation: Float64,
    translation: Float64,
    metric: MetricScale | None,
) -> Reconstruction:
    """Transform a reconstruction by the similarity ``x' = scale * rotation @ x + translation``.

    Args:
        reconstruction: The reconstruction.
        scale: Scale of the similarity transform.
        rotation: (3, 3) rotation.
        translation: (3,) translation of the similarity transform, in units of the new world.
        metric: Estimate of meters per unit of the new world.
    """
    images = []
    for image in reconstruction.images:
        rotated = image.rotation @ rotation.T
        images.append(
            replace(
                image,
                rotation=rotated,
                translation=scale * image.translation - rotated @ translation,
                depth=LazyDepth(image.depth, None, scale, metric=image.depth.metric),
                scale=image.scale * scale,
            )
        )
    points = scale * reconstruction.points @ rotation.T + translation
    rigs = tuple(rig.scaled(scale) for rig in reconstruction.rigs)
    return replace(reconstruction, images=tuple(images), points=points, metric=metric, rigs=rigs)
