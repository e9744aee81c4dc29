"""Tests that the report renders reasons in plain words."""

from __future__ import annotations

import contextlib
import json
from typing import Any

import pytest

from mpsfm_core.data.decisions import (
    CameraReason,
    DoubtReason,
    GpsReason,
    HookReason,
    ImageReason,
    PairReason,
    ProviderReason,
    Reason,
    ReasonCode,
    reason_from_json,
)
from mpsfm_core.data.errors import DataError
from mpsfm_core.report.findings import describe_scale, findings
from mpsfm_core.report.reasons import explain
from mpsfm_core.report.verdict import judge

CODES = [code for codes in ReasonCode.__subclasses__() for code in codes]
EXAMPLES: dict[str, str | float] = {
    "other_image": "b.jpg",
    "step": "final-check",
    "geometry": "degenerate",
    "detail": "not installed",
}


def example(code: ReasonCode) -> Reason:
    """Return a reason with plausible values for all fields of its code."""
    return Reason(code, {name: EXAMPLES.get(name, 0.25) for name in code.fields})


@pytest.mark.parametrize("code", CODES, ids=str)
def test_every_code_is_explained_with_all_its_fields(code: ReasonCode) -> None:
    explained = explain(example(code))
    assert explained.title and explained.text
    assert "{" not in explained.text + explained.remedy
    assert not any(character.isdigit() for character in explained.title)
    for name in code.fields:
        values = {**example(code).values, name: "final-check" if name == "step" else 0.75}
        other = {**values, name: "re-registration" if name == "step" else 0.5}
        with contextlib.suppress(ValueError):  # number formats fail for text fields
            assert explain(Reason(code, values)).text != explain(Reason(code, other)).text


@pytest.mark.parametrize("code", ImageReason, ids=str)
def test_every_image_reason_has_a_remedy(code: ImageReason) -> None:
    assert explain(example(code)).remedy


@pytest.mark.parametrize("code", CODES, ids=str)
def test_reason_stored_as_json_is_read_back(code: ReasonCode) -> None:
    stored = json.loads(json.dumps(example(code).to_json()))
    assert reason_from_json(type(code), stored) == example(code)


def test_codes_are_unique_and_unknown_or_incomplete_reasons_are_refused() -> None:
    assert len({code.value for code in ImageReason}) == len(ImageReason)
    with pytest.raises(DataError, match="no known code"):
        reason_from_json(ImageReason, {"code": "moon"})
    with pytest.raises(DataError, match="needs the values num_inliers, min_inliers, got num"):
        ImageReason.TOO_FEW_INLIERS.because(num_inliers=3)


def summary(**changes: Any) -> dict[str, Any]:
    detail = {"focal_length_from": "intrinsics", "focal_length_px": 500.0}
    return {
        "status": "success",
        "images": {
            "total": 3,
            "registered": ["a", "b", "c"],
            "unconfirmed": {},
            "unregistered": {},
            "details": {name: dict(detail) for name in "abc"},
        },
        "pairs": {
            "matched": 3,
            "verified": 3,
            "all": [
                {"images": pair, "matches": 50, "inliers": 40}
                for pair in (["a", "b"], ["a", "c"], ["b", "c"])
            ],
        },
        "reconstructions": [
            {
                "metric_scale": {"trusted": True, "spread": 0.1, "num_images": 3},
                "evidence": {
                    "parts": [["a", "b", "c"]],
                    "median_angle_deg": 8.0,
                    "images": {name: {"points": 90, "explained_ratio": 0.9} for name in "abc"},
                },
            },
        ],
        "providers": [{"block": "depth", "name": "compact", "passed_over": {}}],
        **changes,
    }


def test_findings_of_good_run_are_empty() -> None:
    assert findings(summary()) == []
    assert judge(summary()).level == "good"


def test_findings_are_sorted_by_severity() -> None:
    said = summary()
    said["images"]["details"]["a"]["focal_length_from"] = "default"
    said["images"]["registered"].remove("c")
    said["images"]["unregistered"]["c"] = ImageReason.NO_VALID_DEPTH.because().to_json()
    missing = ProviderReason.NO_WEIGHTS.because(detail="https://host/a/file.onnx is gone")
    said["providers"][0]["passed_over"] = {"better": missing.to_json()}
    found = findings(said)
    assert [finding.level for finding in found] == ["warning", "warning", "note"]
    assert found[-1].text.endswith("better (weights missing).")
    assert judge(said).level == "doubtful"


def test_findings_of_run_without_matches() -> None:
    few = PairReason.TOO_FEW_MATCHES.because(num_matches=5, min_matches=15)
    dropped = [
        {"images": pair, "matches": 5, "dropped": few.to_json()}
        for pair in (["a", "b"], ["a", "c"], ["b", "c"])
    ]
    said = summary(status="failed", pairs={"matched": 3, "verified": 0, "all": dropped})
    said["images"]["registered"] = []
    first = findings(said)[0]
    assert first.level == "bad"
    assert "too few matches in 3 pairs" in first.text


def test_findings_name_photo_that_depends_on_one_other() -> None:
    said = summary()
    said["pairs"]["all"].pop()
    (found,) = findings(said)
    assert set(found.images) == {"b", "c"}


def test_refined_focal_lengths_are_reported_once() -> None:
    report = summary()
    for name, origin, focal in (("a", "default", 400), ("b", "exif", 400), ("c", "exif", 800)):
        report["images"]["details"][name] |= {
            "focal_length_from": origin,
            "refined_focal_length_px": float(focal),
        }
    guess, change = findings(report)
    assert (guess.images, change.images) == (("a",), ("b", "c"))
    assert "initial guess by -20%." in guess.text
    assert change.title == "The focal length of 2 photos changed much"
    assert "values from exif by -20% to +60%" in change.text


@pytest.mark.parametrize(
    ("metric", "depth", "expected"),
    [
        (None, "compact", ("unknown", "no depth is metric")),
        ({}, "compact", ("meters", "as predicted by compact: 5 depth maps, spread 6%")),
        ({}, "files", ("meters", "as given by the depth files: 5 depth maps, spread 6%")),
        ({"by": "GPS positions"}, "compact", ("meters", "by 5 GPS positions, spread 6%")),
        (
            {"trusted": False, "metres_per_unit": 0.25},
            "compact",
            ("uncertain", "one unit is about 0.25 m by 5 depth maps, spread 6%"),
        ),
    ],
)
def test_scale_names_its_source(
    metric: dict[str, Any] | None, depth: str, expected: tuple[str, str]
) -> None:
    report = summary()
    known = {"trusted": True, "spread": 0.06, "num_images": 5, "by": "depth maps"}
    scale = None if metric is None else known | metric
    report["reconstructions"][0]["metric_scale"] = scale
    report["providers"][0]["name"] = depth
    assert describe_scale(report) == expected


def test_findings_of_a_refined_guess_give_its_std() -> None:
    report = summary()
    report["images"]["details"]["a"] |= {
        "focal_length_from": "default",
        "refined_focal_length_px": 400.0,
        "focal_length_std_px": 8.0,
    }
    (finding,) = findings(report)
    assert (finding.level, finding.images) == ("note", ("a",))
    assert "standard deviation is at most 2.0%" in finding.text


def test_findings_of_a_kept_guess_give_the_reason() -> None:
    report = summary()
    reason = CameraReason.NOT_OBSERVABLE.because(focal_length_std_ratio=0.4)
    report["images"]["details"]["a"] |= {
        "focal_length_from": "default",
        "refined_focal_length_px": 520.0,  # value of an earlier refinement
        "focal_length_reason": reason.to_json(),
    }
    (finding,) = findings(report)
    assert doubts(report) == [DoubtReason.UNKNOWN_FOCAL_LENGTH]
    assert (finding.level, finding.images) == ("warning", ("a",))
    assert "standard deviation of 40%" in finding.text


def test_findings_of_an_estimated_distortion_give_its_std() -> None:
    report = summary()
    for name, radial in (("a", -0.031), ("b", -0.034)):
        report["images"]["details"][name] |= {
            "focal_length_from": "exif",
            "radial_distortion": radial,
            "radial_distortion_std": 0.002,
        }
    (finding,) = findings(report)
    assert (finding.level, finding.images) == ("note", ("a", "b"))
    assert "is -0.034 to -0.031. Its standard deviation is at most 0.002" in finding.text


def test_explain_of_a_refused_distortion_gives_the_estimate() -> None:
    reason = CameraReason.DISTORTION_OUT_OF_RANGE.because(radial=0.7)
    assert "0.70" in explain(reason).text
    reason = CameraReason.DISTORTION_NOT_OBSERVABLE.because(radial_std=0.08)
    assert "0.08" in explain(reason).text


def doubts(report: dict[str, Any]) -> list[DoubtReason]:
    """Return the codes of the reasons why a run is doubtful."""
    return [doubt.reason.code for doubt in judge(report).doubts]


def test_verdict_without_doubt_is_good_or_partial() -> None:
    report = summary()
    assert judge(report).level == "good"
    report["images"]["registered"].remove("c")
    assert judge(report).text == "2 of 3 photos registered, 1 missing."
    assert judge(report).level == "partial"


def test_verdict_doubts_wrong_providers() -> None:
    doubt = DoubtReason.MEANINGLESS_SCORES.because(provider="mine", num_pairs=7)
    report = summary(doubts=[doubt.to_json()])
    assert judge(report).level == "doubtful" and doubts(report) == [doubt.code]
    (finding,) = findings(report)
    assert "matcher mine" in finding.text and "plugins check mine" in finding.remedy


def test_unusable_pair_filter_is_a_finding() -> None:
    reason = HookReason.LEFT_OUT.because(plugin="mine", hook="mpsfm_filter_pairs", detail="fault")
    (finding,) = findings(summary(hooks=[reason.to_json()]))
    assert finding.level == "warning"
    assert "plugin mine" in finding.text and "plugins check mine" in finding.remedy


def test_verdict_doubts_pairs_that_share_no_points() -> None:
    report = summary()
    for pair in report["pairs"]["all"][:2]:
        pair |= {"inliers": 80, "explained": 3}
    (doubt,) = judge(report).doubts
    assert doubt.reason.code is DoubtReason.UNEXPLAINED_PAIRS
    assert doubt.images == ("a", "b", "c") and doubt.reason.values["num_matches"] == 80
    report["pairs"]["all"][0]["explained"] = 60
    assert not doubts(report)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (
            {"contradicted_group": {"images": ["a", "b"], "margin": 90}},
            DoubtReason.CONTRADICTED_GROUP,
        ),
        ({"parts": [["a", "b"], ["c"]]}, DoubtReason.DISCONNECTED),
        ({"median_angle_deg": 0.1}, DoubtReason.LOW_PARALLAX),
        (
            {"images": {"a": {"points": 99, "explained_ratio": 0.9, "pose_error_deg": 4.2}}},
            DoubtReason.UNCERTAIN_POSES,
        ),
        ({"images": {"a": {"points": 12, "explained_ratio": 0.9}}}, DoubtReason.FEW_POINTS),
        (
            {"images": {"a": {"points": 99, "explained_ratio": 0.05}}},
            DoubtReason.FEW_EXPLAINED_MATCHES,
        ),
    ],
)
def test_verdict_doubts_weak_evidence(change: dict[str, Any], code: DoubtReason) -> None:
    report = summary()
    report["reconstructions"][0]["evidence"] |= change
    assert doubts(report) == [code]


@pytest.mark.parametrize(
    ("scale_std", "depth_std", "is_doubtful", "has_note"),
    [(0.5, 0.15, True, False), (0.5, 0.03, False, True), (0.01, 0.15, False, False)],
    ids=["weak depth", "precise depth", "matches"],
)
def test_verdict_doubts_distances_that_neither_matches_nor_depth_determine(
    scale_std: float, depth_std: float, is_doubtful: bool, has_note: bool
) -> None:
    report = summary()
    report["reconstructions"][0]["median_relative_depth_std"] = depth_std
    report["reconstructions"][0]["evidence"]["relative_scale_std"] = scale_std
    assert doubts(report) == ([DoubtReason.SCALE_FROM_DEPTH] if is_doubtful else [])
    notes = [item for item in findings(report) if item.level == "note"]
    assert [note.title.endswith("come from depth") for note in notes] == [True] * has_note


@pytest.mark.parametrize(
    ("disagreement", "error_deg", "is_doubtful"),
    [(2.5, 2.5, True), (1.5, 2.5, False), (2.5, 1.5, False), (None, None, False)],
)
def test_verdict_doubts_poses_that_depend_on_contradictory_depth(
    disagreement: float | None, error_deg: float | None, is_doubtful: bool
) -> None:
    report = summary()
    evidence = report["reconstructions"][0]["evidence"]
    evidence["depth_disagreement"] = disagreement
    evidence["images"]["a"]["match_pose_error_deg"] = error_deg
    assert doubts(report) == ([DoubtReason.CONTRADICTORY_DEPTH] if is_doubtful else [])


def test_verdict_doubts_a_model_that_gps_contradicts() -> None:
    report = summary()
    misfit = GpsReason.FEW_INLIERS.because(num_inliers=7, num_positions=24).to_json()
    report["georeference"] = {"why_not": misfit}
    assert doubts(report) == [DoubtReason.GPS_MISFIT]


def test_verdict_doubts_guessed_focal_lengths_that_were_not_refined() -> None:
    report = summary()
    report["images"]["details"]["b"]["focal_length_from"] = "default"
    (doubt,) = judge(report).doubts
    assert doubt.images == ("b",)


@pytest.mark.parametrize("source", ["default", "exif"])
@pytest.mark.parametrize(("std_px", "is_doubtful"), [(100.0, True), (20.0, False)])
def test_verdict_doubts_focal_lengths_with_large_std(
    source: str, std_px: float, is_doubtful: bool
) -> None:
    report = summary()
    report["images"]["details"]["b"] |= {
        "focal_length_from": source,
        "focal_length_px": 500.0,
        "refined_focal_length_px": 600.0,
        "focal_length_std_px": std_px,
    }
    expected = [DoubtReason.UNKNOWN_FOCAL_LENGTH] if is_doubtful else []
    assert doubts(report) == expected


def test_findings_include_images_that_were_left_out() -> None:
    report = summary()
    report["images"]["left_out"] = {"c": "mask c.png is all black: it excludes every pixel"}
    (finding,) = [item for item in findings(report) if item.images == ("c",)]
    assert (finding.level, finding.title) == ("warning", "1 photo could not be used")
    assert finding.text == "Mask c.png is all black: it excludes every pixel."
