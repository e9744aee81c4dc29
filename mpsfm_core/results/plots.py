"""Plots of images, matches, depth, cameras and residuals with matplotlib.

The plots need ``pip install "mpsfm-core[report]"``. Each plot function returns a matplotlib figure,
which a notebook shows and ``figure.savefig("FILE.png")`` writes.
"""

from __future__ import annotations

import numpy as np
import pycolmap
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mpsfm_core.data import DepthPrior, Float64, View
from mpsfm_core.data.errors import InputError
from mpsfm_core.extraction.match_graph import MatchGraph
from mpsfm_core.inputs.images import ImageSet

_MAX_LINES = 100
"""Maximum number of matches in a plot of two images."""
_MAX_POINTS = 20_000
"""Maximum number of 3D points in a plot of a model."""


def plot_matches(images: ImageSet, matches: MatchGraph, name_a: str, name_b: str) -> Figure:
    """Draw two images with their verified matches.

    Args:
        images: Images of the match graph.
        matches: Result of :func:`mpsfm_core.match_images`.
        name_a: Name of the left image.
        name_b: Name of the right image.

    Raises:
        InputError: the images ``name_a`` and ``name_b`` are no verified pair.

    Examples:
        >>> plots.plot_matches(images, matches, "view_0.jpg", "view_1.jpg")
    """
    verified = matches.verified
    if (name_a, name_b) not in verified:
        raise InputError(f"{name_a!r} and {name_b!r} are no verified pair; see matches.dropped")
    rows = verified[name_a, name_b].matches
    view_a, view_b = (_view(images, name) for name in (name_a, name_b))
    xy_a = matches.keypoints[name_a][rows[:, 0]]
    xy_b = matches.keypoints[name_b][rows[:, 1]] + [view_a.camera.width, 0]
    height = max(view_a.camera.height, view_b.camera.height)
    canvas = np.zeros((height, view_a.camera.width + view_b.camera.width, 3), np.uint8)
    canvas[: view_a.camera.height, : view_a.camera.width] = view_a.image
    canvas[: view_b.camera.height, view_a.camera.width :] = view_b.image
    figure, (axes,) = _figure(1, 9, 9 * height / canvas.shape[1])
    axes.imshow(canvas)
    shown = np.linspace(0, len(rows) - 1, min(len(rows), _MAX_LINES)).astype(int)
    lines = np.stack([xy_a[shown], xy_b[shown]])
    axes.plot(lines[..., 0], lines[..., 1], lw=0.6, color="lime")
    axes.set_title(f"{name_a}, {name_b}: {len(rows)} verified matches", fontsize=9)
    axes.axis("off")
    return figure


def plot_depth(view: View, depth: DepthPrior) -> Figure:
    """Draw an image, its depth map, and the standard deviation of depth relative to depth.

    Args:
        view: Undistorted view of the image.
        depth: Depth prior or refined depth of the view.

    Examples:
        >>> plots.plot_depth(images.view(0), priors.depth["view_0.jpg"])
    """
    figure, (left, middle, right) = _figure(3, 10, 2.8)
    left.imshow(view.image)
    masked = np.where(depth.valid, depth.depth, np.nan)
    figure.colorbar(middle.imshow(masked, cmap="viridis"), ax=middle, shrink=0.8)
    middle.set_title("depth" + (" (m)" if depth.metric else ""), fontsize=9)
    if depth.variance is not None:
        safe = np.where(depth.valid, depth.depth, 1)
        ratio = np.where(depth.valid, np.sqrt(depth.variance) / safe, np.nan)
        figure.colorbar(right.imshow(ratio, cmap="magma"), ax=right, shrink=0.8)
    right.set_title("std / depth", fontsize=9)
    for axes in (left, middle, right):
        axes.axis("off")
    return figure


def plot_model(model: pycolmap.Reconstruction) -> Figure:
    """Draw the points and camera centers of a COLMAP model from above and from the side.

    The axes of the plot are principal components of the point positions.

    Examples:
        >>> plots.plot_model(result.model)
    """
    points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    colors = np.array([point.color for point in model.points3D.values()]).reshape(-1, 3) / 255
    registered = [model.images[number] for number in sorted(model.reg_image_ids())]
    centers = np.array([image.projection_center() for image in registered]).reshape(-1, 3)
    middle = np.median(points if len(points) else centers, axis=0)
    axes_of_scene = np.linalg.svd((points if len(points) else centers) - middle, False)[2]
    step = max(1, len(points) // _MAX_POINTS)
    xyz, path = (points[::step] - middle) @ axes_of_scene.T, (centers - middle) @ axes_of_scene.T
    reach = 1.2 * np.percentile(np.abs(np.concatenate([xyz, path])), 98, axis=0)
    figure, panels = _figure(2, 9, 4)
    for axes, (x, y) in zip(panels, ((0, 1), (0, 2)), strict=True):
        axes.scatter(xyz[:, x], xyz[:, y], s=1, c=colors[::step])
        axes.plot(path[:, x], path[:, y], "^", color="red", ms=5)
        axes.set(xlim=(-reach[x], reach[x]), ylim=(-reach[y], reach[y]), aspect="equal")
    figure.suptitle(f"{len(registered)} images, {len(points)} points", fontsize=9)
    return figure


def plot_residuals(model: pycolmap.Reconstruction) -> Figure:
    """Draw a histogram of the reprojection errors of a COLMAP model, and the mean per image.

    Examples:
        >>> plots.plot_residuals(result.model)
    """
    figure, (left, right) = _figure(2, 9, 3)
    errors = {str(i.name): _residuals(model, i) for i in model.images.values() if i.has_pose}
    left.hist(np.concatenate([*errors.values(), np.zeros(0)]), bins=40, range=(0, 4))
    left.set(xlabel="reprojection error (px)", ylabel="observations")
    means = [values.mean() if len(values) else 0.0 for values in errors.values()]
    right.bar(range(len(means)), means)
    right.set(xlabel="image", ylabel="mean error (px)")
    return figure


def _residuals(model: pycolmap.Reconstruction, image: pycolmap.Image) -> Float64:
    """Return the reprojection errors (n,) in pixels of the observations of an image."""
    errors = []
    for point in image.points2D:
        if point.has_point3D():
            projected = image.project_point(model.points3D[point.point3D_id].xyz)
            if projected is not None:
                errors.append(np.linalg.norm(projected - point.xy))
    return np.array(errors, dtype=np.float64)


def _view(images: ImageSet, name: str) -> View:
    return images.view(images.names.index(name))


def _figure(columns: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(width, height), layout="constrained", dpi=70)
    return figure, list(np.atleast_1d(figure.subplots(1, columns)))
