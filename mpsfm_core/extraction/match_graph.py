"""Results of extraction: match graph and priors of a set of images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from mpsfm_core.data import (
    DepthPrior,
    Features,
    Float64,
    NormalPrior,
    PinholeCamera,
    Pose,
    SparseMatches,
    VerifiedPair,
)
from mpsfm_core.data.decisions import Reason
from mpsfm_core.extraction.matching.pair_matching import (
    AssembledMatches,
    CandidateMatches,
    PairMatcher,
)
from mpsfm_core.extraction.matching.verification import TwoViewGeometry

NamePair = tuple[str, str]


@dataclass(frozen=True, eq=False)
class MatchGraph:
    """Features, matches and two-view geometries of a set of images."""

    names: tuple[str, ...]
    """Names of the images."""
    features: Mapping[str, Features]
    """Features with descriptors and scores by image name, empty for a detector-free matcher."""
    assembled: AssembledMatches
    """Verified pairs, and keypoints of all images, by image index."""
    candidates: tuple[CandidateMatches, ...] = ()
    """Matches of all matched pairs before verification, by image index."""
    geometries: tuple[TwoViewGeometry, ...] = ()
    """Two-view geometry of each matched pair, in the order of ``candidates``."""
    min_inliers: int = 0
    """Minimum number of inliers of a verified pair."""
    num_proposed: int = 0
    """Number of selected image pairs before plugins filter the pairs."""
    matcher: PairMatcher | None = None
    """Matchers of the run, which also give the depth that a matcher predicts, or None."""
    duplicates: Mapping[str, str] = field(default_factory=dict)
    """Name of the original image by name of the duplicate, which shows the same view."""

    @property
    def keypoints(self) -> dict[str, Float64]:
        """Adjusted keypoints (n, 2) float64 by image name, in pixels of the undistorted view.

        The keypoints of :attr:`features` come first, followed by points of dense matches.
        """
        return dict(zip(self.names, self.assembled.keypoints, strict=True))

    @property
    def keypoint_std_px(self) -> dict[str, float]:
        """Standard deviation of keypoint coordinates in pixels, by image name."""
        return dict(zip(self.names, self.assembled.std_px, strict=True))

    @property
    def verified(self) -> dict[NamePair, VerifiedPair]:
        """Verified pair with inlier matches, scores and relative pose, by pair of image names."""
        return {
            (self.names[pair.image_a], self.names[pair.image_b]): pair
            for pair in self.assembled.pairs
        }

    @property
    def matches(self) -> dict[NamePair, SparseMatches]:
        """Matches of :attr:`features` with scores before verification, by pair of image names."""
        return {self._pair(found): found.sparse for found in self.candidates}

    @property
    def dropped(self) -> dict[NamePair, Reason]:
        """Reason why an image pair could not be verified, by pair of image names."""
        return {
            self._pair(found): geometry.drop_reason(len(found), self.min_inliers)
            for found, geometry in zip(self.candidates, self.geometries, strict=True)
            if geometry.dropped
        }

    def _pair(self, found: CandidateMatches) -> NamePair:
        return self.names[found.pair[0]], self.names[found.pair[1]]


@dataclass(frozen=True, eq=False)
class Priors:
    """Depth and normal priors with calibrated variance, in the resolution that the mapper uses."""

    depth: Mapping[str, DepthPrior]
    """Depth prior with variance by image name."""
    normals: Mapping[str, NormalPrior]
    """Normal prior with variance by image name."""
    groups: Mapping[str, int] = field(default_factory=dict)
    """Group number by image name; a multi-view network predicts depth of a group in one scale."""
    proposed_poses: Mapping[str, Pose] = field(default_factory=dict)
    """Pose ``cam_from_group`` that a multi-view network predicted, by image name."""
    follows_focal: bool = False
    """True if the provider of depth takes the intrinsics of a view into account, so that metric
    depth is proportional to the focal length."""

    def depth_focal_px(self, camera: PinholeCamera) -> float | None:
        """Return the focal length to which metric depth of a view with a camera is proportional."""
        return camera.fx if self.follows_focal else None
