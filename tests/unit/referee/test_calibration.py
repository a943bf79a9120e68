"""The calibration of the referee: worlds, how their gates are counted, and the committed table."""

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import calibration
import calibration_cases
import calibration_monitor
import calibration_rows
import calibration_worlds as worlds
import numpy as np
import pytest
from calibration_cases import Case, Claim
from calibration_gates import Draw, joined, random_walk_filter, turned
from calibration_rows import Row, kept
from numpy.testing import assert_allclose, assert_array_equal
from recorded import read_recordings
from scipy import stats

import consistency as cs
from consistency.diagnostics import nis_of
from consistency.referee.diagnostics.nees import nees
from consistency.referee.geometry import planar_error

ROOT = Path(__file__).parents[3]
TABLE = json.loads((ROOT / "reports/reference/calibration.json").read_text(encoding="utf-8"))
ROWS = calibration_rows.rows_of(TABLE)
RIGHT = {name: world for name, world in (worlds.WORLDS | worlds.LOGS).items() if name != "linear-gaussian"}


@pytest.fixture(autouse=True)
def _pool(monkeypatch):
    """A stand-in for the runs of the Kalman filter, whose errors are exact by their own tests."""
    error = np.random.default_rng(7).standard_normal((301, 100, 3))
    monkeypatch.setitem(worlds.POOL, "linear-gaussian", (error, np.eye(3)))


# --- the committed table ------------------------------------------------------------------------------------


def test_every_case_was_measured_with_all_its_gates():
    measured = {(r.world, r.question, r.ratio, r.runs, r.stated, r.bound): r.gates for r in ROWS}
    for case in calibration_cases.cases():
        for claim in case.claims:
            gates = measured[(case.world, claim.question, case.ratio, case.runs, claim.stated, claim.bound)]
            assert gates >= case.gates, (case, claim)


def test_what_was_measured_keeps_the_promise():
    assert [row for row in ROWS if not kept(row)] == []


def test_the_documentation_shows_it():
    assert calibration_rows.markdown(TABLE) in (ROOT / "docs/reference/rates.md").read_text(encoding="utf-8")


def test_rows_of_one_module_take_the_place_of_their_questions_in_their_worlds():
    def said(rows):
        return [str(row) for row in rows]  # NaN is not equal to itself

    old = ROWS[0]
    new = replace(old, world="a new world", question="a new question", gates=7, found=1)
    table = calibration_rows.merged(TABLE, [new], {"a new world": "it", "a new question": "asked"})
    assert said(calibration_rows.rows_of(table)) == said([*ROWS, new])
    assert (table["seed"], table["wall_time_s"]) == (TABLE["seed"], TABLE["wall_time_s"])
    assert table["questions"] == TABLE["questions"] | {"a new question": "asked"}
    again = calibration_rows.merged(table, [replace(new, found=2)], {})
    assert [row.found for row in calibration_rows.rows_of(again) if row.question == new.question] == [2]
    assert again["worlds"] == table["worlds"]
    beside = calibration_rows.merged(TABLE, [replace(new, question=old.question)], {"a new world": "it"})
    assert said(row for row in calibration_rows.rows_of(beside) if row.world != "a new world") == said(ROWS)
    last = ROWS[-1]
    asked = [row for row in ROWS if (row.question, row.world) == (last.question, last.world)]
    assert said(calibration_rows.rows_of(calibration_rows.merged(TABLE, [*asked, new], {}))) == said([*ROWS, new])
    first = [row for row in ROWS if (row.question, row.world) == (old.question, old.world)]
    in_place = calibration_rows.rows_of(calibration_rows.merged(TABLE, first, {}))
    assert said(in_place) == said(ROWS)


def test_every_question_and_world_of_the_table_is_explained():
    assert {row.question for row in ROWS} == set(TABLE["questions"])
    assert {row.world for row in ROWS} == set(TABLE["worlds"])


# --- promises -----------------------------------------------------------------------------------------------

ALARMS = Row("w", "false alarm", 1.0, 21, 1, 0.05, "<=", 1000, 50)
POWER = Row("w", "power", 1.5, 61, 1, 0.95, ">=", 1000, 950)


@pytest.mark.parametrize(
    "row, good",
    [
        (ALARMS, True), (replace(ALARMS, found=0), True), (replace(ALARMS, found=66), True),
        (replace(ALARMS, found=70), False), (replace(ALARMS, stated=0.01, found=21), False),
        (POWER, True), (replace(POWER, found=1000), True), (replace(POWER, found=935), True),
        (replace(POWER, found=930), False),
        (replace(ALARMS, stated=0.0, found=0), True), (replace(ALARMS, stated=0.0, found=1), False),
    ],
)  # fmt: skip
def test_a_promise_is_broken_beyond_its_binomial_limit(row, good):
    assert kept(row) is good


def test_the_quick_rows_of_a_referee_that_keeps_its_promises_fail_less_than_once_in_5000():
    """At rates exactly as stated, which is as bad as a promise that is kept can be."""
    claims = [(case.gates, claim) for case in calibration_cases.quick_cases() for claim in case.claims]
    confidence = calibration_cases.quick_confidence(len(claims))
    chance = 0.0
    for gates, claim in claims:
        found = np.arange(gates + 1)
        rows = (Row("w", claim.question, 1.0, 1, 1, claim.stated, claim.bound, gates, int(k)) for k in found)
        broken = np.array([not kept(row, confidence) for row in rows])
        chance += float(stats.binom.pmf(found, gates, claim.stated)[broken].sum())
    assert 2e-6 < chance < 2e-4


# --- worlds -------------------------------------------------------------------------------------------------


def p_values(gate, step):
    """That one step of a gate is N(0, P), whose runs are independent: of the NEES, and of the NIS."""
    found = []
    if gate.error is not None or gate.nees is not None:
        if gate.error is not None:
            there = np.isfinite(gate.error[:, step]).all(axis=-1)
            values, dof = nees(gate.error[there, step], gate.covariance[there, step]), gate.error.shape[-1]
        else:
            values, dof = gate.nees[:, step], gate.dof
        found.append(stats.kstest(values, "chi2", args=(dof,)).pvalue)
        found.append(
            2 * min(stats.chi2.sf(values.sum(), dof * len(values)), stats.chi2.cdf(values.sum(), dof * len(values)))
        )
    nis, dof = gate.nis, gate.nis_dof
    if gate.innovations is not None:
        nis, dof = nis_of(gate.innovations, gate.innovation_covariances)
    if nis is not None:
        found.append(two_sided(np.nansum(nis[:, step]), dof[:, step].sum()))
    return found


def two_sided(total, dof):
    return 2.0 * float(min(stats.chi2.sf(total, dof), stats.chi2.cdf(total, dof)))


@pytest.mark.parametrize("name", RIGHT)
def test_every_step_of_a_right_world_is_as_stated(name):
    """Under 150 p values at 1e-7; one and the same in every run of the tests."""
    rng = np.random.default_rng(20070)
    gate = RIGHT[name].draw(Draw(rng, 3000, 30))
    for step in (0, 14, 29):
        assert min(p_values(gate, step)) > 1e-7
    assert max(p_values(gate.wrong_by(1.5), 0)) < 1e-3  # negative control
    if gate.innovations is not None or gate.nis is not None:
        assert gate.optimal_gain == (name == "NIS alone")


@pytest.mark.parametrize("name", worlds.HEAVY)
def test_heavy_tails_have_the_stated_covariance(name):
    """Means of squares over 6,000 runs, whose standard error is worked out from the sample: 6 of them."""
    gate = worlds.HEAVY[name].draw(Draw(np.random.default_rng(20070), 6000, 4))
    products = np.einsum("rti,rtj->rij", gate.error, gate.error).reshape(6000, 9) / 4
    away = products.mean(axis=0) - np.eye(3).ravel()
    assert (np.abs(away) < 6 * products.std(axis=0) / np.sqrt(6000)).all()
    assert np.abs(gate.error).max() > 6.0 or name.startswith("t10")  # the tails are there


def test_errors_of_a_filter_have_its_variance_and_turn_with_it():
    """Means of products over 4,000 runs against their stated values, 6 standard errors of theirs."""
    draw = Draw(np.random.default_rng(20070), 4000, 6)
    error, variance = random_walk_filter(draw, start=2.0, process=0.5, noise=3.0, n=2)
    stretched, variance = error * [1.0, 3.0], variance * [1.0, 9.0]
    assert_allclose(variance[0, 0], 1.0 / (1.0 / 2.5 + 1.0 / 3.0))  # information adds up
    heading = np.array([0.0, 0.3, 1.2, -2.0, 4.0, 0.7])
    for each in (0.0 * heading, heading):
        body, covariance = turned(stretched, variance, np.broadcast_to(each, (4000, 6)))
        products = np.einsum("rti,rtj->rtij", body, body)
        away = products.mean(axis=0) - covariance[0]
        assert (np.abs(away) < 6 * products.std(axis=0) / np.sqrt(4000)).all()
    assert_allclose(body[:, 1], stretched[:, 1] @ [[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])


def test_gates_take_their_own_runs_of_the_pool():
    case = Case("linear-gaussian", 43, 7, ())
    gates = [calibration.Growing(case, number, 1)(43).error for number in range(7)]
    assert len(np.unique(np.concatenate(gates)[:, 0, 0])) == 301
    grown = calibration.Growing(case, 2, 1)
    grown(10)
    assert_array_equal(grown(43).error, gates[2])


# --- planar poses -------------------------------------------------------------------------------------------


def test_poses_have_exactly_the_left_invariant_errors_that_were_drawn(tmp_path):
    """In memory and as a file for ``analyse --error left``; under another convention they are others."""
    truth, estimate, covariance = worlds.left_poses(Draw(np.random.default_rng(20070), 6, 20))
    recording = worlds.recorded(truth, estimate, covariance)
    path = tmp_path / "poses.npz"
    np.savez(path, estimates=estimate, truth=truth, covariances=covariance)
    (read,) = read_recordings(path, error="left")
    assert_array_equal(recording.errors.error, read.errors.error)
    assert_array_equal(recording.errors.covariance, read.errors.covariance)
    assert_array_equal(recording.errors.nees, read.errors.nees)
    assert recording.failures == read.failures == ()
    (other,) = read_recordings(path, error="so2")
    assert np.abs(other.errors.error - read.errors.error).max() > 0.01


def test_an_estimate_less_its_error_is_the_truth():
    rng = np.random.default_rng(20070)
    pose, error = rng.standard_normal((2, 50, 3))
    error[0] = 0.0
    motion = worlds._composed(pose, worlds._se2_exp(error))
    assert_allclose(planar_error(motion, pose, "left"), error, atol=1e-12)


# --- gates and rows -----------------------------------------------------------------------------------------

CASE = Case("AR(.95)", 30, 4, (Claim("false alarm", "fault", 0.05, "<="), Claim("all-clear", "consistent", 0.9, ">=")))


def test_a_gate_depends_on_its_number_and_not_on_how_it_is_drawn():
    case = replace(CASE, mode="until decided")
    at_once, grown = calibration.Growing(case, 3, 1), calibration.Growing(case, 3, 1)
    for runs in (5, 5, 12, 30, 8):
        part = grown(runs)
        assert len(part.error) == len(part.covariance) == runs
    assert_array_equal(grown(30).first(12).error, grown(12).error)
    assert not np.array_equal(at_once(5).error, calibration.Growing(case, 4, 1)(5).error)
    assert_array_equal(at_once(5).error, grown(5).error)


def test_a_fault_scales_every_covariance_that_is_stated():
    gate = worlds.WORLDS["fixed gain"].draw(Draw(np.random.default_rng(1), 4, 5))
    wrong = gate.wrong_by(2.0)
    assert_allclose(wrong.covariance, gate.covariance / 2.0)
    assert_allclose(wrong.innovation_covariances, gate.innovation_covariances / 2.0)
    assert_array_equal(wrong.error, gate.error)
    alone = worlds.WORLDS["NIS alone"].draw(Draw(np.random.default_rng(1), 4, 5))
    assert_allclose(alone.wrong_by(0.5).nis, 0.5 * alone.nis)
    values = worlds.WORLDS["independent"].draw(Draw(np.random.default_rng(1), 4, 5))
    assert_allclose(joined([values, values]).wrong_by(3.0).nees[4:], 3.0 * values.nees)


def test_outcomes_are_counted_as_each_claim_says():
    outcomes = [
        calibration.Outcome(status, fault, wrong_scale, located, runs)
        for status, fault, wrong_scale, located, runs in (
            ("consistent", False, False, False, 10),
            ("overconfident", True, True, True, 20),
            ("undecided", False, False, False, 90),
            ("conservative", True, True, False, 40),
            ("biased", True, False, False, 40),
        )
    ]
    counts = {
        "fault": 3, "consistent": 1, "overconfident": 1, "conservative": 1, "scale": 2, "wrong scale": 2, "located": 1,
    }  # fmt: skip
    claims = tuple(Claim("q", counted, 0.05, "<=") for counted in counts)
    rows = calibration.rows_of_case(replace(CASE, claims=claims, mode="until decided"), outcomes)
    assert [row.found for row in rows] == list(counts.values())
    assert {(row.mean_runs, row.late_runs, row.looks, row.gates) for row in rows} == {(40.0, 90.0, 0, 5)}


def test_the_e_process_stops_where_it_crosses(monkeypatch):
    monkeypatch.setattr(calibration, "_evidence_values", lambda means, dof: np.cumprod(np.full(len(means), 2.0)))
    (outcome,) = calibration.judged(replace(CASE, mode="e-process", ratio=3.0), range(1), 3)
    assert (outcome.runs, outcome.status, outcome.fault) == (5, "overconfident", True)  # 2^5 is the first above 20
    monkeypatch.setattr(calibration, "_evidence_values", lambda means, dof: np.full(len(means), 19.9))
    (outcome,) = calibration.judged(replace(CASE, mode="e-process", ratio=3.0), range(1), 3)
    assert (outcome.runs, outcome.fault) == (30, False)


def test_means_of_runs_take_the_steps_that_a_run_has():
    gate = worlds.WORLDS["ragged"].draw(Draw(np.random.default_rng(2), 5, 10))
    for run, mean in enumerate(calibration.run_means(gate)):
        there = np.isfinite(gate.error[run, :, 0])
        pairs = zip(gate.error[run, there], gate.covariance[run, there], strict=True)
        by_hand = [e @ np.linalg.inv(P) @ e for e, P in pairs]
        assert_allclose(mean, np.mean(by_hand))


def test_rows_do_not_depend_on_the_number_of_workers():
    one, two = (list(calibration.measure([replace(CASE, gates=30)], 5, workers)) for workers in (1, 2))
    assert one == two
    assert [row.question for row in one] == ["false alarm", "all-clear"]


def test_quick_rows_end_where_nothing_is_doubtful(monkeypatch):
    monkeypatch.setattr(calibration, "ProcessPoolExecutor", ThreadPoolExecutor)
    monkeypatch.setattr(calibration, "BATCH", 3)
    monkeypatch.setattr(calibration, "CLEAR", 6)
    of = partial(calibration.measure, seed=5, workers=1)
    assert list(of([replace(CASE, gates=9)], quick=True)) == list(of([replace(CASE, gates=6)]))
    wrong = replace(CASE, gates=9, ratio=3.0)
    assert list(of([wrong], quick=True)) == list(of([wrong]))


def test_rows_of_other_modules_join_the_table(monkeypatch):
    row = {
        "world": "gated", "question": "monitor", "ratio": 1.0, "runs": 1, "looks": 0, "stated": 0.05, "bound": "<=",
        "gates": 100, "found": 3, "mean_runs": 1.0, "late_runs": 1.0,
    }  # fmt: skip
    module = SimpleNamespace(rows=lambda quick, seed: [row], ABOUT={"gated": "with a gate", "monitor": "an alarm"})
    monkeypatch.setattr(calibration, "MODULES", ("there", "nowhere"))
    monkeypatch.setattr(calibration.importlib.util, "find_spec", lambda name: name == "there" or None)
    monkeypatch.setattr(calibration.importlib, "import_module", lambda name: module)
    rows, about = calibration.further_rows(True, 1)
    table = calibration_rows.document(rows, about, seed=1)
    assert table["worlds"] == {"gated": "with a gate"}
    assert table["questions"] == {"monitor": "an alarm"}
    assert "| monitor | gated | 1 | 1 | ≤ 5 % | 3.0 % (1, 1) | 100 |" in calibration_rows.markdown(table)
    assert calibration_rows.rows_of(json.loads(json.dumps(table))) == rows


# --- command ------------------------------------------------------------------------------------------------


def test_the_table_replaces_what_stands_between_its_marks(tmp_path):
    path = tmp_path / "referee.md"
    start, end = calibration_rows.MARKS
    path.write_text(f"before\n{start}\nold\n{end}\nafter\n")
    table = calibration_rows.document([ALARMS, POWER], {"w": "a world"}, seed=1)
    calibration_rows.write_docs(table, path)
    text = path.read_text()
    assert text.startswith("before\n")
    assert text.endswith("\nafter\n")
    assert "old" not in text
    assert "| false alarm | w | 1 | 21 | ≤ 5 % | 5.0 % | 1000 |" in text
    calibration_rows.write_docs(table, path)
    assert path.read_text() == text
    path.write_text("no marks")
    with pytest.raises(ValueError, match="needs the marks"):
        calibration_rows.write_docs(table, path)


@pytest.mark.parametrize("found, status", [(5, 0), (90, 1)])
def test_a_broken_promise_is_the_exit_status(found, status, monkeypatch, tmp_path, capsys):
    row = replace(ALARMS, gates=100, found=found)
    monkeypatch.setattr(calibration, "measure", lambda *arguments: iter([row]))
    monkeypatch.setattr(calibration, "further_rows", lambda *arguments: ([], {"w": "a world"}))
    assert calibration.main(["--quick", "--out", str(tmp_path / "t.json")]) == status
    said = capsys.readouterr().out
    assert f"promises broken: {status} (by chance: less than once in 5,000 runs)" in said
    assert "seed " in said
    assert json.loads((tmp_path / "t.json").read_text())["rows"][0]["found"] == found


# --- the monitor's worlds and rows ----------------------------------------------------------------------------


@pytest.mark.parametrize("gate", [None, 0.99, 0.95])
@pytest.mark.parametrize("name", list(calibration_monitor.WORLDS))
def test_monitors_at_once_are_the_monitor(name, gate):
    """Step by step, with a fault, so that there are rejections and alarms."""
    world = calibration_monitor.WORLDS[name](np.random.default_rng(), 4)
    at_once = [calibration_monitor.Monitors(4, world.dof, tolerance, gate) for tolerance in (1.0, 1.2)]
    one_by_one = [[cs.Monitor(0.05, tolerance, gate) for _ in range(4)] for tolerance in (1.0, 1.2)]
    for step in range(150):
        nis = (1.0 if step < 100 else 2.5) * world.nis()
        for many, singles in zip(at_once, one_by_one, strict=True):
            evidence = many.update(nis)
            for single, value in zip(singles, nis, strict=True):
                single.update(value, world.dof)
            assert_allclose(evidence, [single.evidence for single in singles], rtol=1e-9)
        world.move(nis <= at_once[0].limit)
    if gate is not None:
        assert sum(single.rejections for single in one_by_one[0])


@pytest.mark.parametrize("name", list(calibration_monitor.WORLDS))
def test_innovations_of_the_filters_are_white_with_the_stated_covariance(name):
    """Without a gate: the total NIS and the product of neighbouring innovations, two-sided at 1e-6 together."""
    world = calibration_monitor.WORLDS[name](np.random.default_rng(), 4000)
    total, product, before = 0.0, [], None
    for _ in range(20):
        nis = world.nis()
        total += nis.sum()
        whitened = np.atleast_2d(world.innovation) / np.sqrt(world.P[: world.dof] + 1.0)
        if before is not None:
            product.append((whitened * before).ravel())
        before = whitened
        world.move(np.ones(4000, bool))
    low, high = stats.chi2.ppf([2.5e-7, 1 - 2.5e-7], 20 * 4000 * world.dof)
    assert low < total < high
    products = np.concatenate(product)
    assert abs(products.mean()) < stats.norm.isf(1.25e-7) * products.std() / np.sqrt(len(products))


@pytest.mark.parametrize("name", list(calibration_monitor.WORLDS))
def test_a_filter_that_misses_a_measurement_knows_it(name):
    """After five rejections that have nothing to do with the values the NIS still has its degrees of freedom (1e-6)."""
    world = calibration_monitor.WORLDS[name](np.random.default_rng(), 20_000)
    before = world.P.copy()
    for _ in range(5):
        world.nis()
        world.move(np.zeros(20_000, bool))
    assert (world.P[0] > before[0]).all()
    low, high = stats.chi2.ppf([5e-7, 1 - 5e-7], 20_000 * world.dof)
    assert low < world.nis().sum() < high


def test_rows_are_those_of_the_calibration_table(monkeypatch):
    monkeypatch.setattr(calibration_monitor, "STEPS", 60)
    monkeypatch.setattr(calibration_monitor, "PATIENCE", 200)
    monkeypatch.setattr(calibration_monitor, "QUICK_MISSIONS", {0.05: 20, 0.01: 40})
    monkeypatch.setattr(calibration_monitor, "WORLDS", {"position": calibration_monitor.Position})
    rows = [Row(**row) for row in calibration_monitor.rows(quick=True, seed=1)]
    alarms, found = [row for row in rows if row.ratio == 1.0], [row for row in rows if row.ratio != 1.0]
    assert [(row.world, row.question[-3:], row.stated, row.gates) for row in alarms] == [
        (world, tolerance, rate, gates)
        for world in ("position", "position, gate 0.99")
        for tolerance in ("e 1", "1.2")
        for rate, gates in ((0.05, 20), (0.01, 40))
    ]
    assert all(row.bound == "<=" and row.found <= row.gates for row in alarms)
    assert {(row.ratio, row.runs) for row in found} == {
        (r, n) for (r, _), n in calibration_monitor.FOUND_WITHIN.items()
    }
    assert all(row.bound == ">=" and 0 < row.found <= row.gates for row in found)
    assert {row.world for row in rows} | {row.question for row in rows} <= set(calibration_monitor.ABOUT)


def test_a_delay_counts_the_steps_of_the_fault(monkeypatch):
    """So gross a fault is found in its first step; at a rate of 50 % many missions have had an alarm before it."""
    monkeypatch.setattr(calibration_monitor, "LATE", 20)
    monkeypatch.setattr(calibration_monitor, "RATIOS", (1e6,))
    monkeypatch.setattr(calibration_monitor, "DELAY_RATE", 0.5)
    found = calibration_monitor.delays("position", None, 200, seed=int(np.random.SeedSequence().generate_state(1)[0]))
    assert set(found) == {(tolerance, 1e6, since) for tolerance in (1.0, 1.2) for since in (1, 21)}
    assert all((steps == 1).all() for steps in found.values())
    assert all(len(found[tolerance, 1e6, 1]) == 200 for tolerance in (1.0, 1.2))
    assert 100 <= len(found[1.0, 1e6, 21]) < 200
