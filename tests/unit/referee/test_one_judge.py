"""One function decides, and makes each verdict once and whole."""

from dataclasses import replace

import numpy as np
import pytest
from draws import identities, independent
from numpy.testing import assert_allclose, assert_array_equal
from records import changed

import consistency as cs
from consistency.diagnostics import (
    Design,
    Errors,
    MapRecord,
    Rejections,
    Settings,
    Verdict,
    follow,
    judge,
    look,
    make_record,
)
from consistency.referee.diagnostics.error_parts import _sum_of_correlations
from consistency.referee.diagnostics.maps import last_nees
from consistency.referee.diagnostics.number_words import ratio_text
from consistency.referee.diagnostics.sample import sample_of
from consistency.referee.diagnostics.verdict_parts import (
    MAIN,
    STEP,
    answers,
    at_share,
    faults_of,
    least_of_steps,
    with_tolerated,
)
from consistency.referee.diagnostics.whitening import every_entry, whiten, whiten_group
from consistency.referee.gating.gate_results import GateResult, runs_to_decide
from consistency.referee.types import Failure

RUNS = 24


def record(scale=1.0, **more):
    error = scale * independent(np.random.default_rng(5), RUNS, 4, 3)
    nees = np.square(error).sum(axis=-1)
    return changed(make_record("f", error, identities(error), nees, axes=("x", "y", "heading")), **more)


def map_of(runs):
    """Two landmarks of each run, the second of the last one without a NEES."""
    run, nees = np.repeat(np.arange(runs), 2), np.tile([3.0, 6.0], runs)
    nees[-1] = np.nan

    def landmarks(last):
        assert last.shape == (runs,)
        return changed(make_record("map", nees=np.tile([3.0, 6.0], (runs, 1)), dof=3), landmarks=np.array([7, 9]))

    return MapRecord(run, nees, 3, landmarks)


def whole_record():
    """A record with everything that stands beside the errors."""
    error = independent(np.random.default_rng(6), RUNS, 4, 3)
    counts = (np.full(RUNS, n) for n in (10, 4, 3, 2))
    return record(
        convention="left", align="", caption="as fitted", causes=("a probable mix-up",), notes=("a note",),
        world=Errors(3.0 * error, identities(error)), read=lambda: map_of(RUNS),
        rejections=Rejections(np.arange(RUNS), *counts),
    )  # fmt: skip


def test_a_verdict_is_made_once_and_whole(monkeypatch):
    """One for the record, one in the world and one on the map; none is refilled."""
    made = []
    build = Verdict.__init__

    def count(self, *arguments, **more):
        build(self, *arguments, **more)
        made.append(self.status)

    monkeypatch.setattr(Verdict, "__init__", count)
    v = judge(whole_record(), keep_record=True)
    assert v.world is not None
    assert v.map is not None
    assert v.map.verdict is not None
    assert sorted(made) == sorted([v.status, v.world.status, v.map.verdict.status])
    assert v.world.status == "overconfident"
    assert v.reasons[0].endswith("; as fitted")
    assert "a probable mix-up" in v.reasons
    assert (v.convention, v.align, v.notes, v.causes) == ("left", None, ("a note",), ("a probable mix-up",))
    assert v.rejection is not None
    assert (v.rejection.offered, v.rejection.rejected) == (10 * RUNS, 3 * RUNS)
    assert v.record is not None
    assert judge(record()).record is None


def test_the_doors_to_the_judge_say_the_same():
    """Of a record, of its arrays, of a sequence of records."""
    given = record(2.0)
    verdicts = [judge(given), cs.judge(given), cs.analyse([given])["f"]]
    verdicts.append(cs.judge(given.errors.error, given.errors.covariance, axes=given.errors.axes, name="f"))
    for verdict in verdicts:
        assert verdict.status == "overconfident"
        assert verdict.reasons == verdicts[0].reasons
        assert verdict.statistics["ratio"] == verdicts[0].statistics["ratio"]


def test_a_look_has_what_stands_beside_the_errors_of_its_runs():
    given = whole_record()
    verdict = look(Design(3), given.first_runs(12), 0.5)
    assert verdict.world is not None
    assert verdict.map is not None
    assert verdict.rejection is not None
    assert (verdict.runs, verdict.world.runs, verdict.map.runs, verdict.rejection.runs) == (12, 12, 12, 12)
    assert verdict.map.verdict is None, "a look has the scores of the maps alone"
    assert verdict.world.convention is None
    assert verdict.world.notes == ()
    errors = changed(given.in_world, read=None, rejections=None)
    assert verdict.world.answers == follow(Design(3), errors.first_runs, 12)[0].answers
    assert verdict.world.answers != judge(errors.first_runs(12)).answers, "a look costs a part of the rate"


def test_a_design_judges_by_the_look_that_decides():
    given, design = record(3.0), Design(3)
    verdict, runs = follow(design, given.first_runs, RUNS)
    by_design = judge(given, design=design)
    assert runs == by_design.runs == 12
    assert by_design.reasons == verdict.reasons
    assert by_design.record is None
    assert judge(given, design=design, keep_record=True).record is given
    assert judge(given).runs == RUNS


@pytest.mark.parametrize("parts", [(), ((0,), (1,), (2,))])
def test_a_record_that_shows_nothing_is_undecided(parts):
    """Whether its errors are right or not, whole or each component by itself; a failure is one nevertheless."""
    wrong = judge(changed(record(3.0, unshown="pieces are too few"), parts=parts))
    assert (wrong.status, wrong.faults) == ("undecided", ())
    given = changed(record(unshown="pieces are too few"), parts=parts)
    assert judge(changed(given, unshown=""), Settings(detect=1e3)).status == "consistent"
    verdict = judge(given, Settings(detect=1e3))
    assert (verdict.status, verdict.faults, verdict.unshown) == ("undecided", (), "pieces are too few")
    ratio = f"the covariance ratio would be {ratio_text(verdict.scale.inflation)} if they are, reported and not judged"
    assert verdict.reasons[0] == f"undecided: pieces are too few; {ratio}"
    assert not verdict.scale.equivalence.shown
    assert verdict.scale.equivalence.runs is None
    failed = judge(replace(given, failures=(Failure("f", 3, 2, "diverged"),)))
    assert (failed.status, failed.unshown) == ("failed", "")
    assert "diverged" in failed.reasons[0]


def test_numbers_of_a_map_and_of_parts_stand_beside_the_others():
    numbers = judge(whole_record(), Settings(lost=0.3)).statistics
    assert numbers["lost"]["asked"] == 0.3
    assert numbers["map_landmarks"] == 2 * RUNS - 1
    assert numbers["map"]["statistics"]["landmarks"] == [7, 9]
    assert (numbers["rejected"], numbers["offered"]) == (3 * RUNS, 10 * RUNS)
    assert numbers["impossible"] == []
    assert "joint_ratio" not in numbers
    assert numbers["world"]["status"] == "overconfident"


def test_a_centred_sample_keeps_what_it_knows():
    given = record()
    sample = sample_of(changed(given, nees=None), Settings())
    names, components = sample.names, dict(sample.components)
    centred = sample.centred()
    assert (centred.names, dict(centred.components)) == (names, components)
    assert components == {"x": [0], "y": [1], "heading": [2], "position": [0, 1]}


# --- the layer of plain types -----------------------------------------------------------------------------


def test_the_scale_is_asked_at_the_whole_rate_where_nothing_else_is():
    settings = Settings(false_alarm=0.04)
    alone, among = (list(answers(dict.fromkeys(q, 0.5), 0.04).values()) for q in ([MAIN], [MAIN, STEP]))
    assert at_share(alone, settings).false_alarm == pytest.approx(0.08)
    assert at_share(among, settings).false_alarm == pytest.approx(0.04)


def test_only_faults_are_tolerated():
    given = tuple(answers({MAIN: 1e-9, STEP: 0.9, "bias": 1e-9}, 0.05).values())
    assert list(faults_of(given)) == [MAIN, "bias"]
    tolerated = with_tolerated(given, {MAIN, STEP})
    assert [a.tolerated for a in tolerated] == [True, False, False]
    assert list(faults_of(tolerated)) == ["bias"]


def test_the_smallest_p_value_of_steps_counts_their_number():
    assert least_of_steps(np.array([0.3, np.nan, 0.01, 0.2])) == (pytest.approx(0.03), 3)
    p, step = least_of_steps(np.full(3, np.nan))
    assert np.isnan(p)
    assert step is None


def test_the_last_nees_of_each_run():
    nees = np.array([[1.0, 2.0, np.nan], [np.nan, np.nan, np.nan], [3.0, np.nan, 4.0]])
    assert_array_equal(last_nees(make_record("f", nees=nees, dof=3)), [2.0, np.nan, 4.0])
    assert last_nees(changed(record(), nees=None)) is None


# --- arrays -------------------------------------------------------------------------------------------------


def test_a_group_of_components_is_whitened_by_its_own_covariance():
    rng = np.random.default_rng(8)
    A = rng.standard_normal((2, 5, 3, 3))
    e, P = rng.standard_normal((2, 5, 3)), A @ np.swapaxes(A, -1, -2) + np.eye(3)
    assert_allclose(whiten_group(e, P, [1]), e[..., [1]] / np.sqrt(P[..., 1, 1, None]))
    pair = whiten(e[..., [2, 0]], P[..., [2, 0], :][..., [2, 0]])
    assert_array_equal(whiten_group(e, P, [2, 0]), pair)
    assert_array_equal(whiten_group(e, P, [0, 1, 2]), whiten(e, P))


@pytest.mark.parametrize("n", [3, 9])
def test_every_entry_is_asked(n):
    P = np.zeros((4, 5, n, n))
    P[1, 2, 0, 2] = P[3, 4, 1, 1] = np.nan
    assert np.argwhere(~every_entry(np.isfinite, P)).tolist() == [[1, 2], [3, 4]]


def test_correlations_are_added_up():
    rng = np.random.default_rng(3)
    A = rng.standard_normal((5, 4, 6))
    expected = sum(np.corrcoef(rows) for rows in A)
    assert_allclose(_sum_of_correlations(np.array([np.cov(rows) for rows in A])), expected)


def test_an_undecided_gate_asks_for_more_runs_than_there_are():
    nothing = Verdict("f", "undecided", 3, 1, Settings())
    assert runs_to_decide(GateResult(False, False, 1.0, nothing.status, [], nothing), 3) == 4
    assert runs_to_decide(GateResult(False, False, 1.0, "not worse", [], None), 3) == 0
