"""Matchers, which match two images by their features or by their pixels."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from mpsfm_core.data import DenseMatches, Features, PairDepth, PairMatches, SparseMatches, View
from mpsfm_core.data.errors import DataError, ProviderError
from mpsfm_core.providers.kinds.depth import check_depth_prior
from mpsfm_core.providers.protocols import ProviderSpec
from mpsfm_core.providers.provider_kind import ProviderKind
from mpsfm_core.providers.validation import (
    name_violations,
    provider_errors,
    require_inside,
    require_undeclared,
    revalidate,
)


@runtime_checkable
class Matcher(Protocol):
    """Provider that matches two images, either by their features or by their pixels."""

    def match(
        self,
        view_a: View,
        view_b: View,
        features_a: Features | None = None,
        features_b: Features | None = None,
    ) -> PairMatches:
        """Match two undistorted images.

        Args:
            view_a: First undistorted image.
            view_b: Second undistorted image, which may have another size.
            features_a: Features of the first image if the matcher has the capability ``sparse``,
                else None. An image may have no features or many thousands.
            features_b: Features of the second image if the matcher has the capability ``sparse``,
                else None.

        Returns:
            Sparse matches are index pairs (m, 2) int64 of features in the first and second image.
            Dense matches are corresponding points (m, 2) float64 in pixels of each image. Sparse
            and dense matches have scores (m,) float32 in [0, 1], where 1 is best. Matchers with the
            capability ``pair-depth`` also return one depth prior per image.
        """
        ...


def require_features(
    purpose: str, features_a: Features | None, features_b: Features | None
) -> tuple[Features, Features]:
    """Return the features of both images, or raise ProviderError if features are missing.

    Args:
        purpose: Beginning of the error message, such as "mutual-nearest matches features".
        features_a: Features of the first image, or None.
        features_b: Features of the second image, or None.

    Returns:
        Features of the first and of the second image.

    Raises:
        ProviderError: The features of the first or second image are None.
    """
    if features_a is None or features_b is None:
        raise ProviderError(f"{purpose}: choose a features provider")
    return features_a, features_b


def run_matcher(
    spec: ProviderSpec,
    provider: Matcher,
    views: tuple[View, View],
    features: tuple[Features, Features] | None = None,
) -> PairMatches:
    """Match two images and validate the matches.

    The matcher receives ``features`` only if it has the capability ``sparse``.
    """
    given = features if features and "sparse" in spec.capabilities else (None, None)
    with provider_errors(spec, _pair_name(views)):
        return validate_matches(spec, views, features, provider.match(*views, *given))


def validate_matches(
    spec: ProviderSpec,
    views: tuple[View, View],
    features: tuple[Features, Features] | None,
    output: object,
) -> PairMatches:
    """Validate the feature indices and the points of matches.

    Args:
        spec: Specification of the provider, with its capabilities.
        views: Undistorted images that the provider processed.
        features: Features of both images, or None for a matcher that needs no features.
        output: Return value of the provider.

    Returns:
        The validated matches as returned by the provider.

    Raises:
        ProviderOutputError: The matches violate a rule of the interface or lack the field of a
            declared capability.
    """
    with name_violations(spec, _pair_name(views)):
        matches = revalidate(output, PairMatches, "matches")
        for capability in ("sparse", "dense"):
            if getattr(matches, capability) is None:
                require_undeclared(spec, capability, capability)
        if matches.sparse is not None:
            _check_sparse(matches.sparse, features)
        if matches.dense is not None:
            revalidate(matches.dense, DenseMatches, "dense")
            require_inside(matches.dense.points_a, views[0].camera, "points_a")
            require_inside(matches.dense.points_b, views[1].camera, "points_b")
        if matches.depth is None:
            require_undeclared(spec, "pair-depth", "depth")
        else:
            depth = revalidate(matches.depth, PairDepth, "depth")
            check_depth_prior(spec, depth.depth_a, "depth_a")
            check_depth_prior(spec, depth.depth_b, "depth_b")
        return matches


def _check_sparse(sparse: SparseMatches, features: tuple[Features, Features] | None) -> None:
    revalidate(sparse, SparseMatches, "sparse")
    if features is None:
        raise DataError(
            "sparse", "sparse matches must be absent, because the matcher received no features"
        )
    for column, (name, available) in enumerate(zip("ab", features, strict=True)):
        largest = int(sparse.indices[:, column].max(initial=-1))
        if largest >= len(available):
            text = f"must be below {len(available)}, the features of view {name}, got {largest}"
            raise DataError("indices", text)


def _pair_name(views: tuple[View, View]) -> str:
    return f"{views[0].name} - {views[1].name}"


KIND = ProviderKind(
    name="matcher",
    title="Matchers",
    protocol=Matcher,
    checks="mpsfm_core.testing.checks.matcher:CHECKS",
    capabilities={
        "sparse": "The matcher requires features and returns matches of features.",
        "dense": "The matcher returns matches of pixel positions; alone, it needs no features.",
        "pair-depth": "The matcher also predicts the depth of both images.",
    },
    default_capabilities=frozenset({"sparse"}),
    example_scene="indoor",
    sees_truth=True,
)
