"""Guards: their names, what they remember of tracks, filters of a user's own, and how rejection is scored."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
from edited import content
from mismatch import WrongMatch, corrupted
from scipy import stats

import consistency as cs
from consistency.bench.filters.guard import Guarded
from consistency.bench.filters.run_filter import run_filter, step_through
from consistency.bench.pages import write_reports
from consistency.bench.pages.results_report import build_report
from consistency.bench.pages.sections.study_sections import rejections
from consistency.bench.protocols import optimal_gain
from consistency.bench.runs.montecarlo import run_log, simulate_log
from consistency.bench.scenario import GuardSettings
from consistency.bench.scenario.effects import EFFECTS
from consistency.bench.store.recorded_log import read_log
from consistency.bench.store.results import open_results
from consistency.bench.types import Info, Observation
from consistency.commands.app import app
from consistency.diagnostics import clustered_share, rejection_score
from consistency.referee.show.as_json import render
from consistency.referee.show.blocks import Name, Table, brief, written
from consistency.referee.verdicts.tables import document

WRONG = [{"kind": "wrong-match", "rate": 0.05}]


@pytest.fixture(autouse=True)
def effect():
    EFFECTS["wrong-match"] = WrongMatch
    yield
    del EFFECTS["wrong-match"]


@pytest.fixture
def wrong(uvd):
    return uvd.variant("wrong", truth__sensor__effects=WRONG)


class Counter:
    """Knows a position, sees how far landmarks are from it, and notes what it was given."""

    name = "counter"

    def init(self, problem):
        return {"seen": (), "given": ()}

    def predict(self, state, control):
        return state

    def update(self, state, observation):
        labels = observation.landmarks.tolist()
        known = [i for i, label in enumerate(labels) if label in state["seen"]]
        y = observation.z[known].ravel()  # what is expected is zero
        info = Info(y, np.eye(len(y)), np.zeros((3, len(y))))
        seen = tuple(dict.fromkeys((*state["seen"], *labels)))
        return {"seen": seen, "given": (*state["given"], tuple(labels))}, info

    def pose(self, state):
        return cs.Gaussian(np.zeros(3), np.eye(3))


def given(filter_, steps, settings=None):
    """Labels that a filter behind ``filter_`` is given in each step, of observations (x, 0, 0) by label."""

    out = list(after(filter_, steps, settings).inner["given"])
    return out


def after(filter_, steps, settings):
    """The state of ``filter_`` after observations (x, 0, 0) by label in each step."""

    class Problem:
        class belief:
            guard = settings

    state = filter_.init(Problem)
    for step in steps:
        z = np.array([[x, 0.0, 0.0] for x in step.values()]).reshape(-1, 3)
        state, _ = filter_.update(filter_.predict(state, None), Observation(np.array([*step], np.int64), z))
    return state


# --- names -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["ekf-uvd+gate", "kf+joint", "ukf-rb+ransac", "parked-ekf-uvd+gate", "submap-ekf-uvd+gate"]
)
def test_any_filter_may_carry_a_guard(name):
    inner, guarded = cs.get_filter(name.partition("+")[0]), cs.get_filter(name)
    assert guarded.name == name
    assert guarded.sensors == inner.sensors
    assert not optimal_gain(guarded)  # gated innovations are not white
    assert getattr(guarded, "error", "so2") == getattr(inner, "error", "so2")


@pytest.mark.parametrize(
    "name, message",
    [
        ("ekf-uvd+gates", "filter 'ekf-uvd': unknown guard 'gates'; known: gate, joint, ransac"),
        ("ekf-uvd+", "unknown guard ''"),
        ("ekf-uvd+gate+joint", "unknown guard 'gate[+]joint'"),
        ("ekf-uv+gate", "unknown filter 'ekf-uv' .did you mean 'ekf-uvd'"),
    ],
)
def test_a_wrong_name_is_refused(name, message):
    with pytest.raises(cs.InputError, match=message):
        cs.get_filter(name)


def test_smoothers_and_guarded_filters_take_no_guard():
    class Smoother(Counter):
        innovates = False

    with pytest.raises(cs.InputError, match="filter 'counter' cannot be guarded: it gives no innovations"):
        cs.guarded(Smoother(), "gate")
    for once in (cs.guarded(Counter(), "gate"), cs.get_filter("ekf-uvd+gate")):
        with pytest.raises(cs.InputError, match="has a guard already"):
            cs.guarded(once, "joint")


# --- the belief --------------------------------------------------------------------------------------


def test_a_belief_without_the_table_has_the_hash_that_it_had(uvd):
    assert cs.load_scenario("herath2007-stereo").hash == "58509e972cc57274"
    told = uvd.variant("told", belief__guard={"confidence": 0.9})
    assert told.hash != uvd.hash
    assert cs.Scenario.model_validate(told.model_dump(mode="json")).hash == told.hash
    assert told.variant("back", belief__guard=None).hash == uvd.hash


@pytest.mark.parametrize(
    "key, value",
    [("confidence", 1.0), ("confidence", 0.0), ("threshold", 0.0), ("min_age", 0), ("forget_after", 0)],
)
def test_settings_out_of_range_are_refused(uvd, key, value):
    with pytest.raises(ValueError, match=key):
        uvd.variant("bad", belief__guard={key: value})


def test_a_log_carries_the_settings(wrong, tmp_path):
    settings = {"confidence": 0.9, "min_age": 2}
    simulate_log(wrong.variant("told", belief__guard=settings), 1, 0, tmp_path / "log")
    log = read_log(tmp_path / "log")
    assert log.belief.guard == GuardSettings(**settings)  # type: ignore[arg-type]
    results = run_log(log, ["ekf-uvd+gate"], jobs=1)
    (row,) = results.rejections.itertuples(index=False)
    assert 0 < row.rejected_spurious <= row.spurious == log.trials[0].spurious.sum()


# --- tracks ------------------------------------------------------------------------------------------


def test_an_observation_that_is_far_off_is_rejected():
    steps = [{1: 0.0, 2: 0.0}, {1: 0.5, 2: 9.0}, {1: 9.0, 2: 0.5}]
    assert given(Guarded(Counter(), "gate"), steps) == [(1, 2), (1,), (2,)]


def test_a_wider_gate_lets_more_pass():
    steps = [{1: 0.0}, {1: 3.8}]
    for confidence, expected in ((0.99, ()), (0.999, (1,))):  # quantiles of chi-square: 3.37^2 and 4.03^2
        assert given(Guarded(Counter(), "gate"), steps, GuardSettings(confidence=confidence))[1] == expected


def test_a_young_track_neither_begins_a_landmark_nor_updates_one():
    steps = [{1: 0.0}, {1: 0.0, 2: 0.0}, {2: 0.0}, {2: 0.0}, {1: 0.0}]
    assert given(Guarded(Counter(), "gate"), steps, GuardSettings(min_age=3)) == [(), (), (), (2,), (1,)]


def test_a_landmark_whose_observations_are_rejected_is_given_up():
    far = {1: 9.0}
    steps = [{1: 0.0}, far, {1: 0.0}, far, {1: 0.0}, far, far, {1: 0.0}]
    expected = [(1,), (), (1,), (), (1,), (), ()]
    assert given(Guarded(Counter(), "gate"), steps, GuardSettings(forget_after=2)) == [*expected, ()]
    assert given(Guarded(Counter(), "gate"), steps) == [*expected, (1,)]  # never, by default


class Recorder(Counter):
    """Knows where landmarks were seen first, and expects them there."""

    def init(self, problem):
        return {"at": {}, "given": (), "forgotten": ()}

    def update(self, state, observation):
        seen = dict(zip(observation.landmarks.tolist(), observation.z, strict=True))
        y = np.array([z - state["at"][label] for label, z in seen.items() if label in state["at"]]).ravel()
        given = (*state["given"], tuple(seen))
        return state | {"at": seen | state["at"], "given": given}, Info(y, np.eye(len(y)), np.zeros((3, len(y))))


class Forgetful(Recorder):
    def forget(self, state, landmark):
        at = {label: z for label, z in state["at"].items() if label != landmark}
        return state | {"at": at, "forgotten": (*state["forgotten"], landmark)}


def rejected(filter_, *steps):
    """Which observations are rejected by a gate before ``filter_``, and the state that it comes to."""
    guarded = Guarded(filter_, "gate")
    state = after(guarded, list(steps), None)
    return guarded.rejected(state).tolist(), state.inner


def test_a_landmark_begins_anew_where_the_second_sighting_does_not_agree_with_the_first():
    which, inner = rejected(Forgetful(), {1: 9.0, 2: 0.0}, {1: 0.0, 2: 0.1}, {1: 0.2, 2: 9.0})
    assert which == [True, False, False, False, False, True]
    assert inner["forgotten"] == (1,)
    assert inner["given"] == ((1, 2), (1, 2), (1,))
    assert inner["at"][1][0] == 0.0


def test_it_does_so_until_two_agree():
    which, inner = rejected(Forgetful(), {1: 0.0}, {1: 9.0}, {1: 0.2}, {1: 0.1}, {1: 9.0}, {1: 0.0})
    assert which == [True, True, False, False, True, False]
    assert inner["at"][1][0] == 0.2


def test_a_track_that_never_agrees_is_given_up():
    guarded = Guarded(Forgetful(), "gate")
    state = after(guarded, [{1: 9.0 * k} for k in range(6)], GuardSettings(forget_after=3))
    assert state.inner["forgotten"] == (1, 1, 1)
    assert guarded.rejected(state).tolist() == [True, True, True, False, True, True]


def test_a_filter_that_cannot_forget_keeps_what_a_landmark_began_with():
    which, inner = rejected(Recorder(), {1: 9.0}, {1: 0.0}, {1: 9.1})
    assert which == [False, True, False]
    assert inner["given"] == ((1,), (), (1,))


def test_a_filter_without_innovations_ends_as_a_failed_run(uvd):
    class Silent(Counter):
        def update(self, state, observation):
            return super().update(state, observation)[0], None

    (failure,) = cs.run_trials(uvd, [cs.guarded(Silent(), "gate")], runs=1, jobs=1).failures.itertuples(index=False)
    assert "a guard needs a filter whose update returns Info" in failure.reason


def test_a_filter_of_ones_own_is_guarded_like_one_of_the_bench(wrong):
    mine = cs.guarded(cs.get_filter("ekf-uvd").textbook, "gate")
    assert pickle.loads(pickle.dumps(mine)).name == "ekf-uvd+gate"  # workers are sent it
    trial = cs.simulate(wrong)
    ours, compiled = (
        run_filter(mine, trial, wrong.belief),
        run_filter(cs.get_filter("ekf-uvd+gate"), trial, wrong.belief),
    )
    assert ours.rejected.tolist() == compiled.rejected.tolist()
    assert np.abs(ours.pose - compiled.pose).max() < 1e-10


def test_small_maps_are_guarded_too(wrong):
    """The first small map is the EKF's; to a new one a landmark is new, and its observation cannot be judged."""
    trial = cs.simulate(wrong, run=1)
    small, whole = (
        step_through(cs.guarded(getattr(filter_, "textbook", filter_), "gate"), trial, wrong.belief)
        for filter_ in map(cs.get_filter, ("submap-ekf-uvd", "ekf-uvd"))
    )
    assert small.failure is None
    joined = trial.first[50]
    assert small.rejected[:joined].tolist() == whole.rejected[:joined].tolist()
    assert small.rejected[:joined].any()
    assert not small.rejected[joined : trial.first[51]].any()


def test_what_is_wrong_is_rejected(linear, rng):
    """In a linear world with exact covariances: most of what is wrong, and few of the rest."""
    trial = corrupted(cs.simulate(linear), rng, 0.1)
    rejected = run_filter(cs.guarded(cs.get_filter("kf").textbook, "joint"), trial, linear.belief).rejected
    assert (rejected & trial.spurious).sum() > 0.6 * trial.spurious.sum()


# --- scores ------------------------------------------------------------------------------------------


def test_shares_and_their_intervals():
    score = rejection_score(*(np.array(n) for n in ([100, 200], [10, 10], [12, 18], [6, 9])))
    assert (score.offered, score.spurious, score.rejected, score.runs) == (300, 20, 30, 2)
    assert score.precision.value == 15 / 30
    assert score.recall.value == 15 / 20
    assert score.false_alarms.value == 15 / 280
    nothing = rejection_score(*np.zeros((4, 3), int))
    assert np.isnan(nothing.recall.value)
    assert nothing.recall[1:] == (0.0, 1.0)


def test_of_like_clusters_the_interval_is_the_exact_binomial_one():
    """Many clusters without spread: the design effect is 1, and the quantiles of t are those of the normal."""
    value, low, high = clustered_share(np.full(3000, 1), np.full(3000, 4))
    exact = stats.binomtest(3000, 12000).proportion_ci(method="exact")
    assert value == 0.25
    assert np.allclose((low, high), exact, rtol=0, atol=2e-5)


def test_few_clusters_widen_the_interval():
    """Ten draws of one each, half of them counted: a design effect of 10 / 9, and so 9 draws that count."""
    value, low, high = clustered_share(np.arange(10) % 2, np.ones(10))
    assert value == 0.5
    assert np.allclose((low, high), (stats.beta.ppf(0.025, 4.5, 5.5), stats.beta.ppf(0.975, 5.5, 4.5)), rtol=1e-9)


def test_ends_of_the_scale():
    assert clustered_share(np.zeros(50), np.full(50, 20))[:2] == (0.0, 0.0)
    assert clustered_share(np.full(50, 20), np.full(50, 20))[0::2] == (1.0, 1.0)
    assert clustered_share(np.array([3]), np.array([9]))[1:] == (0.0, 1.0)  # one run says nothing of the spread


# --- results -----------------------------------------------------------------------------------------

FILTERS = ["ekf-uvd", "ekf-uvd+gate"]


def test_rejections_are_kept_streamed_and_resumed(wrong, tmp_path):
    memory = cs.run_trials(wrong, FILTERS, runs=4, seed=1, jobs=1)
    memory.write(tmp_path / "memory")
    stored = cs.run_trials(wrong, FILTERS, runs=4, seed=1, jobs=2, out=tmp_path / "stored")
    cs.run_trials(wrong, FILTERS, runs=2, seed=1, jobs=1, out=tmp_path / "resumed")
    previous = open_results(tmp_path / "resumed")
    cs.run_trials(wrong, FILTERS, runs=4, seed=1, jobs=1, previous=previous, out=tmp_path / "resumed")
    assert "rejections.parquet" in content(tmp_path / "memory")
    assert content(tmp_path / "memory") == content(tmp_path / "stored") == content(tmp_path / "resumed")
    assert "rejections" in stored.manifest["tables"]
    table = cs.read_results(tmp_path / "stored").rejections
    assert table["filter"].unique().tolist() == ["ekf-uvd+gate"]
    for row in table.itertuples(index=False):
        trial = cs.simulate(wrong, run=row.run, seed=1)
        rejected = run_filter(cs.get_filter("ekf-uvd+gate"), trial, wrong.belief).rejected
        counts = (len(rejected), trial.spurious.sum(), rejected.sum(), (rejected & trial.spurious).sum())
        assert (row.offered, row.spurious, row.rejected, row.rejected_spurious) == counts


def test_a_failed_run_counts_up_to_its_end(uvd):
    class Breaks(Counter):
        def update(self, state, observation):
            if len(state["given"]) == 3:
                raise ValueError("enough")
            return super().update(state, observation)

    results = cs.run_trials(uvd, [cs.guarded(Breaks(), "gate")], runs=1, jobs=1)
    assert results.rejections["offered"].tolist() == [cs.simulate(uvd).first[3]]


def test_verdicts_tell_precision_and_recall(wrong, capsys, tmp_path):
    cs.run_trials(wrong, FILTERS, runs=4, seed=2, jobs=1, out=tmp_path / "out")
    verdicts = cs.analyse(cs.read_results(tmp_path / "out"))
    assert verdicts["ekf-uvd"].rejection is None
    score = verdicts["ekf-uvd+gate"].rejection
    assert score.precision != score.recall
    statistics = json.loads(render(document(verdicts)))["ekf-uvd+gate"]["statistics"]
    assert statistics["rejection_recall"] == list(score.recall)
    assert statistics["rejection_precision"] == list(score.precision)
    app(["analyse", str(tmp_path / "out")], standalone_mode=False)
    out = capsys.readouterr().out
    assert f"ekf-uvd+gate rejected {score.rejected} of {score.offered} observations, {score.spurious}" in out
    assert "precision" in str(verdicts["ekf-uvd+gate"])


def test_a_report_has_a_row_for_each_guard(wrong, tmp_path):
    cs.run_trials(wrong, FILTERS, runs=3, seed=1, jobs=1, out=tmp_path / "out")
    study = build_report(tmp_path / "out").studies[0]
    _, table = rejections(study)
    assert isinstance(table, Table)
    ((_, (row,)),) = table.groups
    score = study.tracks[1].verdict.rejection
    assert row[:4] == (
        Name("ekf-uvd+gate", study.tracks[1].look), str(score.offered), str(score.spurious), str(score.rejected)
    )  # fmt: skip
    shares = (score.precision, score.recall, score.false_alarms)
    assert [written(cell).partition(" ")[0] for cell in row[4:]] == [brief(100 * share.value) for share in shares]
    write_reports(tmp_path / "out", tmp_path / "r.html", None, False)
    assert "Rejected observations" in (tmp_path / "r.html").read_text(encoding="utf-8")
    assert rejections(replace(study, tracks=study.tracks[:1])) == ()


def test_a_clean_world_has_a_share_of_rejections_alone(uvd):
    verdict = cs.analyse(cs.run_trials(uvd, ["ekf-uvd+gate"], runs=2, jobs=1))["ekf-uvd+gate"]
    assert verdict.rejection.spurious == 0
    assert "precision" not in str(verdict)
    assert "rejected" in str(verdict)
