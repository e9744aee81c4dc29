"""Depth integration on torch: the steps of `integration_energy` and `multigrid`, array by array.

Same energy, same preconditioner, same steps, all in double precision, so that results agree with
the compiled kernels to rounding; lines are solved by parallel scans. Each level of the V-cycle is
some hundred small operations, whose launch a GPU can only hide on large maps; on a CPU the kernels
are faster.

Planes of a level are framed by zeros, one pixel at the top and left and two at the bottom and
right, so that all strided neighbours of all pixels exist.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from mpsfm_core.data import Float64
from mpsfm_core.optimize.integration_energy import EnergyTerms
from mpsfm_core.optimize.multigrid import SOLVED, Solution

_TINY = 1e-30
# Offset of a neighbour, and the plane and offset at which the coupling to it is stored.
_NEIGHBOURS = (
    ((0, 1), "east", (0, 0)),
    ((0, -1), "east", (0, -1)),
    ((1, 0), "south", (0, 0)),
    ((-1, 0), "south", (-1, 0)),
    ((1, 1), "southeast", (0, 0)),
    ((-1, -1), "southeast", (-1, -1)),
    ((1, -1), "southwest", (0, 0)),
    ((-1, 1), "southwest", (-1, 1)),
)
_Pair = tuple[int, int]
_Grid = tuple[_Pair, _Pair]  # first pixel and step
_Share = dict[int, Tensor]  # by corner of a cell: 0 and 1 above 2 and 3

_ALL: _Grid = ((0, 0), (1, 1))
# What the smoother solves: pixels that the next grid keeps, rows and columns that it leaves out.
_POINTS: _Grid = ((0, 0), (2, 2))
_ROWS: _Grid = ((1, 0), (2, 1))
_COLUMNS: _Grid = ((0, 1), (1, 2))


class TorchMajoriser(NamedTuple):
    """`integration_energy.Majoriser` on the device."""

    energy: float
    point_energy: float
    gradient: Tensor
    east: Tensor
    south: Tensor
    mass: Tensor


class TorchSolver:
    """Majorises the energy of one image and steps to the minimum of a majoriser."""

    def __init__(self, terms: EnergyTerms, device: str) -> None:
        def move(array: NDArray[Any]) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(array)).to(device)

        self._losses = terms.losses
        inner = (slice(None), slice(1, -1), slice(1, -1))
        normals = terms.normals
        self._slope, self._normal, self._weight = (
            move(plane[inner]).double() for plane in (normals.slope, normals.normal, normals.weight)
        )
        self._ahead = move(normals.link[inner])
        self._prior = move(terms.prior.log_depth)
        self._precision = move(terms.prior.precision).double()
        self._prior_weight = terms.prior.weight
        self._pixels = move(terms.points.rows * self._prior.shape[1] + terms.points.columns)
        self._targets = move(terms.points.log_depth)
        self._certainty = move(terms.points.precision)

    def majorise(self, z: Float64) -> TorchMajoriser:
        """Energy at log depth z (h, w), and the quadratic that touches it there."""
        here = torch.from_numpy(z).to(self._prior)
        along_x, east, flux_x = self._links(0, 1, here)
        along_y, south, flux_y = self._links(1, 0, here)
        energy = along_x + along_y
        gradient = flux_x.roll(1, 1) - flux_x + flux_y.roll(1, 0) - flux_y
        offset = here - self._prior
        scale = self._losses.prior_scale**2
        ratio = self._precision * offset**2 / scale
        root = (1 + ratio).sqrt()
        energy += float(2 * self._prior_weight * scale * (ratio / (root + 1)).sum())
        mass = self._prior_weight * self._precision / root
        gradient += mass * offset
        scale = self._losses.point_scale**2
        offset = here.flatten()[self._pixels] - self._targets
        ratio = self._certainty * offset**2 / scale
        of_points = float(scale * ratio.log1p().sum())
        weight = self._certainty / (1 + ratio)
        mass.view(-1).index_add_(0, self._pixels, weight)
        gradient.view(-1).index_add_(0, self._pixels, weight * offset)
        mean = of_points / max(len(self._pixels), 1)
        return TorchMajoriser(energy + of_points, mean, gradient, east, south, mass)

    def _links(self, axis: int, dim: int, z: Tensor) -> tuple[float, Tensor, Tensor]:
        """Energy of an axis; coupling and half the force between each pixel and the next."""
        k, limit = self._losses.sharpness, self._losses.normal_limit
        slope, normal, weight = self._slope[axis], self._normal[axis], self._weight[axis]
        difference = _difference(z, dim)
        has_ahead = self._ahead[axis]
        has_behind = has_ahead.roll(1, dim)
        ahead = slope * difference + normal
        behind = slope * difference.roll(1, dim) + normal
        exponents = torch.stack(
            [
                torch.where(has_ahead, -k * ahead**2, -torch.inf),
                torch.where(has_behind, -k * behind**2, -torch.inf),
                torch.full_like(ahead, -k * limit),
            ]
        )
        total = exponents.logsumexp(0)
        share = (exponents[:2] - total).exp()
        sides = has_ahead.double() + has_behind
        full = (sides + np.exp(-k * limit)).log()
        energy = float((weight * (full - total)).sum() / k)
        ahead_weight, behind_weight = weight * slope * share
        coupling = ahead_weight * slope + (behind_weight * slope).roll(-1, dim)
        return energy, coupling, ahead_weight * ahead + (behind_weight * behind).roll(-1, dim)

    def step(self, here: TorchMajoriser, iterations: int) -> Solution:
        """Preconditioned conjugate gradients from zero, as `multigrid.Multigrid.solve`."""
        levels = _build_levels(here.east, here.south, here.mass)
        residual = -here.gradient
        x, direction = torch.zeros_like(residual), torch.zeros_like(residual)
        first, previous, done = 0.0, 1.0, 0
        while done < iterations:
            preconditioned = _v_cycle(levels, residual)
            product = float((residual * preconditioned).sum())
            first = first or product
            if not product > SOLVED**2 * first:
                break
            direction = preconditioned + product / previous * direction
            image = here.mass * direction
            for coupling, dim in ((here.east, 1), (here.south, 0)):
                flux = coupling * _difference(direction, dim)
                image += flux.roll(1, dim) - flux
            curvature = float((direction * image).sum())
            if not curvature > 0:
                break
            length = product / curvature
            x, residual = x + length * direction, residual - length * image
            done, previous = done + 1, product
        return Solution(x.cpu().numpy(), done, float("nan"))


def _difference(z: Tensor, dim: int) -> Tensor:
    """The next pixel minus this one, and 0 at the end."""
    return pad(z.diff(dim=dim), (0, 1) if dim else (0, 0, 0, 1))


class _Lines(NamedTuple):
    """Tridiagonal systems along the last dimension, factored: inverse pivots and scan factors."""

    pivot: Tensor
    forward: list[Tensor]
    backward: list[Tensor]


class _Level(NamedTuple):
    """One grid with the diagonal (h, w), its neighbours' couplings, and how the next coarser grid
    interpolates it: shares of the pixels right of, below, and diagonally below the kept ones."""

    planes: dict[str, Tensor]
    diagonal: Tensor
    neighbours: tuple[tuple[_Pair, str, _Pair], ...]
    rows: _Lines
    columns: _Lines
    top: _Share
    left: _Share
    middle: _Share


def _framed(plane: Tensor) -> Tensor:
    return pad(plane, (1, 2, 1, 2))


def _every(framed: Tensor, offset: _Pair, pixels: _Grid = _ALL) -> Tensor:
    """The pixels (first, step) of the grid, seen moved by an offset."""
    (row, column), (down, across) = pixels
    height, width = framed.shape[0] - 3, framed.shape[1] - 3
    rows = slice(1 + row + offset[0], 1 + height + offset[0], down)
    return framed[rows, slice(1 + column + offset[1], 1 + width + offset[1], across)]


def _cells(framed: Tensor, row: int, column: int) -> Tensor:
    """For each kept pixel the one at an offset of -1 to 2, zero outside of the grid."""
    rows, columns = (framed.shape[0] - 2) // 2, (framed.shape[1] - 2) // 2
    return framed[1 + row :: 2, 1 + column :: 2][:rows, :columns]


def _next(plane: Tensor, down: int, across: int) -> Tensor:
    """The value of the next cell below or to the right, or of the one before if negative."""
    edges = (max(-across, 0), max(across, 0), max(-down, 0), max(down, 0))
    height, width = plane.shape
    padded = pad(plane, edges)
    return padded[max(down, 0) :, max(across, 0) :][:height, :width]


def _build_levels(east: Tensor, south: Tensor, mass: Tensor) -> list[_Level]:
    fine = {"east": east, "south": south, "mass": mass}
    planes = {name: _framed(plane) for name, plane in fine.items()}
    planes["southeast"] = planes["southwest"] = torch.zeros_like(planes["mass"])
    levels = [_prepare(planes, _NEIGHBOURS[:4])]
    while max(levels[-1].diagonal.shape) > 1:
        levels.append(_prepare(_coarsen(levels[-1]), _NEIGHBOURS))
    return levels


def _prepare(planes: dict[str, Tensor], neighbours: tuple[tuple[_Pair, str, _Pair], ...]) -> _Level:
    mass, couplings = (
        _every(planes["mass"], (0, 0)),
        [_every(planes[name], offset) for _, name, offset in neighbours],
    )
    diagonal = mass + sum(couplings)
    right, left, below, above = couplings[:4]
    oblique = mass + sum(couplings[4:])
    odd = slice(1, None, 2)
    rows = _factor(left[odd], right[odd], (above + below + oblique)[odd])
    columns = _factor(above.T[odd], below.T[odd], (left + right + oblique).T[odd])
    shares = _interpolation({**planes, "diagonal": _framed(diagonal)})
    detached = diagonal <= _TINY
    return _Level(planes, diagonal.masked_fill(detached, 1), neighbours, rows, columns, *shares)


def _factor(before: Tensor, after: Tensor, rest: Tensor) -> _Lines:
    """Lines (count, length) with couplings to the pixels before and after and other holds.

    Pivots are p[j] + after[j] with p[j] = rest[j] + 1 / (1 / before[j] + 1 / p[j - 1]): a chain of
    linear fractions with positive coefficients, hence a scan over 2 x 2 matrices.
    """
    before, after, rest = before.clamp(min=0), after.clamp(min=0), rest.clamp(min=_TINY)
    matrix = torch.stack([rest + before, rest * before, torch.ones_like(rest), before], -1)
    matrix = matrix.reshape(*rest.shape, 2, 2)
    shift = 1
    while shift < matrix.shape[1]:
        product = matrix[:, shift:] @ matrix[:, :-shift]
        product = product / product.amax((-2, -1), keepdim=True)
        matrix = torch.cat([matrix[:, :shift], product], 1)
        shift *= 2
    total = matrix[..., 0, 0] / matrix[..., 1, 0] + after
    pivot = torch.where(total > _TINY, 1 / total, 0.0)
    return _Lines(pivot, _powers(before * pivot), _powers((after * pivot).flip(1)))


def _powers(factor: Tensor) -> list[Tensor]:
    """Factors over 1, 2, 4 ... places for `_scan`."""
    powers, shift = [], 1
    while shift < factor.shape[1]:
        powers.append(factor)
        factor = factor * pad(factor[:, :-shift], (shift, 0))
        shift *= 2
    return powers


def _scan(powers: list[Tensor], values: Tensor) -> Tensor:
    """y[j] = values[j] + factor[j] y[j - 1] along the last dimension."""
    shift = 1
    for factor in powers:
        values = values + factor * pad(values[:, :-shift], (shift, 0))
        shift *= 2
    return values


def _interpolation(planes: dict[str, Tensor]) -> tuple[_Share, _Share, _Share]:
    def at(name: str, row: int, column: int) -> Tensor:
        return _cells(planes[name], row, column)

    top = _shares(
        at("east", 0, 0) + at("southwest", 0, 1) + at("southeast", -1, 0),
        at("east", 0, 1) + at("southeast", 0, 1) + at("southwest", -1, 2),
        at("mass", 0, 1),
    )
    left = _shares(
        at("south", 0, 0) + at("southeast", 0, -1) + at("southwest", 0, 1),
        at("south", 1, 0) + at("southwest", 1, 0) + at("southeast", 1, 0),
        at("mass", 1, 0),
    )
    right, bottom = [_next(w, 0, 1) for w in left], [_next(w, 1, 0) for w in top]
    north, south = at("south", 0, 1), at("south", 1, 1)
    west, east = at("east", 1, 0), at("east", 1, 1)
    corners = (
        at("southeast", 0, 0) + north * top[0] + west * left[0],
        at("southwest", 0, 2) + north * top[1] + east * right[0],
        at("southwest", 1, 1) + south * bottom[0] + west * left[1],
        at("southeast", 1, 1) + south * bottom[1] + east * right[1],
    )
    diagonal = at("diagonal", 1, 1)
    inverse = torch.where(diagonal > _TINY, 1 / diagonal, 0.0)
    middle = {corner: inverse * value for corner, value in enumerate(corners)}
    return {0: top[0], 1: top[1]}, {0: left[0], 2: left[1]}, middle


def _shares(first: Tensor, second: Tensor, mass: Tensor) -> tuple[Tensor, Tensor]:
    first, second = first.clamp(min=0), second.clamp(min=0)
    total = first + second + mass.abs()
    inverse = torch.where(total > _TINY, 1 / total, 0.0)
    return first * inverse, second * inverse


def _coarsen(level: _Level) -> dict[str, Tensor]:
    """The Galerkin product, a square of corner values for each coupling and mass of a cell."""
    one = torch.ones_like(level.top[0])
    corner = [{k: one} for k in range(4)]
    top, left, middle = level.top, level.left, level.middle
    right = {1: _next(left[0], 0, 1), 3: _next(left[2], 0, 1)}
    bottom = {2: _next(top[0], 1, 0), 3: _next(top[1], 1, 0)}
    nodes = {(0, 0): corner[0], (0, 1): top, (0, 2): corner[1], (1, 0): left, (1, 1): middle}
    nodes |= {(1, 2): right, (2, 0): corner[2], (2, 1): bottom, (2, 2): corner[3]}
    pairs = {(i, j): torch.zeros_like(one) for i in range(4) for j in range(i + 1, 4)}
    mass = [torch.zeros_like(one) for _ in range(4)]

    def add_square(weight: Tensor, shares: dict[int, Tensor]) -> None:
        total = torch.stack(list(shares.values())).sum(0)
        for k, share in shares.items():
            mass[k] += weight * share * total
        for (i, j), plane in pairs.items():
            if i in shares and j in shares:
                plane -= weight * shares[i] * shares[j]

    for row, column in ((0, 0), (0, 1), (1, 0), (1, 1)):
        weight, shares = _cells(level.planes["mass"], row, column), nodes[row, column]
        add_square(weight.clamp(max=0), shares)
        lumped = weight.clamp(min=0) * torch.stack(list(shares.values())).abs().sum(0)
        for k, share in shares.items():
            mass[k] += lumped * share.abs()
        for (down, across), name, _ in level.neighbours[::2]:
            # Couplings to the lower left are those of the pixel to the right.
            start = (row, column - min(across, 0))
            a, b = nodes[start], nodes[row + down, start[1] + across]
            ends = {k: a.get(k, 0 * one) - b.get(k, 0 * one) for k in {*a, *b}}
            add_square(_cells(level.planes[name], *start), ends)
    planes = {
        "east": pairs[0, 1] + _next(pairs[2, 3], -1, 0),
        "south": pairs[0, 2] + _next(pairs[1, 3], 0, -1),
        "southeast": pairs[0, 3],
        "southwest": _next(pairs[1, 2], 0, -1),
        "mass": mass[0] + _next(mass[1], 0, -1) + _next(mass[2], -1, 0) + _next(mass[3], -1, -1),
    }
    return {name: _framed(plane) for name, plane in planes.items()}


def _v_cycle(levels: list[_Level], rhs: Tensor) -> Tensor:
    """An approximate solution for rhs (h, w), as `multigrid.Multigrid._v_cycle`."""
    level = levels[0]
    if len(levels) == 1:
        return rhs / level.diagonal
    x = torch.zeros_like(_framed(rhs))
    for pixels in (_POINTS, _ROWS, _COLUMNS):
        _relax(level, x, rhs, pixels)
    residual = _residual(level, x, rhs, _ALL)
    correction = _v_cycle(levels[1:], _gather(level, residual))
    x[1:-2, 1:-2] += _spread(level, correction)[: rhs.shape[0], : rhs.shape[1]]
    for pixels in (_COLUMNS, _ROWS, _POINTS):
        _relax(level, x, rhs, pixels)
    return x[1:-2, 1:-2]


def _residual(level: _Level, x: Tensor, rhs: Tensor, pixels: _Grid) -> Tensor:
    (row, column), (down, across) = pixels
    grid = (slice(row, None, down), slice(column, None, across))
    total = rhs[grid] - level.diagonal[grid] * _every(x, (0, 0), pixels)
    for offset, name, stored in level.neighbours:
        total += _every(level.planes[name], stored, pixels) * _every(x, offset, pixels)
    return total


def _relax(level: _Level, x: Tensor, rhs: Tensor, pixels: _Grid) -> None:
    """Solve kept pixels one by one, or left-out lines as a whole."""
    change = _residual(level, x, rhs, pixels)
    if pixels == _POINTS:
        change /= level.diagonal[::2, ::2]
    else:
        lines = level.rows if pixels == _ROWS else level.columns
        change = change if pixels == _ROWS else change.T
        change = _scan(lines.backward, _scan(lines.forward, change * lines.pivot).flip(1)).flip(1)
        change = change if pixels == _ROWS else change.T
    _every(x, (0, 0), pixels).add_(change)


def _gather(level: _Level, residual: Tensor) -> Tensor:
    framed = _framed(residual)
    total = _cells(framed, 0, 0).clone()
    for node, share in (((0, 1), level.top), ((1, 0), level.left), ((1, 1), level.middle)):
        values = _cells(framed, *node)
        for corner, weight in share.items():
            total += _next(weight * values, -(corner // 2), -(corner % 2))
    return total


def _spread(level: _Level, coarse: Tensor) -> Tensor:
    fine = coarse.repeat_interleave(2, 0).repeat_interleave(2, 1)
    for (row, column), share in (((0, 1), level.top), ((1, 0), level.left), ((1, 1), level.middle)):
        values = [_next(coarse, k // 2, k % 2) * weight for k, weight in share.items()]
        fine[row::2, column::2] = torch.stack(values).sum(0)
    return fine
