"""Marginal variances of refined log depth, the diagonal of an inverse grid operator.

The algorithm is selected inversion by nested dissection (George, 1973). The operator is a sparse
matrix with a five-point stencil on the pixel grid. Separator lines halve the grid until small
blocks remain. Block elimination proceeds bottom-up, from the small blocks to the separators. Each
elimination leaves a dense Schur complement on the boundary of the eliminated part. A top-down pass
then computes the entries of the inverse matrix on the boundaries of grid parts. Grid parts of equal
size are processed together as stacked dense matrices. Selected inversion for n pixels takes
O(n^1.5) operations and O(n log n) memory.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from mpsfm_core.data import Float32, Float64, Int64

_BLOCK_SIDE = 6
"""Maximum side in pixels of a grid block that is not divided further. [ours]"""

_Pixel = tuple[int, int]


class _Part(NamedTuple):
    """Size of a rectangular part of the pixel grid, and True for sides that adjoin other parts."""

    height: int
    width: int
    top: bool = False
    bottom: bool = False
    left: bool = False
    right: bool = False


class _Child(NamedTuple):
    """Parts of equal shape that result from dividing the equally shaped parts of a group."""

    group: int
    """Index of the group that contains the smaller parts."""
    members: slice
    """Indices of the smaller parts in their group."""
    where: Int64
    """Indices of the boundary pixels of a smaller part in the list of inner and outer pixels of the
    divided part."""


class _Group(NamedTuple):
    """Group of rectangular grid parts with equal shape, which are processed together."""

    origins: Int64
    """(m, 2) row and column of the top left pixel of each part of the group."""
    inner: list[_Pixel]
    """Pixels that are eliminated, relative to the top left pixel of the grid part."""
    outer: list[_Pixel]
    """Boundary pixels around the grid part, relative to the top left pixel of the part."""
    children: list[_Child]
    """Smaller parts into which the parts of the group are divided, empty if the group is not
    divided."""


class _Elimination(NamedTuple):
    """Inverse blocks from eliminating the inner pixels of equally shaped grid parts."""

    inverse: Float64
    """(m, s, s) inverses of the blocks of inner pixels."""
    gain: Float64
    """(m, s, b) products of each inverse block with the matrix block between inner and outer
    pixels."""


def compute_inverse_diagonal(east: Float32, south: Float32, mass: Float32) -> Float64:
    """Compute the diagonal of the inverse of a five-point grid operator.

    Args:
        east: (h, w) coupling weights between each pixel and the next pixel to the right.
        south: (h, w) coupling weights between each pixel and the next pixel below.
        mass: (h, w) mass of each pixel, which is added to the diagonal. Every connected set of
            pixels requires a positive mass.

    Returns:
        (h, w) float64 variances, infinite for pixels without couplings and mass.
    """
    planes = np.zeros((2, mass.shape[0] + 1, mass.shape[1] + 1))
    planes[0, :-1, :-2] = east[:, :-1]
    planes[1, :-2, :-1] = south[:-1]
    # Index -1 of `plane` wraps to the last row or column, whose couplings are zero.
    diagonal = sum(plane + np.roll(plane, 1, 1 - axis) for axis, plane in enumerate(planes))
    diagonal = diagonal[:-1, :-1] + mass
    detached = diagonal == 0
    diagonal[detached] = 1
    groups = _dissect(*mass.shape)
    with threadpool_limits(1, "blas"):
        eliminations = _eliminate(groups, planes, diagonal)
        variance = _recover(groups, eliminations, mass.shape)
    variance[detached] = np.inf
    return variance


def _dissect(height: int, width: int) -> list[_Group]:
    """Dissect the pixel grid recursively, and group parts of equal shape."""
    groups: list[_Group] = []
    level = {_Part(height, width): [np.zeros((1, 2), np.int64)]}
    while level:
        first_below = len(groups) + len(level)
        below: dict[_Part, list[Int64]] = {}
        for part, blocks in level.items():
            origins = np.concatenate(blocks)
            inner, halves = _halve(part)
            outer = _surrounding(part)
            index = {pixel: k for k, pixel in enumerate(inner + outer)}
            children = []
            for (row, column), half in halves:
                siblings = below.setdefault(half, [])
                first = sum(map(len, siblings))
                siblings.append(origins + np.array([row, column]))
                children.append(
                    _Child(
                        first_below + list(below).index(half),
                        slice(first, first + len(origins)),
                        np.array([index[row + r, column + c] for r, c in _surrounding(half)]),
                    )
                )
            groups.append(_Group(origins, inner, outer, children))
        level = below
    return groups


def _halve(part: _Part) -> tuple[list[_Pixel], list[tuple[_Pixel, _Part]]]:
    """Return the separator pixels of a grid part, and offsets and shapes of its two halves."""
    height, width = part.height, part.width
    if max(height, width) <= _BLOCK_SIDE:
        return [(r, c) for r in range(height) for c in range(width)], []
    if width >= height:
        line = (width - 1) // 2
        halves = [
            ((0, 0), part._replace(width=line, right=True)),
            ((0, line + 1), part._replace(width=width - line - 1, left=True)),
        ]
        return [(r, line) for r in range(height)], halves
    line = (height - 1) // 2
    halves = [
        ((0, 0), part._replace(height=line, bottom=True)),
        ((line + 1, 0), part._replace(height=height - line - 1, top=True)),
    ]
    return [(line, c) for c in range(width)], halves


def _surrounding(part: _Part) -> list[_Pixel]:
    """Return the pixels outside a part of the grid that adjoin the part."""
    rows, columns = range(part.height), range(part.width)
    return (
        [(-1, c) for c in columns if part.top]
        + [(part.height, c) for c in columns if part.bottom]
        + [(r, -1) for r in rows if part.left]
        + [(r, part.width) for r in rows if part.right]
    )


def _eliminate(groups: list[_Group], planes: Float64, diagonal: Float64) -> list[_Elimination]:
    """Eliminate the inner pixels of all grid parts, from small parts to the whole grid."""
    eliminations: dict[int, _Elimination] = {}
    remainders: dict[int, Float64] = {}
    for number in reversed(range(len(groups))):
        group = groups[number]
        count, size = len(group.inner), len(group.inner) + len(group.outer)
        front = np.zeros((len(group.origins), size, size))
        for child in group.children:
            front[:, child.where[:, None], child.where] += remainders[child.group][child.members]
        _add_stencil(front, group, planes, diagonal)
        coupling = front[:, :count, count:]
        inverse = np.linalg.inv(front[:, :count, :count]).astype(np.float64, copy=False)
        gain = inverse @ coupling
        remainders[number] = front[:, count:, count:] - coupling.swapaxes(1, 2) @ gain
        eliminations[number] = _Elimination(inverse, gain)
    return [eliminations[number] for number in range(len(groups))]


def _add_stencil(front: Float64, group: _Group, planes: Float64, diagonal: Float64) -> None:
    """Add the grid operator's rows of inner pixels to the dense matrix of a grid part."""
    index = {pixel: k for k, pixel in enumerate(group.inner + group.outer)}
    rows, columns = group.origins.T
    for k, (r, c) in enumerate(group.inner):
        front[:, k, k] += diagonal[rows + r, columns + c]
        for axis, neighbor, (dr, dc) in (
            (0, (r, c + 1), (r, c)),
            (0, (r, c - 1), (r, c - 1)),
            (1, (r + 1, c), (r, c)),
            (1, (r - 1, c), (r - 1, c)),
        ):
            if neighbor in index:
                front[:, k, index[neighbor]] -= planes[axis, rows + dr, columns + dc]


def _recover(
    groups: list[_Group], eliminations: list[_Elimination], shape: tuple[int, int]
) -> Float64:
    """Compute the variances of inner pixels from boundary covariances, top-down."""
    variance = np.empty(shape)
    around = [np.empty((len(g.origins), len(g.outer), len(g.outer))) for g in groups]
    for group, (inverse, gain), outer in zip(groups, eliminations, around, strict=True):
        cross = -gain @ outer
        inner = inverse - cross @ gain.swapaxes(1, 2)
        rows, columns = (group.origins[:, None] + np.array(group.inner)).transpose(2, 0, 1)
        variance[rows, columns] = inner.diagonal(0, 1, 2)
        if group.children:
            joint = np.block([[inner, cross], [cross.swapaxes(1, 2), outer]])
            for child in group.children:
                around[child.group][child.members] = joint[:, child.where[:, None], child.where]
    return variance
