"""Maximum-likelihood fit of a std ``max_j(theta_j * term_j)`` to errors.

The likelihood is a mixture of inlier errors and gross errors. An inlier error has a Student t
distribution with the modeled variance plus the variance of the truth. Errors of networks have
heavier tails than a normal distribution. A gross error is uniform up to the largest possible error;
the ratio of gross errors is also fitted. The maximum of the likelihood determines the ratios
between the factors ``theta_j``. The common scale of the factors is set such that 68.27 % of the
inlier errors are within one std. All images have equal weight in the likelihood.

The paper chose the factors of appendix C from calibration plots and the area under sensitivity
curves. The likelihood rewards a correct ranking and a correct size of the std.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.special import gamma
from scipy.stats import t as student_t

from mpsfm_core.calibration.samples import Residuals
from mpsfm_core.data import Bool, Float64, Int64
from mpsfm_core.geometry.statistics import MAD_TO_STD, weighted_quantile

ONE_SIGMA = 0.6827
"""Probability that a normally distributed error is within one std."""
FREEDOM = 4.0
"""Degrees of freedom of the Student t distribution [Lange, Little & Taylor, JASA 1989]."""
MAX_GROSS = 0.5
"""Maximum ratio of gross errors in the mixture."""
DOMINANT_SHARE = 0.01
"""Minimum ratio of samples for which a term is the largest, so that the data determine its factor
[ours]."""
STD_OF_T = float(student_t(FREEDOM).ppf(0.5 + ONE_SIGMA / 2))
"""Quantile of the t distribution with the coverage of one std of a normal distribution."""
_NORMALISER = gamma(0.5 * (FREEDOM + 1)) / gamma(0.5 * FREEDOM) / np.sqrt(FREEDOM * np.pi)
_RESTARTS = 5
_SMALLEST_GAIN = 1e-6
_RANGE = 1e4
"""Bound of the ratio between a std factor and the factor that is fitted if its term is the only
one."""


@dataclass(frozen=True, eq=False)
class StdFit:
    """Fitted model of the std, the maximum of m scaled terms."""

    names: tuple[str, ...]
    """Names of the m terms of the modeled std."""
    values: Float64
    """(m,) fitted factors ``theta_j`` of the std terms."""
    edge_ratio: float | None
    """Minimum ratio of neighboring depths at a depth edge, or None for a model without edges."""
    edge_scale: float
    """Factor by which the std is larger at depth edges."""
    gross: float
    """Ratio of gross errors in the mixture."""
    shares: Float64
    """(m,) ratio of samples for which each term is the largest."""
    limits: Float64
    """(m,) std factors below which a term is rarely the largest, so that the data do not determine
    the factor."""
    log_density: Float64
    """(images,) mean log density of the errors of each image."""


def fit_std(
    residuals: Residuals, names: Sequence[str] | None = None, edge_ratio: float | None = None
) -> StdFit:
    """Fit the factors of the std terms and of depth edges to errors.

    Args:
        residuals: Errors and terms.
        names: Names of the std terms to fit; all terms by default.
        edge_ratio: Minimum ratio of neighboring depths at a depth edge, or None to fit no edge
            factor.
    """
    problem = _Problem(residuals, tuple(names or residuals.names), edge_ratio)
    best = min((problem.solve(start) for start in problem.starts()), key=lambda found: found[1])
    return problem.finish(best[0])


def bootstrap_fit(
    residuals: Residuals, fit: StdFit, count: int, rng: np.random.Generator
) -> Float64:
    """Repeat a fit of the std on bootstrap samples of images.

    Returns:
        (count, m + 1) factors of the terms and the edge factor for each bootstrap sample.
    """
    problem = _Problem(residuals, fit.names, fit.edge_ratio)
    start = problem.vector(fit)
    drawn = np.empty((count, len(fit.names) + 1))
    for row in drawn:
        chosen = rng.integers(residuals.images, size=residuals.images)
        repeats = np.bincount(chosen, minlength=residuals.images)
        again = problem.reweighted(repeats)
        found = again.finish(again.solve(start)[0])
        row[:-1], row[-1] = found.values, found.edge_scale
    return drawn


@dataclass(frozen=True, eq=False)
class _State:
    """Quantities of the likelihood and its gradient for n errors at one parameter vector."""

    largest: Int64
    """(n,) index of the largest std term of each sample."""
    variance: Float64
    """(n,) modeled variance of each error."""
    total: Float64
    """(n,) modeled variance plus the variance of the true value."""
    inlier: Float64
    """(n,) posterior probability that the error is an inlier."""
    log_density: Float64
    """(n,) log probability density of each error."""


class _Problem:
    """Maximum-likelihood problem of the std fit, solved by L-BFGS.

    The parameters are the logs of the term factors, the log of the edge factor (if any), and the
    logit of the gross error ratio relative to ``MAX_GROSS``.
    """

    def __init__(
        self, residuals: Residuals, names: tuple[str, ...], edge_ratio: float | None
    ) -> None:
        self._residuals = residuals
        self._names = names
        self._edge_ratio = edge_ratio
        self._terms = residuals.terms[:, [residuals.names.index(name) for name in names]]
        self._squared = residuals.error**2
        self._noise = residuals.noise**2
        self._edges: Bool = (
            np.zeros(len(residuals), dtype=np.bool_)
            if edge_ratio is None
            else residuals.step > np.log(edge_ratio)
        )
        self._uniform = 0.5 / residuals.limit
        self._weights = residuals.weights() / residuals.images
        self._alone = self._factors_alone()

    def reweighted(self, repeats: Int64) -> _Problem:
        """Return the fit problem with repeated images of a bootstrap sample."""
        other = copy(self)
        other._weights = self._weights * repeats[self._residuals.image]
        return other

    def starts(self) -> list[Float64]:
        """Return start parameters with equal std terms, and with each std term dominant in turn."""
        count = len(self._names)
        rest = [0.0] * (self._edge_ratio is not None) + [-2.0]
        mixes = [np.zeros(count)]
        if count > 1:
            mixes += [np.where(np.eye(count, dtype=np.bool_)[j], 0.0, -0.7) for j in range(count)]
        return [np.concatenate([self._alone + mix, rest]) for mix in mixes]

    def vector(self, fit: StdFit) -> Float64:
        """Convert a fit to the parameter vector of the optimization."""
        edges = [np.log(fit.edge_scale)] * (self._edge_ratio is not None)
        share = np.clip(fit.gross / MAX_GROSS, 1e-4, 1 - 1e-4)
        return np.concatenate([np.log(fit.values), edges, [np.log(share / (1 - share))]])

    def solve(self, start: Float64) -> tuple[Float64, float]:
        """Minimize the negative log likelihood, and return the parameters and the minimum."""
        span = np.log(_RANGE)
        bounds = [(v - span, v + span) for v in self._alone]
        bounds += [(0.0, span)] * (self._edge_ratio is not None) + [(-9.0, 9.0)]
        best = minimize(self._objective, start, jac=True, method="L-BFGS-B", bounds=bounds)
        # Restart L-BFGS, because its curvature estimate is wrong after another std term becomes the
        # largest.
        for _ in range(_RESTARTS):
            again = minimize(self._objective, best.x, jac=True, method="L-BFGS-B", bounds=bounds)
            gain = best.fun - again.fun
            best = again if gain > 0 else best
            if gain < _SMALLEST_GAIN:
                break
        return np.asarray(best.x), float(best.fun)

    def finish(self, vector: Float64) -> StdFit:
        """Scale all std factors to a coverage of 68.27 % within one std, and build the fit."""
        state = self._evaluate(vector)
        count = len(self._names)
        inside = np.maximum(self._squared - self._noise, 0) / state.variance
        squared = weighted_quantile(inside, self._weights * state.inlier, ONE_SIGMA)
        vector = vector.copy()
        vector[:count] += 0.5 * np.log(max(squared, 1e-12))
        state = self._evaluate(vector)
        shares = np.zeros(count)
        np.add.at(shares, state.largest, self._weights)
        density = state.log_density * self._residuals.weights()
        per_image = np.zeros(self._residuals.images)
        np.add.at(per_image, self._residuals.image, density)
        return StdFit(
            self._names,
            np.exp(vector[:count]),
            self._edge_ratio,
            float(np.exp(vector[count])) if self._edge_ratio is not None else 1.0,
            _gross(vector[-1]),
            shares / shares.sum(),
            self._limits(vector),
            per_image,
        )

    def _limits(self, vector: Float64) -> Float64:
        """Compute the factor below which each std term is rarely the largest, or infinity."""
        count = len(self._names)
        limits = np.full(count, np.inf)
        scaled = self._terms * np.exp(vector[:count])
        for j in range(count if count > 1 else 0):
            others = np.delete(scaled, j, axis=1).max(axis=1)
            limits[j] = weighted_quantile(others / self._terms[:, j], self._weights, DOMINANT_SHARE)
        return limits

    def _factors_alone(self) -> Float64:
        """Compute the log of each std factor from the median error, for its term alone."""
        spread = MAD_TO_STD * np.median(np.abs(self._residuals.error))
        values: Float64 = np.log(max(spread, 1e-9) / np.median(self._terms, axis=0))
        return values

    def _evaluate(self, vector: Float64) -> _State:
        count = len(self._names)
        scaled = self._terms * np.exp(vector[:count])
        largest = scaled.argmax(axis=1)
        variance = np.take_along_axis(scaled, largest[:, None], axis=1)[:, 0] ** 2
        if self._edge_ratio is not None:
            variance = np.where(self._edges, variance * np.exp(2 * vector[count]), variance)
        total = variance + self._noise
        gross = _gross(vector[-1])
        usual = _NORMALISER * STD_OF_T / np.sqrt(total)
        usual *= (1 + self._far(total)) ** (-0.5 * (FREEDOM + 1))
        density = (1 - gross) * usual + gross * self._uniform
        inlier = (1 - gross) * usual / density
        return _State(largest, variance, total, inlier, np.log(density))

    def _far(self, total: Float64) -> Float64:
        return self._squared * (STD_OF_T**2 / FREEDOM) / total

    def _objective(self, vector: Float64) -> tuple[float, Float64]:
        """Compute the negative mean log density and its gradient."""
        state, weights, count = self._evaluate(vector), self._weights, len(self._names)
        # Derivative of the log density by log std, through the variance.
        far = self._far(state.total)
        slope = weights * state.inlier * ((FREEDOM + 1) * far / (1 + far) - 1)
        slope *= state.variance / state.total
        gradient = np.zeros(len(vector))
        gradient[:count] = np.bincount(state.largest, weights=slope, minlength=count)
        if self._edge_ratio is not None:
            gradient[count] = slope[self._edges].sum()
        gross = _gross(vector[-1])
        chance = (1 - state.inlier) / gross - state.inlier / (1 - gross)
        gradient[-1] = (weights * chance).sum() * gross * (1 - gross / MAX_GROSS)
        return -float((weights * state.log_density).sum()), -gradient


def _gross(logit: float) -> float:
    """Convert the logit parameter to the ratio of gross errors."""
    return float(MAX_GROSS / (1 + np.exp(-logit)))
