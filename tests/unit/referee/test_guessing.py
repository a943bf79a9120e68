"""No error is declared: which conventions the covariances do not contradict."""

import json

import numpy as np
import pytest
from command import consistency
from recorded import read_recordings
from scipy.spatial.transform import Rotation

import consistency as cs
from consistency.diagnostics import judge
from consistency.referee.geometry import SPATIAL

pytestmark = pytest.mark.usefixtures("without_hints")

# standard deviations of x, y, z (m) and of the rotation about x, y, z (rad): they differ, so that a frame shows
SIGMA = np.array([0.02, 0.2, 0.06, 0.01, 0.1, 0.03])


def write(folder, convention, runs=40, factor=1.0, key=1):
    """Poses whose errors have a hundredth of diag(SIGMA^2) in a convention, to first order; ``factor`` on it."""
    rng, est, truth = np.random.default_rng(key), folder / "est", folder / "truth"
    est.mkdir()
    truth.mkdir()
    numbers = " ".join(f"{x:.12g}" for x in 0.01 * np.diag(SIGMA**2).ravel())
    for run in range(runs):
        lines = [[], []]
        for k in range(3):
            p, R = 20.0 * rng.standard_normal(3), Rotation.random(random_state=rng.integers(2**31))
            e = 0.1 * np.sqrt(factor) * SIGMA * rng.standard_normal(6)
            true_p, true_R = applied(p, R, e, convention)
            lines[0].append(f"{k} {_text(p, R)} {numbers}")
            lines[1].append(f"{k} {_text(true_p, true_R)}")
        for each, text in zip((est, truth), lines, strict=True):
            (each / f"r{run:02d}.txt").write_text("\n".join(text) + "\n")
    return est, truth


def applied(p, R, e, convention):
    turn = Rotation.from_rotvec(e[3:])
    if convention == "so3":
        return p + e[:3], turn * R
    if convention == "so3-body":
        return p + e[:3], R * turn
    if convention == "left":
        return p + R.apply(e[:3]), R * turn
    if convention == "rvec":
        return p + e[:3], Rotation.from_rotvec(R.as_rotvec() + e[3:])
    if convention == "euler":
        return p + e[:3], Rotation.from_euler("ZYX", R.as_euler("ZYX") + e[:2:-1])
    return turn.apply(p) + e[:3], turn * R


def _text(p, R):
    return " ".join(f"{x:.15g}" for x in (*p, *R.as_quat()))


def read(files, error):
    """The record of files without a look at the clocks."""
    (record,) = read_recordings(*files, error=error, time_offset=0.0)
    return record


@pytest.fixture(scope="module")
def files(tmp_path_factory, without_hints):
    return {convention: write(tmp_path_factory.mktemp(convention), convention) for convention in SPATIAL}


@pytest.fixture(scope="module")
def guesses(files):
    return {convention: read(files[convention], "guess") for convention in SPATIAL}


@pytest.mark.parametrize("convention", SPATIAL)
def test_the_right_convention_is_the_one_that_is_left(guesses, convention):
    """At a false-alarm rate of 1e-4, so that chance rejects the right one in 1 of 10,000 seeds."""
    record = guesses[convention]
    assert set(record.guesses) == set(SPATIAL)
    v = cs.judge(record, false_alarm=1e-4)
    assert (v.status, v.faults) == ("undecided", ())
    assert [kind for kind, guess in v.guesses.items() if guess.possible] == [convention]
    assert f"not rejected at a rate of 0.01 %: {convention} (covariance ratio" in v.reasons[0]
    gone = ", ".join(kind for kind in v.guesses if kind != convention)
    assert f"; rejected: {gone}. The filter's documentation says which it is; declare it with --error" in v.reasons[0]
    assert v.guesses[convention].ratio.holds(1.0)


def test_the_declared_error_has_its_own_status_and_intervals_hold_together(files, guesses):
    """Bonferroni over all conventions: wider than the interval of one."""
    right, wrong, guess = read(files["left"], "left"), read(files["left"], "so3"), guesses["left"]
    assert judge(wrong).status not in ("consistent", "undecided")
    v = judge(guess)
    assert v.guesses["left"].status == judge(right).status
    assert v.guesses["so3"].status == judge(wrong).status
    assert v.convention is None
    assert not v.answers
    assert not v.equivalence.shown
    alone = judge(guess.guesses["left"])
    value, low, high = v.guesses["left"].ratio
    assert value == pytest.approx(alone.scale.inflation.value)
    assert low < alone.scale.inflation.low
    assert high > alone.scale.inflation.high


def test_none_fits(tmp_path):
    v = judge(read(write(tmp_path, "left", runs=15, factor=9.0), "guess"))
    assert v.status == "undecided"
    assert "at a rate of 5 % each all are rejected: so3, so3-body, left, right, rvec, euler" in v.reasons[0]
    assert len([line for line in v.reasons if line.startswith("if the error is ")]) == len(SPATIAL)


def test_the_command(files, capsys):
    est, truth = files["so3-body"]
    options = ("--error", "guess", "--time-offset", "0", "--json")
    said = json.loads(consistency(capsys, "analyse", est, "--truth", truth, *options)[0])["est"]
    assert said["status"] == "undecided"
    assert set(said["statistics"]["guesses"]) == set(SPATIAL)
    assert said["statistics"]["guesses"]["so3-body"]["possible"] is True
    assert said["statistics"]["guesses"]["left"]["possible"] is False


def test_a_table_of_planar_poses(tmp_path):
    rng = np.random.default_rng(3)
    est = ["run,step,x,y,heading,P_xx,P_xy,P_xh,P_yy,P_yh,P_hh"]
    truth = ["run,step,x,y,heading"]
    for run in range(60):
        h, e = rng.uniform(-3, 3), rng.standard_normal(3) * [0.02, 0.3, 1e-3]
        est.append(f"{run},1,0,0,{h},4e-4,0,0,9e-2,0,1e-6")
        x, y = np.cos(h) * e[0] - np.sin(h) * e[1], np.sin(h) * e[0] + np.cos(h) * e[1]
        truth.append(f"{run},1,{x},{y},{h + e[2]}")
    (tmp_path / "est.csv").write_text("\n".join(est) + "\n")
    (tmp_path / "truth.csv").write_text("\n".join(truth) + "\n")
    (guess,) = read_recordings(tmp_path / "est.csv", tmp_path / "truth.csv", error="guess")
    v = cs.judge(guess, false_alarm=1e-4)
    assert list(v.guesses) == ["so2", "left", "right"]
    assert [kind for kind, one in v.guesses.items() if one.possible] == ["left"]
    part = guess.of_runs(slice(0, 30))
    assert len(part.guesses["left"].run_numbers) == 30
    (tmp_path / "plain.csv").write_text("step,a,P_a_a\n1,0.5,1\n2,-0.5,1\n")
    (tmp_path / "zero.csv").write_text("step,a\n1,0\n2,0\n")
    with pytest.raises(cs.InputError, match="--error guess: is for poses"):
        read_recordings(tmp_path / "plain.csv", tmp_path / "zero.csv", error="guess", state=["a"])


@pytest.mark.parametrize(
    "options, message",
    [
        ({"relative": "1"}, "--error guess: does not go with --relative"),
        ({"truth_covariance": "columns"}, "--error guess: does not go with --truth-covariance"),
    ],
)
def test_what_is_refused(tmp_path, options, message):
    with pytest.raises(cs.InputError, match=message):
        read_recordings(*write(tmp_path, "so3", 2), error="guess", **options)
