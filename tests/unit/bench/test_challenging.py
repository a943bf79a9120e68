"""The search for the world in which a filter is most overconfident; the search on scripted scores."""

from __future__ import annotations

import itertools
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import challenge_rate
import numpy as np
import pytest

import consistency as cs
from consistency.bench.challenging import challenge as scoring
from consistency.bench.challenging.challenge import (
    BASES,
    BATCH,
    RUNGS,
    WORST,
    Budget,
    ChallengePhases,
    ChallengeScorer,
    Done,
    Plan,
    ScoredWorld,
    base_of,
    challenge,
    challenge_data,
    challenge_lines,
    is_overconfident,
    ranked,
    score_of_run,
    search,
    standard_error,
    write_scenario,
)
from consistency.bench.challenging.world_space import Choice, LogScale, Point, space_of
from consistency.bench.runs.isolation import Isolation
from consistency.bench.simulation import lap_length, planned_path, require_landmarks_in_view
from consistency.commands import main
from consistency.referee.errors import InputError

STEREO = cs.load_scenario("herath2007-stereo")
SMALL = ("steps=50:100", "seed=2007", "path=circle", "sensor=1", "odometry=1")


def point_with(space, **values):
    return tuple(values.get(d.name, d.plain) for d in space.dimensions)  # type: ignore[return-value]


# --- the space of worlds ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", BASES)
def test_the_plain_point_is_the_base(name):
    base = cs.load_scenario(name)
    space = space_of(base)
    assert space.world(space.plain).hash == base.hash
    assert space.text(space.plain) == f"{name} as it is"
    assert ("baseline" in space.values(space.plain)) == (name == "herath2007-stereo")


def test_truth_and_belief_change_alike():
    base = STEREO.variant("told", belief__sensor__disparity=(1.0, 32.0))
    space = space_of(base)
    world = space.world(point_with(space, sensor=2.0, odometry=0.5, baseline=0.18, range=8.0, steps=100, density=0.5))
    truth, belief = world.truth, world.belief
    assert truth.sensor.sigma == belief.sensor.sigma == (2.68, 3.06, 1.3)
    assert truth.motion.sigma_v == belief.motion.sigma_v == 0.025
    assert truth.motion.sigma_omega == belief.motion.sigma_omega == 0.5 * base.truth.motion.sigma_omega
    assert truth.sensor.B == belief.sensor.B == 0.18
    assert truth.sensor.disparity == belief.sensor.disparity == (1.0, 64.0)
    assert (truth.sensor.range, truth.steps, truth.landmarks.count) == ((0.5, 8.0), 100, 60)
    assert "baseline 0.18 m instead of 0.09 m" in world.summary


@pytest.mark.parametrize("shape", ["rounded-rectangle", "figure-of-eight"])
def test_another_path_is_as_long_and_its_landmarks_as_dense(shape):
    space = space_of(STEREO)
    truth = space.world(point_with(space, path=shape)).truth
    assert lap_length(truth.path) == pytest.approx(lap_length(STEREO.truth.path), rel=0.01)
    boxes = [np.array([of.landmarks.x, of.landmarks.y]) for of in (truth, STEREO.truth)]
    dense = [of.landmarks.count / np.prod(np.diff(box)) for of, box in zip((truth, STEREO.truth), boxes, strict=True)]
    assert dense[0] == pytest.approx(dense[1], rel=0.02)
    driven = planned_path(truth)[:, :2]
    margins = np.concatenate([driven.min(axis=0) - boxes[0][:, 0], boxes[0][:, 1] - driven.max(axis=0)])
    assert margins == pytest.approx(4.0, abs=0.12)


def test_a_base_elsewhere_keeps_its_centre_and_a_circle_is_a_circle():
    eight = {"shape": "figure-of-eight", "radius": 2.0, "start": (10.0, -5.0), "heading": 0.0, "speed": 0.5}
    box = {"layout": "uniform", "count": 50, "seed": 1, "x": (4.0, 16.0), "y": (-13.0, 3.0), "z": (-1.0, 1.0)}
    space = space_of(STEREO.variant("there", truth__path=eight, truth__landmarks=box))
    path = space.world(point_with(space, path="circle")).truth.path
    assert (path.shape, path.start) == ("circle", (14.0, -5.0))


def test_values_are_rounded_and_their_places_are_right():
    scale = LogScale("range", 4.0, 2.0, 12.0, " m")
    assert (scale.at(0.0), scale.at(1.0)) == (2.0, 12.0)
    assert scale.at(0.37) == 3.9
    assert scale.where(scale.at(0.37)) == pytest.approx(0.37, abs=0.01)
    steps = LogScale("steps", 500, 100, 1000, whole=True)
    assert isinstance(steps.at(0.5), int)
    choice = Choice("path", "circle", ("circle", "figure-of-eight"))
    assert [choice.at(choice.where(value)) for value in choice.values] == list(choice.values)
    assert choice.at(1.0) == "figure-of-eight"


def test_bounds_of_the_user():
    space = space_of(STEREO, ["baseline=0.2:0.3", "path=circle", "range=5"])
    assert space.values(space.plain)["baseline"] == 0.2  # the bound that is nearest to the base
    corner = space.values(space.at(np.ones(len(space.dimensions))))
    assert (corner["baseline"], corner["path"], corner["range"]) == (0.3, "circle", 5.0)
    assert space.where(space.plain)[-1] == 0.0  # fixed


@pytest.mark.parametrize(
    "text, complaint",
    [
        ("depth=1:2", "with a NAME out of seed, sensor"),
        ("range", "with a NAME out of"),
        ("range=8:2", "low <= high"),
        ("range=0:2", "positive"),
        ("range=a:b", "range=LOW:HIGH"),
        ("range=1:2:3", "range=LOW:HIGH"),
        ("steps=nan", "steps=LOW:HIGH"),
        ("range=1:inf", "range=LOW:HIGH"),
        ("path=square", "'square' is not one of its values; choose from circle"),
        ("seed=-1", "'-1' is not one"),
    ],
)
def test_bounds_that_mean_nothing_are_refused(text, complaint):
    with pytest.raises(InputError, match=complaint):
        space_of(STEREO, [text])


GROWTH = {"disparity": [2.0, 10.0], "ratio": [1.0, 2.0]}
BIAS = {"u": [-100.0, 100.0], "v": [0.0], "bias_d": [[0.5, -0.5]]}


@pytest.mark.parametrize(
    "truth, belief, complaint",
    [
        (
            {"disparity_growth": GROWTH},
            {},
            r"'belief\.sensor\.disparity_growth' is not what truth\.sensor\.disparity_g",
        ),
        ({}, {"disparity_growth": GROWTH}, r"'belief\.sensor\.disparity_growth' is not"),
        ({"effects": [{"kind": "local-bias", **BIAS}]}, {}, r"'belief\.sensor\.bias' is not the bias of the effect"),
        ({}, {"bias": BIAS}, r"'belief\.sensor\.bias' is not the bias of the effect"),
        (
            {"effects": [{"kind": "swap", "rate": 0.1}]},
            {},
            r"no belief holds the effect 'swap' \(truth\.sensor\.effects\)",
        ),
    ],
)
def test_a_sensor_that_errs_otherwise_than_believed_is_refused(truth, belief, complaint):
    keys = {f"truth__sensor__{key}": value for key, value in truth.items()}
    keys |= {f"belief__sensor__{key}": value for key, value in belief.items()}
    with pytest.raises(InputError, match=complaint):
        space_of(STEREO.variant("wrong", **keys))


def test_a_sensor_that_errs_as_believed_is_challenged():
    chosen = {
        "kind": "selection", "count": 6, "forget_steps": 4, "seed": 1, "cells": [4, 3], "near": 6.0,
        "strength": 1.0, "stereo": 1.0, "image": 1.0, "depth": 1.0,
    }  # fmt: skip
    base = STEREO.variant(
        "right", truth__sensor__effects=[{"kind": "local-bias", **BIAS}, chosen], belief__sensor__bias=BIAS,
        truth__sensor__disparity_growth=GROWTH, belief__sensor__disparity_growth=GROWTH,
    )  # fmt: skip
    space = space_of(base)
    other = space.world(tuple(2.0 * d.base if d.name == "sensor" else d.base for d in space.dimensions))
    assert (
        other.truth.sensor.disparity_growth
        == other.belief.sensor.disparity_growth
        == base.truth.sensor.disparity_growth
    )
    assert other.truth.sensor.sigma[2] == 2.0 * base.truth.sensor.sigma[2]
    assert other.truth.sensor.effects == base.truth.sensor.effects


def test_a_scenario_with_listed_landmarks_has_fewer_dimensions():
    base = STEREO.variant("listed", truth__landmarks={"layout": "listed", "points": [(2.0, 0.0, 0.0)]})
    assert [d.name for d in space_of(base).dimensions] == [
        "sensor", "odometry", "steps", "dt", "tilt", "height", "baseline", "range"
    ]  # fmt: skip


def test_rates_mounts_and_loops_are_dimensions():
    """A lap of a tenth of the length, with landmarks as far beyond it and as dense; mounts are believed."""
    space = space_of(STEREO)
    world = space.world(point_with(space, dt=0.5, tilt=40.0, height=1.0, lap=0.1))
    assert (world.truth.dt, world.truth.steps) == (0.5, 500)
    assert world.truth.sensor.mount == world.belief.sensor.mount
    assert world.truth.sensor.mount.position == (0.0, 0.0, 1.0)
    np.testing.assert_allclose(np.rad2deg(world.truth.sensor.mount.rotation), (0.0, 40.0, 0.0))
    assert lap_length(world.truth.path) == pytest.approx(0.1 * lap_length(STEREO.truth.path), rel=0.01)
    half = world.truth.landmarks.x[1]
    assert half - world.truth.path.radius == pytest.approx(8.0 - 4.0, abs=0.1)
    assert world.truth.landmarks.count == pytest.approx(120 * (half / 8.0) ** 2, abs=2)
    short = space.world(point_with(space, lap=0.5, path="figure-of-eight"))
    assert lap_length(short.truth.path) == pytest.approx(0.5 * lap_length(STEREO.truth.path), rel=0.01)
    tilted = STEREO.variant(
        "tilted", **{f"{half}__sensor__mount": {"rotation": (0.1, 0.2, 0.3)} for half in ("truth", "belief")}
    )
    turned = space_of(tilted).world(point_with(space_of(tilted), height=0.5))
    assert turned.truth.sensor.mount.rotation == (0.1, 0.2, 0.3)


def test_bounds_of_a_file(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text('baseline = 0.09\nrange = [2.0, 8.0]\npath = ["circle", "rounded-rectangle"]\ntilt = [0, 20]\n')
    kept = {d.name: d for d in space_of(STEREO, [str(path), "range=3:5"]).dimensions}
    same = {
        d.name: d
        for d in space_of(
            STEREO, ["baseline=0.09", "range=3:5", "path=circle,rounded-rectangle", "tilt=0,20"]
        ).dimensions
    }
    assert kept == same
    path.write_text("baseline = {}\n")
    with pytest.raises(InputError, match=r"rig.toml: key 'baseline': give a value, \[LOW, HIGH\], or an array"):
        space_of(STEREO, [str(path)])
    with pytest.raises(InputError, match=r"none\.toml"):
        space_of(STEREO, ["none.toml"])


# --- the search --------------------------------------------------------------------------------------


class Scripted:
    """Scores of a known mean with noise of 0.5: worst at a long range and few landmarks, of one path."""

    def __init__(self, space, budget):
        self.space, self.budget, self.rng = space, budget, np.random.default_rng(5)
        self.rungs: list[tuple[int, int]] = []

    def mean(self, point):
        values = self.space.values(point)
        bad = 4.0 * np.log(float(values["range"]) / 4.0) - np.log(float(values["density"]))
        return float(bad) if values["path"] == "figure-of-eight" else 0.5 * float(bad)

    def __call__(self, candidates, trials):
        self.rungs.append((len(candidates), trials))
        for candidate in candidates:
            more = trials - len(candidate.scores)
            candidate.scores += list(self.mean(candidate.point) + 0.5 * self.rng.standard_normal(more))
            candidate.usable = self.space.values(candidate.point)["seed"] != 2007
            self.budget.used += more


def searched(trials, seed):
    space, budget = space_of(STEREO), Budget(trials=trials)
    scripted, tried = Scripted(space, budget), dict[Point, ScoredWorld]()
    search(space, scripted, lambda: budget.left(1.0), np.random.default_rng(seed), tried)
    return scripted, tried


@pytest.mark.parametrize("seed", range(3))
def test_the_worst_world_is_found(seed):
    """The best possible mean is 6.5, and a random world of the first batch has 0.6 on average."""
    scripted, tried = searched(3000, seed)
    best = ranked(tried.values())[0]
    assert scripted.mean(best.point) > 5.0
    assert len(best.scores) == RUNGS[-1]
    assert scripted.space.values(best.point)["seed"] != 2007  # those are not usable


def test_time_goes_to_the_promising():
    scripted, tried = searched(400, 0)
    assert scripted.rungs[:4] == [(BATCH, 2), *scripted.rungs[1:4]]
    halves = [count for count, _ in scripted.rungs[:4]]
    assert all(after <= before // 2 for before, after in itertools.pairwise(halves))
    assert [trials for _, trials in scripted.rungs[:4]] == list(RUNGS)
    assert next(iter(tried)) == scripted.space.plain  # the base is tried first
    assert 400 <= scripted.budget.used <= 400 + 2 * BATCH  # ends with the rung in which the budget ends


def test_a_space_of_one_world_ends():
    fixed = ("baseline=0.09", "density=1", "range=4", "steps=500", "lap=1", "dt=0.1", "tilt=0", "height=0", *SMALL[1:])
    space, budget = space_of(STEREO, fixed), Budget(trials=100)
    tried = {}

    def evaluate(candidates, trials):
        for candidate in candidates:
            candidate.scores += [0.0] * (trials - len(candidate.scores))

    search(space, evaluate, lambda: budget.left(1.0), np.random.default_rng(0), tried)
    assert list(tried) == [space.plain]


def test_a_lucky_few_do_not_beat_many():
    few, many = ScoredWorld((1,), [2.0, 2.0]), ScoredWorld((2,), [1.9] * 16)
    assert few.score < many.score
    assert ranked([few, many]) == [many, few]
    assert ScoredWorld((3,)).score == -np.inf
    assert standard_error([0.0, 2.0]) == pytest.approx(1.0)


def test_a_budget_of_time_ends():
    budget = Budget(seconds=1000.0)
    assert budget.left(0.5)
    budget.started -= 600.0
    assert not budget.left(0.5)
    assert budget.left(0.8)
    assert budget.until(0.8) == budget.started + 800.0
    assert Budget(trials=5).until(0.5) == np.inf


# --- what is confirmed ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "status, anees, faults, found",
    [
        ("consistent", 3.1, (), False),
        ("undecided", 3.4, (), False),
        ("overconfident", 4.0, ("scale",), True),
        ("heavy-tailed", 3.2, ("outliers",), True),
        ("overconfident", 3.1, ("scale of pose and map",), True),
        ("biased", 3.5, ("bias", "scale in some step"), True),
        ("biased", 3.5, ("bias",), False),
        ("inconsistent", 3.1, ("shape", "distribution"), False),
        ("conservative", 2.0, ("scale",), False),
        ("failed", 3.0, (), True),
        ("failed", float("nan"), (), True),
    ],
)
def test_only_errors_that_are_too_large_count(status, anees, faults, found):
    verdict = SimpleNamespace(status=status, inflation=anees / 3.0, faults=faults, failures=())
    assert is_overconfident(verdict) is found
    verdict.failures = ("a run",)
    assert is_overconfident(verdict)  # a breakdown always does


@pytest.mark.parametrize(
    "changes, complaint",
    [
        ({"minutes": 0.0}, "--minutes must be a positive number"),
        ({"minutes": float("nan")}, "--minutes"),
        ({"trials": 10}, "either --minutes or --trials"),
        ({"minutes": None}, "either --minutes or --trials"),
        ({"minutes": None, "trials": 1}, "--trials must be at least 2"),
        ({"seed": -1}, "--seed"),
        ({"detect": 0.5}, "--detect must be a ratio above 1"),
        ({"detect": float("inf")}, "--detect"),
        ({"false_alarm": 0.0}, "--false-alarm"),
    ],
)
def test_a_plan_that_cannot_be_is_refused(changes, complaint):
    with pytest.raises(InputError, match=complaint):
        Plan(**changes)


def test_the_runs_are_those_of_a_planned_verdict_and_the_seeds_differ():
    assert Plan().runs == 61
    assert Plan(detect=1.2).runs == 301
    assert len({seed for plan in (Plan(), Plan(seed=1)) for seed in plan.seeds}) == 4


def test_the_base_fits_the_filter():
    names = {name: base_of(cs.get_filter(name)).name for name in ("ekf-uvd", "ekf-xyz", "kf")}
    assert names == {"ekf-uvd": BASES[0], "ekf-xyz": BASES[0], "kf": BASES[2]}


# --- a whole challenge ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def far():
    """A search among short worlds of long range; in all of them ekf-uvd is grossly overconfident."""
    return challenge(
        "ekf-uvd", None, Plan(minutes=None, trials=150, jobs=1), [*SMALL, "range=6:9", "baseline=0.05:0.09"]
    )


def test_a_wrong_filter_is_found(far):
    """The false alarm of the confirmation does not matter here, and its p value leaves no doubt."""
    assert far.found
    assert far.p_value < 1e-3
    assert far.verdict.runs == 61
    assert 0.8 * 150 <= far.trials <= 0.8 * 150 + 2 * BATCH  # what has begun is finished
    assert far.ratio > 2.0
    assert challenge_lines(far, Path("a.toml"))[0].startswith("ekf-uvd is overconfident in ")


def test_the_file_repeats_the_confirmation(far, tmp_path):
    write_scenario(far, tmp_path / "found.toml")
    world = cs.load_scenario(tmp_path / "found.toml")
    assert world.hash == far.world.hash
    assert "ekf-uvd is" in world.summary
    results = cs.run_trials(world, ["ekf-uvd"], far.plan.runs, far.plan.seeds[-1], 1)
    assert cs.analyse(results)["ekf-uvd"].statistic == far.verdict.statistic
    text = (tmp_path / "found.toml").read_text()
    assert f"--runs 61 --seed {far.plan.seeds[-1]}" in text.splitlines()[0]


def test_trials_in_place_of_time_give_the_same_result_on_any_number_of_workers(far):
    again = challenge("ekf-uvd", STEREO, replace(far.plan, jobs=2), [*SMALL, "range=6:9", "baseline=0.05:0.09"])
    left = {key: value for key, value in challenge_data(again, Path("a.toml")).items() if key != "seconds"}
    assert left == {key: value for key, value in challenge_data(far, Path("a.toml")).items() if key != "seconds"}


def test_what_is_not_found_is_not_called_consistent():
    """A right filter; by chance it would be found in 1 % of seeds, and this seed was the first."""
    outcome = challenge("kf", None, Plan(minutes=None, trials=60, jobs=1, false_alarm=0.01), SMALL)
    assert not outcome.found
    assert outcome.verdict.settings.false_alarm == 0.01
    text = "\n".join(challenge_lines(outcome, Path("out.toml")))
    assert "no world found within 60 trials" in text
    assert "no proof" in text
    assert challenge_data(outcome, Path("out.toml"))["file"] is None


class Breaking:
    """A Python filter that breaks down at step 3."""

    name = "breaking"

    def init(self, problem):
        return 0, problem.start

    def predict(self, state, control):
        if state[0] == 2:
            raise ZeroDivisionError("lost")
        return state[0] + 1, state[1]

    def update(self, state, observation):
        return state, None

    def pose(self, state):
        return cs.Gaussian(state[1], np.eye(3))


def test_a_filter_that_breaks_down_is_the_worst():
    outcome = challenge(Breaking(), None, Plan(minutes=None, trials=40, jobs=1), SMALL)
    assert outcome.found
    assert outcome.verdict.failures
    assert outcome.ratio == pytest.approx(np.exp(WORST))
    assert "broke down" in "\n".join(challenge_lines(outcome, Path("out.toml")))


class Constant:
    """In the place of a bench: every trial of every world has the same score. Keeps what it is asked with."""

    filter, workers = SimpleNamespace(name="constant"), 1

    def __init__(self, score):
        self.score, self.seeds, self.ends = score, list[int](), list[float]()

    def __call__(self, jobs, seed, until):
        self.seeds.append(seed)
        self.ends.append(until)
        return [Done((self.score,) * len(runs), 0.0) for _, runs in jobs]


def test_the_search_has_most_of_the_budget_and_trials_of_its_own():
    bench = Constant(1.0)
    phases = ChallengePhases(bench, space_of(STEREO), Plan(minutes=None, trials=250))
    worst = phases.search()
    assert worst is phases.tried[worst.point]
    assert worst.scores == [1.0] * RUNGS[-1]
    assert set(bench.seeds) == {phases.plan.seeds[0]}
    assert 0.8 * 250 <= phases.budget.used <= 0.8 * 250 + 2 * BATCH


def test_worlds_whose_confirmation_takes_too_long_are_passed_over():
    bench = Constant(1.0)
    campaign = ChallengePhases(bench, space_of(STEREO), Plan(minutes=1.0))
    slow, fast = ScoredWorld(campaign.space.plain), ScoredWorld(point_with(campaign.space, density=0.5))
    assert campaign.slowest == pytest.approx(0.2 * 60.0 / 61)
    campaign.evaluate([fast], 2)
    campaign.slowest = -1.0
    campaign.evaluate([slow], 2)
    assert (fast.usable, slow.usable) == (True, False)
    assert set(bench.ends) == {campaign.budget.started + 0.8 * 60.0}


class Invariant:
    """A Python filter that states one covariance of the pose and a far larger one of its own error."""

    name, error = "invariant", "right"
    init, predict, update = (lambda self, *given: (0, given[0])), (lambda self, *given: given[0]), None

    def pose(self, state):
        return cs.Gaussian(state[1].start, np.eye(3))

    def own_covariance(self, state):
        return 1e4 * np.eye(3)


def test_the_score_is_in_the_error_of_the_filter():
    filter_ = Invariant()
    filter_.update = lambda state, observation: (state, None)
    world = require_landmarks_in_view(STEREO)
    with Isolation([filter_], STEREO.belief) as isolation:
        assert score_of_run(isolation, world, 0, 0) < -5.0  # in the additive error it is above 0


class Ends(Invariant):
    """Ends its process, or never ends a step."""

    def __init__(self, hangs):
        self.hangs = hangs

    def predict(self, state, control):
        while self.hangs:
            pass
        os._exit(3)


@pytest.mark.skipif(sys.platform != "linux", reason="signals")
@pytest.mark.parametrize("hangs", [False, True])
def test_a_filter_that_crashes_or_hangs_fails_its_trials_alone(hangs, monkeypatch):
    monkeypatch.setattr(scoring, "PATIENCE", 0.3)
    filter_ = Ends(hangs)
    with ChallengeScorer(filter_, jobs=2) as bench:
        done = bench([(STEREO, [0]), (STEREO, [1])], 0, until=time.monotonic() + 0.5)
    assert [each.scores for each in done if each is not None] == [(WORST,), (WORST,)]


def test_worlds_that_show_nothing_are_left_out():
    """And if there is no other, that is said."""
    blind = STEREO.variant("blind", truth__landmarks__x=(50.0, 60.0))
    with pytest.raises(InputError, match="no world within the bounds"):
        challenge("ekf-uvd", blind, Plan(minutes=None, trials=40, jobs=1), SMALL)


def test_no_trial_begins_after_the_time():
    short = STEREO.variant("short", truth__steps=20)
    with ChallengeScorer(cs.get_filter("ekf-uvd"), 1) as bench:
        (late,), (done,) = bench([(short, range(3))], 0, until=0.0), bench([(short, range(3))], 0)
    assert (len(late.scores), len(done.scores)) == (0, 3)


# --- the command ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments, complaint",
    [
        (("ekf-uvx",), "unknown filter 'ekf-uvx'"),
        (("kf", "--scenario", "herath2007-stereo"), "filter 'kf' works on a sensor linear"),
        (("ekf-xyz", "--scenario", "herath2007-optimistic"), "key 'belief.motion.sigma_v'"),
        (("kf", "--jobs", "0"), "jobs must be at least 1"),
        (("kf", "--out", "found.txt"), "--out found.txt: must end in .toml"),
        (("kf", "--out", "no/found.toml"), "there is no folder no; make it first"),
        (("kf", "--fail-on", "nothing"), "--fail-on must be 'found'"),
    ],
)
def test_unusable_input_ends_in_one_line_and_status_2(arguments, complaint, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main(["challenge", *arguments])
    assert stop.value.code == 2
    said = capsys.readouterr().err
    assert complaint in said
    assert len(said.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_dead_reckoning_is_right_in_worlds_with_a_camera():
    """The filter by which benchmarks/challenge_rate.py counts searches over tilts and heights."""
    outcome = challenge(*challenge_rate.opponents("dead-reckoning"), Plan(None, 40, 3, 1, 1e-4))
    assert outcome.worlds > 5
    assert not outcome.found
