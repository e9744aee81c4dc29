"""Depth and normals providers that return the ground truth, for tests of wrappers."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from mpsfm_core.data import Bool, DepthPrior, Float64, NormalPrior, PinholeCamera, View
from mpsfm_core.data.options import Options
from mpsfm_core.geometry import pixel_centers
from mpsfm_core.providers import Kind, ProviderContext, ProviderSpec
from mpsfm_core.testing.examples import Example
from mpsfm_core.testing.painted_views import RELATIVE_STD, read_depth, read_normals

_MIN_PART_PX = 32
"""Smallest side in pixels of a cropped or resized view whose camera is checked."""
_MAX_RESIZED_DIFFERENCE = 2.0
"""Largest mean difference of colors between a synthetic view and its resized copy, both reduced to
:data:`_MIN_PART_PX` pixels. The difference is 0.4 for a copy and 3.2 for a neighboring view."""
_CAMERA_TOLERANCE = 1e-6
"""Largest accepted relative error of the intrinsics that a wrapper passes on."""


class GroundTruthOptions(Options):
    """Options of the ground-truth provider that a wrapper under test wraps."""

    variance: bool = True
    """True if the returned depth and normals have a variance."""
    metric: bool = True
    """True if the returned depth has the flag ``metric``."""
    scale: float = 1.0
    """Factor by which the true depth is multiplied."""
    mirrored_hole: bool = False
    """True if the maps of mirrored views have no value in the left third, as networks reject other
    pixels of a mirrored view."""
    reduction: int = 1
    """Factor by which the returned depth or normal map is smaller than the view."""
    fails: bool = False
    """True if each call raises an error."""


class GroundTruth:
    """Ground truth of synthetic views and of all views whose colors encode depth and normals.

    Known synthetic views and their mirrored and rotated images are recognized by their pixels. The
    depth and normals of any other view, for instance a crop made by a wrapper, are decoded from
    colors that encode them.
    """

    def __init__(self) -> None:
        self.received_depth: list[bool] = []
        """One value per call of the normals provider, True if the call received a depth prior."""
        self.returned: list[tuple[DepthPrior | NormalPrior, bytes]] = []
        """Priors that the provider returned to the wrapper, and their pickled values."""
        self.mask: Bool | None = None
        """Mask of the view that the wrapper receives, or None if the view has no mask."""
        self.wrong_inputs: list[str] = []
        """Errors of the cameras and depth priors that the wrapper passed to the provider."""
        self._examples: list[Example] = []

    def add_example(self, example: Example) -> None:
        """Add a synthetic view, which is recognized by its pixels from then on."""
        self._examples.append(example)

    def factory(self, kind: Kind) -> Callable[[GroundTruthOptions, ProviderContext], object]:
        """Return the factory of a depth or normals provider with this ground truth."""
        make = GroundTruthDepth if kind == "depth" else GroundTruthNormals
        return lambda options, context: make(self, options)

    def predict(
        self, view: View, options: GroundTruthOptions
    ) -> tuple[Float64, Float64, Bool, Float64]:
        """Return depth (h, w), normals (h, w, 3), validity and relative std (h, w) of a view."""
        if options.fails:
            raise RuntimeError("the wrapped provider fails")
        recognized = self._recognize(view)
        if recognized is not None:
            example, turns = recognized
            name = f"{example.name!r}{f', rotated by {90 * turns} degrees' if turns else ''}"
            self._require_input(name, view.camera, _rotate_camera(example.camera, turns))
            self._require_mask(name, view, example, turns)
            shape = [-(-side // options.reduction) for side in view.image.shape[:2]]
            rows, columns = shape[::-1] if turns % 2 else shape
            truth = example.truth((rows, columns))
            spread = relative_std(truth.valid.shape, mirrored=example.mirrored)
            valid = truth.valid.copy()
            if example.mirrored and options.mirrored_hole:
                valid[:, : valid.shape[1] // 3] = False
            depth = np.rot90(truth.depth * valid, turns)
            normals = np.rot90(truth.normals * valid[..., None], turns) @ _rotation(turns).T
            return depth, normals, np.rot90(valid, turns), np.rot90(spread, turns)
        self._check_part(view)
        depth = read_depth(view.image)
        spread = np.full(depth.shape, RELATIVE_STD)
        return depth, read_normals(view.image), depth > 0, spread

    def record(self, prior: DepthPrior | NormalPrior) -> None:
        """Store a copy of a returned prior, by which a check finds out if a wrapper modifies it."""
        if self.mask is not None:
            self.returned.append((prior, pickle.dumps(prior)))

    def receive_depth(self, view: View, depth: DepthPrior | None) -> None:
        """Record the depth prior that a wrapper passes to its normals provider."""
        self.received_depth.append(depth is not None)
        recognized = self._recognize(view)
        if depth is None or recognized is None:
            return
        example, turns = recognized
        truth = example.truth(depth.shape[::-1] if turns % 2 else depth.shape)
        true = np.rot90(truth.depth, turns)
        where = np.rot90(truth.smooth, turns) & depth.valid
        if where.any() and np.median(abs(depth.depth[where] / true[where] - 1)) > 0.02:
            self.wrong_inputs.append(f"the depth of another view for {example.name!r}")

    def _require_input(self, name: str, found: PinholeCamera, true: PinholeCamera) -> None:
        """Record an error if the camera of a view is not the true one."""
        if not np.allclose(found.params, true.params, rtol=_CAMERA_TOLERANCE):
            self.wrong_inputs.append(f"the camera of {name}: {found} instead of {true}")

    def _require_mask(self, name: str, view: View, example: Example, turns: int) -> None:
        """Record an error if the mask of a view is neither dropped nor moved with the image."""
        if self.mask is None or view.mask is None:
            return
        mask = self.mask[:, ::-1] if example.mirrored else self.mask
        if not np.array_equal(np.rot90(mask, turns), view.mask):
            self.wrong_inputs.append(f"the mask of another view for {name}")

    def _recognize(self, view: View) -> tuple[Example, int] | None:
        """Return the example that a view shows, and its number of rotations by 90 degrees."""
        for example in reversed(self._examples):
            for turns in range(4):
                image = np.rot90(example.view.image, turns)
                if image.shape == view.image.shape:
                    if np.array_equal(image, view.image):
                        return example, turns
                    if turns == 0 and np.array_equal(image[:, ::-1], view.image):
                        return example.mirror(), 0
        return None

    def _check_part(self, view: View) -> None:
        """Record an error if the camera of a cropped or resized synthetic view is not its own."""
        import cv2  # The import is local, because pytest loads this module when it collects tests.

        height, width = view.image.shape[:2]
        for example in reversed(self._examples) if min(height, width) >= _MIN_PART_PX else ():
            image = example.view.image
            if image.shape[0] >= height and image.shape[1] >= width:
                cost = cv2.matchTemplate(image, view.image, cv2.TM_SQDIFF)
                y, x = np.unravel_index(int(cost.argmin()), cost.shape)
                if np.array_equal(image[y : y + height, x : x + width], view.image):
                    part = example.crop(int(x), int(y), width, height)
                    self._require_input(f"a part of {example.name!r}", view.camera, part.camera)
                    return
            small = cv2.resize(image, (_MIN_PART_PX, _MIN_PART_PX), interpolation=cv2.INTER_AREA)
            other = cv2.resize(
                view.image, (_MIN_PART_PX, _MIN_PART_PX), interpolation=cv2.INTER_AREA
            )
            if np.abs(small.astype(float) - other).mean() < _MAX_RESIZED_DIFFERENCE:
                camera = example.camera.resized(width, height)
                self._require_input(f"a resized copy of {example.name!r}", view.camera, camera)
                return


def _rotation(turns: int) -> Float64:
    """Return the rotation (3, 3) of vectors if the image is rotated by ``numpy.rot90``."""
    quarter = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return np.linalg.matrix_power(quarter, turns)


def _rotate_camera(camera: PinholeCamera, turns: int) -> PinholeCamera:
    """Return the camera of an image that is rotated by ``numpy.rot90``."""
    for _ in range(turns):
        size, focal = (camera.height, camera.width), (camera.fy, camera.fx)
        camera = PinholeCamera(*size, *focal, camera.cy, camera.width - camera.cx)
    return camera


def relative_std(shape: tuple[int, int], *, mirrored: bool = False) -> Float64:
    """Return relative standard deviations (h, w) from 0.02 to 0.1 without any symmetry."""
    x, y = np.moveaxis(pixel_centers(shape[1], shape[0]) / (shape[1], shape[0]), -1, 0)
    x = 1 - x if mirrored else x
    spread: Float64 = 0.02 + 0.08 * np.clip(0.75 * x + 0.25 * y, 0, 1)
    return spread


class GroundTruthDepth:
    """Depth provider that returns the ground truth on the pixel grid of the view."""

    def __init__(self, ground_truth: GroundTruth, options: GroundTruthOptions) -> None:
        self._ground_truth = ground_truth
        self._options = options

    def predict(self, view: View) -> DepthPrior:
        """Return the true depth of a view."""
        depth, _, valid, spread = self._ground_truth.predict(view, self._options)
        depth = self._options.scale * depth
        variance = (spread * depth) ** 2 if self._options.variance else None
        prior = DepthPrior.from_arrays(depth, variance, valid, metric=self._options.metric)
        self._ground_truth.record(prior)
        return prior


class GroundTruthNormals:
    """Normals provider that returns the ground truth on the pixel grid of the view."""

    def __init__(self, ground_truth: GroundTruth, options: GroundTruthOptions) -> None:
        self._ground_truth = ground_truth
        self._options = options

    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        """Return the true normals of a view and record the received depth prior."""
        self._ground_truth.receive_depth(view, depth)
        _, normals, valid, spread = self._ground_truth.predict(view, self._options)
        variance = (2 * spread) ** 2 if self._options.variance else None
        prior = NormalPrior.from_arrays(normals, variance, valid, camera=view.camera)
        self._ground_truth.record(prior)
        return prior


def _make_spec(kind: Kind, factory: type) -> ProviderSpec:
    reference = f"{__name__}:{factory.__name__}"
    return ProviderSpec(kind, "ground-truth", reference, GroundTruthOptions)


GROUND_TRUTH_SPECS: Mapping[Kind, ProviderSpec] = MappingProxyType(
    {
        "depth": _make_spec("depth", GroundTruthDepth),
        "normals": _make_spec("normals", GroundTruthNormals),
    }
)
"""Specifications by kind. The contract tests replace the factory of the ground-truth provider by
:meth:`GroundTruth.factory`."""
