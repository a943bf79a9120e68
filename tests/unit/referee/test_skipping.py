"""First steps left out of the statistics, and the hint that a fault is in them alone."""

import json

import numpy as np
import pytest
from command import consistency, refused
from draws import autoregression, identities, independent, verdict_on
from numpy.testing import assert_array_equal
from recorded import read_recordings
from records import changed

import consistency as cs
from consistency.diagnostics import Settings, make_record
from consistency.referee.diagnostics.fault_location import until
from consistency.referee.diagnostics.nees import simultaneous_band
from consistency.referee.diagnostics.record import Skip, Skipped, skip_of, without_first
from consistency.referee.diagnostics.sample import sample_of
from consistency.referee.errors import InputError
from consistency.referee.verdicts.compare_sources import baseline, read_baseline, write_baseline
from consistency.testing import ConsistencyError, assert_consistent, assert_not_worse

RUNS, STEPS, FIRST = 30, 40, 6
SURE = 1e-5
VOID = "a number that was chosen on these data voids the false-alarm rate"


@pytest.fixture
def errors(rng):
    """Too large in the first 6 of 40 steps, right afterwards."""
    error = independent(rng, RUNS, STEPS, 3)
    error[:, :FIRST] *= 4.0
    return error


@pytest.fixture
def archive(tmp_path, errors):
    path = tmp_path / "mine.npz"
    np.savez(path, errors=errors, covariances=identities(errors), t=100.0 + 0.5 * np.arange(STEPS))
    return path


# --- what is asked ----------------------------------------------------------------------------------


def test_steps_or_seconds_or_nothing():
    of = {"20": Skip(20), 20: Skip(20), "2s": Skip(2, "s"), " 0.5 s": Skip(0.5, "s")}
    assert {given: skip_of(given) for given in of} == of
    assert [skip_of(given) for given in (None, 0, "0", "0s")] == [None] * 4


@pytest.mark.parametrize("given", [-1, "2.5", 2.5, True, "x", "2m", "s", ""])
def test_neither_steps_nor_seconds(given):
    with pytest.raises(ValueError, match="must be a whole number of steps"):
        skip_of(given)


def test_seconds_count_from_the_first_time_of_each_run():
    """The step at the end of the seconds is kept; a run that begins later loses later steps."""
    t = np.array([[0.0, 0.5, 1.0, 1.5], [np.nan, 7.0, 7.5, 8.0]])
    assert_array_equal(Skip(1.0, "s").mask((2, 4), t), [[1, 1, 0, 0], [0, 1, 1, 0]])
    assert_array_equal(Skip(1.0, "s").mask((2, 4), t[0]), [[1, 1, 0, 0]] * 2)
    with pytest.raises(ValueError, match="there are no times; give a number of steps"):
        Skip(1.0, "s").mask((2, 4), np.array([[0.0, 1.0, 2.0, 3.0], [np.nan] * 4]))


# --- verdicts ---------------------------------------------------------------------------------------


def test_the_rest_is_judged_by_its_own_steps(archive, errors):
    """As the errors without those steps, whose numbers it keeps; one right log in 1e5 is found at fault."""
    record = cs.read(archive)
    assert cs.judge(record).status == "overconfident"
    errors[:, 22] *= 5.0
    verdict = cs.judge(record, skip=FIRST, false_alarm=SURE)
    cut = verdict_on(np.delete(errors, 22, axis=1)[:, FIRST:], false_alarm=SURE)
    assert verdict.status == cut.status == "consistent"
    assert verdict.reasons[0].endswith("; without the first 6 steps of each run")
    assert any(VOID in reason for reason in verdict.reasons)
    assert (verdict.steps, verdict.scale.judged_steps) == (STEPS, STEPS - FIRST)  # type: ignore[union-attr]
    assert verdict.statistics["skip"] == "6"
    assert (verdict.statistics["skipped_steps"], verdict.statistics["skipped_runs"]) == (FIRST, 0)
    assert verdict.statistics["left_out_steps"] == []
    assert np.isfinite(record.errors.nees).all()  # type: ignore[arg-type]


def test_steps_keep_their_numbers(errors):
    errors[:, 22] *= 5.0
    with pytest.raises(ConsistencyError, match="without the first 6 steps of each run") as fault:
        assert_consistent(errors, np.array(identities(errors)), skip=FIRST, false_alarm=0.01)
    assert fault.value.verdict.first_step == 23


def test_tables_have_times_of_each_run(tmp_path):
    """Two days, which share no clock: seconds count from the first estimate of each."""
    head = "run,t,a,P_a_a\n"
    rows = [f"{run},{5000.0 * run + 0.1 * k:.1f},{{}},1\n" for run in range(3) for k in range(10 + run)]
    noise = np.random.default_rng(3).normal(size=len(rows))
    (tmp_path / "est.csv").write_text(
        head + "".join(row.format(f"{e:.6f}") for row, e in zip(rows, noise, strict=True))
    )
    (tmp_path / "truth.csv").write_text(head + "".join(row.format(0) for row in rows))
    (record,) = read_recordings(tmp_path / "est.csv", tmp_path / "truth.csv", state=["a"])
    assert np.isnan(record.runs.t).all()
    rest = record.without_first(Skip(0.35, "s"))
    assert_array_equal(np.isfinite(rest.errors.nees).sum(axis=1), [6, 7, 8])  # type: ignore[arg-type]
    assert record.without_first(None).runs.skipped is None


def test_windows_count_as_steps_and_by_their_beginning(tmp_path, rng):
    D = np.tile([1.0, 0.0, 0.0], (40, 1))
    np.savez(
        tmp_path / "m.npz",
        estimates=D + 0.01 * rng.normal(size=D.shape),
        truth=np.cumsum(D, axis=0),
        covariances=np.tile(1e-4 * np.eye(3), (40, 1, 1)),
        t=0.5 * np.arange(40),
    )
    (record,) = read_recordings(tmp_path / "m.npz", relative=3, motions=True)
    windows = int(np.isfinite(record.errors.nees).sum())  # type: ignore[arg-type]
    for skip, lost in ((Skip(2), 2), (Skip(3.0, "s"), 2), (Skip(3.1, "s"), 3)):
        rest = record.without_first(skip)
        assert int(np.isfinite(rest.errors.nees).sum()) == windows - lost  # type: ignore[arg-type]
    verdict = cs.judge(cs.read(tmp_path / "m.npz", relative=3, motions=True), skip=2)
    assert verdict.runs == windows - 2
    assert "without the first 2 steps of each log" in verdict.reasons[0]


def test_a_run_of_which_nothing_is_left_is_named(errors, tmp_path):
    lengths = np.full(RUNS, STEPS)
    lengths[3] = 4
    np.savez(tmp_path / "short.npz", errors=errors, covariances=identities(errors), lengths=lengths)
    verdict = cs.judge(cs.read(tmp_path / "short.npz"), skip=FIRST)
    assert verdict.statistics["skipped_runs"] == 1
    assert any("nothing is left of 1 run;" in reason for reason in verdict.reasons)


def test_a_run_that_had_nothing_has_lost_nothing():
    """Of a whole run, one of two steps and one without a value, the second alone is emptied."""
    nees = np.ones((3, 5))
    nees[1, 2:] = nees[2] = np.nan
    left, lost = without_first(Skip(2), {"nees": nees, "nis_dof": np.full((3, 5), 4)}, "mine")
    assert lost == Skipped(Skip(2), steps=2, empty=1)
    assert_array_equal(np.isfinite(left["nees"]), [[False] * 2 + [True] * 3, [False] * 5, [False] * 5])
    assert left["nis_dof"].tolist() == [[0, 0, 4, 4, 4]] * 3


def test_refusals(archive, tmp_path, errors):
    record = cs.read(archive)
    with pytest.raises(InputError, match="skip=40: nothing of mine is left, whose last step is 40"):
        cs.judge(record, skip=STEPS)
    np.savez(tmp_path / "bare.npz", errors=errors, covariances=identities(errors))
    with pytest.raises(InputError, match="skip=2s: there are no times; give a number of steps"):
        cs.judge(cs.read(tmp_path / "bare.npz"), skip="2s")
    with pytest.raises(InputError, match=r"skip=2\.5: must be a whole number of steps"):
        cs.judge(record, skip=2.5)
    with pytest.raises(ValueError, match=r"^skip 40: nothing of the estimator is left, whose last step is 40"):
        assert_consistent(errors, identities(errors), skip=STEPS)


def test_innovations_without_the_first_steps(rng):
    """NIS of the left-out steps count no more, nor do their degrees of freedom; one right case in 1e5 fails."""
    nis = rng.chisquare(2, (RUNS, STEPS))
    nis[:, :FIRST] *= 9.0
    given = {"nis": nis, "nis_dof": 2, "optimal_gain": True, "false_alarm": SURE}
    with pytest.raises(ConsistencyError):
        assert_consistent(**given)
    verdict = assert_consistent(**given, skip=FIRST)
    assert verdict.innovations.dof == 2 * RUNS * (STEPS - FIRST)
    assert verdict.innovations.ratio == pytest.approx(nis[:, FIRST:].mean() / 2)


def test_gates_with_nees_alone(errors):
    nees = np.square(errors).sum(axis=-1)
    assert assert_consistent(nees=nees, dof=3, skip=FIRST, false_alarm=SURE).statistics["skipped_steps"] == FIRST
    with pytest.raises(ConsistencyError, match="skip=8 in a gate"):
        assert_consistent(nees=nees, dof=3, false_alarm=0.01)


def test_a_comparison_without_the_first_steps(errors, rng):
    """Both filters are right afterwards; one pair in 1e5 is said to differ."""
    P, other = np.array(identities(errors)), independent(rng, RUNS, STEPS, 3)
    with pytest.raises(ConsistencyError):
        assert_not_worse(errors, P, other, P, false_alarm=SURE)
    assert_not_worse(errors, P, other, P, false_alarm=SURE, skip=FIRST, detect=3.0)


def test_a_baseline_holds_what_it_was_written_with(archive, tmp_path):
    records = read_recordings(archive)
    write_baseline(baseline(records, "mine", skip=FIRST), tmp_path / "base.json")
    assert read_baseline(tmp_path / "base.json", skip="6").skip == "6"
    for skip, wanted in ((None, "without --skip"), (7, "with --skip 7")):
        with pytest.raises(InputError, match=f"was written with --skip 6; write it again {wanted}"):
            read_baseline(tmp_path / "base.json", skip=skip)
    means = baseline(records, "mine").filters["mine"].nees
    rest = baseline(records, "mine", skip=FIRST).filters["mine"].nees
    assert (rest < means).all()


def test_records_of_two_errors():
    """Errors stay, and so does the error of the filter's own; what they are held against is left out."""
    shape = (2, 4)
    P, own = np.full((*shape, 3, 3), 1.0), np.full((*shape, 3, 3), 2.0)
    numbers = np.ones(shape)
    error = np.ones((*shape, 3))
    c = changed(
        make_record(
            "f",
            error,
            own,
            numbers,
            nis=numbers,
            nis_dof=numbers.astype(np.int64),
            t=np.arange(1.0, 5.0),
            convention="left",
        ),
        world=make_record("f", error, P, numbers).errors,
    )
    rest = c.without_first(Skip(2.0, "s"))
    world = rest.in_world
    for values in (
        rest.errors.nees,
        rest.innovations.nis,
        rest.errors.covariance[..., 0, 1],
        world.errors.nees,
        world.errors.covariance[..., 2, 2],
    ):
        assert_array_equal(np.isnan(values), [[True, True, False, False]] * 2)
    assert_array_equal(rest.innovations.nis_dof, [[0, 0, 1, 1]] * 2)
    assert rest.innovations.nis_dof.dtype == np.int64
    assert rest.errors.error is world.errors.error is error
    assert np.isfinite(P).all()
    with pytest.raises(InputError, match="--skip 4: nothing of f is left"):
        c.without_first(Skip(4))


def test_the_command(archive, tmp_path, capsys):
    out, _ = consistency(capsys, "analyse", archive, "--skip", "3s", "--fail-on", "inconsistent", "--json")
    (verdict,) = json.loads(out).values()
    assert verdict["statistics"]["skip"] == "3s"
    out, _ = consistency(capsys, "analyse", archive, "--fail-on", "inconsistent", status=1)
    assert "the fault is in the first 8 steps only" in out.replace("\n", " ")
    refused(capsys, "analyse", archive, "--skip", "99")
    refused(capsys, "compare", archive, archive, "--skip", "x")
    consistency(capsys, "compare", archive, archive, "--skip", "6")
    consistency(capsys, "baseline", archive, "--skip", "6", "--out", tmp_path / "b.json")
    err = refused(capsys, "compare", archive, tmp_path / "b.json")
    assert "was written with --skip 6; write it again without --skip" in err


# --- the hint ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("ratio", [6.0, 1.0 / 6.0])
@pytest.mark.parametrize("steps", [1, 5, 16])
def test_a_fault_of_the_first_steps_is_named(steps, ratio, rng):
    """50 standard errors from being missed, and the ratio afterwards is outside its interval in one case of 20."""
    error = independent(rng, 200, 60, 3)
    error[:, :steps] *= np.sqrt(ratio)
    verdict = verdict_on(error, false_alarm=SURE)
    until = verdict.location.until
    assert until.step in (steps, 1 << (steps - 1).bit_length())
    assert until.early == pytest.approx(1.0 + (ratio - 1.0) * steps / until.step, rel=0.3)
    assert until.late.value == pytest.approx(1.0, abs=0.05)
    where = "the first step" if until.step == 1 else f"the first {until.step} steps"
    (said,) = (reason for reason in verdict.reasons if "the fault is in" in reason)
    assert said.startswith(f"the fault is in {where} only, where the covariance ratio is ")
    assert f"state --skip {until.step} (skip={until.step} in a gate)" in said
    assert verdict.statistics["until"] == until.step


def test_a_bias_of_the_first_steps_is_named(rng):
    error = autoregression(rng, 100, 64, 3)
    error[:, :8, 0] += 4.0
    verdict = verdict_on(error, false_alarm=SURE)
    assert verdict.location.until.step == 8


def test_no_hint_where_a_fault_remains(rng):
    """Half of the fault is left, or a later step has one too, or the fault is in the later steps."""
    for scale in (np.r_[np.full(8, 9.0), np.full(56, 2.5)], np.r_[9.0, np.ones(40), 9.0, np.ones(22)],
                  np.r_[np.ones(32), np.full(32, 9.0)]):  # fmt: skip
        error = independent(rng, 100, 64, 3) * np.sqrt(scale)[:, None]
        verdict = verdict_on(error, false_alarm=SURE)
        assert verdict.faults
        assert verdict.location.until is None


def test_first_steps_that_are_right_carry_no_fault(rng):
    """Errors of the first step are 1 but for 3 %, those of the others x1.2; no step leaves the band."""
    error = independent(rng, 200, 60, 3)
    error *= np.sqrt(3.0 * np.r_[0.97, np.full(59, 1.2)] / np.square(error).sum(axis=-1).mean(axis=0))[:, None]
    sample = sample_of(make_record("f", error, identities(error)), Settings())
    inside = simultaneous_band(sample.nees / 1.2, 3, SURE)
    assert not inside.outside.any()
    assert until(sample, inside, 1.5) is None


def test_the_first_steps_hold_the_whole_stretch_of_a_fault(rng):
    """12 steps at fault, in none of which the band is left: the first 8 do not carry it alone."""
    error = independent(rng, 200, 60, 3)
    error[:, :12] *= 3.0
    sample = sample_of(make_record("f", error, identities(error)), Settings())
    wide = simultaneous_band(np.full_like(sample.nees, 3.0), 3, SURE)
    assert not wide.outside.any()
    for end, step in ((8, 8), (9, 16), (12, 16), (16, 16)):
        found = until(sample, wide, 1e3, slice(0, end))
        assert found is not None
        assert found.step == step


def test_no_start_to_skip_is_more_than_half(rng):
    """The end of a fault in 40 of 64 steps is named; leaving these out is no advice."""
    verdict = verdict_on(independent(rng, 100, 64, 3) * np.sqrt(np.r_[np.full(40, 9.0), np.ones(24)])[:, None])
    assert verdict.location.until.step == 40
    assert verdict.location.since is None
    said = [reason for reason in verdict.reasons if "the fault is in the first 40 steps only" in reason]
    assert len(said) == 1
    assert "--skip" not in said[0]


@pytest.mark.parametrize("ratio", [1.0 / 6.0, 2.0, 4.0])
@pytest.mark.parametrize("first, last", [(21, 40), (4, 8), (12, 12), (5, 46)])
def test_a_fault_that_begins_and_ends_is_named_by_both(first, last, ratio, rng):
    """Ends are exact but for one step of x2 in 200 runs, whose likelihood a neighbour exceeds with less than 1e-3."""
    error = independent(rng, 200, 50, 3)
    error[:, first - 1 : last] *= np.sqrt(ratio)
    verdict = verdict_on(error, false_alarm=SURE)
    where = f"steps {first} to {last}" if first < last else f"step {first}"
    assert (verdict.statistics["since"], verdict.statistics["until"]) == (first, last)
    assert verdict.inflation == pytest.approx(ratio, rel=0.3)
    assert verdict.location.until.late.value == pytest.approx(1.0, abs=0.1)
    assert f" in {where}" in verdict.reasons[0]
    assert any(reason.startswith(f"the fault is in {where} only; in the others ") for reason in verdict.reasons)
    assert "--skip" not in " ".join(verdict.reasons)


def test_the_place_of_a_fault_where_steps_depend(rng):
    """AR(0.9): late faults have no end, a fault in the middle does not begin at the start, and ends are near."""
    for begin, end in ((50, 100), (80, 100), (20, 60), (60, 70)):
        for ratio in (2.0, 4.0):
            error = autoregression(rng, 40, 100, 6, 0.9)
            error[:, begin:end] *= np.sqrt(ratio)
            verdict = verdict_on(error)
            assert "in the first" not in " ".join(verdict.reasons)
            until = verdict.location.until
            assert (until is None) or (end < 100 and abs(until.step - end) <= 4)
            assert until is None or abs(verdict.location.since - begin - 1) <= 4


def test_no_hint_of_few_runs_or_a_single_step(rng):
    for shape in ((7, 60), (50, 1)):
        error = 3.0 * independent(rng, *shape, 3)
        if shape[1] > 1:
            error[:, 8:] /= 3.0
        verdict = verdict_on(error)
        assert verdict.location.until is None
