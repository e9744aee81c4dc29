"""Test scenes with unknown focal lengths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mpsfm_core.data import MappingProblem, PinholeCamera
from mpsfm_core.data.camera_models import CameraModel
from mpsfm_core.extraction.matching.verification import verify_matches
from mpsfm_core.extraction.options import VerificationOptions
from mpsfm_core.geometry.distortion import distort_rays
from mpsfm_core.mapping.component import Component
from mpsfm_core.mapping.events import NullMappingEvents
from mpsfm_core.mapping.mapper import Mapper
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.triangulation import complete_and_merge_tracks
from mpsfm_core.testing.synthetic.problems import SyntheticNoise, make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(640, 480, 520.0, 520.0, 320.0, 240.0)
POSES = arc_poses(5, 14.0)


def make_room(camera: PinholeCamera = CAMERA) -> MappingProblem:
    """Return five images of a room with true, known intrinsics."""
    return make_mapping_problem(room_scene(), camera, POSES, noise=SyntheticNoise(keypoints_px=0.5))


def scale_focal(camera: PinholeCamera, factor: float) -> PinholeCamera:
    """Return the camera with another focal length."""
    return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)


def distort(
    problem: MappingProblem, *coefficients: float, model: CameraModel = CameraModel.SIMPLE_RADIAL
) -> MappingProblem:
    """Return the problem with keypoints of a lens with distortion, in images of a camera model."""
    coefficients = coefficients + (0.0,) * (4 - len(coefficients))
    center = np.array([CAMERA.cx, CAMERA.cy])
    images = (
        replace(
            image,
            keypoints=center
            + CAMERA.fx
            * distort_rays(
                (image.keypoints - center) / CAMERA.fx, coefficients, fisheye=model.is_fisheye
            ),
            camera_model=model,
        )
        for image in problem.images
    )
    return replace(problem, images=tuple(images))


def guess_focals(
    problem: MappingProblem, factors: Sequence[float], log_std: float = 0.7
) -> MappingProblem:
    """Return the problem with wrong focal lengths, and the relative poses that follow from them."""
    images = tuple(
        replace(
            image,
            camera=scale_focal(image.camera, factor),
            focal_known=False,
            focal_log_std=log_std,
        )
        for image, factor in zip(problem.images, factors, strict=True)
    )
    pairs = []
    for pair in problem.pairs:
        image_a, image_b = images[pair.image_a], images[pair.image_b]
        rows_a, rows_b = pair.matches.T
        geometry = verify_matches(
            image_a.camera,
            image_b.camera,
            image_a.keypoints[rows_a],
            image_b.keypoints[rows_b],
            VerificationOptions(),
        )
        if not geometry.dropped:
            inliers = geometry.inliers
            pairs.append(
                replace(
                    pair,
                    matches=pair.matches[inliers],
                    scores=pair.scores[inliers],
                    rotation=geometry.rotation,
                    translation=geometry.translation,
                    calibrated=geometry.configuration == "calibrated",
                )
            )
    return MappingProblem(images, tuple(pairs))


def register_true_poses(problem: MappingProblem, images: Sequence[int] = range(5)) -> Component:
    """Return a component with some images in their true poses, and their points."""
    component = Mapper(problem, MapperOptions(), NullMappingEvents())._create_component()
    for image in images:
        component.scene.register(image, POSES[image][:, :3], POSES[image][:, 3])
    complete_and_merge_tracks(component.scene, MapperOptions().triangulation, create=True)
    return component
