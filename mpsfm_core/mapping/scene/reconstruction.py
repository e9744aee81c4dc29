"""Reconstruction: the result of the mapper."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from mpsfm_core.data import DepthPrior, Float64, Int64, PinholeCamera, Pose
from mpsfm_core.data.decisions import Reason

_NO_ROWS = np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class RegisteredImage:
    """One registered image."""

    index: int
    """Index in :attr:`mpsfm_core.data.MappingProblem.images`."""
    name: str
    camera: PinholeCamera
    """Undistorted intrinsics, with the refined focal length."""
    rotation: Float64
    """(3, 3) float64 rotation of ``cam_from_world``."""
    translation: Float64
    """(3,) float64 translation of ``cam_from_world``, in world units."""
    point_ids: Int64
    """(n,) int64 row in :attr:`Reconstruction.points` of each keypoint, or -1."""
    depth: DepthPrior
    """Refined depth in world units on the grid of the prior, with its relative variance."""
    scale: float
    """World units per unit of the prior."""
    confirmed: bool = True
    """False if the image was registered tentatively, without verification."""
    focal_log_std: float | None = None
    """Posterior standard deviation of the log focal length; None if it was not estimated."""
    focal_reason: Reason | None = None
    """Why the focal length is not refined, a ``CameraReason``; None if it is refined."""


@dataclass(frozen=True)
class MetricScale:
    """Estimate of the meter, from the scales of metric priors or from GPS."""

    metres_per_unit: float
    """Meters per world unit before scaling; it has been applied if ``trusted``."""
    spread: float
    """Robust relative standard deviation (1.4826 MAD) of the estimates of the images."""
    num_images: int
    """Number of images with an estimate."""
    trusted: bool
    """Whether the coordinates are meters."""
    by: str = "depth maps"
    """Source of the estimate, for the report."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Registered images and points of one component."""

    images: tuple[RegisteredImage, ...]
    """Registered images by index."""
    points: Float64
    """(p, 3) float64 world points."""
    errors_px: Float64
    """(p,) float64 mean reprojection error of each point."""
    metric: MetricScale | None = None
    """Estimate of the meter; None without metric priors."""

    @property
    def poses(self) -> dict[str, Pose]:
        """Image name -> pose."""
        return {image.name: (image.rotation, image.translation) for image in self.images}

    def num_multi_view_points(self) -> Int64:
        """Return the number (n,) of points of each image that at least three images observe."""
        observed = [np.unique(image.point_ids[image.point_ids >= 0]) for image in self.images]
        num_views = np.bincount(np.concatenate([*observed, _NO_ROWS]), minlength=len(self.points))
        return np.array([(num_views[rows] >= 3).sum() for rows in observed], dtype=np.int64)

    @property
    def confirmed_images(self) -> tuple[RegisteredImage, ...]:
        """Images that are not registered tentatively."""
        return tuple(image for image in self.images if image.confirmed)


@dataclass(frozen=True)
class MappingReport:
    """Report of the mapper, for ``summary.json``."""

    image_reasons: Mapping[str, Reason] = field(default_factory=dict)
    """Image name -> why the image is not registered."""
    pair_reasons: Mapping[str, Reason] = field(default_factory=dict)
    """``"name_a name_b"`` -> why the pair could not initialize a component."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Step -> time, summed over all runs."""
    counts: Mapping[str, int] = field(default_factory=dict)
    """Step -> number of calls, summed over all runs."""
    runs: int = 1
    """Number of runs with different seeds."""


@dataclass(frozen=True, eq=False)
class MappingResult:
    """Result of the mapper."""

    reconstructions: tuple[Reconstruction, ...]
    """Disconnected components, the largest first; empty if no initialization succeeded."""
    report: MappingReport


def transform_reconstruction(
    reconstruction: Reconstruction,
    scale: float,
    rotation: Float64,
    translation: Float64,
    metric: MetricScale | None,
) -> Reconstruction:
    """Transform a reconstruction to another world, ``x' = scale * rotation @ x + translation``.

    Args:
        reconstruction: The reconstruction.
        scale: Scale of the similarity transform.
        rotation: (3, 3) rotation.
        translation: (3,) translation in units of the new world.
        metric: Estimate of the meter in the new world.
    """
    images = []
    for image in reconstruction.images:
        rotated = image.rotation @ rotation.T
        depth = image.depth
        variance = None if depth.variance is None else depth.variance * np.float32(scale**2)
        images.append(
            replace(
                image,
                rotation=rotated,
                translation=scale * image.translation - rotated @ translation,
                depth=replace(depth, depth=depth.depth * np.float32(scale), variance=variance),
                scale=image.scale * scale,
            )
        )
    points = scale * reconstruction.points @ rotation.T + translation
    return replace(reconstruction, images=tuple(images), points=points, metric=metric)
