"""Tests of the pair filter alone, and combined with other filters in a registry."""

from __future__ import annotations

import pytest
from mpsfm_pair_filter.plugin import mpsfm_filter_pairs, read_scores

from mpsfm_core.data.errors import InputError
from mpsfm_core.providers.registry import Registry

PAIRS = [("a.jpg", "b.jpg"), ("a.jpg", "c, d.jpg"), ("b.jpg", "c, d.jpg")]
SCORES = """# image, image, score
a.jpg, b.jpg, 0.93

"c, d.jpg",b.jpg,0.4
"""


@pytest.fixture
def scores(tmp_path, monkeypatch):
    path = tmp_path / "scores.csv"
    path.write_text(SCORES)
    monkeypatch.setenv("MPSFM_PAIR_SCORES", str(path))
    return path


def test_pairs_with_high_or_no_score_are_kept(scores, monkeypatch):
    assert mpsfm_filter_pairs(PAIRS) == PAIRS[:2]
    monkeypatch.setenv("MPSFM_PAIR_MIN_SCORE", "0.4")
    assert mpsfm_filter_pairs(PAIRS) == PAIRS
    monkeypatch.setenv("MPSFM_PAIR_MIN_SCORE", "0.95")
    assert mpsfm_filter_pairs(PAIRS) == PAIRS[1:2]


def test_no_file_keeps_all_pairs(monkeypatch):
    monkeypatch.delenv("MPSFM_PAIR_SCORES", raising=False)
    assert mpsfm_filter_pairs(PAIRS) is None
    registry = Registry.discover()
    assert registry.call_hook("mpsfm_filter_pairs", pairs=PAIRS) == []


def test_is_called_through_the_registry(scores):
    answers = Registry.discover().call_hook("mpsfm_filter_pairs", pairs=PAIRS)
    assert answers == [PAIRS[:2]]


def test_is_listed_as_a_plugin_with_hooks_only():
    lines = {line.distribution: line for line in Registry.discover().status()}
    line = lines["mpsfm-pair-filter"]
    assert line.kind == "plugin" and line.available
    assert line.capabilities == ("filter_pairs",)


def test_lower_of_repeated_scores_is_used(scores):
    with scores.open("a") as file:
        file.write("b.jpg,a.jpg,0.1\n")
    assert read_scores(scores)[frozenset(("a.jpg", "b.jpg"))] == 0.1


@pytest.mark.parametrize("line", ["a.jpg,b.jpg", "a.jpg,b.jpg,high", "a.jpg b.jpg 0.3"])
def test_wrong_line_of_csv_is_named(scores, line):
    with scores.open("a") as file:
        file.write(f"{line}\n")
    with pytest.raises(InputError, match=r"scores\.csv:5: expected image, image, score"):
        mpsfm_filter_pairs(PAIRS)


def test_invalid_file_gives_a_warning(scores, caplog):
    scores.unlink()
    assert Registry.discover().call_hook("mpsfm_filter_pairs", pairs=PAIRS) == []
    assert "cannot be read" in caplog.text
