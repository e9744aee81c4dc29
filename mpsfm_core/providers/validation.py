"""Validation of the depth, normals, matches and other values that providers return.

The functions ``run_*`` call a provider and validate its return value. Any exception of a provider
becomes an :class:`~mpsfm_core.data.errors.MpsfmError` that names provider and image. The functions
``validate_*`` only validate a given return value of a provider. Return values are instances of the
classes in :mod:`mpsfm_core.data`, which validate themselves on construction. The functions
``validate_*`` validate these instances again, because arrays are mutable. The functions
``validate_*`` also compare the return value with the image size and with the declared capabilities
of the provider.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

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
    SparseMatches,
    View,
    dot_with_rays,
)
from mpsfm_core.data.errors import DataError, MpsfmError, ProviderOutputError, ProviderRunError
from mpsfm_core.providers import (
    DepthProvider,
    FeatureProvider,
    FocalEstimator,
    JointProvider,
    MaskProvider,
    Matcher,
    MultiViewProvider,
    NormalsProvider,
    ProviderSpec,
    RetrievalProvider,
)

MAX_MEDIAN_NORMAL_VARIANCE = np.pi**2
"""Largest plausible median of the angular variance of normals in rad^2. No angle exceeds pi, so a
larger median is in degrees or no variance."""

FACING_TOLERANCE = 1e-3
"""Largest dot product of a unit normal that faces the camera with its viewing ray. The limit is
positive because of rounding, see :data:`~mpsfm_core.data.UNIT_NORMAL_TOLERANCE`."""


def run_depth(spec: ProviderSpec, provider: DepthProvider, view: View) -> DepthPrior:
    """Predict the depth of an image and validate it, see :meth:`DepthProvider.predict`."""
    with provider_errors(spec, view.name):
        return validate_depth(spec, view, provider.predict(view))


def run_joint(
    spec: ProviderSpec, provider: JointProvider, view: View
) -> tuple[DepthPrior, NormalPrior]:
    """Predict depth and normals of an image in one network pass and validate both."""
    with provider_errors(spec, view.name):
        answer = provider.predict_joint(view)
        if not (isinstance(answer, tuple) and len(answer) == 2):
            raise DataError(
                "output", f"the output must be a pair (depth, normals), got {_type(answer)}"
            )
        return validate_depth(spec, view, answer[0]), validate_normals(spec, view, answer[1])


def run_focal(spec: ProviderSpec, provider: FocalEstimator, view: View) -> float | None:
    """Estimate the focal length of an image in pixels; return None if there is no estimate."""
    with provider_errors(spec, view.name):
        focal = provider.estimate_focal(view)
        if focal is None:
            return None
        if not (isinstance(focal, (int, float, np.number)) and 0 < focal < np.inf):
            raise DataError(
                "focal", f"the focal length must be a positive number of pixels, got {focal!r}"
            )
        return float(focal)


def run_normals(
    spec: ProviderSpec, provider: NormalsProvider, view: View, depth: DepthPrior | None = None
) -> NormalPrior:
    """Predict the normals of an image and validate the normal prior.

    The provider receives the prior ``depth`` only if it has the capability ``needs-depth``.
    """
    given = depth if "needs-depth" in spec.capabilities else None
    with provider_errors(spec, view.name):
        return validate_normals(spec, view, provider.predict(view, given))


def run_multiview(
    spec: ProviderSpec, provider: MultiViewProvider, views: Sequence[View]
) -> MultiViewPrior:
    """Predict the depth of several images jointly and validate the depth priors."""
    with provider_errors(spec, _group_name(views)):
        return validate_multiview(spec, views, provider.predict_group(tuple(views)))


def run_features(spec: ProviderSpec, provider: FeatureProvider, view: View) -> Features:
    """Extract the features of an image and validate the keypoints and descriptors."""
    with provider_errors(spec, view.name):
        return validate_features(spec, view, provider.extract(view))


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


def run_retrieval(spec: ProviderSpec, provider: RetrievalProvider, view: View) -> Float32:
    """Compute the global descriptor of an image and validate the descriptor."""
    with provider_errors(spec, view.name):
        return validate_retrieval(spec, view, provider.describe(view))


def run_mask(spec: ProviderSpec, provider: MaskProvider, view: View) -> Bool:
    """Compute the mask of usable pixels of an image and validate the mask."""
    with provider_errors(spec, view.name):
        return validate_mask(spec, view, provider.mask(view))


def validate_depth(spec: ProviderSpec, view: View, output: object) -> DepthPrior:
    """Validate the type, values and declared capabilities of a predicted depth prior.

    Args:
        spec: Specification of the provider, with its capabilities.
        view: Undistorted image that the provider processed.
        output: Return value of the provider.

    Returns:
        The validated prior as returned by the provider.

    Raises:
        ProviderOutputError: The provider's output violates a rule of the interface. The error
            message names provider, image, field and rule.
    """
    with _name_violations(spec, view.name):
        return _check_depth(spec, output, "depth")


def validate_normals(spec: ProviderSpec, view: View, output: object) -> NormalPrior:
    """Validate that predicted normals are unit vectors that face the camera.

    Args:
        spec: Specification of the provider, with its capabilities.
        view: Undistorted image that the provider processed.
        output: Return value of the provider.

    Returns:
        The validated prior as returned by the provider.

    Raises:
        ProviderOutputError: The provider's output violates a rule of the interface. The error
            message names provider, image, field and rule.
    """
    with _name_violations(spec, view.name):
        prior = _revalidate(output, NormalPrior, "normals")
        _require_not_empty(prior.shape, "normals")
        _require_facing(prior, view.camera)
        if prior.variance is None:
            if spec.kind == "normals":
                _require_undeclared(spec, "variance", "variance")
        elif prior.valid.any():
            median = float(np.median(prior.variance[prior.valid]))
            if median > MAX_MEDIAN_NORMAL_VARIANCE:
                raise DataError(
                    "variance", f"the variance must be in rad^2, but its median is {median:.3g}"
                )
        return prior


def validate_multiview(spec: ProviderSpec, views: Sequence[View], output: object) -> MultiViewPrior:
    """Validate the depth priors, poses and intrinsics that a multi-view network predicts.

    Args:
        spec: Specification of the provider, with its capabilities.
        views: Undistorted images that the provider processed.
        output: Return value of the provider.

    Returns:
        The validated priors as returned by the provider.

    Raises:
        ProviderOutputError: The provider's output violates a rule of the interface. The error
            message names provider, images, field and rule.
    """
    with _name_violations(spec, _group_name(views)):
        group = _revalidate(output, MultiViewPrior, "output")
        if not isinstance(group.depth, tuple) or len(group.depth) != len(views):
            found = len(group.depth) if isinstance(group.depth, tuple) else _type(group.depth)
            raise DataError(
                "depth", f"the depth must be a tuple of {len(views)} priors, got {found}"
            )
        for prior in group.depth:
            _check_depth(spec, prior, "depth")
        if group.poses is None:
            _require_undeclared(spec, "proposes-poses", "poses")
        if group.intrinsics is None:
            _require_undeclared(spec, "proposes-intrinsics", "intrinsics")
        return group


def validate_features(spec: ProviderSpec, view: View, output: object) -> Features:
    """Validate the values of extracted features, whose keypoints must be inside the image.

    Args:
        spec: Specification of the provider, with its capabilities.
        view: Undistorted image that the provider processed.
        output: Return value of the provider.

    Returns:
        The validated features as returned by the provider.

    Raises:
        ProviderOutputError: The provider's output violates a rule of the interface. The error
            message names provider, image, field and rule.
    """
    with _name_violations(spec, view.name):
        features = _revalidate(output, Features, "features")
        _require_inside(features.keypoints, view.camera, "keypoints")
        return features


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
    with _name_violations(spec, _pair_name(views)):
        matches = _revalidate(output, PairMatches, "matches")
        for capability in ("sparse", "dense"):
            if getattr(matches, capability) is None:
                _require_undeclared(spec, capability, capability)
        if matches.sparse is not None:
            _check_sparse(matches.sparse, features)
        if matches.dense is not None:
            _revalidate(matches.dense, DenseMatches, "dense")
            _require_inside(matches.dense.points_a, views[0].camera, "points_a")
            _require_inside(matches.dense.points_b, views[1].camera, "points_b")
        if matches.depth is None:
            _require_undeclared(spec, "pair-depth", "depth")
        else:
            depth = _revalidate(matches.depth, PairDepth, "depth")
            _check_depth(spec, depth.depth_a, "depth_a")
            _check_depth(spec, depth.depth_b, "depth_b")
        return matches


def validate_retrieval(spec: ProviderSpec, view: View, output: object) -> Float32:
    """Validate that a global descriptor is a finite, non-empty float32 vector.

    Args:
        spec: Specification of the provider, with its capabilities.
        view: Undistorted image that the provider processed.
        output: Return value of the provider.

    Returns:
        The validated descriptor as returned by the provider.

    Raises:
        ProviderOutputError: The provider's output violates a rule of the interface. The error
            message names provider, image, field and rule.
    """
    with _name_violations(spec, view.name):
        vector = _require_array(output, "descriptor", np.dtype(np.float32), 1)
        _require_not_empty(vector.shape, "descriptor")
        if not np.isfinite(vector).all():
            raise DataError("descriptor", "must be finite")
        return vector


def validate_mask(spec: ProviderSpec, view: View, output: object) -> Bool:
    """Validate that a mask is a bool array in the size of the image.

    Args:
        spec: Specification of the provider, with its capabilities.
        view: Undistorted image that the provider processed.
        output: Return value of the provider.

    Returns:
        The validated mask as returned by the provider.

    Raises:
        ProviderOutputError: The provider's output violates a rule of the interface. The error
            message names provider, image, field and rule.
    """
    with _name_violations(spec, view.name):
        mask = _require_array(output, "mask", np.dtype(np.bool_), 2)
        expected = (view.camera.height, view.camera.width)
        if mask.shape != expected:
            raise DataError(
                "mask", f"the mask must have the image's shape {expected}, got {mask.shape}"
            )
        return mask


def validate_filtered_pairs(
    answer: object, pairs: Sequence[tuple[str, str]]
) -> list[tuple[str, str]]:
    """Validate the image pairs that a plugin's hook ``mpsfm_filter_pairs`` selects.

    Args:
        answer: Return value of the plugin's hook ``mpsfm_filter_pairs``.
        pairs: Candidate pairs of image names that the plugin received.

    Returns:
        Selected pairs of image names as a list. Selected pairs that are no candidates remain in the
        list and have no effect.

    Raises:
        TypeError: The hook's return value is not an iterable of pairs of image names.
        ValueError: The plugin selects image pairs, but none of them is a candidate.
    """
    if not isinstance(answer, Iterable):
        raise TypeError(f"the hook must return pairs of image names, got {_type(answer)}")
    filtered: list[tuple[str, str]] = []
    for pair in answer:
        if not (isinstance(pair, Sequence) and len(pair) == 2):
            raise TypeError(f"the hook must return pairs of image names, got {pair!r}")
        first, second = pair
        if not (isinstance(first, str) and isinstance(second, str)):
            raise TypeError(f"the hook must return pairs of image names, got {pair!r}")
        filtered.append((first, second))
    candidates = {frozenset(pair) for pair in pairs}
    if filtered and not any(frozenset(pair) in candidates for pair in filtered):
        raise ValueError(
            f"the hook returns no candidate pair, for example {filtered[0]!r}: image names have "
            f"their folder and extension, such as {pairs[0] if pairs else ('a.jpg', 'b.jpg')!r}"
        )
    return filtered


@contextmanager
def provider_errors(spec: ProviderSpec, image: str) -> Iterator[None]:
    """Convert any exception of a provider to an MP-SfM error that names provider and image.

    Subclasses of MpsfmError, such as WeightsError for missing weights, are not converted, because
    their messages already name the next step.

    Args:
        spec: Specification of the provider, with its capabilities.
        image: Name of the image that the provider processes, or names of several images.

    Raises:
        ProviderRunError: The provider raised an exception.
        ProviderOutputError: The return value of the provider violates a rule of the interface.
    """
    with _name_violations(spec, image):
        try:
            yield
        except MpsfmError:
            raise
        except MemoryError as error:
            raise ProviderRunError(
                f"provider {spec.name!r}, image {image!r}: out of memory; reduce the image size or "
                f"the number of workers"
            ) from error
        except (Exception, SystemExit) as error:
            text = f"provider {spec.name!r}, image {image!r}: {type(error).__name__}: {error}"
            raise ProviderRunError(text) from error


@contextmanager
def _name_violations(spec: ProviderSpec, image: str) -> Iterator[None]:
    """Convert a DataError about a provider's output to an error that names provider and image."""
    try:
        yield
    except DataError as error:
        raise ProviderOutputError(spec.name, image, error.field, error.rule) from error


Checked = TypeVar(
    "Checked",
    DepthPrior,
    NormalPrior,
    MultiViewPrior,
    Features,
    SparseMatches,
    DenseMatches,
    PairDepth,
    PairMatches,
)


def _revalidate(output: object, expected: type[Checked], field: str) -> Checked:
    """Require that a provider's output has the expected type, and validate its values again."""
    if not isinstance(output, expected):
        raise DataError(field, f"the output must be a {expected.__name__}, got {_type(output)}")
    return replace(output)  # The constructor validates the field values again.


def _check_depth(spec: ProviderSpec, output: object, field: str) -> DepthPrior:
    prior = _revalidate(output, DepthPrior, field)
    _require_not_empty(prior.shape, field)
    if not prior.metric:
        _require_undeclared(spec, "metric", field)
    if prior.variance is None:
        _require_undeclared(spec, "variance", "variance")
    return prior


def _require_facing(prior: NormalPrior, camera: PinholeCamera) -> None:
    facing_away = (dot_with_rays(camera, prior.normals) > FACING_TOLERANCE)[prior.valid]
    if facing_away.any():
        ratio = f"{100 * facing_away.mean():.3g} % of the valid pixels"
        raise DataError("normals", f"normals must face the camera (n . ray < 0), not so at {ratio}")


def _check_sparse(sparse: SparseMatches, features: tuple[Features, Features] | None) -> None:
    _revalidate(sparse, SparseMatches, "sparse")
    if features is None:
        raise DataError(
            "sparse", "sparse matches must be absent, because the matcher received no features"
        )
    for column, (name, available) in enumerate(zip("ab", features, strict=True)):
        largest = int(sparse.indices[:, column].max(initial=-1))
        if largest >= len(available):
            text = f"must be below {len(available)}, the features of view {name}, got {largest}"
            raise DataError("indices", text)


def _require_undeclared(spec: ProviderSpec, capability: str, field: str) -> None:
    """Raise DataError if the provider declares the capability of a field that is None."""
    if capability in spec.capabilities:
        raise DataError(field, f"the output lacks the declared capability {capability!r}")


def _require_inside(points: Float64, camera: PinholeCamera, field: str) -> None:
    outside = ((points < 0) | (points > camera.size)).any(axis=1)
    if outside.any():
        x, y = points[outside][0]
        size = f"{camera.width}x{camera.height}"
        raise DataError(
            field, f"points must lie inside of the {size} image, got ({x:.2f}, {y:.2f})"
        )


def _require_not_empty(shape: tuple[int, ...], field: str) -> None:
    if 0 in shape:
        raise DataError(field, f"the array must not be empty, but has shape {shape}")


def _require_array(
    output: object, field: str, dtype: np.dtype[Any], dimensions: int
) -> NDArray[Any]:
    if not isinstance(output, np.ndarray):
        raise DataError(field, f"the output must be a numpy array, got {_type(output)}")
    if output.dtype != dtype or output.ndim != dimensions:
        expected = f"{dimensions}-dimensional {dtype}"
        raise DataError(
            field, f"the output must be a {expected} array, got {output.dtype} {output.shape}"
        )
    return output


def _pair_name(views: tuple[View, View]) -> str:
    return f"{views[0].name} - {views[1].name}"


def _group_name(views: Sequence[View]) -> str:
    return ", ".join(view.name for view in views)


def _type(value: object) -> str:
    return type(value).__name__
