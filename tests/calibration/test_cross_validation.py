"""What a study reports, and what it warns of."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from mpsfm_core.calibration.cross_validation import CalibrationStudy, StudyOptions, run_study
from mpsfm_core.calibration.model_selection import DepthData
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration
from tests.calibration.simulation import Simulated, simulate

PRIOR = Simulated(network=False, relative_std=0.1, std_floor=0.0, gross=0.02)
DECLARED = DepthCalibration(relative_std=0.02, std_floor=0)


def run(images: int, parameters: Simulated = PRIOR, **options: int) -> CalibrationStudy:
    data = DepthData(simulate(parameters, images, pixels=300))
    return run_study(data, DECLARED, StudyOptions(bootstraps=20).model_copy(update=options))


@pytest.fixture(scope="module")
def twenty() -> CalibrationStudy:
    return run(20)


def test_coverage_on_held_out_images_before_and_after(twenty: CalibrationStudy) -> None:
    before, after = (twenty.report["metrics"][when] for when in ("before", "after"))
    assert before["coverage"][0] < 0.2
    assert after["coverage"][0] == pytest.approx(0.683 * 0.98, abs=0.03)
    assert after["nll_heavy"] < before["nll_heavy"]
    assert len(after["coverage_of_folds"]) == 4


def test_scenes_are_held_out_as_a_whole() -> None:
    """Of three scenes one has twice the errors: fitted to the others, its std covers less."""
    easy = simulate(PRIOR, 16, pixels=300)
    hard = simulate(replace(PRIOR, relative_std=0.2), 8, seed=1, pixels=300)
    named = [replace(image, name=f"{'ab'[n // 8]}/{image.name}") for n, image in enumerate(easy)]
    named += [replace(image, name=f"c/{image.name}") for image in hard]
    found = run_study(DepthData(tuple(named)), DECLARED, StudyOptions(bootstraps=0))
    assert found.report["folds"] == 3
    *others, last = found.report["metrics"]["after"]["coverage_of_folds"]
    assert last == pytest.approx(0.38, abs=0.05)
    assert min(others) > 0.7


def test_the_scale_of_each_image_is_told_and_not_part_of_the_std(twenty: CalibrationStudy) -> None:
    # Simulated images have scales with a log spread of 0.2, twice the std.
    assert twenty.report["scale"]["log_spread"] == pytest.approx(0.2, rel=0.5)
    after = twenty.report["metrics"]["after"]
    assert after["coverage_without_scaling"][0] < after["coverage"][0] - 0.2


def test_truth_in_no_unit_says_nothing_about_the_scale() -> None:
    data = DepthData(simulate(PRIOR, 8, pixels=200), in_meters=False)
    report = run_study(data, DECLARED, StudyOptions(bootstraps=0)).report
    assert "coverage_without_scaling" not in report["metrics"]["after"]


def test_the_report_is_plain_data(twenty: CalibrationStudy) -> None:
    assert json.loads(json.dumps(twenty.report)) == twenty.report


def test_the_same_input_gives_the_same_study(twenty: CalibrationStudy) -> None:
    assert run(20).report == twenty.report


def test_enough_images_give_no_warning(twenty: CalibrationStudy) -> None:
    assert twenty.warnings == ()


def test_few_images_are_warned_of() -> None:
    assert any("only 3 images" in warning for warning in run(3).warnings)
    alone = run(1)
    assert any("no cross-validation" in warning for warning in alone.warnings)
    assert alone.report["folds"] == 0


def test_a_wide_interval_is_warned_of() -> None:
    quiet, loud = (replace(PRIOR, relative_std=std) for std in (0.03, 0.3))
    mixed = simulate(quiet, 6, pixels=100) + simulate(loud, 6, pixels=100)
    warnings = run_study(DepthData(mixed), DECLARED, StudyOptions(bootstraps=40)).warnings
    assert any("relative_std is between" in warning for warning in warnings)


def test_wrong_truth_is_suspected() -> None:
    warnings = run(12, replace(PRIOR, gross=0.4)).warnings
    assert any("check the truth of these images" in warning for warning in warnings)


def test_a_prior_that_is_the_truth_is_declared_nearly_exact() -> None:
    exact = tuple(replace(s, truth=s.prior * 1.3) for s in simulate(PRIOR, 4, pixels=100))
    calibration = run_study(DepthData(exact), DECLARED, StudyOptions(bootstraps=5)).calibration
    assert isinstance(calibration, DepthCalibration)
    assert calibration.relative_std < 1e-6
