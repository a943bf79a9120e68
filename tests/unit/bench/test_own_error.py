"""The convention of a filter's error, and its map: from the filter through the runs to files and back."""

import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from edited import content
from invariant import Invariant
from numpy.testing import assert_allclose, assert_array_equal

import consistency as cs
from consistency.bench.filters.run_filter import run_filter
from consistency.bench.runs.montecarlo import run_log, simulate_log
from consistency.bench.runs.run_outcome import outcome_of
from consistency.bench.store.recorded_log import read_log
from consistency.bench.store.results import OWN_NUMBERS, joined, open_results
from consistency.bench.types import Estimates, Map, Trial
from consistency.referee.column_names import OWN_COVARIANCE, POINT_COVARIANCE
from consistency.referee.geometry import planar_error
from consistency.referee.types import Failure

FILTERS = ["ekf-uvd", Invariant()]
OWN = [*OWN_COVARIANCE, "own_nees"]


@pytest.fixture(scope="module")
def results(uvd):
    return cs.run_trials(uvd, FILTERS, runs=6, seed=5, jobs=1)


def matrices(table, columns):
    out = np.zeros((len(table), 3, 3))
    for name, (i, j) in columns.items():
        out[:, i, j] = out[:, j, i] = table[name]
    return out


# --- a step-wise filter --------------------------------------------------------------------------


def test_estimates_carry_the_convention_the_covariance_and_the_map(uvd):
    trial = cs.simulate(uvd, 1, seed=5)
    said, twin = (run_filter(f, trial, uvd.belief) for f in (Invariant(), cs.get_filter("ekf-uvd").textbook))
    assert (said.error, twin.error, twin.own) == ("right", "so2", None)
    for k in (0, 10, 59):
        x, y, _ = said.pose[k]
        M = np.array([[1, 0, y], [0, 1, -x], [0, 0, 1.0]])
        assert_allclose(said.own[k], M @ said.covariance[k] @ M.T, rtol=1e-12)
    compiled = run_filter(cs.get_filter("ekf-uvd"), trial, uvd.belief)
    assert_array_equal(said.map.landmarks, compiled.map.landmarks)
    assert_allclose(said.map.mean, compiled.map.mean, atol=1e-8)
    assert_allclose(said.map.covariance, compiled.map.covariance, atol=1e-8)


class WithJoint(Invariant):
    """Gives the joint Gaussian of pose and map too."""

    def joint(self, state):
        return self.textbook.joint(state)


def test_the_joint_covariance_is_sorted_as_the_map_is(uvd):
    class Backwards(WithJoint):
        def map(self, state):
            return dict(reversed(super().map(state).items()))

        def joint(self, state):
            given = super().joint(state)
            rows = np.arange(len(given.mean)).reshape(-1, 3)
            rows[1:] = rows[:0:-1]
            return cs.Gaussian(given.mean[rows.ravel()], given.covariance[np.ix_(rows.ravel(), rows.ravel())])

    trial = cs.simulate(uvd)
    compiled = cs.get_filter("ekf-uvd").run(trial, uvd.belief).map.joint
    for filter_ in (WithJoint(), Backwards()):
        said = run_filter(filter_, trial, uvd.belief).map
        assert_array_equal(said.landmarks, np.unique(trial.landmark))
        assert_allclose(said.joint, compiled, atol=1e-9)
    assert run_filter(Invariant(), trial, uvd.belief).map.joint is None


@pytest.mark.parametrize(
    "spoil, reason",
    [
        (lambda P: P[1:, 1:], "ValueError: joint() gave an array of shape"),
        (lambda P: np.where(P[0, 0] == P, np.nan, P), "the joint covariance of pose and map is not finite"),
        (lambda P: P + np.eye(len(P), k=2), "the joint covariance of pose and map is not symmetric"),
    ],
)
def test_a_joint_covariance_that_cannot_be(uvd, spoil, reason):
    class Breaks(WithJoint):
        def joint(self, state):
            given = super().joint(state)
            return cs.Gaussian(given.mean, spoil(given.covariance))

    said = run_filter(Breaks(), cs.simulate(uvd), uvd.belief)
    assert said.failure.reason.startswith(reason)
    assert said.map is None


def test_a_filter_without_map_has_none(uvd):
    class Mapless(Invariant):
        map = None  # type: ignore[assignment]

    assert run_filter(Mapless(), cs.simulate(uvd), uvd.belief).map is None
    assert cs.run_trials(uvd, [Mapless()], runs=2, jobs=1).map is None


@pytest.mark.parametrize(
    "own, reason",
    [
        (np.eye(2), "ValueError: own_covariance() gave an array of shape (2, 2), not (3, 3)"),
        (np.diag([1.0, 1.0, np.nan]), "the covariance of the error 'right' is not finite"),
        (np.eye(3) + np.eye(3, k=1), "the covariance of the error 'right' is not symmetric"),
        (np.diag([1.0, 1.0, -1.0]), "the covariance of the error 'right' is not positive definite"),
        (np.diag([1.0, 1.0, 0.0]), "the covariance of the error 'right' is not positive definite"),
        (None, "LinAlgError: no root (in own_covariance, test_own_error.py:LINE)"),
    ],
)
def test_an_own_covariance_that_cannot_be(uvd, own, reason):
    class Breaks(Invariant):
        def predict(self, state, control):
            self.step = getattr(self, "step", 0) + 1
            return super().predict(state, control)

        def own_covariance(self, state):
            if self.step < 7:
                return super().own_covariance(state)
            if own is None:
                raise np.linalg.LinAlgError("no root")
            return own

    said = run_filter(Breaks(), cs.simulate(uvd), uvd.belief)
    assert said.failure.step == 7
    assert re.sub(r":\d+\)", ":LINE)", said.failure.reason) == reason
    assert np.isfinite(said.own[:6]).all()
    assert np.isnan(said.own[6:]).all()
    assert said.map is None


def one_landmark(mean, covariance, label=0):
    return {label: cs.Gaussian(mean, covariance)}


@pytest.mark.parametrize(
    "given, reason",
    [
        ([1.0], "TypeError: map must return a dictionary of landmarks by label"),
        (one_landmark(np.zeros(2), np.eye(3)), "ValueError: map() gave an array of shape (2,), not (3,)"),
        (one_landmark(np.zeros(3), np.eye(2)), "ValueError: map() gave an array of shape (2, 2), not (3, 3)"),
        (one_landmark(np.full(3, np.inf), np.eye(3)), "landmark 0 in the map is not finite"),
        (one_landmark(np.zeros(3), np.full((3, 3), np.nan), 4), "landmark 4 in the map is not finite"),
        (
            one_landmark(np.zeros(3), np.eye(3) + np.eye(3, k=1), 4),
            "the covariance of landmark 4 in the map is not symmetric",
        ),
        (
            one_landmark(np.zeros(3), np.eye(3), 120),
            "ValueError: map() has a landmark 120; they are numbered 0 to 119",
        ),
        (
            one_landmark(np.zeros(3), np.eye(3), "tree"),
            "ValueError: map() has a landmark 'tree'; they are numbered 0 to 119",
        ),
    ],
)
def test_a_map_that_cannot_be(uvd, given, reason):
    class Breaks(Invariant):
        def map(self, state):
            return given

    trial = cs.simulate(uvd)
    said = run_filter(Breaks(), trial, uvd.belief)
    assert (said.failure.step, said.failure.reason) == (trial.steps, reason)
    assert said.map is None
    assert np.isfinite(said.pose[:-1]).all()
    assert np.isnan(said.pose[-1]).all()


@pytest.mark.parametrize("error", ["so3", "RIGHT", None, 3])
def test_an_error_that_is_no_convention(uvd, error):
    class Odd(Invariant):
        pass

    Odd.error = error
    text = rf"filter 'right': its error must be one of so2, left, right, vector, got {error!r}"
    with pytest.raises(cs.InputError, match=text):
        cs.run_trials(uvd, [Odd()], runs=1)


def test_an_error_without_its_covariance(uvd):
    class Silent:
        name, error = "silent", "left"
        init = predict = update = pose = Invariant.pose

    with pytest.raises(cs.InputError, match=r"filter 'silent': with the error 'left' it needs own_covariance\(state\)"):
        cs.run_trials(uvd, [Silent()], runs=1)


def test_a_whole_trial_of_another_error_than_declared(uvd):
    class Whole(Invariant):
        def run(self, trial, belief):
            return replace(run_filter(Invariant(), trial, belief), own=None)

        def is_ready(self, trial, belief):
            return True

        def compile(self, trial, belief):
            pass

    with pytest.raises(cs.InputError, match="its estimates must be of the error 'right' and carry it"):
        cs.run_trials(uvd, [Whole()], runs=1, jobs=1)


# --- files ---------------------------------------------------------------------------------------


def test_own_nees_is_of_the_own_error(results):
    assert results.manifest["error"] == {"right": "right"}
    rows = results.estimates.merge(results.truth, on=["run", "step"], suffixes=("", "_true")).query("filter == 'right'")
    true, estimate = (rows[[f"{name}{end}" for name in ("x", "y", "heading")]].to_numpy() for end in ("_true", ""))
    own = matrices(rows, OWN_COVARIANCE)
    judged = rows["own_nees"].notna().to_numpy()
    assert set(rows.loc[~judged, "step"]) == {1}
    e = planar_error(true, estimate, "right")[judged]
    expected = np.einsum("ki,kij,kj->k", e, np.linalg.inv(own[judged]), e)
    assert_allclose(rows.loc[judged, "own_nees"], expected, rtol=1e-6)
    nees = rows.loc[judged, "nees"].to_numpy()
    assert np.abs(nees - expected).max() > 1e-3, "the additive error is another one"


def test_other_filters_have_no_own_columns(results, uvd):
    table = results.estimates
    assert table.loc[table["filter"] == "ekf-uvd", OWN].isna().all(axis=None)
    alone = cs.run_trials(uvd, ["ekf-uvd"], runs=6, seed=5, jobs=1)
    assert not set(OWN) & set(alone.estimates)
    assert "error" not in alone.manifest
    among = table[table["filter"] == "ekf-uvd"].drop(columns=OWN)
    pd.testing.assert_frame_equal(among, alone.estimates, check_exact=True)


def test_own_columns_are_written_streamed_and_read_back(uvd, results, tmp_path):
    results.write(tmp_path / "memory")
    stored = cs.run_trials(uvd, FILTERS, runs=6, seed=5, jobs=1, out=tmp_path / "streamed")
    assert content(tmp_path / "streamed") == content(tmp_path / "memory")
    for name in ("estimates", "map", "truth"):
        pd.testing.assert_frame_equal(getattr(stored, name), getattr(results, name), check_exact=True)
    assert stored.error_of("right") == "right"
    assert stored.error_of("ekf-uvd") == "so2"
    assert pq.ParquetFile(tmp_path / "memory" / "estimates.parquet").schema_arrow.names[-7:] == OWN
    batches = list(stored.batches("estimates", OWN_NUMBERS, "right"))
    again = np.concatenate([batch["own_P_xh"] for batch in batches])
    assert_array_equal(again, results.estimates.query("filter == 'right'")["own_P_xh"])


@pytest.mark.parametrize("streamed", [False, True])
def test_resuming_keeps_own_columns_and_maps(uvd, results, tmp_path, streamed):
    results.write(tmp_path / "whole")
    cs.run_trials(uvd, FILTERS, runs=3, seed=5, jobs=1).write(tmp_path / "out")
    out = {"out": tmp_path / "out"} if streamed else {}
    more = cs.run_trials(uvd, FILTERS, runs=6, seed=5, jobs=1, previous=open_results(tmp_path / "out"), **out)
    if not streamed:
        more.write(tmp_path / "out", overwrite=True)
    assert content(tmp_path / "out") == content(tmp_path / "whole")
    assert more.manifest["error"] == {"right": "right"}


def test_resuming_with_another_error_is_refused(uvd, results):
    class Left(Invariant):
        error = "left"

    with pytest.raises(cs.InputError, match="the results to resume have another error of a filter"):
        cs.run_trials(uvd, ["ekf-uvd", Left()], runs=8, seed=5, jobs=1, previous=results)


def test_joined_results_keep_errors_and_maps(uvd, results):
    parts = [cs.run_trials(uvd, [f], runs=6, seed=5, jobs=1) for f in FILTERS]
    whole = joined(parts)
    assert whole.manifest["error"] == {"right": "right"}
    pd.testing.assert_frame_equal(whole.estimates, results.estimates, check_exact=True)
    pd.testing.assert_frame_equal(whole.map, results.map, check_exact=True)
    pd.testing.assert_frame_equal(whole.truth, results.truth, check_exact=True)
    assert whole.filters == results.filters


def test_results_that_lack_the_columns_of_an_error(results, tmp_path):
    replace(results, estimates=results.estimates.drop(columns=OWN)).write(tmp_path / "out")
    with pytest.raises(cs.InputError, match=r"estimates\.parquet: column 'own_P_xx' is missing"):
        cs.read_results(tmp_path / "out")


def test_a_manifest_with_an_unknown_error(results, tmp_path):
    replace(results, manifest=results.manifest | {"error": {"right": "up"}}).write(tmp_path / "out")
    with pytest.raises(cs.InputError, match=r"manifest\.json: key 'error': must be one of so2, left, .* got 'up'"):
        cs.read_results(tmp_path / "out")


# --- the map -------------------------------------------------------------------------------------


def test_the_map_after_the_last_step(results, uvd):
    table = results.map
    for run, name in ((2, "ekf-uvd"), (4, "right")):
        trial = cs.simulate(uvd, run, seed=5)
        rows = table[(table["filter"] == name) & (table["run"] == run)]
        assert list(rows["landmark"]) == sorted(set(trial.landmark))
        e = results.landmarks.set_index("landmark").loc[rows["landmark"]].to_numpy() - rows[["x", "y", "z"]].to_numpy()
        P = matrices(rows, POINT_COVARIANCE)
        assert_allclose(rows["nees"], np.einsum("ki,kij,kj->k", e, np.linalg.inv(P), e), rtol=1e-6)


def test_a_failed_run_has_no_map(uvd):
    class Breaks(Invariant):
        def own_covariance(self, state):
            return -np.eye(3)

    results = cs.run_trials(uvd, ["ekf-uvd", Breaks()], runs=2, jobs=1)
    assert len(results.failures) == 2
    assert set(results.map["filter"]) == {"ekf-uvd"}
    assert set(OWN) < set(results.estimates), "columns do not depend on how runs end"


def of_map(labels_in_map, **changes):
    """Rows of a map of unit covariances at the origin."""
    count = len(labels_in_map)
    trial = Trial(
        run=3, start=np.zeros(3), controls=np.ones((1, 3)), first=np.array([0, 3]), landmark=np.array([0, 4, 1]),
        z=np.ones((3, 3)), n_landmarks=5, truth=np.zeros((2, 3)), landmarks=np.diag([1.0, 2.0, 3.0]),
        source=np.array([0, -1, 2]),
    )  # fmt: skip
    joint = np.eye(3 + 3 * count)
    joint[0, 3] = joint[3, 0] = 0.5  # pose and first landmark, in x
    blocks = np.broadcast_to(np.eye(3), (count, 3, 3)).copy()
    map_ = Map(np.array(labels_in_map), np.zeros((count, 3)), blocks, joint)
    said = Estimates("f", 3, np.zeros((1, 3)), np.eye(3)[None], np.full(1, np.nan), np.zeros(1, np.int64), map=map_)
    broken = replace(said, filter="g", failure=Failure("g", 3, 1, "NaN"))
    outcome = outcome_of(replace(trial, **changes), [said, broken])
    assert list(outcome.maps) == ["f"], "a failed run has no map"
    return pd.DataFrame(outcome.maps["f"])


def test_labels_that_are_no_landmark_have_no_nees():
    """Id 4 is none in the world; id 1 is one that was never seen as itself; id 2 is only seen under another id."""
    rows = of_map([0, 1, 2, 4])
    assert_array_equal(rows["nees"], [1.0, np.nan, 9.0, np.nan])
    assert_allclose(rows["joint_nees"], [4.0 / 3.0, np.nan, 9.0, np.nan])
    assert list(rows["run"]) == [3] * 4
    assert_array_equal(of_map([0, 1, 2], source=None)["nees"], [1.0, 4.0, 9.0])
    assert of_map([0, 1], landmarks=None)[["nees", "joint_nees"]].isna().all(axis=None)
    assert of_map([0, 1], truth=None)["joint_nees"].isna().all()
    assert list(of_map([0, 4], labels=np.array([10, 11, 12, 13, 77]))["landmark"]) == [10, 77]


def test_a_map_of_a_log_has_the_numbers_of_its_files(uvd, tmp_path):
    simulate_log(uvd, 2, 5, tmp_path / "log")
    for name in ("landmarks", "observations"):
        table = pd.read_parquet(tmp_path / "log" / f"{name}.parquet")
        table.assign(landmark=1000 + 3 * table["landmark"]).to_parquet(tmp_path / "log" / f"{name}.parquet")
    by_log = run_log(read_log(tmp_path / "log"), ["ekf-uvd"], jobs=1).map
    direct = cs.run_trials(uvd, ["ekf-uvd"], runs=2, seed=5, jobs=1).map
    assert_array_equal(by_log["landmark"], 1000 + 3 * direct["landmark"])
    assert_allclose(by_log["nees"], direct["nees"], rtol=1e-6)


def test_a_map_of_the_linear_world_is_right(small):
    """Mean NEES of the landmarks 3: in 200 runs of the Kalman filter within 4 standard deviations of run means."""
    table = cs.run_trials(small("linear-gaussian"), ["kf"], runs=200, seed=1, jobs=1).map
    means = table.groupby("run")["nees"].mean() / 3.0
    assert abs(means.mean() - 1.0) < 4.0 * means.std() / np.sqrt(len(means))
    assert means.std() < 0.6, "so that the bound is one"
