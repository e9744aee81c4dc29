"""The one gate between providers and the rest: what passes here obeys the contract.

``run_*`` calls a provider on a view or pair and validates the answer; whatever goes wrong becomes
one :class:`~mpsfm_core.data.errors.MpsfmError` that names provider and image. ``validate_*`` checks
an answer alone. The data types check themselves when they are made; here they are checked again
(their arrays may have been written to since), against the view, and against what the provider's
specification promises. """

from __future__ import annotations

from collections.abc import Iterator, Sequence
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
"""rad^2; no angle deviates by more than pi, so a larger median is in degrees or no variance."""

FACING_TOLERANCE = 1e-3
"""Cosine of the angle between ray and normal up to which a normal may look away: rounding, as in
:data:`~mpsfm_core.data.UNIT_NORMAL_TOLERANCE`."""


def run_depth(spec: ProviderSpec, provider: DepthProvider, view: View) -> DepthPrior:
    """Predict the depth of a view."""
    with provider_errors(spec, view.name):
        return validate_depth(spec, view, provider.predict(view))


def run_joint(
    spec: ProviderSpec, provider: JointProvider, view: View
) -> tuple[DepthPrior, NormalPrior]:
    """Predict depth and normals of a view in one pass."""
    with provider_errors(spec, view.name):
        answer = provider.predict_joint(view)
        if not (isinstance(answer, tuple) and len(answer) == 2):
            raise DataError("output", f"must be (depth, normals), got {_type(answer)}")
        return validate_depth(spec, view, answer[0]), validate_normals(spec, view, answer[1])


def run_focal(spec: ProviderSpec, provider: FocalEstimator, view: View) -> float | None:
    """Estimate the focal length of a view in its pixels; None where the provider cannot tell."""
    with provider_errors(spec, view.name):
        focal = provider.estimate_focal(view)
        if focal is None:
            return None
        if not (isinstance(focal, (int, float, np.number)) and 0 < focal < np.inf):
            raise DataError("focal", f"must be a positive number of pixels, got {focal!r}")
        return float(focal)


def run_normals(
    spec: ProviderSpec, provider: NormalsProvider, view: View, depth: DepthPrior | None = None
) -> NormalPrior:
    """Predict the normals of a view; ``depth`` is handed on when the spec says ``needs-depth``."""
    given = depth if "needs-depth" in spec.capabilities else None
    with provider_errors(spec, view.name):
        return validate_normals(spec, view, provider.predict(view, given))


def run_multiview(
    spec: ProviderSpec, provider: MultiViewProvider, views: Sequence[View]
) -> MultiViewPrior:
    """Predict the depth of a group of views."""
    with provider_errors(spec, _group_name(views)):
        return validate_multiview(spec, views, provider.predict_group(tuple(views)))


def run_features(spec: ProviderSpec, provider: FeatureProvider, view: View) -> Features:
    """Detect and describe the features of a view."""
    with provider_errors(spec, view.name):
        return validate_features(spec, view, provider.extract(view))


def run_matcher(
    spec: ProviderSpec,
    provider: Matcher,
    views: tuple[View, View],
    features: tuple[Features, Features] | None = None,
) -> PairMatches:
    """Match two views; ``features`` are handed on when the spec says ``sparse``."""
    given = features if features and "sparse" in spec.capabilities else (None, None)
    with provider_errors(spec, _pair_name(views)):
        return validate_matches(spec, views, features, provider.match(*views, *given))


def run_retrieval(spec: ProviderSpec, provider: RetrievalProvider, view: View) -> Float32:
    """Describe a view by one vector."""
    with provider_errors(spec, view.name):
        return validate_retrieval(spec, view, provider.describe(view))


def run_mask(spec: ProviderSpec, provider: MaskProvider, view: View) -> Bool:
    """Which pixels of a view may be used."""
    with provider_errors(spec, view.name):
        return validate_mask(spec, view, provider.mask(view))


def validate_depth(spec: ProviderSpec, view: View, output: object) -> DepthPrior:
    """Rules: type and values of :class:`DepthPrior`; not empty; metric and with a variance where
    the spec promises that."""
    with _rules(spec, view.name):
        return _check_depth(spec, output, "depth")


def validate_normals(spec: ProviderSpec, view: View, output: object) -> NormalPrior:
    """Rules: type and values of :class:`NormalPrior`; not empty; facing the camera; with a
    variance where the spec of a normals provider promises that, and that in rad^2."""
    with _rules(spec, view.name):
        prior = _checked(output, NormalPrior, "normals")
        _not_empty(prior.shape, "normals")
        _facing(prior, view.camera)
        if prior.variance is None:
            if spec.kind == "normals":
                _promised(spec, "variance", "variance")
        elif prior.valid.any():
            median = float(np.median(prior.variance[prior.valid]))
            if median > MAX_MEDIAN_NORMAL_VARIANCE:
                raise DataError("variance", f"must be in rad^2, the median is {median:.3g}")
        return prior


def validate_multiview(spec: ProviderSpec, views: Sequence[View], output: object) -> MultiViewPrior:
    """Rules: type and values of :class:`MultiViewPrior`; one prior a view, each as for depth; poses and
    intrinsics where the spec promises them."""
    with _rules(spec, _group_name(views)):
        group = _checked(output, MultiViewPrior, "output")
        if not isinstance(group.depth, tuple) or len(group.depth) != len(views):
            found = len(group.depth) if isinstance(group.depth, tuple) else _type(group.depth)
            raise DataError("depth", f"must be a tuple of {len(views)} priors, got {found}")
        for prior in group.depth:
            _check_depth(spec, prior, "depth")
        if group.poses is None:
            _promised(spec, "proposes-poses", "poses")
        if group.intrinsics is None:
            _promised(spec, "proposes-intrinsics", "intrinsics")
        return group


def validate_features(spec: ProviderSpec, view: View, output: object) -> Features:
    """Rules: type and values of :class:`Features`; keypoints inside of the view."""
    with _rules(spec, view.name):
        features = _checked(output, Features, "features")
        _inside(features.keypoints, view.camera, "keypoints")
        return features


def validate_matches(
    spec: ProviderSpec,
    views: tuple[View, View],
    features: tuple[Features, Features] | None,
    output: object,
) -> PairMatches:
    """Rules: type and values of :class:`PairMatches`; sparse indices within the features, dense
    points inside of the views; everything that the spec promises is there."""
    with _rules(spec, _pair_name(views)):
        matches = _checked(output, PairMatches, "matches")
        for capability in ("sparse", "dense"):
            if getattr(matches, capability) is None:
                _promised(spec, capability, capability)
        if matches.sparse is not None:
            _check_sparse(matches.sparse, features)
        if matches.dense is not None:
            _checked(matches.dense, DenseMatches, "dense")
            _inside(matches.dense.points_a, views[0].camera, "points_a")
            _inside(matches.dense.points_b, views[1].camera, "points_b")
        if matches.depth is None:
            _promised(spec, "pair-depth", "depth")
        else:
            depth = _checked(matches.depth, PairDepth, "depth")
            _check_depth(spec, depth.depth_a, "depth_a")
            _check_depth(spec, depth.depth_b, "depth_b")
        return matches


def validate_retrieval(spec: ProviderSpec, view: View, output: object) -> Float32:
    """Rules: (d,) float32 with d > 0, finite."""
    with _rules(spec, view.name):
        vector = _array(output, "descriptor", np.dtype(np.float32), 1)
        _not_empty(vector.shape, "descriptor")
        if not np.isfinite(vector).all():
            raise DataError("descriptor", "must be finite")
        return vector


def validate_mask(spec: ProviderSpec, view: View, output: object) -> Bool:
    """Rules: (H, W) bool on the grid of the view."""
    with _rules(spec, view.name):
        mask = _array(output, "mask", np.dtype(np.bool_), 2)
        expected = (view.camera.height, view.camera.width)
        if mask.shape != expected:
            raise DataError("mask", f"must have the view's shape {expected}, got {mask.shape}")
        return mask


@contextmanager
def provider_errors(spec: ProviderSpec, image: str) -> Iterator[None]:
    """Turn any exception of a provider into one that names provider and image.

    Errors that are ours already (missing weights, unreadable files) pass unchanged, as they say
    what to do.
    """
    with _rules(spec, image):
        try:
            yield
        except MpsfmError:
            raise
        except MemoryError as error:
            text = f"provider {spec.name!r}, image {image!r}: out of memory"
            raise ProviderRunError(f"{text}; reduce the size of images or workers") from error
        except (Exception, SystemExit) as error:
            text = f"provider {spec.name!r}, image {image!r}: {type(error).__name__}: {error}"
            raise ProviderRunError(text) from error


@contextmanager
def _rules(spec: ProviderSpec, image: str) -> Iterator[None]:
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


def _checked(output: object, expected: type[Checked], field: str) -> Checked:
    if not isinstance(output, expected):
        raise DataError(field, f"must be a {expected.__name__}, got {_type(output)}")
    return replace(output)  # runs the checks of the type again


def _check_depth(spec: ProviderSpec, output: object, field: str) -> DepthPrior:
    prior = _checked(output, DepthPrior, field)
    _not_empty(prior.shape, field)
    if not prior.metric:
        _promised(spec, "metric", field)
    if prior.variance is None:
        _promised(spec, "variance", "variance")
    return prior


def _facing(prior: NormalPrior, camera: PinholeCamera) -> None:
    away = (dot_with_rays(camera, prior.normals) > FACING_TOLERANCE)[prior.valid]
    if away.any():
        share = f"{100 * away.mean():.3g} % of the valid pixels"
        raise DataError("normals", f"must face the camera (n . ray < 0), not so at {share}")


def _check_sparse(sparse: SparseMatches, features: tuple[Features, Features] | None) -> None:
    _checked(sparse, SparseMatches, "sparse")
    if features is None:
        raise DataError("sparse", "must be absent, as there are no features")
    for column, (name, available) in enumerate(zip("ab", features, strict=True)):
        largest = int(sparse.indices[:, column].max(initial=-1))
        if largest >= len(available):
            text = f"must be below {len(available)}, the features of view {name}, got {largest}"
            raise DataError("indices", text)


def _promised(spec: ProviderSpec, capability: str, field: str) -> None:
    """Raise for something that is absent if the specification promises it."""
    if capability in spec.capabilities:
        raise DataError(field, f"lacks what the specification declares: {capability!r}")


def _inside(points: Float64, camera: PinholeCamera, field: str) -> None:
    outside = ((points < 0) | (points > camera.size)).any(axis=1)
    if outside.any():
        x, y = points[outside][0]
        size = f"{camera.width}x{camera.height}"
        raise DataError(field, f"must lie inside of the {size} view, got ({x:.2f}, {y:.2f})")


def _not_empty(shape: tuple[int, ...], field: str) -> None:
    if 0 in shape:
        raise DataError(field, f"must not be empty, has shape {shape}")


def _array(output: object, field: str, dtype: np.dtype[Any], dimensions: int) -> NDArray[Any]:
    if not isinstance(output, np.ndarray):
        raise DataError(field, f"must be a numpy array, got {_type(output)}")
    if output.dtype != dtype or output.ndim != dimensions:
        wanted = f"{dimensions}-dimensional {dtype}"
        raise DataError(field, f"must be a {wanted} array, got {output.dtype} {output.shape}")
    return output


def _pair_name(views: tuple[View, View]) -> str:
    return f"{views[0].name} - {views[1].name}"


def _group_name(views: Sequence[View]) -> str:
    return ", ".join(view.name for view in views)


def _type(value: object) -> str:
    return type(value).__name__
