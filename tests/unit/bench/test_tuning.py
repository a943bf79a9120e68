"""Tuning: what a factor scales, how runs are scored, how data are divided, and what is said of the outcome."""

import json
import os
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from documents import ROOT
from scipy import stats

import consistency as cs
from consistency.bench.filters.filter_inputs import problem_of
from consistency.bench.filters.run_filter import run_filter, step_through
from consistency.bench.store.recorded_log import Log
from consistency.bench.tuning.noise_factor_fit import (
    BeliefScorer,
    noise_groups_of,
    rounded,
    scaled,
    score_of_run_by_innovations,
    sigma_by_channel,
)
from consistency.bench.tuning.tune import (
    MOST_TOLERATED,
    factor_text,
    part_of,
    parts_of,
    tolerant,
    tuning_data,
    tuning_lines,
)
from consistency.commands import main
from consistency.diagnostics import Settings
from consistency.referee.diagnostics.number_words import short
from consistency.referee.diagnostics.verdict_parts import Interval

RUNS, SEED = 8, 60_321


def off(scenario, q, r):
    """A belief whose variances of Q and R have to be multiplied by ``q`` and ``r`` to be right."""
    motion, sensor = scenario.truth.motion, scenario.truth.sensor
    return scenario.variant(
        "off",
        belief__motion__sigma_v=motion.sigma_v / np.sqrt(q),
        belief__motion__sigma_omega=motion.sigma_omega / np.sqrt(q),
        belief__sensor__sigma=tuple(sigma / np.sqrt(r) for sigma in sensor.sigma),
    )


# --- groups ------------------------------------------------------------------------------------------


def test_a_factor_scales_the_variances_of_its_channels(uvd):
    before = sigma_by_channel(uvd.belief)
    groups = noise_groups_of("Q.omega, R.u+R.d", uvd.belief)
    assert [group.name for group in groups] == ["Q.omega", "R.u+R.d"]
    after = sigma_by_channel(scaled(uvd.belief, groups, np.log([4.0, 0.25])))
    ratios = {name: after[name] / before[name] for name in before}
    wanted = {"Q.v": 1.0, "Q.omega": 2.0, "R.u": 0.5, "R.v": 1.0, "R.d": 0.5}
    assert ratios == pytest.approx(wanted)


def test_all_of_q_leaves_out_a_noise_that_is_zero(uvd):
    still = uvd.variant("still", belief__motion__sigma_omega=0.0)
    assert [group.channels for group in noise_groups_of("Q,R", still.belief)] == [("Q.v",), ("R.u", "R.v", "R.d")]


@pytest.mark.parametrize(
    "text, said",
    [
        ("Q,P0", "unknown noise 'P0'; there are Q, Q.v, Q.omega, R, R.u, R.v, R.d"),
        ("Q,Q.v", "'Q.v' is named twice"),
        ("R.u+R.u", "'R.u' is named twice"),
        ("Q.omega", "'Q.omega' is believed to be zero"),
        ("", "unknown noise ''"),
    ],
)
def test_groups_that_mean_nothing_are_refused(uvd, text, said):
    still = uvd.variant("still", belief__motion__sigma_omega=0.0)
    with pytest.raises(cs.InputError, match=f"--groups {text}".replace("+", r"\+")) as refused:
        noise_groups_of(text, still.belief)
    assert said in str(refused.value)


def test_what_is_judged_has_the_digits_that_are_written(uvd):
    belief = rounded(scaled(uvd.belief, noise_groups_of("Q,R", uvd.belief), np.array([0.1, 0.2])))
    assert all(value == float(f"{value:.6g}") for value in sigma_by_channel(belief).values())


# --- scores ------------------------------------------------------------------------------------------


def test_the_score_by_innovations_is_their_log_density(linear):
    trial, twin = cs.simulate(linear, seed=SEED), cs.get_filter("kf").textbook
    state, wanted = twin.init(problem_of(trial, linear.belief)), []
    for step in range(1, trial.steps + 1):
        state, info = twin.update(twin.predict(state, trial.control(step)), trial.observation(step))
        known = info is not None and len(info.innovation)
        wanted.append(stats.multivariate_normal(cov=info.S).logpdf(info.innovation) if known else 0.0)
    for estimates in (run_filter(cs.get_filter("kf"), trial, linear.belief), step_through(twin, trial, linear.belief)):
        score = score_of_run_by_innovations(trial, estimates)
        assert score.log_density == pytest.approx(np.array(wanted), rel=1e-9, abs=1e-8)
        assert score.dof == estimates.nis_dof.sum()
        assert score.nis == pytest.approx(np.nansum(estimates.nis))


class Silent:
    """Dead reckoning without innovations."""

    name = "silent"

    def init(self, problem):
        return problem

    def predict(self, state, control):
        return state

    def update(self, state, observation):
        return state, None

    def pose(self, state):
        return cs.Gaussian(state.start, np.eye(3))


class Broken(Silent):
    name = "broken"

    def pose(self, state):
        return cs.Gaussian(state.start, -np.eye(3))


def test_what_cannot_be_scored_is_refused(uvd):
    with pytest.raises(cs.InputError, match="reports no innovations: its update must return an Info"):
        cs.tune(uvd, Silent(), runs=2, seed=SEED, jobs=1)
    with pytest.raises(cs.InputError, match=r"'ekf-uvd\+gate' leaves observations out"):
        cs.tune(uvd, "ekf-uvd+gate", runs=2, seed=SEED)
    with pytest.raises(cs.InputError, match=r"'broken' fails at every noise.* in 2 of 2 runs \(run 0, step 1"):
        cs.tune(uvd, Broken(), runs=2, seed=SEED, jobs=1)
    with pytest.raises(cs.InputError, match="runs must be at least 1"):
        cs.tune(uvd, "ekf-uvd", runs=0)


def test_a_run_that_fails_makes_the_setting_impossible(uvd):
    with BeliefScorer(Broken(), [cs.simulate(uvd, seed=SEED)], uvd.belief, 1) as bench:
        scores = bench(uvd.belief)
    assert scores.failures[0].startswith("run 0, step 1: ")


def test_the_same_trials_are_scored_alike_by_any_number_of_workers(uvd):
    trials = [cs.simulate(uvd, run, SEED) for run in range(4)]
    benches = [BeliefScorer(cs.get_filter("ekf-uvd"), trials, uvd.belief, jobs) for jobs in (1, 2)]
    with benches[0] as alone, benches[1] as together:
        assert np.array_equal(alone(uvd.belief).log_density, together(uvd.belief).log_density)


class Believer(Silent):
    """Says its noise as its pose, and the process that it is in as its variance."""

    def pose(self, state):
        x = np.array([state.belief.motion.sigma_v, 0.0, 0.0])
        return cs.Gaussian(x, np.diag([float(os.getpid()), 1.0, 1.0]))


def test_a_filter_keeps_its_process_and_takes_each_belief(uvd):
    trials = [cs.simulate(uvd, run, SEED) for run in range(2)]
    said = set()
    with BeliefScorer(Believer(), trials, uvd.belief, 1) as bench:
        for factor in (1.0, 2.0, 3.0):
            belief = scaled(uvd.belief, noise_groups_of("Q", uvd.belief), np.log([factor**2]))
            for trial in trials:
                [estimates] = bench._isolation.run(trial, belief)
                assert estimates.pose[-1, 0] == belief.motion.sigma_v
                said.add(estimates.covariance[-1, 0, 0])
    assert len(said) == 1
    with pytest.raises(RuntimeError, match="the study has ended"):
        bench._isolation.run(trials[0])


# --- parts -------------------------------------------------------------------------------------------


def test_the_two_parts_of_a_scenario_share_no_trial(uvd):
    parts = parts_of(uvd, 2, SEED)
    results = parts.on_fresh(cs.get_filter("ekf-uvd"), uvd.belief, 1, None)
    fresh = results.estimates["heading"].to_numpy()
    fitted = [run_filter(cs.get_filter("ekf-uvd"), trial, uvd.belief).pose[:, 2] for trial in parts.trials]
    assert not np.isclose(np.concatenate(fitted), fresh, rtol=1e-9, atol=0.0).any()
    assert f"--runs 2 --seed {results.manifest['seed']}" == parts.again


def test_a_drive_is_cut_in_two(uvd):
    trial, ekf = cs.simulate(uvd, seed=SEED), cs.get_filter("ekf-uvd")
    whole, first = run_filter(ekf, trial, uvd.belief), run_filter(ekf, part_of(trial, 0, 25), uvd.belief)
    assert np.array_equal(first.pose, whole.pose[:25])
    second = part_of(trial, 25, trial.steps)
    assert np.array_equal(second.start, trial.truth[25])
    for step in (1, trial.steps - 25):
        assert np.array_equal(second.observation(step).z, trial.observation(25 + step).z)
        assert second.control(step) == trial.control(25 + step)
    assert np.array_equal(part_of(replace(trial, truth=None), 25, 60).start, np.zeros(3))


def test_runs_of_a_log_are_divided_and_its_only_run_is_cut(uvd, linear):
    log = Log("log", [cs.simulate(uvd, run, SEED) for run in range(5)], uvd.belief, None)
    parts = parts_of(log, 50, 0)
    assert [trial.run for trial in parts.trials] == [0, 1, 2]
    assert sorted(parts.on_fresh(cs.get_filter("ekf-uvd"), uvd.belief, 1, None).runs_of("ekf-uvd")) == [3, 4]
    only = parts_of(replace(log, trials=log.trials[:1]), 50, 0)
    assert only.trials[0].steps == 30
    assert only.fitted_on == "the first 30 steps"
    assert only.judged_on == "the other 30, which begin with an empty map"
    with pytest.raises(cs.InputError, match="one run of a linear world cannot be divided"):
        parts_of(Log("log", [cs.simulate(linear, seed=SEED)], linear.belief, None), 50, 0)


# --- the whole ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tuned(small):
    return cs.tune(off(small("linear-gaussian"), 4.0, 0.25), "kf", runs=RUNS, seed=SEED)


def test_factors_are_found_in_a_world_in_which_the_filter_is_exact(tuned):
    """Q is known to 7 % and R to 2 % (480 steps): a bound of a third is beyond 4.5 standard deviations."""
    q, r = tuned.factors
    assert q.value == pytest.approx(4.0, rel=1.0 / 3.0)
    assert r.value == pytest.approx(0.25, rel=0.1)
    assert 1.1 < q.interval.high / q.interval.low < 2.0
    assert 1.01 < r.interval.high / r.interval.low < 1.2
    belief = tuned.belief
    assert belief.motion.sigma_v == pytest.approx(0.05, rel=0.2)
    assert belief.sensor.sigma == pytest.approx((0.05, 0.05, 0.05), rel=0.05)
    assert tuned.chosen.settings < 120


def test_before_and_after_are_judged_on_the_same_fresh_runs(tuned):
    """The belief before is wrong by a factor of 4 in all innovations: NIS says so in any sample."""
    before, after = tuned.before.innovations, tuned.verdict.innovations
    assert before.dof == after.dof
    assert not 0.9 < before.ratio < 1.1
    assert after.ratio == pytest.approx(1.0, abs=0.1)


def test_a_filter_that_is_not_compiled_hears_the_factors(small):
    scenario = off(small("linear-gaussian", truth__steps=20), 1.0, 4.0)
    kf = cs.get_filter("kf")
    compiled, plain = (cs.tune(scenario, filter_, runs=3, seed=SEED, jobs=2) for filter_ in (kf, kf.textbook))
    for a, b in zip(compiled.factors, plain.factors, strict=True):
        assert a.value == pytest.approx(b.value, rel=0.01)  # to where the search settles
    assert plain.factors[1].value > 2.0


def test_the_words_say_what_came_of_it(tuned):
    text = str(tuned)
    assert text == "\n".join(tuning_lines(tuned))
    assert "kf on off: fitted by the likelihood of the innovations on 8 runs" in text
    assert f"  Q {factor_text(tuned.factors[0])} (sigma: Q.v 0.025 -> {tuned.belief.motion.sigma_v:.4g}" in text
    assert f"sigma_v = {tuned.belief.motion.sigma_v}" in text
    assert "[belief.motion]" in text
    assert "would be found with power 0.95" in text
    data = json.loads(json.dumps(tuning_data(tuned), allow_nan=False))
    assert data["chosen"]["factors"][0]["factor"] == tuned.factors[0].value
    assert data["chosen"]["sigma"]["R.x"] == tuned.belief.sensor.sigma[0]


@pytest.mark.parametrize(
    "status, is_said",
    [("overconfident", True), ("biased", True), ("failed", True), ("undecided", False), ("consistent", False)],
)
def test_a_fault_that_is_left_is_not_blamed_on_the_noises(tuned, status, is_said):
    changed = replace(tuned, chosen=replace(tuned.chosen, verdict=replace(tuned.verdict, status=status)))
    said = "the size of Q, R is not all that is wrong, unless the fault was found by chance, as in one of 20 verdicts"
    assert (said in str(changed)) is is_said


def with_interval(tuned, low, high, edge=0):
    """The same outcome with another interval of Q."""
    q, r = tuned.factors
    changed = replace(q, interval=Interval(q.value, low, high), edge=edge)
    return replace(tuned, chosen=replace(tuned.chosen, factors=(changed, r)))


@pytest.mark.parametrize(
    "low, high, edge, said",
    [
        (0.0, 0.004, 0, ", at most x0.004 with 95 %"),
        (3.0, np.inf, 0, ", at least x3.00 with 95 %"),
        (0.0, np.inf, 0, ", which these data do not bound"),
        (0.0, 0.5, -1, "is at the limit of what is tried, x0.0001; at most x0.50 with 95 %"),
        (20.0, np.inf, 1, "is at the limit of what is tried, x10000; at least x20.0 with 95 %"),
        (0.0, np.inf, 1, "is at the limit of what is tried, x10000; not known with 95 %"),
    ],
)
def test_an_open_interval_is_said_and_exported(tuned, low, high, edge, said):
    changed = with_interval(tuned, low, high, edge)
    text = said if edge else f"x{short(changed.factors[0].value)}{said}"
    assert factor_text(changed.factors[0]) == text
    assert f"  Q {text} (sigma: Q.v" in str(changed)
    exported = json.loads(json.dumps(tuning_data(changed), allow_nan=False))["chosen"]["factors"][0]
    assert exported["low"] == low
    assert exported["high"] == (high if np.isfinite(high) else None)
    assert exported["edge"] == edge


def test_a_process_noise_that_few_short_runs_hardly_tell_has_an_open_interval(small):
    """A tenth of the true noise, in 6 runs of 4 steps: what it adds to a step is a ten-thousandth of R."""
    scenario = off(small("linear-gaussian", truth__steps=4, truth__motion__sigma_v=0.005,
                         truth__motion__sigma_omega=0.0087), 1.0, 1.0)  # fmt: skip
    tuning = cs.tune(scenario, "kf", runs=6, seed=SEED, jobs=1)
    q, r = tuning.factors
    assert q.interval.low == 0.0
    assert 1.0 < q.interval.high < np.inf
    assert 0.0 < r.interval.low < r.value < r.interval.high
    assert f"at most x{short(q.interval.high)} with 95 %" in str(tuning)


def test_the_uncertainty_of_a_fit_is_no_fault_but_no_more_is():
    settings = Settings()
    assert tolerant(settings, np.array([[-0.05, 0.05], [-0.01, 0.01]])).tolerated == pytest.approx(np.exp(0.05))
    assert tolerant(settings, np.array([[-1.0, 1.0]])).tolerated == MOST_TOLERATED
    assert tolerant(settings, np.array([[-np.inf, 0.0]])).tolerated == MOST_TOLERATED
    assert tolerant(Settings(tolerance=1.3), np.array([[-0.05, 0.05]])).tolerated == 1.3


# --- the command -------------------------------------------------------------------------------------


def status_of(capsys, *arguments):
    with pytest.raises(SystemExit) as ended:
        main(["tune", *map(str, arguments)])
    out, err = capsys.readouterr()
    return int(ended.value.code or 0), out, err


SCENARIO = "linear-gaussian"


@pytest.mark.parametrize(
    "arguments, said",
    [
        ((), "give either a SCENARIO or --log DIR"),
        ((SCENARIO, "--log", "x"), "give either a SCENARIO or --log DIR"),
        (("--log", "x", "--runs", 3), "--runs and --seed do not go with --log"),
        ((SCENARIO, "--fail-on", "alarm"), "--fail-on must be 'inconsistent', got 'alarm'"),
        ((SCENARIO, "--groups", "Z"), "--groups Z: unknown noise 'Z'"),
        ((SCENARIO, "--detect", 1.0), "--detect must be a positive ratio"),
        ((SCENARIO, "--out", "."), "--out .: exists already"),
    ],
)
def test_unusable_options_are_refused_in_a_sentence(capsys, arguments, said):
    status, out, err = status_of(capsys, *arguments, "--filter", "kf")
    assert (status, out, len(err.strip().splitlines())) == (2, "", 1)
    assert said in err


def test_the_folder_holds_a_scenario_that_can_be_run(capsys, tmp_path, small):
    from consistency.bench.scenario import scenario_text

    world, out = tmp_path / "wrong.toml", tmp_path / "out"
    world.write_text(scenario_text(off(small("linear-gaussian"), 4.0, 0.25)))
    options = (world, "--filter", "kf", "--runs", 4, "--seed", SEED, "--out", out)
    status, text, _ = status_of(capsys, *options, "--json")
    data = json.loads(text)
    assert status == 0
    assert sorted(path.name for path in out.iterdir()) == ["manifest.json", "tuning.json", "wrong-tuned.toml"]
    assert json.loads((out / "tuning.json").read_text()) == data
    written = cs.load_scenario(out / "wrong-tuned.toml")
    assert sigma_by_channel(written.belief) == data["chosen"]["sigma"]
    assert written.truth == cs.load_scenario(world).truth
    status, _, err = status_of(capsys, *options)
    assert status == 2
    assert "exists already; choose another folder or add --overwrite" in err
    wanted = 0 if data["consistent"] else 1
    status, text, _ = status_of(capsys, *options, "--overwrite", "--fail-on", "inconsistent")
    assert status == wanted
    assert f"consistency run {out}/wrong-tuned.toml --filter kf --runs 4 --seed" in text


def test_a_log_is_tuned_to_a_sensor_file(capsys, tmp_path, small):
    from consistency.bench.runs.montecarlo import simulate_log

    scenario, log, out = off(small("herath2007-stereo"), 4.0, 1.0), tmp_path / "log", tmp_path / "out"
    simulate_log(scenario, 4, SEED, log)
    status, text, _ = status_of(capsys, "--log", log, "--filter", "ekf-uvd", "--out", out)
    assert status == 0
    assert "fitted by the likelihood of the innovations on the first 2 runs, judged on the other 2" in text
    data = json.loads((out / "tuning.json").read_text())
    (log / "sensor.toml").write_text((out / "sensor.toml").read_text())
    assert sigma_by_channel(cs.read_log(log).belief) == data["chosen"]["sigma"]
    assert data["chosen"]["sigma"]["Q.v"] > scenario.belief.motion.sigma_v
    assert cs.read_log(log).belief.sensor.B == scenario.belief.sensor.B


# --- the manual --------------------------------------------------------------------------------------


def test_the_filterpy_filter_of_the_manual(tmp_path, capsys):
    script = (ROOT / "docs/examples/tune_my_ekf.py").read_text(encoding="utf-8")
    short = script.replace("runs=20", "runs=2").replace("truth__steps=50", "truth__steps=6")
    assert short != script
    (tmp_path / "mine.py").write_text(short)
    runpy.run_path(str(tmp_path / "mine.py"), run_name="__main__")
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("my-ekf on doubtful: fitted by the likelihood of the innovations on 2 runs")
    assert "(sigma: Q.v 0.005 -> " in said[1]


# --- a real robot ------------------------------------------------------------------------------------


def test_one_robot_of_mrclam():
    """Innovations of the second half are as large as stated after a fit to the first; the drive is still at fault."""
    folder = Path(os.environ.get("CONSISTENCY_DATA", "")) / "mrclam" / "MRCLAM_Dataset6"
    if not os.environ.get("CONSISTENCY_DATA") or not folder.is_dir():
        pytest.skip("set CONSISTENCY_DATA to the folder that holds mrclam/MRCLAM_Dataset6")
    from consistency.bench.runs.reproduce_findings import sibling

    conversion = sibling(str(Path(__file__).parents[3] / "experiments/e15_mrclam.py"), "mrclam_log")
    trial, belief, _, _ = conversion.log_of(conversion.read_robot(folder, 3))
    tuning = cs.tune(Log("robot 3", [trial], belief, None), "oc-ekf-rb")
    before, after = tuning.before.innovations, tuning.verdict.innovations
    assert abs(np.log(after.ratio)) < abs(np.log(before.ratio))
    assert tuning.has_fault
