"""Marginal variances: the exact diagonal of the inverse of a five-point grid operator.

The algorithm is selected inversion by nested dissection (George, 1973). Separator lines halve the
grid until small blocks remain. Blocks and then separators are eliminated bottom-up. Each
elimination leaves a dense Schur complement on the boundary of the eliminated part. A top-down pass
then computes the entries of the inverse on these boundaries. Parts of equal size are processed
together as stacked dense matrices. For n pixels this takes O(n^1.5) operations and O(n log n)
memory.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from mpsfm_core.data import Float32, Float64, Int64

_BLOCK_SIDE = 6
"""Maximum side in pixels of a block that is not divided. [ours, fastest of 3 to 12]"""

_Pixel = tuple[int, int]


class _Part(NamedTuple):
    """Rectangle of the grid: its size, and the sides on which it has neighbors."""

    height: int
    width: int
    top: bool = False
    bottom: bool = False
    left: bool = False
    right: bool = False


class _Child(NamedTuple):
    """One half of every part of a group, separated by a line of pixels."""

    group: int
    """Number of the group that contains the halves."""
    members: slice
    """Indices of the halves within their group."""
    where: Int64
    """Indices of the boundary pixels of a half among the inner and outer pixels of the part."""


class _Group(NamedTuple):
    """Parts of the grid that have equal shape."""

    origins: Int64
    """(m, 2) top left pixel of each part of the group."""
    inner: list[_Pixel]
    """Pixels that are eliminated, relative to the top left pixel of the part."""
    outer: list[_Pixel]
    """Boundary pixels around the part, relative to the top left pixel of the part."""
    children: list[_Child]
    """Two halves of each part, or no halves."""


class _Elimination(NamedTuple):
    """Result of the elimination of the inner pixels of the parts of a group."""

    inverse: Float64
    """(m, s, s) inverses of the blocks of inner pixels."""
    gain: Float64
    """(m, s, b) products of inverse block and coupling of inner to outer pixels."""


def compute_inverse_diagonal(east: Float32, south: Float32, mass: Float32) -> Float64:
    """Compute ``diag(A^-1)`` of the operator A that ``multigrid`` describes.

    Args:
        east: (h, w) couplings of each pixel to the next pixel to the right.
        south: (h, w) couplings of each pixel to the next pixel below.
        mass: (h, w) masses of the pixels. Every connected set of pixels needs a positive mass.

    Returns:
        (h, w) float64 variances, infinite for pixels without couplings and mass.
    """
    planes = np.zeros((2, mass.shape[0] + 1, mass.shape[1] + 1))
    planes[0, :-1, :-2] = east[:, :-1]
    planes[1, :-2, :-1] = south[:-1]
    # index -1 is the last row or column, which is zero
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
    """Dissect the grid into groups of parts, parents before children, beginning with the grid."""
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
    """Return the separator of a part, and the offsets and shapes of the separated halves."""
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
    """Return the boundary pixels around a part of the grid."""
    rows, columns = range(part.height), range(part.width)
    return (
        [(-1, c) for c in columns if part.top]
        + [(part.height, c) for c in columns if part.bottom]
        + [(r, -1) for r in rows if part.left]
        + [(r, part.width) for r in rows if part.right]
    )


def _eliminate(groups: list[_Group], planes: Float64, diagonal: Float64) -> list[_Elimination]:
    """Eliminate bottom-up, adding the Schur complement of each part to the matrix of its parent."""
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
    """Add the operator rows of the inner pixels to the matrix of a part."""
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
    """Recover variances top-down, from boundary covariances to those of the inner pixels."""
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
