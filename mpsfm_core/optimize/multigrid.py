"""Conjugate gradients with a black-box multigrid preconditioner on image grids.

The linear system has a symmetric positive definite matrix A on the pixels. The coefficients of A
are non-negative couplings between horizontal and vertical neighbors, and a non-negative mass per
pixel that is added to the diagonal::

    x' A x = sum east (x[i, j] - x[i, j+1])^2 + sum south (x[i, j] - x[i+1, j])^2 + sum mass x^2

Couplings jump by orders of magnitude at depth discontinuities, which breaks geometric multigrid.
Following black-box multigrid (Dendy, 1982), the interpolation is derived from the operator, and the
coarse operators are Galerkin products with nine-point stencils.

The smoother solves for whole rows and columns that the next coarser grid omits, because strips of
one pixel width have no coarse pixel. All arrays are double precision. Single precision would be too
inexact in regions with small mass behind depth discontinuities.

All arrays have a border of one zero pixel, so that no kernel branches at image borders.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Float32, Float64, Int64
from mpsfm_core.support import jit

_kernel, _helper = (
    jit.kernel(fastmath={"contract", "reassoc"}),
    jit.helper(fastmath={"contract", "reassoc"}),
)

SOLVED = 1e-10
"""Relative error of the solution below which only rounding errors remain."""
_TINY = 1e-30
"""Threshold below which a diagonal entry of the matrix is treated as zero."""
_PLANES, _FIRST_WEIGHTS = 19, 11
"""Number of arrays per multigrid level, and index of the first array of interpolation weights."""
_Squares = tuple[float, ...]
"""Couplings (6) and masses (4) of the four corner pixels of a coarse grid cell."""
_Corners = tuple[float, float, float, float]
_NO_SQUARES: _Squares = (0.0,) * 10


class LinearSolution(NamedTuple):
    """Solution of a linear system by conjugate gradients."""

    x: Float64
    """(h, w) float64 solution of the linear system."""
    iterations: int
    """Number of conjugate-gradient iterations."""
    relative_error: float
    """Residual norm ``sqrt(r' M r)`` with the preconditioner M, relative to the norm at x = 0."""


class _Level(NamedTuple):
    """Matrix and work arrays of a multigrid level, (h + 2, w + 2) with a border of one pixel.

    The arrays ``east``, ``south``, ``southeast`` and ``southwest`` contain the coupling of each
    pixel with the neighbor in this direction. On the finest level the diagonal couplings are zero.
    The array ``diagonal`` is the matrix diagonal, or 1 at pixels without coupling and mass. The
    arrays ``row_pivot`` and ``column_pivot`` are inverse pivots of the line smoother. The eight
    ``weights`` (8, h, w) interpolate three fine pixels per coarse pixel. A fine pixel on a coarse
    row has two weights (left, right), a fine pixel on a coarse column has two weights (top,
    bottom), and a fine pixel between both has four weights.
    """

    east: Float64
    south: Float64
    southeast: Float64
    southwest: Float64
    mass: Float64
    diagonal: Float64
    row_pivot: Float64
    column_pivot: Float64
    x: Float64
    rhs: Float64
    work: Float64
    weights: Float64


class Multigrid:
    """Multigrid-preconditioned conjugate-gradient solver for a fixed grid size.

    The solver is deterministic and single-threaded. The kernels of the solver release the GIL, so
    several solvers may run in threads, but threads must not share a solver.
    """

    def __init__(self, height: int, width: int) -> None:
        shapes = [(height, width)]
        while height > 1 or width > 1:
            height, width = (height + 1) // 2, (width + 1) // 2
            shapes.append((height, width))
        framed = np.array(shapes, dtype=np.int64) + 2
        first = np.concatenate([[0], np.cumsum(_PLANES * framed.prod(axis=1))])
        # A single array for all levels is large enough for huge memory pages.
        self._grids = _Grids(np.zeros(first[-1]), first, framed)
        self._levels = [_level(self._grids, number) for number in range(len(framed))]
        self._vectors = np.zeros((3, *self._levels[0].x.shape))

    def update(self, east: Float32, south: Float32, mass: Float32) -> None:
        """Set the coefficients of the linear system, and derive the matrices of all levels.

        The solution is zero at pixels without couplings and mass, where the right-hand side must be
        zero.

        Args:
            east: (h, w) non-negative couplings to the next pixel to the right. The couplings of the
                last column are ignored.
            south: (h, w) non-negative couplings to the next pixel below. The couplings of the last
                row are ignored.
            mass: (h, w) non-negative mass of each pixel, which is added to the matrix diagonal.
        """
        finest = self._levels[0]
        finest.east[1:-1, 1:-2] = east[:, :-1]
        finest.south[1:-2, 1:-1] = south[:-1]
        finest.mass[1:-1, 1:-1] = mass
        _derive_levels(self._grids)

    def solve(self, rhs: Float64, iterations: int, tolerance: float = 0.0) -> LinearSolution:
        """Solve ``A x = rhs`` (h, w) by preconditioned conjugate gradients from x = 0."""
        x, direction, _ = self._vectors
        x[:] = direction[:] = 0
        self._levels[0].rhs[1:-1, 1:-1] = rhs
        done, error = _conjugate_gradients(self._grids, self._vectors, iterations, tolerance)
        return LinearSolution(x[1:-1, 1:-1].copy(), done, error)


class _Grids(NamedTuple):
    """Memory of the arrays of all multigrid levels, the finest level first.

    The field ``first`` (n + 1,) is the start of each multigrid level in ``memory``. The field
    ``shapes`` (n, 2) contains the grid size of each level, including the border.
    """

    memory: Float64
    first: Int64
    shapes: Int64


@_helper
def _level(grids: _Grids, number: int) -> _Level:
    """Return the arrays of a multigrid level, which share the common memory."""
    height, width = grids.shapes[number]
    planes = grids.memory[grids.first[number] : grids.first[number + 1]]
    p = planes.reshape((_PLANES, height, width))
    # Each field is given explicitly, because numba cannot unpack an array into a named tuple.
    return _Level(
        p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8], p[9], p[10], p[_FIRST_WEIGHTS:]
    )


@_kernel
def _derive_levels(grids: _Grids) -> None:
    """Derive all multigrid levels from couplings and masses of the finest level."""
    last = len(grids.shapes) - 1
    for number in range(last):
        fine, coarse = _level(grids, number), _level(grids, number + 1)
        _prepare_smoother(fine)
        _derive_interpolation(fine, coarse)
        _coarsen(fine, coarse, number > 0)
    _prepare_smoother(_level(grids, last))


@_kernel
def _conjugate_gradients(
    grids: _Grids, vectors: Float64, iterations: int, tolerance: float
) -> tuple[int, float]:
    """Solve the linear system on the finest multigrid level by conjugate gradients.

    The residual of the linear system replaces the right-hand side in memory. The rows of
    ``vectors`` are x, the search direction p, and the product A p. The function returns the fields
    ``iterations`` and ``relative_error`` of :class:`LinearSolution`.
    """
    finest = _level(grids, 0)
    x, direction, image, residual = vectors[0], vectors[1], vectors[2], finest.rhs
    done, first, previous, product = np.int64(0), 0.0, 1.0, 0.0
    while done < iterations:
        _v_cycle(grids)
        product = _dot(residual, finest.x)
        if first == 0.0:
            first = product
        if not product > max(tolerance, SOLVED) ** 2 * first:
            break
        _turn(product / previous, finest.x, direction)
        curvature = _apply(finest, direction, image)
        if not curvature > 0:
            break
        _step(product / curvature, direction, image, x, residual)
        done, previous = done + 1, product
    error = np.sqrt(max(product, 0.0) / first) if first > 0 else 0.0
    return done, error


@_helper
def _v_cycle(grids: _Grids) -> None:
    """Approximate the solution of the linear system by a multigrid V-cycle."""
    last = len(grids.shapes) - 1
    for number in range(last):
        fine = _level(grids, number)
        _smooth(fine, number > 0, False)
        _restrict(fine, _level(grids, number + 1), number > 0)
    coarsest = _level(grids, last)
    coarsest.x[1, 1] = coarsest.rhs[1, 1] / coarsest.diagonal[1, 1]
    for number in range(last - 1, -1, -1):
        fine = _level(grids, number)
        _prolong(_level(grids, number + 1), fine)
        _smooth(fine, number > 0, True)


@_helper
def _prepare_smoother(level: _Level) -> None:
    """Compute the matrix diagonal and the pivots of the line smoother without cancellation."""
    east, south, southeast, southwest = level.east, level.south, level.southeast, level.southwest
    height, width = level.mass.shape
    above, rest, pivot = np.zeros(width), level.work, level.row_pivot
    for i in range(1, height - 1):
        for j in range(1, width - 1):
            diagonal = southeast[i, j] + southeast[i - 1, j - 1]
            diagonal += southwest[i, j] + southwest[i - 1, j + 1] + level.mass[i, j]
            horizontal, vertical = east[i, j] + east[i, j - 1], south[i, j] + south[i - 1, j]
            total = horizontal + vertical + diagonal
            level.diagonal[i, j] = total if total > _TINY else 1.0
            rest[i, j] = vertical + diagonal
            above[j] = _chain(above[j], south[i - 1, j], horizontal + diagonal)
            level.column_pivot[i, j] = _inverse(above[j] + max(south[i, j], 0.0))
    last = height - 2 - height % 2
    for first in range(2, height - 1, 8):
        a, b, c, d = _four_rows(first, last)
        p, q, r, s = 0.0, 0.0, 0.0, 0.0
        for j in range(1, width - 1):
            p = _chain(p, east[a, j - 1], rest[a, j])
            q = _chain(q, east[b, j - 1], rest[b, j])
            r = _chain(r, east[c, j - 1], rest[c, j])
            s = _chain(s, east[d, j - 1], rest[d, j])
            pivot[a, j], pivot[b, j] = p, q
            pivot[c, j], pivot[d, j] = r, s
        for k in range(first, min(first + 7, last + 1), 2):
            for j in range(1, width - 1):
                pivot[k, j] = _inverse(pivot[k, j] + max(east[k, j], 0.0))


@_helper
def _chain(stiffness: float, coupling: float, rest: float) -> float:
    """Return the next pivot in the elimination of a line, computed without cancellation."""
    coupling = max(coupling, 0.0)
    total: float = max(rest, 0.0) + coupling * stiffness * _inverse(coupling + stiffness)
    return total


@_helper
def _inverse(value: float) -> float:
    """Return the inverse of a value, or 0 for values below the threshold `_TINY`."""
    return 1.0 / value if value > _TINY else 0.0


@_helper
def _smooth(level: _Level, nine_point: bool, backward: bool) -> None:
    """Smooth by Gauss-Seidel over pixels, rows and columns, or in reverse order if ``backward``."""
    if backward:
        _relax_columns(level, nine_point)
        _relax_rows(level, nine_point)
        _relax_points(level, nine_point)
    else:
        _start_points(level)
        _relax_rows(level, nine_point)
        _relax_columns(level, nine_point)


@_helper
def _start_points(level: _Level) -> None:
    """Apply Jacobi relaxation from x = 0 to the pixels that the coarser grid contains."""
    x = level.x
    x[:] = 0
    for i in range(1, x.shape[0] - 1, 2):
        for j in range(1, x.shape[1] - 1, 2):
            x[i, j] = level.rhs[i, j] / level.diagonal[i, j]


@_helper
def _relax_points(level: _Level, nine_point: bool) -> None:
    """Apply Gauss-Seidel relaxation to the pixels that the coarser grid contains."""
    x, row = level.x, level.work[0]
    for i in range(1, x.shape[0] - 1, 2):
        _residual_row(level, i, nine_point, row)
        for j in range(1, x.shape[1] - 1, 2):
            x[i, j] += row[j] / level.diagonal[i, j]


@_helper
def _relax_rows(level: _Level, nine_point: bool) -> None:
    """Solve for each row that the coarser grid omits, four rows at a time for speed."""
    east, pivot, x, rows = level.east, level.row_pivot, level.x, level.work
    height, width = x.shape
    last = height - 2 - height % 2
    for first in range(2, height - 1, 8):
        a, b, c, d = _four_rows(first, last)
        for k in range(4):
            if first + 2 * k <= last:
                _residual_row(level, first + 2 * k, nine_point, rows[k])
        p, q, r, s = 0.0, 0.0, 0.0, 0.0
        for j in range(1, width - 1):
            # The elimination recurrence has only one multiply-add per pixel.
            p = rows[0, j] * pivot[a, j] + max(east[a, j - 1], 0.0) * pivot[a, j] * p
            q = rows[1, j] * pivot[b, j] + max(east[b, j - 1], 0.0) * pivot[b, j] * q
            r = rows[2, j] * pivot[c, j] + max(east[c, j - 1], 0.0) * pivot[c, j] * r
            s = rows[3, j] * pivot[d, j] + max(east[d, j - 1], 0.0) * pivot[d, j] * s
            rows[0, j], rows[1, j], rows[2, j], rows[3, j] = p, q, r, s
        p, q, r, s = 0.0, 0.0, 0.0, 0.0
        for j in range(width - 2, 0, -1):
            p = rows[0, j] + max(east[a, j], 0.0) * pivot[a, j] * p
            q = rows[1, j] + max(east[b, j], 0.0) * pivot[b, j] * q
            r = rows[2, j] + max(east[c, j], 0.0) * pivot[c, j] * r
            s = rows[3, j] + max(east[d, j], 0.0) * pivot[d, j] * s
            rows[0, j], rows[1, j], rows[2, j], rows[3, j] = p, q, r, s
        for k in range(4):
            if first + 2 * k <= last:
                for j in range(1, width - 1):
                    x[first + 2 * k, j] += rows[k, j]


@_helper
def _four_rows(first: int, last: int) -> tuple[int, int, int, int]:
    """Return the indices of four rows with step 2 from row ``first``, at most ``last``."""
    return first, min(first + 2, last), min(first + 4, last), min(first + 6, last)


@_helper
def _relax_columns(level: _Level, nine_point: bool) -> None:
    """Solve for each column that the coarser grid omits; loops over all columns vectorize."""
    south, pivot, x, change = level.south, level.column_pivot, level.x, level.work
    height, width = x.shape
    change[0] = 0
    for i in range(1, height - 1):
        _residual_row(level, i, nine_point, change[i])
        for j in range(1, width - 1):
            carried = max(south[i - 1, j], 0.0) * change[i - 1, j]
            change[i, j] = (change[i, j] + carried) * pivot[i, j]
    for i in range(height - 2, 0, -1):
        for j in range(1, width - 1):
            change[i, j] += max(south[i, j], 0.0) * pivot[i, j] * change[i + 1, j]
        for j in range(2, width - 1, 2):
            x[i, j] += change[i, j]


@_helper
def _residual_row(level: _Level, i: int, nine_point: bool, row: Float64) -> None:
    """Compute the residual ``rhs - A x`` of one pixel row."""
    east, south, southeast, southwest = level.east, level.south, level.southeast, level.southwest
    x = level.x
    for j in range(1, x.shape[1] - 1):
        center = level.rhs[i, j] - level.diagonal[i, j] * x[i, j]
        horizontal = east[i, j] * x[i, j + 1] + east[i, j - 1] * x[i, j - 1]
        row[j] = center + horizontal + south[i, j] * x[i + 1, j] + south[i - 1, j] * x[i - 1, j]
    if nine_point:
        for j in range(1, x.shape[1] - 1):
            falling = southeast[i, j] * x[i + 1, j + 1] + southeast[i - 1, j - 1] * x[i - 1, j - 1]
            rising = southwest[i, j] * x[i + 1, j - 1] + southwest[i - 1, j + 1] * x[i - 1, j + 1]
            row[j] += falling + rising


@_helper
def _restrict(fine: _Level, coarse: _Level, nine_point: bool) -> None:
    """Restrict the residual to the next coarser level by the transposed interpolation."""
    residual, weights = fine.work, coarse.weights
    for i in range(1, fine.x.shape[0] - 1):
        _residual_row(fine, i, nine_point, residual[i])
    residual[0] = 0
    for i in range(1, coarse.x.shape[0] - 1):
        r = 2 * i - 1
        for j in range(1, coarse.x.shape[1] - 1):
            c = 2 * j - 1
            total = residual[r, c]
            total += weights[0, i, j] * residual[r, c + 1]
            total += weights[1, i, j - 1] * residual[r, c - 1]
            total += weights[2, i, j] * residual[r + 1, c]
            total += weights[3, i - 1, j] * residual[r - 1, c]
            total += weights[4, i, j] * residual[r + 1, c + 1]
            total += weights[5, i, j - 1] * residual[r + 1, c - 1]
            total += weights[6, i - 1, j] * residual[r - 1, c + 1]
            total += weights[7, i - 1, j - 1] * residual[r - 1, c - 1]
            coarse.rhs[i, j] = total


@_helper
def _prolong(coarse: _Level, fine: _Level) -> None:
    """Add the interpolated correction of a coarse level to the next finer level."""
    weights, x = coarse.weights, coarse.x
    for i in range(1, x.shape[0] - 1):
        r = 2 * i - 1
        for j in range(1, x.shape[1] - 1):
            c = 2 * j - 1
            here, right, below, across = x[i, j], x[i, j + 1], x[i + 1, j], x[i + 1, j + 1]
            fine.x[r, c] += here
            fine.x[r, c + 1] += weights[0, i, j] * here + weights[1, i, j] * right
            fine.x[r + 1, c] += weights[2, i, j] * here + weights[3, i, j] * below
            top = weights[4, i, j] * here + weights[5, i, j] * right
            bottom = weights[6, i, j] * below + weights[7, i, j] * across
            fine.x[r + 1, c + 1] += top + bottom


@_helper
def _derive_interpolation(fine: _Level, coarse: _Level) -> None:
    """Derive the interpolation weights of black-box multigrid (Dendy 1982) from the matrix."""
    east, south, southeast, southwest = fine.east, fine.south, fine.southeast, fine.southwest
    weights = coarse.weights
    rows, columns = fine.x.shape[0] - 2, fine.x.shape[1] - 2
    for i in range(1, coarse.x.shape[0] - 1):
        r = 2 * i - 1
        for j in range(1, coarse.x.shape[1] - 1):
            c = 2 * j - 1
            if c < columns:
                left = east[r, c] + southwest[r, c + 1] + southeast[r - 1, c]
                right = east[r, c + 1] + southeast[r, c + 1] + southwest[r - 1, c + 2]
                weights[0, i, j], weights[1, i, j] = _shares(left, right, fine.mass[r, c + 1])
            if r < rows:
                top = south[r, c] + southeast[r, c - 1] + southwest[r, c + 1]
                bottom = south[r + 1, c] + southwest[r + 1, c] + southeast[r + 1, c]
                weights[2, i, j], weights[3, i, j] = _shares(top, bottom, fine.mass[r + 1, c])
    for i in range(1, coarse.x.shape[0] - 1):
        r = 2 * i
        for j in range(1, coarse.x.shape[1] - 1):
            c = 2 * j
            if r <= rows and c <= columns:
                inverse = 1.0 / fine.diagonal[r, c]
                top, bottom = south[r - 1, c] * inverse, south[r, c] * inverse
                left, right = east[r, c - 1] * inverse, east[r, c] * inverse
                weights[4, i, j] = (
                    southeast[r - 1, c - 1] * inverse
                    + top * weights[0, i, j]
                    + left * weights[2, i, j]
                )
                weights[5, i, j] = (
                    southwest[r - 1, c + 1] * inverse
                    + top * weights[1, i, j]
                    + right * weights[2, i, j + 1]
                )
                weights[6, i, j] = (
                    southwest[r, c] * inverse
                    + bottom * weights[0, i + 1, j]
                    + left * weights[3, i, j]
                )
                weights[7, i, j] = (
                    southeast[r, c] * inverse
                    + bottom * weights[1, i + 1, j]
                    + right * weights[3, i, j + 1]
                )


@_helper
def _shares(first: float, second: float, mass: float) -> tuple[float, float]:
    """Return the interpolation weights of the two coarse neighbors of a fine pixel.

    On coarse multigrid levels, couplings and masses can be negative. Strong couplings across a line
    can make a mass negative. Negative masses reduce the interpolation weights as positive masses of
    equal size do.
    """
    first, second = max(first, 0.0), max(second, 0.0)
    inverse = _inverse(first + second + abs(mass))
    return first * inverse, second * inverse


@_helper
def _coarsen(fine: _Level, coarse: _Level, nine_point: bool) -> None:
    """Compute the coarse matrix as Galerkin product, from the quadratic form of each cell."""
    weights = coarse.weights
    for plane in (coarse.east, coarse.south, coarse.southeast, coarse.southwest, coarse.mass):
        plane[:] = 0
    for i in range(1, coarse.x.shape[0] - 1):
        r = 2 * i - 1
        for j in range(1, coarse.x.shape[1] - 1):
            c = 2 * j - 1
            # Interpolation weights of the fine pixels of a cell from its four corners.
            c00, c01 = (1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0)
            c10, c11 = (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)
            top = (weights[0, i, j], weights[1, i, j], 0.0, 0.0)
            left = (weights[2, i, j], 0.0, weights[3, i, j], 0.0)
            right = (0.0, weights[2, i, j + 1], 0.0, weights[3, i, j + 1])
            bottom = (0.0, 0.0, weights[0, i + 1, j], weights[1, i + 1, j])
            middle = (weights[4, i, j], weights[5, i, j], weights[6, i, j], weights[7, i, j])

            q = _NO_SQUARES
            q = _add_mass(q, fine.mass[r, c], c00)
            q = _add_mass(q, fine.mass[r, c + 1], top)
            q = _add_mass(q, fine.mass[r + 1, c], left)
            q = _add_mass(q, fine.mass[r + 1, c + 1], middle)
            q = _add_coupling(q, fine.east[r, c], c00, top)
            q = _add_coupling(q, fine.east[r, c + 1], top, c01)
            q = _add_coupling(q, fine.east[r + 1, c], left, middle)
            q = _add_coupling(q, fine.east[r + 1, c + 1], middle, right)
            q = _add_coupling(q, fine.south[r, c], c00, left)
            q = _add_coupling(q, fine.south[r, c + 1], top, middle)
            q = _add_coupling(q, fine.south[r + 1, c], left, c10)
            q = _add_coupling(q, fine.south[r + 1, c + 1], middle, bottom)
            if nine_point:
                q = _add_coupling(q, fine.southeast[r, c], c00, middle)
                q = _add_coupling(q, fine.southeast[r, c + 1], top, right)
                q = _add_coupling(q, fine.southeast[r + 1, c], left, bottom)
                q = _add_coupling(q, fine.southeast[r + 1, c + 1], middle, c11)
                q = _add_coupling(q, fine.southwest[r, c + 1], top, left)
                q = _add_coupling(q, fine.southwest[r, c + 2], c01, middle)
                q = _add_coupling(q, fine.southwest[r + 1, c + 1], middle, c10)
                q = _add_coupling(q, fine.southwest[r + 1, c + 2], right, bottom)

            coarse.east[i, j] += q[0]
            coarse.east[i + 1, j] += q[1]
            coarse.south[i, j] += q[2]
            coarse.south[i, j + 1] += q[3]
            coarse.southeast[i, j] += q[4]
            coarse.southwest[i, j + 1] += q[5]
            coarse.mass[i, j] += q[6]
            coarse.mass[i, j + 1] += q[7]
            coarse.mass[i + 1, j] += q[8]
            coarse.mass[i + 1, j + 1] += q[9]


@_helper
def _add_mass(q: _Squares, mass: float, a: _Corners) -> _Squares:
    """Add a fine pixel's mass term to the six couplings and four masses of a coarse cell.

    The mass term is ``mass * (a . corners)^2`` with the interpolation weights ``a``. Positive
    masses are lumped to the corners, which avoids negative couplings at isolated large masses.
    Negative masses are added exactly, because lumping could make the coarse matrix indefinite.
    """
    a0, a1, a2, a3 = a[0], a[1], a[2], a[3]
    heavy, light = max(mass, 0.0), min(mass, 0.0)
    lumped = heavy * (abs(a0) + abs(a1) + abs(a2) + abs(a3))
    exact = light * (a0 + a1 + a2 + a3)
    return (
        q[0] - light * a0 * a1,
        q[1] - light * a2 * a3,
        q[2] - light * a0 * a2,
        q[3] - light * a1 * a3,
        q[4] - light * a0 * a3,
        q[5] - light * a1 * a2,
        q[6] + lumped * abs(a0) + exact * a0,
        q[7] + lumped * abs(a1) + exact * a1,
        q[8] + lumped * abs(a2) + exact * a2,
        q[9] + lumped * abs(a3) + exact * a3,
    )


@_helper
def _add_coupling(q: _Squares, coupling: float, a: _Corners, b: _Corners) -> _Squares:
    """Add the coupling term of two fine pixels, ``coupling * ((a - b) . corners)^2``, to a cell."""
    v0, v1, v2, v3 = a[0] - b[0], a[1] - b[1], a[2] - b[2], a[3] - b[3]
    total = v0 + v1 + v2 + v3
    return (
        q[0] - coupling * v0 * v1,
        q[1] - coupling * v2 * v3,
        q[2] - coupling * v0 * v2,
        q[3] - coupling * v1 * v3,
        q[4] - coupling * v0 * v3,
        q[5] - coupling * v1 * v2,
        q[6] + coupling * v0 * total,
        q[7] + coupling * v1 * total,
        q[8] + coupling * v2 * total,
        q[9] + coupling * v3 * total,
    )


@_helper
def _apply(level: _Level, x: Float64, image: Float64) -> float:
    """Compute the product ``A x`` on the finest multigrid level, and return ``x' A x``."""
    east, south, mass = level.east, level.south, level.mass
    curvature = 0.0
    for i in range(1, x.shape[0] - 1):
        for j in range(1, x.shape[1] - 1):
            here = x[i, j]
            value = mass[i, j] * here
            value += east[i, j] * (here - x[i, j + 1]) + east[i, j - 1] * (here - x[i, j - 1])
            value += south[i, j] * (here - x[i + 1, j]) + south[i - 1, j] * (here - x[i - 1, j])
            image[i, j] = value
            curvature += here * value
    return curvature


@_helper
def _step(length: float, direction: Float64, image: Float64, x: Float64, residual: Float64) -> None:
    """Move x along the conjugate-gradient search direction, and update the residual."""
    for i in range(1, x.shape[0] - 1):
        for j in range(1, x.shape[1] - 1):
            x[i, j] += length * direction[i, j]
            residual[i, j] -= length * image[i, j]


@_helper
def _turn(factor: float, preconditioned: Float64, direction: Float64) -> None:
    """Compute the next conjugate-gradient search direction."""
    for i in range(1, direction.shape[0] - 1):
        for j in range(1, direction.shape[1] - 1):
            direction[i, j] = preconditioned[i, j] + factor * direction[i, j]


@_helper
def _dot(a: Float64, b: Float64) -> float:
    """Return the dot product of two pixel arrays, without their borders."""
    total = 0.0
    for i in range(1, a.shape[0] - 1):
        for j in range(1, a.shape[1] - 1):
            total += a[i, j] * b[i, j]
    return total
