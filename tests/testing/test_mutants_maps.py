"""Depth providers, normals providers and wrappers with one fault each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from mpsfm_core import DepthPrior, NormalPrior, View
from mpsfm_core.geometry import pixel_centers, rays
from mpsfm_core.providers import ProviderSpec
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing import ContractSetup, run_checks
from mpsfm_core.testing.examples import outdoor_example
from mpsfm_core.testing.painted_views import RELATIVE_STD, read_depth, read_normals
from tests.support.reference_providers import (
    PaintedDepth,
    PaintedNormals,
    Wrapper,
    depth_prior,
    normal_prior,
)

PAINTED = ContractSetup(truth_source="painted")


def ray_lengths(view: View) -> np.ndarray:
    return np.linalg.norm(rays(view.camera, pixel_centers(*view.camera.size)), axis=-1)


def shifted(image: np.ndarray, pixels: float) -> np.ndarray:
    matrix = np.array([[1, 0, pixels], [0, 1, pixels]])
    size = image.shape[1], image.shape[0]
    return cv2.warpAffine(image.astype(np.float32), matrix, size, borderMode=cv2.BORDER_REPLICATE)


def halved_by_corners(image: np.ndarray) -> np.ndarray:
    """Fault: resizes to half the size with the centers of the corner pixels fixed
    (align_corners=True)."""
    rows, columns = (max(side // 2, 2) for side in image.shape[:2])
    x = np.linspace(0, image.shape[1] - 1, columns, dtype=np.float32)
    y = np.linspace(0, image.shape[0] - 1, rows, dtype=np.float32)
    return cv2.remap(image.astype(np.float32), *np.meshgrid(x, y), cv2.INTER_LINEAR)


class RayLength(PaintedDepth):
    def predict(self, view: View) -> DepthPrior:
        return depth_prior(read_depth(view.image) * ray_lengths(view))


class Millimetres(PaintedDepth):
    def predict(self, view: View) -> DepthPrior:
        return depth_prior(1000 * read_depth(view.image))


class Disparity(PaintedDepth):
    """Fault: returns inverse depth instead of depth."""

    def predict(self, view: View) -> DepthPrior:
        depth = read_depth(view.image)
        return DepthPrior.from_arrays(1 / np.maximum(depth, 0.1), valid=depth > 0, metric=False)


class BlueFirst(PaintedDepth):
    def predict(self, view: View) -> DepthPrior:
        return depth_prior(read_depth(view.image[..., ::-1]))


class HalfPixel(PaintedDepth):
    def predict(self, view: View) -> DepthPrior:
        return depth_prior(read_depth(shifted(view.image, 0.5)))


class AlignedCorners(PaintedDepth):
    def predict(self, view: View) -> DepthPrior:
        return depth_prior(read_depth(halved_by_corners(view.image)))


class CentreCrop(PaintedDepth):
    """Fault: crops the border, as in training, so that the map does not cover the view."""

    def predict(self, view: View) -> DepthPrior:
        rows, columns = (side // 32 for side in view.image.shape[:2])
        image = view.image[rows or None : -rows or None, columns or None : -columns or None]
        return depth_prior(read_depth(image))


class Transposed(PaintedDepth):
    def predict(self, view: View) -> DepthPrior:
        return depth_prior(read_depth(view.image).T)


class UpsideDown(PaintedDepth):
    def predict(self, view: View) -> DepthPrior:
        return depth_prior(read_depth(view.image)[::-1])


class FarSky(PaintedDepth):
    """Fault: marks every pixel as valid, with a depth of 100 m for the sky."""

    def predict(self, view: View) -> DepthPrior:
        depth = read_depth(view.image)
        return depth_prior(np.where(depth > 0, depth, 100.0))


class NothingIsSure(PaintedDepth):
    def predict(self, view: View) -> DepthPrior:
        prior = super().predict(view)
        checkers = np.indices(prior.shape).sum(axis=0) % 2 == 0
        return DepthPrior.from_arrays(prior.depth, prior.variance, checkers)


class Tilted(PaintedDepth):
    """Fault: depth increases to the right."""

    def predict(self, view: View) -> DepthPrior:
        slope = np.linspace(0.9, 1.1, view.camera.width)
        return depth_prior(read_depth(view.image) * slope)


class OldIntrinsics(PaintedDepth):
    """Fault: resizes the image to the network's size, but uses the focal length of the original."""

    def predict(self, view: View) -> DepthPrior:
        image = cv2.resize(view.image, (192, 144), interpolation=cv2.INTER_AREA)
        return depth_prior(read_depth(image) * view.camera.fx / 144.0)


class UpsideDownFocal(PaintedDepth):
    def predict(self, view: View) -> DepthPrior:
        return depth_prior(read_depth(view.image) * 0.75 * view.camera.width / view.camera.fx)


class StdForVariance(PaintedDepth):
    def predict(self, view: View) -> DepthPrior:
        depth = read_depth(view.image)
        return DepthPrior.from_arrays(depth, RELATIVE_STD * depth)


class RelativeVariance(PaintedDepth):
    """Fault: the variance is the square of the relative std, without the depth."""

    def predict(self, view: View) -> DepthPrior:
        depth = read_depth(view.image)
        return DepthPrior.from_arrays(depth, np.full(depth.shape, RELATIVE_STD**2))


class HugeVariance(PaintedDepth):
    def predict(self, view: View) -> DepthPrior:
        depth = read_depth(view.image)
        return DepthPrior.from_arrays(depth, np.full(depth.shape, 3e38))


class TinyVariance(PaintedDepth):
    """Fault: the variance is in square kilometers and vanishes compared with the calibrated std."""

    def predict(self, view: View) -> DepthPrior:
        prior = super().predict(view)
        return replace(prior, variance=prior.variance * np.float32(1e-6))


class TwoOpinions(PaintedDepth):
    def predict_joint(self, view: View) -> tuple[DepthPrior, NormalPrior]:
        depth, normals = super().predict_joint(view)
        return depth_prior(depth.depth * 1.01), normals


class JointNormalsTurned(PaintedDepth):
    def predict_joint(self, view: View) -> tuple[DepthPrior, NormalPrior]:
        depth, normals = super().predict_joint(view)
        return depth, normal_prior(normals.normals * (-1, 1, 1), view)


class FocalOfNetwork(PaintedDepth):
    """Fault: the focal length is in pixels of a reduced image."""

    def estimate_focal(self, view: View) -> float:
        return 40 / 192 * max(view.camera.size)


class FocalOfWidth(PaintedDepth):
    """Fault: the focal length of a portrait view follows its width."""

    def estimate_focal(self, view: View) -> float:
        return 0.75 * view.camera.width


class FocalRatio(PaintedDepth):
    def estimate_focal(self, view: View) -> float:
        return 0.75


class FocalOfCamera(PaintedDepth):
    """Fault: ``estimate_focal`` returns the guessed focal length of the given camera."""

    def estimate_focal(self, view: View) -> float:
        return view.camera.fx


class InvertedMask(PaintedDepth):
    """Fault: the provider marks depth as valid at masked-out pixels only."""

    def predict(self, view: View) -> DepthPrior:
        prior = super().predict(view)
        return prior if view.mask is None else replace(prior, valid=prior.valid & ~view.mask)


class DistantIsInvalid(PaintedDepth):
    """Correct: depth beyond 6 m is invalid, as of a cautious network."""

    def predict(self, view: View) -> DepthPrior:
        prior = super().predict(view)
        return replace(prior, valid=prior.valid & (prior.depth < 6))


def test_depth_provider_may_reject_distant_pixels() -> None:
    registry = Registry()
    registry.add(ProviderSpec("depth", "cautious", DistantIsInvalid))
    (result,) = run_checks(registry, "depth", "cautious", PAINTED, only={"depth-validity"})
    assert result.status == "pass" and "lost" in result.message


@pytest.mark.parametrize(
    ("factory", "check", "message", "capabilities"),
    [
        (InvertedMask, "masked", "invalid at pixels where the mask is True", ()),
        (RayLength, "depth-is-z", "is the length of the ray", ()),
        (Millimetres, "depth-scale", r"declared metric and is 1e\+03 times the true", ()),
        (Disparity, "depth-scale", "not proportional to z", ()),
        (BlueFirst, "depth-channel-order", "follows the blue channel", ()),
        (HalfPixel, "depth-pixel-convention", r"shifted by \(\+0.5., \+0.5.\) px", ()),
        (AlignedCorners, "depth-pixel-convention", "at the border", ()),
        (CentreCrop, "depth-pixel-convention", "at the border", ()),
        (Transposed, "depth-orientation", "x and y are swapped", ()),
        (UpsideDown, "depth-orientation", "upside down", ()),
        (FarSky, "depth-validity", "100% of the pixels without any surface are valid", ()),
        (NothingIsSure, "depth-validity", "50% of the pixels with a surface are not valid", ()),
        (Tilted, "depth-flip", "of the mirrored view differs by .*%", ()),
        (OldIntrinsics, "depth-same-in-larger-view", "grows 2 times", ("intrinsics-aware",)),
        (UpsideDownFocal, "depth-intrinsics", "changes 0.67 times", ("intrinsics-aware",)),
        (StdForVariance, "depth-variance", "equals the std", ()),
        (RelativeVariance, "depth-variance", "times the std that the test network reports", ()),
        (HugeVariance, "depth-calibration", "after calibration, variance: must be finite", ()),
        (TinyVariance, "depth-calibration", "does not change the calibrated variance", ()),
        (TwoOpinions, "depth-joint", "return different depth", ("joint-normals",)),
        (
            JointNormalsTurned,
            "depth-joint",
            "normals of predict_joint are .* degrees off",
            ("joint-normals",),
        ),
        (FocalRatio, "depth-focal", "is 1 px, and 1 px", ("estimates-focal",)),
        (FocalOfNetwork, "depth-focal", "is 40 px, the truth is 144 px", ("estimates-focal",)),
        (FocalOfCamera, "depth-focal", "144 px, and 288 px if the camera", ("estimates-focal",)),
        (FocalOfWidth, "depth-focal", "144 x 192 view is 108 px", ("estimates-focal",)),
    ],
)
def test_faulty_depth_provider_fails_its_check(
    caught: Callable[..., None],
    factory: type,
    check: str,
    message: str,
    capabilities: tuple[str, ...],
) -> None:
    caught("depth", factory, check, message, PAINTED, *capabilities)


class Away(PaintedNormals):
    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        prior = super().predict(view)
        return replace(prior, normals=-prior.normals)


class AwayAndDropped(PaintedNormals):
    """Fault: normals face away from the camera, so all of them are dropped."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        return normal_prior(-read_normals(view.image), view)


class OpenGL(PaintedNormals):
    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        prior = super().predict(view)
        return replace(prior, normals=prior.normals * np.float32([1, -1, -1]))


class LeftIsRight(PaintedNormals):
    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        return normal_prior(read_normals(view.image) * (-1, 1, 1), view)


class WorldFrame(PaintedNormals):
    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        world_from_camera = outdoor_example("painted").pose[:, :3].T
        return normal_prior(read_normals(view.image) @ world_from_camera.T, view)


class NotUnit(PaintedNormals):
    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        prior = super().predict(view)
        return NormalPrior(1.1 * prior.normals, prior.variance, prior.valid)


class NormalsBlueFirst(PaintedNormals):
    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        return normal_prior(read_normals(view.image[..., ::-1]), view)


class NormalsHalfPixel(PaintedNormals):
    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        return normal_prior(read_normals(shifted(view.image, -0.5)), view)


class NormalsStd(PaintedNormals):
    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        prior = super().predict(view)
        return replace(prior, variance=np.sqrt(prior.variance))


class Degrees(PaintedNormals):
    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        prior = super().predict(view)
        return replace(prior, variance=np.degrees(np.degrees(prior.variance)))


class Leaning(PaintedNormals):
    """Fault: normals lean a little to the left."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        return normal_prior(read_normals(view.image) - (0.2, 0, 0), view)


class Stretched(PaintedNormals):
    """Fault: normals depend on the number of columns instead of angles."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        return normal_prior(read_normals(view.image) * (1, 192 / view.camera.width, 1), view)


class EndlessVariance(PaintedNormals):
    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        prior = super().predict(view)
        return replace(prior, variance=prior.variance * np.float32(1e-12))


@pytest.mark.parametrize(
    ("factory", "check", "message"),
    [
        (Away, "output-rules", r"must face the camera \(n . ray < 0\), not so at 100 %"),
        (AwayAndDropped, "normals-frame", "only 0 of .* pixels with a surface are valid"),
        (OpenGL, "output-rules", "must face the camera"),
        (LeftIsRight, "normals-frame", "x is negated"),
        (WorldFrame, "normals-frame", "in the world's frame"),
        (NotUnit, "output-rules", "must have unit length"),
        (NormalsBlueFirst, "normals-channel-order", "BGR instead of RGB"),
        (NormalsHalfPixel, "normals-pixel-convention", r"shifted by \(-0.*, -0.*\) px"),
        (NormalsStd, "normals-variance", "equals the std"),
        (Degrees, "output-rules", r"must be in rad\^2"),
        (Leaning, "normals-flip", "of the mirrored view"),
        (Stretched, "normals-same-in-larger-view", "off in an enlarged view"),
        (EndlessVariance, "normals-calibration", "does not change the calibrated variance"),
    ],
)
def test_faulty_normals_provider_fails_its_check(
    caught: Callable[..., None], factory: type, check: str, message: str
) -> None:
    caught("normals", factory, check, message, PAINTED)


class DropsVariance(Wrapper):
    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        return replace(super().predict(view, depth), variance=None)


class WantsVariance(Wrapper):
    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        prior = super().predict(view, depth)
        return replace(prior, variance=prior.variance + prior.variance)


class AlwaysMetric(Wrapper):
    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        return replace(super().predict(view, depth), metric=True)


class OfItsOwn(Wrapper):
    """Fault: scales depth to a fixed mean depth."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        prior = super().predict(view, depth)
        return depth_prior(prior.depth * 4 / np.median(prior.depth))


class KeepsDepth(Wrapper):
    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        return self.inner.predict(view)


class MirrorNotUndone(Wrapper):
    """Fault: averages the depth of the mirrored image without mirroring it back."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        image = np.ascontiguousarray(view.image[:, ::-1])
        second = self.inner.predict(replace(view, image=image))
        return depth_prior((super().predict(view).depth + second.depth) / 2)


class MirroredNormals(Wrapper):
    """Fault: mirrors the normals of the mirrored image back without negating x."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        second = self.inner.predict(replace(view, image=np.ascontiguousarray(view.image[:, ::-1])))
        return normal_prior(second.normals[:, ::-1], view)


class FillsHoles(Wrapper):
    """Fault: marks every pixel as valid, including the sky."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        prior = super().predict(view, depth)
        filled = np.where(prior.valid[..., None], prior.normals, np.float32([0, 0, -1]))
        return NormalPrior(filled, None, np.ones(prior.shape, bool))


class DoublesIntrinsics(Wrapper):
    """Fault: reduces large views and scales metric depth with them."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        prior = super().predict(view, depth)
        return prior if view.camera.width < 300 else depth_prior(2 * prior.depth)


class HidesErrors(Wrapper):
    """Fault: returns a constant depth if the wrapped provider fails."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        try:
            return super().predict(view, depth)
        except Exception:
            return depth_prior(np.full(view.image.shape[:2], 3.0))


@pytest.mark.parametrize(
    ("factory", "check", "message", "wraps"),
    [
        (DropsVariance, "wrapper-keeps-variance", "drops the variance", "depth"),
        (DropsVariance, "wrapper-keeps-variance", "drops the variance", "normals"),
        (WantsVariance, "wrapper-without-variance", "NoneType", "depth"),
        (AlwaysMetric, "wrapper-keeps-unit", "returns depth with metric=True", "depth"),
        (OfItsOwn, "wrapper-uses-the-provider", "grows 1.00 to 1.00 times", "depth"),
        (KeepsDepth, "wrapper-hands-on-depth", "does not pass the depth prior", "normals"),
        (MirrorNotUndone, "depth-scale", "not proportional to z", "depth"),
        (MirroredNormals, "normals-frame", "x is negated", "normals"),
        (FillsHoles, "normals-validity", "without any surface are valid", "normals"),
        (HidesErrors, "wrapper-errors", "although the wrapped provider raises", "depth"),
        (DoublesIntrinsics, "depth-same-in-larger-view", "grows 2 times", "depth"),
    ],
)
def test_faulty_wrapper_fails_its_check(
    caught: Callable[..., None], factory: type, check: str, message: str, wraps: str
) -> None:
    caught("wrapper", factory, check, message, None, f"wraps-{wraps}")
