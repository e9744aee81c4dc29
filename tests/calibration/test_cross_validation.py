"""Tests of the calibration study and its warnings."""

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


def test_study_improves_cross_validated_coverage(twenty: CalibrationStudy) -> None:
    before, after = (twenty.report["metrics"][when] for when in ("before", "after"))
    assert before["coverage"][0] < 0.2
    assert after["coverage"][0] == pytest.approx(0.683 * 0.98, abs=0.03)
    assert after["nll_heavy"] < before["nll_heavy"]
    assert len(after["coverage_of_folds"]) == 4


def test_study_folds_are_whole_scenes() -> None:
    """A fit to two scenes has low coverage on the third, which has twice the errors."""
    easy = simulate(PRIOR, 16, pixels=300)
    hard = simulate(replace(PRIOR, relative_std=0.2), 8, seed=1, pixels=300)
    named = [replace(image, name=f"{'ab'[n // 8]}/{image.name}") for n, image in enumerate(easy)]
    named += [replace(image, name=f"c/{image.name}") for image in hard]
    found = run_study(DepthData(tuple(named)), DECLARED, StudyOptions(bootstraps=0))
    assert found.report["folds"] == 3
    *others, last = found.report["metrics"]["after"]["coverage_of_folds"]
    assert last == pytest.approx(0.38, abs=0.05)
    assert min(others) > 0.7


def test_study_reports_scale_separately(twenty: CalibrationStudy) -> None:
    # The log scales of simulated images have a std of 0.2, twice the std of errors.
    assert twenty.report["scale"]["log_spread"] == pytest.approx(0.2, rel=0.5)
    after = twenty.report["metrics"]["after"]
    assert after["coverage_without_scaling"][0] < after["coverage"][0] - 0.2


def test_study_truth_without_unit_has_no_unscaled_coverage() -> None:
    data = DepthData(simulate(PRIOR, 8, pixels=200), in_meters=False)
    report = run_study(data, DECLARED, StudyOptions(bootstraps=0)).report
    assert "coverage_without_scaling" not in report["metrics"]["after"]


def test_study_report_is_plain_data(twenty: CalibrationStudy) -> None:
    assert json.loads(json.dumps(twenty.report)) == twenty.report


def test_study_is_deterministic(twenty: CalibrationStudy) -> None:
    assert run(20).report == twenty.report


def test_study_many_images_has_no_warning(twenty: CalibrationStudy) -> None:
    assert twenty.warnings == ()


def test_study_few_images_warns() -> None:
    assert any("only 3 images" in warning for warning in run(3).warnings)
    alone = run(1)
    assert any("no cross-validation" in warning for warning in alone.warnings)
    assert alone.report["folds"] == 0


def test_study_wide_interval_warns() -> None:
    quiet, loud = (replace(PRIOR, relative_std=std) for std in (0.03, 0.3))
    mixed = simulate(quiet, 6, pixels=100) + simulate(loud, 6, pixels=100)
    warnings = run_study(DepthData(mixed), DECLARED, StudyOptions(bootstraps=40)).warnings
    assert any("relative_std is between" in warning for warning in warnings)


def test_study_gross_errors_warn() -> None:
    warnings = run(12, replace(PRIOR, gross=0.4)).warnings
    assert any("check the truth of these images" in warning for warning in warnings)


def test_study_exact_prior_has_small_std() -> None:
    exact = tuple(replace(s, truth=s.prior * 1.3) for s in simulate(PRIOR, 4, pixels=100))
    calibration = run_study(DepthData(exact), DECLARED, StudyOptions(bootstraps=5)).calibration
    assert isinstance(calibration, DepthCalibration)
    assert calibration.relative_std < 1e-6
