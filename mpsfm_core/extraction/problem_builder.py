"""Construction of mapping problems from arrays of the caller and results of extraction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from mpsfm_core.data import (
    Bool,
    DepthPrior,
    Features,
    Float64,
    MappingImage,
    MappingProblem,
    NormalPrior,
    PinholeCamera,
    Rig,
    SparseMatches,
    VerifiedPair,
)
from mpsfm_core.data.camera_models import CameraModel
from mpsfm_core.data.errors import InputError, did_you_mean
from mpsfm_core.extraction.match_graph import MatchGraph, NamePair
from mpsfm_core.extraction.matching.verification import CALIBRATED, verify_matches
from mpsfm_core.extraction.options import ExtractionOptions, VerificationOptions
from mpsfm_core.extraction.priors import prior_maps
from mpsfm_core.geometry import sample_nearest
from mpsfm_core.geometry.pycolmap_conversion import pinhole_from_colmap, pose_from
from mpsfm_core.inputs.images import ImageSet
from mpsfm_core.inputs.undistortion import is_pinhole
from mpsfm_core.providers.builtin.constant_depth import FLAT_GRID
from mpsfm_core.providers.builtin.normals_from_depth import fit_normals
from mpsfm_core.providers.builtin.options import NormalsFromDepthOptions
from mpsfm_core.providers.builtin.plugin import FLAT_CALIBRATION, FROM_DEPTH_CALIBRATION
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, NormalCalibration

Cameras = ImageSet | Mapping[str, PinholeCamera | pycolmap.Camera]
Matches = MatchGraph | Mapping[NamePair, "SparseMatches | VerifiedPair | NDArray[Any]"]
Keypoints = Mapping[str, "Features | NDArray[Any]"]
Depths = Mapping[str, "DepthPrior | NDArray[Any] | tuple[NDArray[Any], NDArray[Any]]"]
Normals = Mapping[str, "NormalPrior | NDArray[Any]"]
Poses = Mapping[str, Any]


def build_problem(
    cameras: Cameras,
    matches: Matches,
    *,
    keypoints: Keypoints | None = None,
    depth: Depths | None = None,
    normals: Normals | None = None,
    masks: Mapping[str, Bool] | None = None,
    poses: Poses | None = None,
    rigs: Sequence[Rig] = (),
    verification: VerificationOptions | None = None,
    seed: int = 0,
) -> MappingProblem:
    """Build the input of the mapper from arrays of the caller and results of other stages.

    Args:
        cameras: Pinhole camera of each image by name, or the result of
            :func:`mpsfm_core.load_images`. The images of the mapping problem have the order of
            ``cameras``.
        matches: Result of :func:`mpsfm_core.match_images`, or matches by pair of image names. The
            matches of a pair are (m, 2) indices of keypoints, :class:`~mpsfm_core.SparseMatches`
            with scores, or a :class:`~mpsfm_core.VerifiedPair`. Pairs that are not yet verified are
            verified by COLMAP's LO-RANSAC, and dropped if the verification fails.
        keypoints: (n, 2) keypoints in COLMAP pixels of the undistorted view, or
            :class:`~mpsfm_core.Features`, by image name. Keypoints are not needed if ``matches`` is
            a match graph.
        depth: Depth prior by image name, as a :class:`~mpsfm_core.DepthPrior`, a z-depth map (h,
            w), or a tuple of depth map and variance map. Depth maps of any size cover the whole
            view, and arrays have an unknown unit. A depth map without variance gets the default
            variance. An image without depth map gets a plane parallel to the image with a large
            variance.
        normals: Normal prior by image name, as a :class:`~mpsfm_core.NormalPrior` or unit normals
            (h, w, 3) in the camera frame. By default, normals are computed from the depth map.
        masks: Mask (H, W) bool by image name, False where keypoints and depth are not used.
        poses: Known pose ``cam_from_world`` by image name, as ``pycolmap.Rigid3d``, a (3, 4) or (4,
            4) matrix, or a tuple of rotation (3, 3) and translation (3,).
        rigs: Cameras that move as one, with the image names of their frames.
        verification: Options of the geometric verification of matches.
        seed: Random seed of the geometric verification of matches.

    Returns:
        Input of :func:`mpsfm_core.run_mapper`.

    Raises:
        InputError: an image name is unknown, keypoints are missing, or an array has a wrong shape.

    Examples:
        >>> problem = mpsfm.build_problem(cameras, {("a", "b"): indices}, keypoints=keypoints)
        >>> result = mpsfm.run_mapper(problem)
    """
    builder = _Builder(cameras, masks or {})
    for what, values in (("keypoints", keypoints), ("depth", depth), ("normals", normals)):
        builder.check_names(what, values or {})
    builder.check_names("poses", poses or {})
    builder.check_names("masks", masks or {})
    builder.check_names("rigs", {name: rig for rig in rigs for name in rig.image_names})
    if isinstance(matches, MatchGraph):
        builder.set_keypoints(matches.keypoints, matches.keypoint_std_px)
        factors = dict(zip(matches.names, matches.assembled.std_factor, strict=True))
        matches = matches.verified
    else:
        factors = {}
    builder.set_keypoints(keypoints or {}, {})
    options = verification or VerificationOptions()
    pairs = builder.pairs(matches, options, seed)
    images = tuple(
        builder.image(name, depth or {}, normals or {}, poses or {}, factors)
        for name in builder.names
    )
    return MappingProblem(images, pairs, tuple(rigs))


class _Builder:
    """Collector of cameras and keypoints by image name, which builds a mapping problem."""

    def __init__(self, cameras: Cameras, masks: Mapping[str, Bool]) -> None:
        self._images = cameras if isinstance(cameras, ImageSet) else None
        self._masks = masks
        if isinstance(cameras, ImageSet):
            self._cameras = {image.name: image.pinhole for image in cameras}
        elif not isinstance(cameras, Mapping):
            raise InputError(
                "cameras: expected a camera for each image name, such as {'a': camera, 'b': camera}"
                f", got {type(cameras).__name__}"
            )
        else:
            self._cameras = {name: _pinhole(name, camera) for name, camera in cameras.items()}
        self.names = list(self._cameras)
        self._rows = {name: row for row, name in enumerate(self.names)}
        self._keypoints = {name: np.empty((0, 2)) for name in self.names}
        self._std_px = dict.fromkeys(self.names, 1.0)

    def check_names(self, what: str, values: Mapping[str, Any]) -> None:
        """Raise InputError if a key of ``values`` is not an image name."""
        for name in values:
            self._check_name(what, name)

    def _check_name(self, what: str, name: str) -> None:
        if name not in self._rows:
            hint = did_you_mean(name, self.names)
            raise InputError(f"{what}: {name!r} is not the name of an image{hint}")

    def set_keypoints(self, keypoints: Keypoints, std_px: Mapping[str, float]) -> None:
        """Replace the keypoints of some images."""
        for name, given in keypoints.items():
            xy = given.keypoints if isinstance(given, Features) else np.asarray(given, np.float64)
            if xy.ndim != 2 or xy.shape[1] != 2:
                raise InputError(f"keypoints of {name!r}: expected shape (n, 2), got {xy.shape}")
            self._keypoints[name] = xy
            given_std = given.std_px if isinstance(given, Features) else 1.0
            self._std_px[name] = std_px.get(name, given_std)

    def pairs(
        self, matches: Mapping[NamePair, Any], options: VerificationOptions, seed: int
    ) -> tuple[VerifiedPair, ...]:
        """Verify pairs that are not yet verified; return all pairs in the order of the images."""
        found: dict[tuple[int, int], VerifiedPair] = {}
        for (name_a, name_b), given in matches.items():
            for name in (name_a, name_b):
                self._check_name("matches", name)
            key = self._rows[name_a], self._rows[name_b]
            pair = given
            if not isinstance(given, VerifiedPair):
                pair = self._verified(name_a, name_b, given, options, seed)
            elif (given.image_a, given.image_b) != key:
                raise InputError(
                    f"matches: the verified pair {name_a!r}, {name_b!r} has the image indices "
                    f"{given.image_a}, {given.image_b} instead of {key[0]}, {key[1]}"
                )
            if pair is not None:
                found[pair.image_a, pair.image_b] = pair
        return tuple(found[key] for key in sorted(found))

    def _verified(
        self, name_a: str, name_b: str, given: Any, options: VerificationOptions, seed: int
    ) -> VerifiedPair | None:
        """Verify the matches of an image pair, and return None if the verification fails."""
        if isinstance(given, SparseMatches):
            indices, scores = given.indices, given.scores
        else:
            indices = np.asarray(given)
            scores = np.ones(len(indices), np.float32)
        if indices.ndim != 2 or indices.shape[1] != 2 or indices.dtype.kind not in "iu":
            raise InputError(
                f"matches of {name_a!r} and {name_b!r}: expected integers (m, 2), got "
                f"{indices.dtype} {indices.shape}"
            )
        if self._rows[name_a] > self._rows[name_b]:
            name_a, name_b, indices = name_b, name_a, indices[:, ::-1]
        usable = np.ones(len(indices), np.bool_)
        for name, rows in zip((name_a, name_b), indices.T, strict=True):
            count = len(self._keypoints[name])
            if len(rows) and not 0 <= rows.min() <= rows.max() < count:
                raise InputError(
                    f"matches of {name_a!r} and {name_b!r}: index {rows.max()} exceeds the "
                    f"{count} keypoints of {name!r}; give keypoints"
                )
            if name in self._masks:
                usable &= sample_nearest(self._masks[name], self._keypoints[name][rows])
        indices, scores = indices[usable], scores[usable]
        geometry = verify_matches(
            self._cameras[name_a],
            self._cameras[name_b],
            self._keypoints[name_a][indices[:, 0]],
            self._keypoints[name_b][indices[:, 1]],
            options,
            std_px=max(self._std_px[name_a], self._std_px[name_b]),
            seed=seed,
        )
        if geometry.dropped:
            return None
        return VerifiedPair(
            self._rows[name_a],
            self._rows[name_b],
            indices[geometry.inliers].astype(np.int64),
            scores[geometry.inliers],
            geometry.rotation,
            geometry.translation,
            geometry.configuration == CALIBRATED,
        )

    def image(
        self,
        name: str,
        depth: Depths,
        normals: Normals,
        poses: Poses,
        factors: Mapping[str, Float64],
    ) -> MappingImage:
        """Combine camera, keypoints, priors and known pose of an image for the mapping problem."""
        camera = self._cameras[name]
        prior = _depth_prior(name, depth.get(name))
        given_normals = _normal_prior(name, normals.get(name), camera, prior)
        grid = camera.size, self._masks.get(name), ExtractionOptions()
        priors = prior_maps.fit_to_grid(prior, given_normals, *grid)
        factor = factors.get(name)
        keypoints = self._keypoints[name]
        source = None if self._images is None else self._images[self._rows[name]]
        return MappingImage(
            name,
            camera,
            keypoints,
            *priors,
            keypoint_std_px=self._std_px[name],
            keypoint_std_factor=None if factor is None or len(factor) != len(keypoints) else factor,
            focal_known=source is None or source.focal_known,
            camera_id=0 if source is None else source.camera.camera_id,
            focal_log_std=0.7 if source is None else source.focal_log_std,
            camera_model=CameraModel.SIMPLE_RADIAL if source is None else source.camera_model,
            known_pose=None if name not in poses else pose_from(name, poses[name]),
        )


def _pinhole(name: str, camera: Any) -> PinholeCamera:
    if isinstance(camera, PinholeCamera):
        return camera
    if not is_pinhole(camera):
        raise InputError(
            f"cameras: the camera of {name!r} has lens distortion; undistort its keypoints first, "
            "or pass the result of load_images"
        )
    return pinhole_from_colmap(camera)


def _depth_prior(name: str, given: Any) -> DepthPrior:
    """Return a depth prior with variance, by default of a plane parallel to the image."""
    if given is None:
        flat = DepthPrior.from_arrays(np.ones(FLAT_GRID), metric=False)
        return FLAT_CALIBRATION.apply(flat)
    if isinstance(given, tuple):
        depth, variance = (np.asarray(values) for values in given)
        if depth.shape != variance.shape:
            raise InputError(
                f"depth of {name!r}: depth has shape {depth.shape}, variance {variance.shape}"
            )
        return DepthPrior.from_arrays(depth, variance, metric=False)
    prior = given
    if not isinstance(given, DepthPrior):
        prior = DepthPrior.from_arrays(np.asarray(given), metric=False)
    return prior if prior.variance is not None else DepthCalibration().apply(prior)


def _normal_prior(name: str, given: Any, camera: PinholeCamera, depth: DepthPrior) -> NormalPrior:
    """Return a normal prior with variance, by default of planes fitted to the depth map."""
    if given is None:
        fitted = fit_normals(camera, depth, NormalsFromDepthOptions())
        return FROM_DEPTH_CALIBRATION.apply(fitted)
    if isinstance(given, NormalPrior):
        prior = given
    else:
        array = np.asarray(given)
        if array.ndim != 3 or array.shape[2] != 3:
            raise InputError(f"normals of {name!r}: expected shape (h, w, 3), got {array.shape}")
        prior = NormalPrior.from_arrays(array, camera=camera)
    return prior if prior.variance is not None else NormalCalibration().apply(prior)
