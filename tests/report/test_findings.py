"""Reasons in plain words."""

from __future__ import annotations

from typing import Any

import pytest

from mpsfm_core.report.findings import findings, verdict
from mpsfm_core.report.reasons import explain, pair_kind

UNKNOWN = explain("something new").kind

IMAGE_REASONS = [
    "no verified match with another image",
    "nothing that it matches could be registered",
    "its depth is valid nowhere",
    "12 matches have a 3D point, 30 are needed",
    "12 matches support its pose, 30 are needed",
    "9% of the matches support its pose, not 25%",
    "neither PnP nor an essential matrix gives a pose",
    "nothing gives a pose",
    "too few points are left after refinement",
    "lost its points when another image was refined",
    "lost its points in global refinement",
    "10% of the pixels contradict the depth of indoor_DSC02912.JPG",
    "at the end 10% of the pixels contradict another view's",
    "3 other images contradict its depth",
    "held to the rest only by an image that was dropped at the end",
    "only 2 images are connected, 3 are wanted",
    "not connected to the others; in components/1",
    "not tried: there are 20 groups",
    "has no known pose, and known poses are fixed",
]


@pytest.mark.parametrize("reason", IMAGE_REASONS)
def test_every_reason_of_the_mapper_is_explained(reason: str) -> None:
    explained = explain(reason)
    assert explained.kind != UNKNOWN
    assert explained.remedy
    assert "{" not in explained.plain + explained.remedy


def test_a_reason_that_is_not_known_stands_for_itself() -> None:
    assert explain("the moon was in the way").plain == "The moon was in the way."


@pytest.mark.parametrize(
    "reason",
    [
        "5 matches, at least 15 are needed",
        "10 inliers of 40 matches",
        "10 inliers of 40 matches (watermark)",
        "10 inliers of 40 matches fit by chance",
        "no relative pose",
    ],
)
def test_every_reason_of_the_verification_is_known(reason: str) -> None:
    assert not any(character.isdigit() for character in pair_kind(reason))


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
            {"metric_scale": {"trusted": True, "spread": 0.1, "num_images": 3}},
        ],
        "providers": [{"block": "depth", "name": "compact", "passed_over": {}}],
        **changes,
    }


def test_nothing_is_found_where_nothing_is_wrong() -> None:
    assert findings(summary()) == []
    assert verdict(summary()).level == "good"


def test_the_worst_comes_first() -> None:
    said = summary()
    said["images"]["details"]["a"]["focal_length_from"] = "default"
    said["images"]["registered"].remove("c")
    said["images"]["unregistered"]["c"] = "its depth is valid nowhere"
    gone = "https://host/a/file.onnx is gone. Run 'mpsfm models fetch https://host/a/file.onnx'"
    said["providers"][0]["passed_over"] = {"better": gone}
    found = findings(said)
    assert [finding.level for finding in found] == ["warning", "warning", "note"]
    assert found[-1].text.endswith("better: file.onnx is gone.")
    assert verdict(said).text == "2 of 3 photos have their place, 1 not."


def test_a_run_that_matched_nothing() -> None:
    dropped = [
        {"images": pair, "matches": 5, "dropped": "5 matches, at least 15 are needed"}
        for pair in (["a", "b"], ["a", "c"], ["b", "c"])
    ]
    said = summary(status="failed", pairs={"matched": 3, "verified": 0, "all": dropped})
    said["images"]["registered"] = []
    first = findings(said)[0]
    assert first.level == "bad"
    assert "too few matches in 3 pairs" in first.text


def test_a_photo_that_hangs_on_another_is_told() -> None:
    said = summary()
    said["pairs"]["all"].pop()
    (found,) = findings(said)
    assert set(found.images) == {"b", "c"}


def test_focal_lengths_are_told_of_once() -> None:
    said = summary()
    for name, origin in (("a", "default"), ("b", "exif")):
        said["images"]["details"][name] |= {
            "focal_length_from": origin,
            "refined_focal_length_px": 400.0,
        }
    guess, change = findings(said)
    assert (guess.images, change.images) == (("a",), ("b",))
    assert "refined, from 500 to 400 px, but a wrong one" in guess.text
    assert change.text.startswith("From 500 (exif) to 400 px.")
