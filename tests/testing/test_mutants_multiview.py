"""Multi-view providers with one fault each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mpsfm_core import DepthPrior, MultiViewPrior, View
from mpsfm_core.geometry import invert, pixel_centers, rays
from mpsfm_core.testing import ContractSetup
from tests.support import reference_providers as ref
from tests.support.reference_providers import ToldGroup, depth_prior

EVERYTHING = ("metric", "variance", "proposes-poses", "proposes-intrinsics")


def told(folder: Path) -> ContractSetup:
    return ContractSetup(
        options={"folder": folder},
        truth_source="prepared",
        prepare=lambda example: ref.tell_group(folder, example),
    )


class Changed(ToldGroup):
    """Ground truth with one modification."""

    def predict_group(self, views: Sequence[View]) -> MultiViewPrior:
        return self.change(super().predict_group(views), views)

    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        raise NotImplementedError


def scaled(prior: DepthPrior, factor: Any) -> DepthPrior:
    return depth_prior(prior.depth * factor)


class RayLength(Changed):
    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        lengths = [
            np.linalg.norm(rays(v.camera, pixel_centers(*v.camera.size)), axis=-1) for v in views
        ]
        return replace(group, depth=tuple(map(scaled, group.depth, lengths)))


class Std(Changed):
    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        depth = tuple(replace(p, variance=np.sqrt(p.variance)) for p in group.depth)
        return replace(group, depth=depth)


class LastFirst(Changed):
    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        return replace(group, depth=group.depth[::-1])


class EachItsOwn(Changed):
    """Fault: normalizes the unit of each depth map separately."""

    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        means = [3 / max(float(np.median(p.depth[p.valid])), 1e-6) for p in group.depth]
        growing = [mean * 1.1**i for i, mean in enumerate(means)]
        return replace(group, depth=tuple(map(scaled, group.depth, growing)))


class AlongTheFirst(Changed):
    """Fault: returns the z of point maps in the frame of the first view."""

    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        first, depth = group.poses[0], []
        for prior, pose, view in zip(group.depth, group.poses, views, strict=True):
            rotation, translation = invert(pose[:, :3], pose[:, 3])
            points = rays(view.camera, pixel_centers(*view.camera.size)) * prior.depth[..., None]
            z = (points @ rotation.T + translation) @ first[2, :3] + first[2, 3]
            depth.append(depth_prior(np.where(prior.valid, z, 0)))
        return replace(group, depth=tuple(depth))


class GroupFromCamera(Changed):
    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        poses = [np.column_stack(invert(p[:, :3], p[:, 3])) for p in group.poses]
        return replace(group, poses=np.array(poses))


class OpenGL(Changed):
    """Fault: cameras look along -z with y up."""

    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        return replace(group, poses=np.diag([1.0, -1.0, -1.0]) @ group.poses)


class CentersForTranslations(Changed):
    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        poses = group.poses.copy()
        poses[:, :, 3] = [invert(p[:, :3], p[:, 3])[1] for p in poses]
        return replace(group, poses=poses)


class UnitSteps(Changed):
    """Fault: normalizes the poses, but leaves depth in meters."""

    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        return replace(group, poses=group.poses * (1, 1, 1, 5))


class OwnGrid(Changed):
    """Fault: the focal length is in pixels of the network's grid of 518 pixels."""

    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        widths = np.array([[view.camera.width] for view in views])
        return replace(group, intrinsics=group.intrinsics * 518 / widths)


class FirstPixelAtZero(Changed):
    """Fault: the principal point is in pixels whose first center is (0, 0)."""

    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        return replace(group, intrinsics=group.intrinsics - np.array([0, 0, 0.5, 0.5]))


class RowsFirst(Changed):
    """Fault: the principal point has row and column swapped."""

    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        return replace(group, intrinsics=group.intrinsics[:, [0, 1, 3, 2]])


class NeedsTwo(Changed):
    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        if len(views) < 2:
            raise IndexError("index 1 is out of bounds for dimension 1 with size 1")
        return group


class OneSize(Changed):
    """Stacks the images."""

    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        np.stack([view.image for view in views])
        return group


class CropsToTheSmallest(Changed):
    """Fault: crops larger views, as the authors' image loaders do."""

    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        rows = min(view.camera.height for view in views)
        columns = min(view.camera.width for view in views)
        depth = []
        for prior in group.depth:
            top, left = (
                (have - want) // 2 for have, want in zip(prior.shape, (rows, columns), strict=True)
            )
            depth.append(depth_prior(prior.depth[top : top + rows, left : left + columns]))
        return replace(group, depth=tuple(depth))


class Fewer(Changed):
    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        return MultiViewPrior(group.depth[1:])


class NoPoses(Changed):
    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        return replace(group, poses=None)


class Sheared(Changed):
    """Fault: the predicted matrix is not orthonormalized to a rotation."""

    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        return replace(group, poses=1.1 * group.poses)


class Mirrored(Changed):
    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        return replace(group, poses=np.diag([-1.0, 1.0, 1.0]) @ group.poses)


class SomeInMetres(Changed):
    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        first, *others = group.depth
        return replace(group, depth=(replace(first, metric=False), *others))


class Chains(Changed):
    """Fault: uses the frame of the previous group, as for a video stream."""

    seen = 0

    def change(self, group: MultiViewPrior, views: Sequence[View]) -> MultiViewPrior:
        self.seen += 1
        return replace(group, poses=group.poses + np.array([0, 0, 0, self.seen]))


@pytest.mark.parametrize(
    ("factory", "check", "message"),
    [
        (RayLength, "depth-is-z", "is the length of the ray"),
        (Std, "depth-variance", "equals the std"),
        (LastFirst, "multiview-order", "order of the maps differs"),
        (EachItsOwn, "multiview-one-unit", "units of the maps in one group differ by"),
        (AlongTheFirst, "multiview-own-axis", "it is z of the first view"),
        (GroupFromCamera, "multiview-poses", "they are group_from_cam"),
        (OpenGL, "multiview-poses", "off by .* degrees"),
        (CentersForTranslations, "multiview-poses", "has another direction"),
        (UnitSteps, "multiview-pose-unit", "are 5 times as long as the unit of depth"),
        (OwnGrid, "multiview-intrinsics", "fx is .* off"),
        (RowsFirst, "multiview-intrinsics", "cx is .*% off"),
        (FirstPixelAtZero, "multiview-intrinsics", "principal point is up to 0.5 px off"),
        (NeedsTwo, "multiview-alone", "index 1 is out of bounds"),
        (OneSize, "multiview-sizes", "must have the same shape"),
        (CropsToTheSmallest, "multiview-sizes", "relative error|shifted"),
        (Fewer, "output-rules", "must be a tuple of 2 priors, got 1"),
        (NoPoses, "output-rules", "lacks the declared capability 'proposes-poses'"),
        (Sheared, "output-rules", "must be rotations and translations"),
        (Mirrored, "output-rules", "must not mirror"),
        (SomeInMetres, "output-rules", "metric in all views of a group or in none"),
        (Chains, "no-state", "after other views"),
    ],
)
def test_faulty_multiview_provider_fails_its_check(
    caught: Callable[..., None], factory: type, check: str, message: str
) -> None:
    caught("multiview", factory, check, message, told, *EVERYTHING, options=ref.ToldOptions)
