"""Leveling of the color differences at the seams of a texture.

Each vertex of each chart gets a color offset, which is smooth within the chart and makes the colors
of neighboring charts equal at their seam [Waechter, Moehrle and Goesele, Let There Be Color, ECCV
2014, section 4.2]. The offsets also correct the exposure and white balance of photos.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import cg
from threadpoolctl import threadpool_limits

from mpsfm_core.data import Float32, Float64, Int64

_SMOOTHNESS = 0.1
"""Weight of offset differences along the edges of a chart [value of Waechter et al.]."""
_MAGNITUDE = 1e-4
"""Weight of the offsets, which fixes the mean color."""
_RELATIVE_RESIDUAL = 1e-4
"""Relative residual at which the conjugate gradients stop, far below one gray value at seams."""
_MAX_ITERATIONS = 500


def level_seams(colors: Float64, vertices: Int64, triangles: Int64) -> Float32:
    """Compute color offsets that make the colors of charts equal at their seams.

    Args:
        colors: (k, 3) color of each corner, a vertex of one chart.
        vertices: (k,) number of the mesh vertex of each corner. Corners of one mesh vertex are on a
            seam.
        triangles: (m, 3) corner indices.

    Returns:
        Offset (k, 3) float32 of the color of each corner, in the unit of ``colors``.
    """
    count = len(colors)
    order = np.argsort(vertices, kind="stable")
    same = vertices[order[1:]] == vertices[order[:-1]]
    first, second = order[:-1][same], order[1:][same]
    starts, ends = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    matrix = (
        _laplacian(first, second, count)
        + _SMOOTHNESS * _laplacian(starts, ends, count)
        + _MAGNITUDE * diags_array(np.ones(count))
    ).tocsr()
    difference = colors[first] - colors[second]
    offsets = np.zeros((count, 3), np.float32)
    preconditioner = diags_array(1 / matrix.diagonal())
    # The dot products of conjugate gradients are so short that threads of BLAS mostly wait.
    with threadpool_limits(1, user_api="blas"):
        for channel in range(3):
            right = np.bincount(second, difference[:, channel], count)
            right -= np.bincount(first, difference[:, channel], count)
            offsets[:, channel], _ = cg(
                matrix,
                right,
                rtol=_RELATIVE_RESIDUAL,
                maxiter=_MAX_ITERATIONS,
                M=preconditioner,
            )
    return offsets


def _laplacian(first: Int64, second: Int64, count: int) -> csr_array:
    """Build the matrix of the sum of squared differences between pairs of values."""
    values = np.repeat((1.0, 1.0, -1.0, -1.0), len(first))
    rows = np.concatenate([first, second, first, second])
    columns = np.concatenate([first, second, second, first])
    return coo_array((values, (rows, columns)), shape=(count, count)).tocsr()
