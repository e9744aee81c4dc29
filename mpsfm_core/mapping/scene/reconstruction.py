"""The finished reconstruction, as the mapper hands it to the results room."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from mpsfm_core.data import DepthPrior, Float64, Int64, PinholeCamera, Pose
from mpsfm_core.data.decisions import Reason

_NO_ROWS = np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class RegisteredImage:
    """One posed image.

    ``index``: position in :attr:`mpsfm_core.data.MappingProblem.images`. ``camera``: undistorted
    intrinsics, refined if that was asked for. ``rotation`` (3, 3), ``translation`` (3,) float64:
    ``cam_from_world``. ``point_ids``: (n,) int64, for each keypoint of the problem's image its
    row in :attr:`Reconstruction.points` or -1. ``depth``: refined depth in world units, on the
    grid of the prior, with the relative variance that the prior declares. ``scale``: world units
    per unit of the prior.
    ``confirmed``: False if it lies where its matches fit best, though nothing confirms that.
    """

    index: int
    name: str
    camera: PinholeCamera
    rotation: Float64
    translation: Float64
    point_ids: Int64
    depth: DepthPrior
    scale: float
    confirmed: bool = True


@dataclass(frozen=True)
class MetricScale:
    """World units to metres, from the per-image scales of metric priors, or from GPS.

    ``metres_per_unit``: the factor already applied when ``trusted``. ``spread``: robust relative
    standard deviation (1.4826 MAD) of the per-image estimates. ``by``: what told it, for people.
    """

    metres_per_unit: float
    spread: float
    num_images: int
    trusted: bool
    by: str = "depth maps"


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Posed images and points.

    ``points``: (p, 3) float64. ``errors_px``: (p,) float64, mean reprojection error of each point.
    ``metric``: None when the priors are not metric; the coordinates are metres when trusted.
    """

    images: tuple[RegisteredImage, ...]
    points: Float64
    errors_px: Float64
    metric: MetricScale | None = None

    @property
    def poses(self) -> dict[str, Pose]:
        """Pose of each image by its name."""
        return {image.name: (image.rotation, image.translation) for image in self.images}

    def num_multi_view_points(self) -> Int64:
        """(n,) how many points of each image three images or more see."""
        seen = [np.unique(image.point_ids[image.point_ids >= 0]) for image in self.images]
        views = np.bincount(np.concatenate([*seen, _NO_ROWS]), minlength=len(self.points))
        return np.array([(views[rows] >= 3).sum() for rows in seen], dtype=np.int64)

    @property
    def confirmed_images(self) -> tuple[RegisteredImage, ...]:
        """The images whose pose is more than a guess."""
        return tuple(image for image in self.images if image.confirmed)


@dataclass(frozen=True)
class MappingReport:
    """What happened, for people and for summary.json.

    ``image_reasons``: image name -> why it is not registered. ``pair_reasons``: "a b" -> why the
    pair could not start a reconstruction. ``seconds``: step -> time. ``counts``: step -> calls,
    both of all ``runs``.
    """

    image_reasons: Mapping[str, Reason] = field(default_factory=dict)
    pair_reasons: Mapping[str, Reason] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)
    counts: Mapping[str, int] = field(default_factory=dict)
    runs: int = 1


@dataclass(frozen=True, eq=False)
class MappingResult:
    """``reconstructions``: disconnected components, largest first; empty when none was possible."""

    reconstructions: tuple[Reconstruction, ...]
    report: MappingReport


def transform_reconstruction(
    reconstruction: Reconstruction,
    scale: float,
    rotation: Float64,
    translation: Float64,
    metric: MetricScale | None,
) -> Reconstruction:
    """The reconstruction in another world, ``x' = scale * rotation x + translation``, whose unit
    ``metric`` describes."""
    images = []
    for image in reconstruction.images:
        turned = image.rotation @ rotation.T
        depth = image.depth
        variance = None if depth.variance is None else depth.variance * np.float32(scale**2)
        images.append(
            replace(
                image,
                rotation=turned,
                translation=scale * image.translation - turned @ translation,
                depth=replace(depth, depth=depth.depth * np.float32(scale), variance=variance),
                scale=image.scale * scale,
            )
        )
    points = scale * reconstruction.points @ rotation.T + translation
    return replace(reconstruction, images=tuple(images), points=points, metric=metric)
