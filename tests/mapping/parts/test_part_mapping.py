"""Tests of mapping in overlapping parts, compared with mapping in one piece."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import MappingProblem
from mpsfm_core.data.decisions import ImageReason
from mpsfm_core.evaluation.pose_auc import CONVENTIONS, pose_auc, pose_errors_deg
from mpsfm_core.extraction.cache import digest
from mpsfm_core.mapping import mapper
from mpsfm_core.mapping.component import Component
from mpsfm_core.mapping.event_log import EventLog
from mpsfm_core.mapping.events import NullMappingEvents
from mpsfm_core.mapping.initialization.initial_pair import InitialPairSelector
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.parts.part_mapping import reconstruct, select_parts
from mpsfm_core.mapping.scene.reconstruction import MappingResult
from mpsfm_core.testing.synthetic.halls import CALIBRATED_PRIORS, HallProblem, make_hall_problem

OPTIONS = MapperOptions(parts=20)
CONVENTION = CONVENTIONS["paper"]


@pytest.fixture(scope="module")
def hall() -> HallProblem:
    return make_hall_problem(49, CALIBRATED_PRIORS, map_width=80)


@pytest.fixture(scope="module")
def in_parts(hall: HallProblem) -> MappingResult:
    return reconstruct(hall.problem, OPTIONS)


def measure_auc(result: MappingResult, hall: HallProblem) -> dict[float, float]:
    poses = result.reconstructions[0].poses
    return pose_auc(pose_errors_deg(poses, hall.truth, CONVENTION), CONVENTION)


def test_parts_are_joined_as_accurately_as_in_one_piece(
    hall: HallProblem, in_parts: MappingResult
) -> None:
    assert len(select_parts(hall.problem, OPTIONS)) >= 3
    (model,) = in_parts.reconstructions
    assert len(model.images) == 49 and not in_parts.report.image_reasons
    whole = measure_auc(reconstruct(hall.problem, MapperOptions()), hall)
    assert measure_auc(in_parts, hall)[1] > whole[1] - 0.01
    assert model.metric is not None and model.metric.trusted
    lengths = np.bincount(
        np.concatenate([np.unique(i.point_ids[i.point_ids >= 0]) for i in model.images])
    )
    assert lengths.min() >= 2


def test_focal_length_is_refined_over_all_parts(hall: HallProblem) -> None:
    camera = hall.problem.images[0].camera
    guess = replace(camera, fx=1.08 * camera.fx, fy=1.08 * camera.fy)
    images = tuple(replace(i, camera=guess, focal_known=False) for i in hall.problem.images)
    problem = replace(hall.problem, images=images)
    whole, parts = (reconstruct(problem, o) for o in (MapperOptions(), OPTIONS))
    (focal_px,) = {image.camera.fx for image in parts.reconstructions[0].images}
    assert focal_px == pytest.approx(whole.reconstructions[0].images[0].camera.fx, rel=1e-3)
    assert measure_auc(parts, hall)[1] > measure_auc(whole, hall)[1] - 0.003


def test_result_does_not_depend_on_the_order_in_which_parts_are_mapped(
    hall: HallProblem, in_parts: MappingResult
) -> None:
    def map_backwards(
        problems: Sequence[MappingProblem], options: MapperOptions
    ) -> list[MappingResult]:
        return [mapper.reconstruct(part, options) for part in reversed(problems)][::-1]

    result = reconstruct(hall.problem, OPTIONS, map_parts=map_backwards)
    assert digest(result.reconstructions[0]) == digest(in_parts.reconstructions[0])


def test_image_that_its_part_lost_is_registered_after_the_join(hall: HallProblem) -> None:
    def lose_an_image(
        problems: Sequence[MappingProblem], options: MapperOptions
    ) -> list[MappingResult]:
        results = []
        for part in problems:
            pairs = tuple(p for p in part.pairs if lost not in _names(part, p.image_a, p.image_b))
            results.append(mapper.reconstruct(replace(part, pairs=pairs), options))
        return results

    lost = hall.problem.images[7].name
    result = reconstruct(hall.problem, OPTIONS, map_parts=lose_an_image)
    assert lost in result.reconstructions[0].poses


def test_depth_maps_of_parts_are_kept_unless_an_image_is_registered_again(
    hall: HallProblem, in_parts: MappingResult
) -> None:
    log = EventLog(hall.problem, NullMappingEvents())
    component = Component(hall.problem, OPTIONS, InitialPairSelector(OPTIONS), log)
    assert component.initialize_from_model(in_parts.reconstructions[0], [])
    maps, state = component.scene.maps, component.maintenance.state()
    before = [depth_map.refinement for depth_map in maps]
    component.maintenance.deregister([7], ImageReason.MISREGISTERED.because(num_matches=1))
    component.register_images(component.scene.mask([7]))
    component.maintenance.refine_globally()
    assert component.scene.registered[7]
    changed = [i for i, was in enumerate(before) if maps[i].refinement is not was]
    assert changed == [7]
    component.maintenance.restore(state)
    component.maintenance.refine_globally()
    assert [depth_map.refinement for depth_map in maps] == before


def _names(problem: MappingProblem, *images: int) -> list[str]:
    return [problem.images[image].name for image in images]


def test_parts_without_common_images_stay_components(hall: HallProblem) -> None:
    first = range(20)
    pairs = tuple(p for p in hall.problem.pairs if (p.image_a in first) == (p.image_b in first))
    result = reconstruct(replace(hall.problem, pairs=pairs), OPTIONS)
    sizes = [len(model.images) for model in result.reconstructions]
    assert sizes == [29, 20]
    assert not any(
        reason.code is ImageReason.NO_REGISTERED_NEIGHBOR
        for reason in result.report.image_reasons.values()
    )


def test_small_problems_and_known_poses_are_mapped_in_one_piece(hall: HallProblem) -> None:
    problem = hall.problem
    assert not select_parts(problem, MapperOptions())
    assert not select_parts(problem, MapperOptions(parts=49))
    assert not select_parts(problem.with_poses(hall.truth), OPTIONS)
    guess = OPTIONS.model_copy(update={"known_poses": "guess"})
    assert len(select_parts(problem.with_poses(hall.truth), guess)) > 1
