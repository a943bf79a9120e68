"""What a first reading needs: the strongest fault first, intervals of the tests, seconds and files, and no more.

The seed of ``rng`` is fixed and was not chosen; faults are so large that a verdict at a rate of 1e-5 finds them.
"""

import itertools
import re
from dataclasses import replace

import numpy as np
import pytest
from draws import identities, independent

import consistency as cs
from consistency.diagnostics import Settings, judge, make_record
from consistency.referee.diagnostics.number_words import UNCERTAIN, off_by, ratio_text, short
from consistency.referee.diagnostics.sentences import reasons
from consistency.referee.diagnostics.verdict_parts import Interval
from consistency.referee.pages.write_pages import compose_files
from consistency.referee.show.blocks import PLAIN, Quantity, written
from consistency.referee.types import Failure
from consistency.referee.verdicts.tables import TERMINAL, cells, document


def judged(error, **settings):
    record = make_record("f", error, identities(error), axes=("x", "y", "heading")[: error.shape[-1]])
    return judge(record, Settings(**{"false_alarm": 1e-5} | settings))  # type: ignore[arg-type]


def test_the_interval_of_the_sentence_is_that_of_the_test(rng):
    """Whatever the data, "shown" goes with an interval inside the ends, and "not shown" with one outside."""
    shown = set()
    for runs, scale in itertools.product((5, 20, 40, 80), (0.8, 1.0, 1.2, 1.35)):
        verdict = judged(independent(rng, runs, 6, 3) * np.sqrt(scale))
        equivalence = verdict.equivalence
        assert equivalence is not None
        assert equivalence.interval is not None
        low, high = equivalence.interval
        assert low < verdict.inflation < high
        assert equivalence.shown == (1.0 / equivalence.factor <= low and high <= equivalence.factor)
        shown.add(equivalence.shown)
        assert verdict.statistics["equivalence"]["interval"] == equivalence.interval
        if not verdict.faults:
            ends = f"(90 % interval {short(low)} to {short(high)})"
            assert f"covariance ratio {short(verdict.inflation)} {ends}" in verdict.reasons[0]
    assert shown == {True, False}


def test_the_interval_of_a_one_sided_test_has_an_upper_end(rng):
    verdict = judged(independent(rng, 60, 6, 3), allow="conservative")
    assert verdict.equivalence is not None
    assert verdict.equivalence.interval is not None
    _, high = verdict.equivalence.interval
    assert f"(below {short(high)} at a confidence of 95 %)" in verdict.reasons[0]


def test_the_strongest_fault_comes_first(rng):
    """A factor of 2 in 400 runs is far surer than a mean of half a standard deviation in single steps."""
    error = np.sqrt(2.0) * independent(rng, 400, 6, 3)
    error[:, 3, 1] += 0.9
    verdict = judged(error)
    found = {answer.question: answer.adjusted for answer in verdict.answers if answer.found}
    assert found.keys() >= {"scale", "bias in some step"}
    sentence = verdict.reasons[0]
    assert re.match(r"overconfident: covariance [a-z ]*too small by x[^;]*; mean error ", sentence)


def test_what_the_status_says_comes_before_a_fault_that_is_surer(rng):
    error = 2.0 * (0.5 + independent(rng, 100, 6, 3))
    verdict = judged(error)
    assert verdict.status == "overconfident"
    answers = tuple(replace(a, adjusted=1e-9 if "bias" in a.question else 1e-3) for a in verdict.answers)
    sentence = reasons(replace(verdict, answers=answers))[0]
    assert re.match(r"overconfident: covariance about the mean too small by .*; mean error ", sentence)
    biased = judged(0.5 + independent(rng, 100, 6, 3))
    assert biased.reasons[0].startswith("biased: mean error ")


def test_credibility_and_p_values_are_details(rng):
    verdict = judged(2.0 * independent(rng, 40, 6, 3))
    assert [text.split(" ")[0] for text in verdict.details] == ["noncredibility", "9"]
    assert set(verdict.details) <= set(verdict.reasons)
    for verbose in (False, True):
        (entry,) = document({"f": verdict}, verbose=verbose).reasons
        assert set(verdict.details).isdisjoint(entry.others) is not verbose
        assert "2-sigma coverage" in " ".join(entry.others)


def test_pages_leave_out_credibility_indices(rng):
    """Nothing on a page of files says what they are."""
    error = 2.0 * independent(rng, 40, 6, 3)
    record = make_record("f", error, identities(error), axes=("x", "y", "heading"))
    document = repr(compose_files([record], {"f": judge(record)}, "f", {}))
    assert "2-sigma coverage" in document
    assert "noncredibility" not in document


def test_a_verdict_that_failed_plans_no_runs(rng):
    error = independent(rng, 20, 6, 3)
    record = make_record("f", error, identities(error))
    settings = Settings(1e-5, detect=1.2)
    assert judge(record, settings).reasons[0].endswith("such runs would probably decide")
    failed = judge(replace(record, failures=(Failure("f", 3, 2, "it broke"),)), settings)
    assert failed.status == "failed"
    assert failed.reasons[1].startswith("no other fault found")
    assert "would probably decide" not in " ".join(failed.reasons)


def test_a_fault_of_a_correlation_names_the_combination(rng):
    error = independent(rng, 100, 6, 3)
    covariance = np.eye(3)
    covariance[0, 1] = covariance[1, 0] = -0.9
    verdict = cs.judge(error, np.broadcast_to(covariance, (100, 6, 3, 3)), axes=["x", "y", "z"])
    assert "scale" in verdict.faults
    assert verdict.axes is not None
    assert all(verdict.axes.inflation[axis].holds(1.0) for axis in "xyz")
    assert not any("worst axis" in text or "mainly" in text for text in verdict.reasons)
    combination = "no single axis is shown wrong; the error is in a combination of x and y (correlation"
    assert any(text.startswith(combination) for text in verdict.reasons)


def test_one_shot_estimates_do_not_get_lost(rng):
    error = independent(rng, 80, 1, 2)
    error[0] = 40.0
    for scale in (1.0, 3.0):
        verdict = judged(scale * error)
        assert not any("lost" in text for text in verdict.reasons)
    assert any("lost runs" in text for text in judged(error, lost=0.1).reasons)
    assert any("may still be lost" in text for text in judged(independent(rng, 80, 2, 2)).reasons)


def test_biased_shows_the_ratio_about_the_mean(rng):
    verdict = judged(independent(rng, 60, 6, 3) + np.array([2.0, 0.0, 0.0]))
    assert verdict.status == "biased"
    assert verdict.bias is not None
    assert verdict.bias.inflation_without is not None
    assert f"{ratio_text(verdict.bias.inflation_without)} about the mean" in cells(TERMINAL, verdict)


@pytest.mark.parametrize(
    "interval, text, factor",
    [
        (Interval(55.1, 6.76, 9.8e5), "at least 6.76", "too small by at least x6.76"),
        (Interval(2.0, 1.5, 2.5), "2.00 [1.50, 2.50]", "too small by x2.00 [1.50, 2.50]"),
        (Interval(2.0, 0.01, 9.0), "2.00 (known to no better than a factor of 100)", None),
    ],
)
def test_an_interval_without_an_upper_end(interval, text, factor):
    assert ratio_text(interval) == text
    assert factor is None or off_by(interval) == factor
    cell = Quantity(interval.value, interval[1:], limit=UNCERTAIN)
    assert written(cell, PLAIN).startswith(text.replace("least ", "least x").split(" (")[0].split(" [")[0])


def test_seconds_and_files_are_named(tmp_path):
    rng = np.random.default_rng()
    stated = np.eye(2)[np.triu_indices(2)]
    for run in range(30):
        error = rng.normal(size=(8, 2)) * (50.0 if run == 7 else 1.0)
        for name, values in (("est", error), ("true", np.zeros((8, 2)))):
            (tmp_path / name).mkdir(exist_ok=True)
            rows = [[0.5 * k, *values[k], *stated] for k in range(8)]
            text = "".join(",".join(map(repr, map(float, row))) + "\n" for row in rows)
            (tmp_path / name / f"{run:02d}.csv").write_text(f"t,a,b,P_a_a,P_a_b,P_b_b\n{text}")
    verdict = cs.judge(cs.read(tmp_path / "est", tmp_path / "true", state=["a", "b"]))
    assert verdict.run_name(7) == f"run 7 ({tmp_path / 'est' / '07.csv'})"
    assert verdict.place(4) == "step 4 (1.5 s)"
    assert f"in run 7 ({tmp_path / 'est' / '07.csv'}), step " in verdict.reasons[0]
    assert re.search(r"step \d \(\d(\.5)? s\)", verdict.reasons[0])
