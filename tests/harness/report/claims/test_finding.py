"""Words of several findings, the steps that they rest on, and the frame of all."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from harness.report.claims import Claim, Finding, agreed, to_frame
from harness.report.claims import finding as words
from harness.report.claims.finding import WORDS, basis_of, with_kept
from harness.statistics import Estimate


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["supported"], "supported"),
        (["supported", "supported"], "supported"),
        (["contradicted", "contradicted"], "contradicted"),
        (["supported", "contradicted"], "undecided"),
        (["supported", "undecided"], "undecided"),
        (["no effect", "no effect"], "no effect"),
        ([], "undecided"),
    ],
)
def test_a_claim_of_several_parts_has_the_word_of_all(words, expected):
    for ordered in itertools.permutations(words):
        assert agreed(ordered) == expected


def test_the_words_are_those_that_the_page_prints():
    assert WORDS == {1: "supported", 0: "undecided", -1: "contradicted"}
    assert (words.WIN, words.LOSS, words.NEGLIGIBLE) == ("win", "loss", "negligible")
    assert (words.NO_EFFECT, words.REPORTED) == ("no effect", "reported")


def test_what_was_found_cannot_be_changed():
    claim = Claim("b", "It wins.", "supported", [finding()])
    assert (claim.basis, claim.failed, claim.without_failed, claim.notes) == ("", 0, "", ())
    for frozen in (claim, finding()):
        with pytest.raises(dataclasses.FrozenInstanceError):
            frozen.verdict = "contradicted"


def test_the_basis_names_the_steps_and_their_share():
    assert basis_of([100_000], 5_000_000) == "at 2% of the paper's length (100,000 steps)"
    expected = "at 2% to 10% of the paper's length (100,000 to 500,000 steps)"
    assert basis_of([500_000, 100_000, 200_000], 5_000_000) == expected
    assert basis_of([], 5_000_000) == ""
    assert basis_of([5_000_000], 5_000_000) == "at 1e+02% of the paper's length (5,000,000 steps)"


def finding(about="gain", task="all", word="win", **more) -> Finding:
    return Finding(about, task, Estimate(1.0, 0.5, 1.5, 10), word, **more)


def test_the_frame_has_a_row_for_each_finding():
    found = [finding(failed=2, detectable=0.7, p=0.01, p_holm=0.04, without_failed="undecided")]
    frame = to_frame([Claim("b", "It wins.", "supported", [*found, finding(task="Ant")])])
    assert frame["task"].tolist() == ["all", "Ant"]
    row = frame.iloc[0]
    assert (row["claim"], row["about"], row["verdict"]) == ("b", "gain", "win")
    assert tuple(row[["mean", "low", "high", "n"]]) == (1.0, 0.5, 1.5, 10)
    assert tuple(row[["failed", "detectable", "p", "p_holm"]]) == (2, 0.7, 0.01, 0.04)
    assert row["without_failed"] == "undecided"
    assert np.isnan(frame.iloc[1]["p"])
    assert tuple(frame.loc[1, ["failed", "without_failed", "note"]]) == (0, "", "")
    assert list(frame.columns) == [
        "claim", "about", "task", "mean", "low", "high", "n", "failed", "detectable", "p",
        "p_holm", "verdict", "without_failed", "note",
    ]  # fmt: skip


def test_without_claims_the_frame_has_its_columns():
    assert {"claim", "mean", "p_holm"} <= set(to_frame([]).columns)


def test_findings_find_themselves_without_the_failed_runs():
    both = with_kept([finding(), finding(task="Ant")], [finding(word="loss")])
    assert [f.without_failed for f in both] == ["loss", "undecided"]
    assert [f.verdict for f in both] == ["win", "win"]
