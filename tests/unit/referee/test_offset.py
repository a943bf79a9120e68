"""Clocks that differ, on runs whose offset is known."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from recorded import notes_of, read_recordings
from scipy import stats

import consistency as cs
from consistency.referee.geometry import wrap
from consistency.referee.readers import clocks
from consistency.referee.readers.clocks import (
    ClockSample,
    Offset,
    clock_shift,
    offset_of,
    samples_of,
    shows_in_estimates,
    time_steps,
)
from consistency.referee.readers.places import Places
from consistency.referee.readers.truth_matching import make_poses

SIGMA = np.array([0.3, 0.3, 0.02])
TRUE_T = np.arange(-2.0, 12.0, 0.02)


def path(rng, speed):
    """A winding drive at every 0.02 s, (700, 3)."""
    heading = rng.uniform(-3, 3) + 0.4 * np.sin(rng.uniform(-1, 1) * TRUE_T) + 0.2 * TRUE_T
    steps = 0.02 * speed * np.column_stack([np.cos(heading), np.sin(heading)])
    return np.column_stack([np.cumsum(steps, axis=0), wrap(heading)])


def run_of(rng, offset, noise=1.0, speed=5.0):
    """100 estimates in 10 s, whose clock is ``offset`` early."""
    t, truth = 0.1 * np.arange(100), path(rng, speed)
    poses = make_poses(
        Places("line {}".format, np.arange(100)), t, np.zeros((100, 3)), np.tile(np.diag(SIGMA**2), (100, 1, 1)),
        np.ones(100, bool), TRUE_T, truth, "planar", "so2", 0.01,
    )  # fmt: skip
    estimate = poses.known(offset).truth - noise * SIGMA * rng.normal(size=(100, 3))
    return poses.with_values(estimate=estimate)


def kalman_runs(rng, count, offset=0.0):
    """Right filters of position and velocity that measure the position each second, whose clocks are ``offset`` early.

    White acceleration of 1 m^2/s^3 as in docs/examples/cpp; 100 estimates in 10 s, the truth at every 0.01 s.
    """

    def moved(x, seconds):
        noise = np.linalg.cholesky([[seconds**3 / 3, seconds**2 / 2], [seconds**2 / 2, seconds]])
        return x @ np.array([[1.0, seconds], [0.0, 1.0]]).T + rng.normal(size=x.shape) @ noise.T

    truth = [rng.normal(size=(count, 2))]
    for _ in range(1100):
        truth.append(moved(truth[-1], 0.01))
    F, Q = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.1**3 / 3, 0.1**2 / 2], [0.1**2 / 2, 0.1]])
    x, P, estimates, covariances = np.zeros((count, 2)), np.eye(2), [], []
    for step in range(1, 101):
        x, P = x @ F.T, F @ P @ F.T + Q
        if step % 10 == 0:
            gain = P[:, 0] / (P[0, 0] + 0.09)
            measured = truth[10 * step][:, 0] + 0.3 * rng.normal(size=count)
            x, P = x + np.outer(measured - x[:, 0], gain), P - np.outer(gain, P[0])
        estimates.append(x)
        covariances.append(P)
    t, place = 0.1 * np.arange(1, 101), Places("line {}".format, np.arange(100))
    poses = make_poses(
        place, t - offset, t, np.array(covariances), np.ones(100, bool), 0.01 * np.arange(1101), t, "vector", "vector",
        0.01,
    )  # fmt: skip
    return [
        poses.with_values(estimate=estimate, truth=path)
        for estimate, path in zip(np.swapaxes(estimates, 0, 1), np.swapaxes(truth, 0, 1), strict=True)
    ]


def sizes(at):
    """In place of the sizes of the errors of a sample: those of a function of the shift."""
    return lambda sample, shift: np.full(len(sample.factors), at(shift))


@pytest.fixture
def rng():
    return np.random.default_rng()


@pytest.mark.parametrize("offset", [-0.35, -0.012, 0.0, 0.04, 0.7])
def test_without_noise_it_is_found_to_the_millisecond(rng, offset):
    found = offset_of(samples_of([run_of(rng, offset, noise=1e-3) for _ in range(5)]))
    assert found.value == pytest.approx(offset, abs=5e-4)
    assert found.low <= found.value <= found.high


def test_a_step_goes_to_the_offset(rng):
    steps = time_steps(*samples_of([run_of(rng, 0.02, noise=1e-3)]), 0.0, 3)
    assert_allclose(steps, 0.02, atol=2e-3)


def test_the_interval_by_hand(rng, monkeypatch):
    """Student's t of the steps that five runs would go from the offset: 2.7764 standard errors with 4 of freedom."""
    steps = iter([0.001, -0.002, 0.004, 0.0, 0.002])
    monkeypatch.setattr(clocks, "time_steps", lambda *_: np.array([next(steps)]))
    found = offset_of(samples_of([run_of(rng, 0.04, noise=1e-3) for _ in range(5)]))
    reach = 2.776445 * np.sqrt(5e-6 / 5)  # squares about the mean of 0.001 add up to 20e-6
    assert found.high - found.value == pytest.approx(reach, rel=1e-6)
    assert found.value - found.low == pytest.approx(reach, rel=1e-6)
    t = (found.value + 0.001) / np.sqrt(5e-6 / 5)
    assert found.p_value == pytest.approx(2.0 * stats.t.sf(t, 4), rel=1e-6)
    assert not found.alone


@pytest.mark.parametrize(
    "nees, then, alone", [(5.0, 2.0, False), (5.0, 3.0, True), (3.9, 1.0, True), (4.1, 1.0, False)]
)
def test_a_single_run_tells_of_its_clock_where_it_is_grossly_off(nees, then, alone, rng, monkeypatch):
    """Mean NEES over its degrees of freedom as it is, and 0.04 s later: beyond 4, and less than half of that."""
    asked = []

    def steps(poses, shift, parts):
        asked.append(parts)
        return np.array([0.001, -0.001, np.nan, 0.0])

    slope = (nees - then) / 0.04**2
    monkeypatch.setattr(ClockSample, "squares", sizes(lambda shift: then + slope * (shift - 0.04) ** 2))
    monkeypatch.setattr(clocks, "time_steps", steps)
    found = offset_of(samples_of([run_of(rng, 0.0)]))
    assert asked == [12]
    assert found.alone is alone
    assert found.value == pytest.approx(0.04, abs=1e-4)
    assert found.explained == pytest.approx(1.0 - then / nees, abs=1e-4)
    asked.clear()
    several = offset_of(samples_of([run_of(rng, 0.0)] * 2))
    assert not several.alone
    assert asked == [1, 1]


@pytest.mark.parametrize("steps, p", [((0.0, 0.0), None), ((0.0, np.nan, 0.0), None), ((0.0, 0.0, 0.0), 0.0)])
def test_steps_that_agree_are_certain_and_two_are_none(steps, p, rng, monkeypatch):
    monkeypatch.setattr(ClockSample, "squares", sizes(lambda shift: 1.0 + (shift - 0.04) ** 2))
    monkeypatch.setattr(clocks, "time_steps", lambda *_: np.array(steps))
    found = offset_of(samples_of([run_of(rng, 0.0)]))
    assert (None if found is None else found.p_value) == p


def test_steps_that_agree_on_no_offset_find_none(rng, monkeypatch):
    monkeypatch.setattr(ClockSample, "squares", sizes(lambda shift: 1.0 + abs(shift)))
    monkeypatch.setattr(clocks, "time_steps", lambda *_: np.zeros(4))
    found = offset_of(samples_of([run_of(rng, 0.0)]))
    assert (found.value, found.p_value) == (0.0, 1.0)


def test_with_noise_it_is_named(rng):
    """40 ms at 5 m/s are 0.2 m beside a sigma of 0.3 m. The estimate spreads by 1.2 ms: 10 times that is never seen."""
    runs = [run_of(rng, 0.04) for _ in range(20)]
    found = offset_of(samples_of(runs))
    assert found.found
    assert found.value == pytest.approx(0.04, abs=0.012)
    shift, notes = clock_shift("est", runs, None)
    assert shift == 0.0
    assert "seem to differ by 0.0" in notes[0]
    assert "--time-offset 0.0" in notes[0]
    shift, notes = clock_shift("est", runs, "estimate")
    assert shift == found.value
    assert "is added to the timestamps" in notes[0]


def test_a_right_clock_is_left_alone(rng):
    """Each is named with probability 1e-4: more than 1 of 20 with 2e-6."""
    assert sum(bool(clock_shift("est", [run_of(rng, 0.0) for _ in range(8)], None)[1]) for _ in range(20)) <= 1


def test_a_right_filters_errors_that_go_with_the_true_velocity_are_not_laid_on_the_clock(rng):
    """The motion of the truth names an offset in more than 9 of 10; each is told with probability 1e-3.

    Of three none is found with 1e-6, and more than one told with 3e-6.
    """
    logs = [kalman_runs(rng, 60) for _ in range(3)]
    assert any(offset_of(samples_of(runs)).found for runs in logs)
    assert sum(bool(clock_shift("est", runs, None)[1]) for runs in logs) <= 1


@pytest.mark.parametrize("offset", [-0.2, 0.2])
def test_clocks_of_a_right_filter_that_differ_are_named(rng, offset):
    """40 runs find it to 0.006 s: 0.05 is eight times that."""
    runs = kalman_runs(rng, 40, offset)
    assert "seem to differ by" in clock_shift("est", runs, None)[1][0]
    assert offset_of(samples_of(runs)).value == pytest.approx(offset, abs=0.05)


def test_estimates_show_an_offset_of_its_own_sign(rng):
    runs = [run_of(rng, 0.04, noise=1e-3) for _ in range(4)]
    assert shows_in_estimates(samples_of(runs), 0.04)
    assert not shows_in_estimates(samples_of(runs), -0.04)
    assert shows_in_estimates(samples_of([run_of(rng, -0.04, noise=1e-3)]), -0.04)
    still = [run.with_values(estimate=np.zeros_like(run.own.estimate)) for run in runs]
    assert not shows_in_estimates(samples_of(still), 0.04)


def test_the_error_of_a_row_is_not_in_the_motion_that_it_is_compared_with(rng, monkeypatch):
    """Errors of single fixes go with the motion of the estimates to their own row, by 40 standard errors."""
    monkeypatch.setattr(clocks, "SHOWN", 1e-7)
    runs = [run_of(rng, 0.0) for _ in range(30)]
    assert not shows_in_estimates(samples_of(runs), 0.01)
    assert not shows_in_estimates(samples_of(runs), -0.01)


def test_what_estimates_show_by_hand(rng, monkeypatch):
    """Sums 3, 5 and 4, each with 10: an offset of -0.4 s; without one of them -0.45, -0.35 and -0.4.

    The standard error is then the root of 2 / 3 * (0.05^2 + 0.05^2), 1 / (10 sqrt 3).
    That is t = -6.93, with the probability 0.0101 with 2 degrees of freedom.
    """
    monkeypatch.setattr(clocks, "_estimate_sums", lambda top, parts: np.array([[top, 10.0]]))
    for rate, shown in ((0.0102, True), (0.0100, False)):
        monkeypatch.setattr(clocks, "SHOWN", rate)
        assert shows_in_estimates([3.0, 5.0, 4.0], -0.4) is shown
        assert not shows_in_estimates([3.0, 5.0, 4.0], 0.4)


def test_the_error_of_a_single_run_is_not_laid_on_the_clock(rng):
    """An error along the path looks the same; only one far too large for the covariance is named."""
    for noise in (1.0, 0.01):  # the second is sure of the offset
        assert clock_shift("est", [run_of(rng, 0.04, noise)], None)[1] == []
    assert "of estimates and truth seem to differ by" in clock_shift("est", [run_of(rng, 0.3)], None)[1][0]


def test_where_nothing_moves_there_is_none(rng):
    runs = [run_of(rng, 0.0) for _ in range(4)]
    still = [
        run.with_values(truth=np.zeros_like(run.true.values), estimate=0.1 * SIGMA * run.own.estimate) for run in runs
    ]
    assert offset_of(samples_of(still)) is None
    with pytest.raises(cs.InputError, match="--time-offset estimate: nothing moves in est"):
        clock_shift("est", still, "estimate")


def with_covariance(run, scale):
    return run.with_values(covariance=run.own.covariance * scale)


@pytest.mark.parametrize("offset", [0.35, -0.28, 0.6])
def test_an_offset_is_found_beside_a_covariance_that_is_far_too_small(rng, offset):
    """By 1e4: every estimate is beyond 100 times its NEES, at the right offset, too. With noise it spreads by 2 ms."""
    runs = [with_covariance(run_of(rng, offset), 1e-4) for _ in range(8)]
    assert clock_shift("est", runs, "estimate")[0] == pytest.approx(offset, abs=0.02)
    assert "--time-offset" in clock_shift("est", runs, None)[1][0]


def test_broken_estimates_decide_nothing(rng):
    """A tenth of the rows, off by 1e4 sigma along x alone."""
    runs = [run_of(rng, 0.04) for _ in range(20)]
    for run in runs:
        run.own.estimate[::10, 0] += 1e4 * SIGMA[0]
    assert offset_of(samples_of(runs)).value == pytest.approx(0.04, abs=0.02)


def test_components_that_are_not_judged_say_nothing(rng):
    runs = [run_of(rng, 0.1) for _ in range(8)]
    for run in runs:
        run.own.estimate[:, 1] += 1e3 * rng.normal(size=100)
    assert offset_of(samples_of(runs, [0, 2])).value == pytest.approx(0.1, abs=0.03)
    assert samples_of(runs, [0, 2])[0].axes == [0, 2]


def test_a_component_that_never_changes_in_the_estimates_says_nothing(rng):
    """A heading of 0 throughout, with errors of many sigma."""
    runs = [run_of(rng, 0.1) for _ in range(8)]
    still = [run.with_values(estimate=run.own.estimate * [1.0, 1.0, 0.0]) for run in runs]
    [first, *_] = samples_of(still)
    assert first.axes == [0, 1]
    P, e = runs[0].own.covariance[:, :2, :2], still[0].errors(0.0)[:, :2]
    nees = np.einsum("ki,kij,kj->k", e, np.linalg.inv(P), e)
    assert_allclose(first.squares(0.0), nees / 2.0)
    assert samples_of(still, [2])[0].axes == [2]  # nothing else is judged


def test_of_many_runs_some_are_looked_at(rng):
    runs = [run_of(rng, 0.04).with_values(run=number) for number in range(3)]
    many = [runs[k % 3].with_values(run=k) for k in range(200)]
    numbers = [sample.poses.source.run for sample in samples_of(many)]
    assert len(numbers) == clocks.RUNS == 60
    assert numbers == sorted(set(numbers))
    assert (numbers[0], numbers[-1]) == (0, 199)
    assert len(samples_of(many[:60])) == 60


# --- files ------------------------------------------------------------------------------------------


@pytest.fixture
def tables(tmp_path, rng):
    """Estimates of 12 runs that are 0.1 s early, with their truths."""
    estimates, truths = [], []
    for number in range(12):
        run = run_of(rng, 0.1)
        P = {name: SIGMA[i] ** 2 for i, name in enumerate(("P_xx", "P_yy", "P_hh"))}
        columns = dict(zip(("x", "y", "heading"), run.own.estimate.T, strict=True))
        P |= dict.fromkeys(("P_xy", "P_xh", "P_yh"), 0)
        estimates.append(pd.DataFrame({"run": number, "t": run.own.t} | columns | P))
        true = dict(zip(("x", "y", "heading"), run.true.values.T, strict=True))
        truths.append(pd.DataFrame({"run": number, "t": run.true.t} | true))
    pd.concat(estimates).to_csv(tmp_path / "est.csv", index=False)
    pd.concat(truths).to_csv(tmp_path / "truth.csv", index=False)
    return tmp_path


def test_tables_are_read_with_an_offset(tables):
    """NEES 3 expected, of 1,200: 2.5 and 3.5 are 7 sigma away."""
    files = tables / "est.csv", tables / "truth.csv"
    for option, right in ((None, False), (0.1, True), ("estimate", True), (-0.1, False)):
        [record] = read_recordings(*files, time_offset=option)
        assert (2.5 < np.nanmean(record.errors.nees) < 3.5) == right, option
    assert "--time-offset 0." in notes_of(read_recordings(*files)[0])
    assert cs.judge(cs.read(*files, time_offset=0.1)).status != "overconfident"


def test_trajectories_are_read_with_an_offset(tmp_path, rng):
    for folder in ("est", "truth", "P"):
        (tmp_path / folder).mkdir()
    for number in range(6):
        run = run_of(rng, 0.1)
        for folder, t, pose in (("est", run.own.t, run.own.estimate), ("truth", run.true.t, run.true.values)):
            half = 0.5 * pose[:, 2]
            zero = np.zeros(len(t))
            up = rng.normal(size=(len(t), 3)) * 0.01 if folder == "est" else np.zeros((len(t), 3))
            turn = np.column_stack([0.5 * up[:, 1:], np.sin(half), np.cos(half)])
            turn /= np.linalg.norm(turn, axis=1)[:, None]
            np.savetxt(tmp_path / folder / f"{number}.txt", np.column_stack([t, pose[:, :2], zero + up[:, 0], turn]))
        P = np.diag([*SIGMA[:2] ** 2, 1e-4, 1e-4, 1e-4, SIGMA[2] ** 2]).ravel()
        np.savetxt(tmp_path / "P" / f"{number}.txt", np.column_stack([run.own.t, np.tile(P, (len(run.own.t), 1))]))
    files = tmp_path / "est", tmp_path / "truth", tmp_path / "P"
    early, right = (np.nanmean(read_recordings(*files, time_offset=o)[0].errors.nees) for o in (None, "estimate"))  # type: ignore[arg-type]
    assert early > 6.8
    assert 5.0 < right < 6.8
    assert "--time-offset 0." in notes_of(read_recordings(*files)[0])


def test_what_has_truth_is_judged_at_every_offset(rng):
    """Also where a shift leaves it without truth: an offset explains nothing by leaving estimates out.

    In a truth that ends with the estimates, wrong by 3 sigma in its last second alone, an offset of a second would.
    """
    run = run_of(rng, 0.0, noise=1e-3)
    within = (run.true.t >= run.own.t[0]) & (run.true.t <= run.own.t[-1] + 1e-9)
    truth = run.true.values[within] + 3.0 * SIGMA * (run.true.t[within] > 8.9)[:, None]
    found = offset_of(samples_of([run.with_values(true_t=run.true.t[within], truth=truth)]))
    assert abs(found.value) < 0.5


@pytest.mark.parametrize("explained, alone, found", [(0.02, False, True), (0.004, False, False), (0.02, True, False)])
def test_an_offset_that_makes_next_to_nothing_is_not_named(explained, alone, found):
    """However sure: x and y exchanged looked like clocks that differ by 0.01 s, which made 0 % of the NEES."""
    assert Offset(-0.01, -0.014, -0.006, 1e-9, explained, alone).found == found


@pytest.mark.parametrize("shift", [0.0, 0.05])
def test_a_truth_beside_the_estimates_is_that_of_other_times_if_the_clocks_differ(rng, shift):
    p = run_of(rng, 0.0)
    own = p.known(0.0).truth
    beside, apart = (p.with_values(true_t=t, truth=own, max_dt=0.2).known(shift) for t in (p.own.t, p.own.t.copy()))
    assert_allclose(beside.truth, apart.truth)
    assert_array_equal(beside.rows, apart.rows)
    assert np.array_equal(beside.truth, own) == (shift == 0.0)
