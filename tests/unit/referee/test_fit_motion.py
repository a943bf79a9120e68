"""Means that depend on the motion, clocks that differ, and inputs that are not poses, on drives with known errors."""

from dataclasses import replace

import numpy as np
import pytest
import relative_poses as spatial
from fit_covariance import OWN_CONSTANTS, World, drives, matrices_of
from numpy.testing import assert_allclose, assert_array_equal
from odometry import windows
from scipy import stats

import consistency as cs
from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.covariance_ratios import JudgedSpan, Ratio, ratio_of
from consistency.referee.fit_covariance.drives import (
    ROUNDED,
    Drive,
    angles,
    clock_offset,
    drive_of,
    ways,
)
from consistency.referee.fit_covariance.fit_files import snippets
from consistency.referee.fit_covariance.mean_and_noise import Mean, fit_noise, fit_slip, jacobian, jacobian_of_mean
from consistency.referee.fit_covariance.noise_model import correction, decided, model_sentence, noise_lines
from consistency.referee.fit_covariance.refusals import TERMS, mean_by_motion, p_value_of, require_poses, values_by_bin
from consistency.referee.geometry import composed, inverse, vectors
from consistency.referee.readers.options import make_reading
from consistency.referee.readers.places import Places
from consistency.referee.readers.truth_matching import make_poses, unstated

SPAN = "10m"
RIGHT = Ratio(1.0, 0.8, 1.25, 0.1, 10, 250)
OPEN = replace(RIGHT, low=0.56, high=1.95)
SPACE = ((4e-4, 2e-4, 3e-4, 2e-6, 3e-6, 4e-6), (4e-4, 1e-4, 2e-4, 1e-5, 1e-5, 2e-5))


def paced(rng, noise, number=5):
    """Drives that go by 0.2 or 1 m a step, for 20 steps each, with noise (sd, m) of the way of each step."""
    found = []
    for i in range(number):
        true = np.zeros((1000, 3))
        true[:, 0] = np.repeat(rng.choice([0.2, 0.6, 1.0], 50), 20)
        true[:, 2] = 0.05 * np.sin(0.1 * np.arange(1000) + i)
        error = np.column_stack([noise * rng.normal(size=1000), 1e-3 * rng.normal(size=(1000, 2))])
        T, M = (composed(np.concatenate([np.eye(3)[None], matrices_of(each)])) for each in (true + error, true))
        found.append(Drive(f"drive {i}", np.arange(1001.0), np.arange(1001), T, M))
    return found


# --- a way by turn ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("world", [World(), World(*SPACE)], ids=["plane", "space"])
def test_effect_of_a_slip_is_its_derivative(world, rng):
    w = windows(drives(rng, 1, world, 300.0))
    w = replace(w, true=w.motions)
    less, more = (Mean(slip=slip).applied(w).errors for slip in (-1e-6, 1e-6))
    assert_allclose((less - more) / 2e-6, jacobian(w.pieces)[..., -1], atol=1e-6)
    longer = Mean(slip=0.1).corrected(w.pieces)
    assert_allclose(ways(longer), ways(w.pieces) + 0.1 * angles(w.pieces))
    assert_allclose(longer[..., w.d :], w.pieces[..., w.d :])
    assert ways(Mean(slip=-1e3).corrected(w.pieces)).min() == 0.0


def test_a_known_slip_is_recovered_and_corrected(rng):
    """With hardly any noise: the corrected motion is the true one."""
    quiet = World((1e-10, 1e-10, 1e-12), (1e-12,) * 3, slip=-0.1)
    w = windows(drives(rng, 2, quiet, 400.0))
    assert fit_slip(w) == pytest.approx(-0.1, rel=1e-3)
    noise = fit_noise(w, by_turn=True)
    assert noise.mean.slip == pytest.approx(-0.1, rel=1e-3)
    assert noise.mean.way == pytest.approx(1.0, abs=1e-3)
    assert np.abs(noise.mean.applied(w).errors).max() < 1e-3
    assert np.abs(fit_noise(w).mean.applied(w).errors).max() > 0.02
    piece = np.array([[[1.0, 0.0, -0.5]]])
    corrected = Mean(2.0, 0.9, (0.1,), slip=-0.2).corrected(piece)
    assert ways(corrected)[0, 0] == pytest.approx(2.0 * (1.0 - 0.2 * 0.5))
    assert corrected[0, 0, 2] == pytest.approx(0.9 * -0.5 + 0.1 * 0.9)


def test_a_slip_keeps_the_floor_and_the_evidence(rng):
    w = windows(drives(rng, 2, World(slip=-0.2), 300.0))
    noise = fit_noise(w, by_turn=True, jitter=np.array([1.0, 2.0, 3.0]))
    assert noise.floor.tolist() == [1.0, 2.0, 3.0]
    alone = fit_noise(Mean(slip=noise.mean.slip).applied(w), jitter=noise.floor)
    assert_array_equal(noise.mean_fit.low, alone.mean_fit.low)
    assert replace(noise.mean, slip=0.0) == alone.mean


def test_a_straight_drive_tells_no_slip(rng):
    steps = np.tile([0.5, 0.0, 0.0], (1200, 1))
    noisy = steps + rng.normal(size=steps.shape) * [0.02, 0.0, 0.0]
    T, M = (composed(matrices_of(each)) for each in (noisy, steps))
    assert fit_slip(windows([Drive("a", np.arange(1200.0), np.arange(1200), T, M)])) == 0.0


def test_a_way_by_turn_is_found_named_and_corrected(rng):
    """The right value is -0.2 m a radian; its standard error over 200 windows is about 0.01."""
    made = drives(rng, 5, World(slip=-0.2, **OWN_CONSTANTS | {"scale": 0.0}), 400.0)
    before, after = cs.fit_covariance(made, SPAN), cs.fit_covariance(made, SPAN, by_turn=True)
    found = before.by_motion
    assert (found.is_found, found.scale, found.by, found.axis) == (True, TERMS[0], "turn", "x")
    assert found.values[0] == pytest.approx(1.0, abs=0.005)  # straight roads have no slip
    assert found.values[-1] < found.values[0] - 0.005
    assert before.status in ("inconsistent", "overconfident", "undecided")
    assert "the scale of the way depends on the turn: x1" in model_sentence(before)
    assert "correct the way by the turn with --by-turn" in model_sentence(before)
    assert not after.by_motion.is_found
    assert after.noise.mean.slip == pytest.approx(-0.2, abs=0.05)
    assert f"correct first: {after.noise.mean.slip:+.3g} m of way a rad of turn" in correction(after)
    assert f"slip_m_per_rad = {after.noise.mean.slip!r}" in snippets(after)["noise.toml"]
    assert after.noise.per_rad[0] < before.noise.per_rad[0] or after.noise.per_m[0] < before.noise.per_m[0]
    already = replace(before, noise=replace(before.noise, mean=after.noise.mean))
    assert "--by-turn" not in model_sentence(already)
    assert f"(add the square of {found.reach:.2g} m to the variance of x)" in model_sentence(already)
    right = replace(before.spans[0], whole=RIGHT, axes=(RIGHT,) * 3)
    shown = replace(before, spans=(right, *before.spans[1:]), lasting=())
    assert shown.status == "inconsistent"
    assert replace(shown, by_motion=None).status == "consistent"
    assert replace(shown, by_motion=replace(found, share=0.09)).status == "consistent"
    assert cs.fit_covariance(made[:2], SPAN, correct=False).by_motion is None
    with pytest.raises(InputError, match="by_turn is a correction"):
        cs.fit_covariance(made, SPAN, correct=False, by_turn=True)


# --- the question -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [0, 1])
def test_a_scale_that_depends_on_the_turn_has_its_values(scale, rng):
    """Planted in thirds of the windows: x1, x1.1 and x1.2 of either scale."""
    made = drives(rng, 4, World((1e-6, 1e-6, 1e-8), (1e-9,) * 3), 500.0)
    w = windows(made)
    size = angles(w.pieces).sum(axis=1)
    thirds = np.searchsorted(np.quantile(size, [1 / 3, 2 / 3]), size, side="right")
    e = w.errors + 0.1 * thirds[:, None] * jacobian_of_mean(w.pieces)[:, :, scale]
    noise = replace(fit_noise(w), mean=Mean())
    found = mean_by_motion(noise, replace(w, true=w.motions @ spatial.exp(e)))
    assert (found.scale, found.by) == (TERMS[scale], "turn")
    assert found.is_found
    assert_allclose(found.values, (1.0, 1.1, 1.2), atol=0.015)  # a straight third tells no scale of turns
    assert_allclose(found.edges, np.quantile(size, [1 / 3, 2 / 3]), rtol=0.3)


def test_a_scale_of_all_windows_that_is_not_corrected_is_no_spread(rng):
    """A tenth of the way is 15 sigma, which would be a share of 200; noise alone makes 0.02 of it on average."""
    w = windows(drives(rng, 5, World(), 400.0))
    noise, thirds = replace(fit_noise(w), mean=Mean()), np.arange(len(w.drive)) % 3
    w = replace(w, true=w.motions @ spatial.exp(w.errors + 0.1 * jacobian_of_mean(w.pieces)[:, :, 0]))
    values, error = values_by_bin(w, thirds, 0)
    assert_allclose(values, 0.1, atol=0.01)  # 10 standard errors
    assert np.abs(error).max() < 0.1
    found = mean_by_motion(noise, w)
    assert found.share < 0.2
    assert found.p_value > 0.01  # fails in 1 %


def test_a_scale_that_depends_on_the_way(rng):
    """Over seconds, with three speeds: x1 at the lowest and x1.1 at the highest."""
    made = paced(rng, 0.01)
    w = windows(made, "20s")
    fast = ways(w.pieces).sum(axis=1) > 15.0
    e = w.errors + 0.1 * fast[:, None] * jacobian_of_mean(w.pieces)[:, :, 0]
    found = mean_by_motion(replace(fit_noise(w), mean=Mean()), replace(w, true=w.motions @ spatial.exp(e)))
    assert (found.is_found, found.scale, found.by) == (True, TERMS[0], "way")
    assert found.values[0] == pytest.approx(1.0, abs=0.02)
    assert found.values[-1] == pytest.approx(1.1, abs=0.02)


def test_noise_of_the_way_by_which_windows_are_divided_is_not_a_dependence(rng):
    """By the estimated way, a window that errs forward is a longer one; by the true way it is not."""
    made = paced(rng, 1.0)
    w = windows(made, "20s")
    noise = fit_noise(w)
    now = noise.mean.applied(w)
    size = ways(now.pieces).sum(axis=1)
    thirds = np.searchsorted(np.quantile(size, [1 / 3, 2 / 3]), size, side="right")
    assert p_value_of(now, now.pieces, thirds, 0) < 1e-3
    assert mean_by_motion(noise, w).p_value > 0.01  # fails in 1 %


def test_the_p_value_is_that_of_scores_of_blocks(rng):
    """Of one drive: errors and the trend of a scale, less what a mean explains of both, in 40 blocks."""
    w = windows(drives(rng, 1, length=600.0))
    bins = np.arange(len(w.drive)) % 3
    size = np.sqrt((w.errors**2).mean(axis=0))
    X = jacobian_of_mean(w.pieces) / size[:, None]
    y = (w.errors / size).ravel()
    asked = (X[..., 1] * bins[:, None]).ravel()
    own = X.reshape(len(y), -1)
    y, asked = (each - own @ np.linalg.lstsq(own, each, rcond=None)[0] for each in (y, asked))
    of_windows = (y * asked).reshape(len(bins), -1).sum(axis=1)
    scores = [block.sum() for block in np.array_split(of_windows, 40)]
    t = stats.ttest_1samp(scores, 0.0).statistic * np.sqrt(1.0 - own.shape[1] / len(y))
    assert p_value_of(w, w.pieces, bins, 1) == pytest.approx(2 * stats.t.sf(abs(t), 39))


def test_constants_of_each_drive_are_no_dependence():
    """Each is found with a chance of 1 % at most: 3 of 10 are with one of 1e-4."""
    found = 0
    for seed in range(10):
        made = drives(np.random.default_rng([7, seed]), 4, World(scale=0.05, turn=0.05, drift=2e-3), 300.0)
        w = windows(made)
        found += mean_by_motion(fit_noise(w), w).p_value < 0.01
    assert found < 3


def test_pieces_of_the_true_motion(rng):
    made = drives(rng, 2, length=200.0)
    w = windows(made).of(np.arange(0, 38, 3))
    assert_allclose(replace(w, pieces=w.true_pieces).errors, 0.0, atol=1e-9)


# --- statuses ---------------------------------------------------------------------------------------------------------


def test_an_undecided_axis_makes_it_undecided_and_is_named(rng):
    axes = (RIGHT, RIGHT, OPEN)
    assert OPEN.status == "undecided"
    judged = JudgedSpan(SPAN, RIGHT, axes, np.ones((1, 4)))
    assert judged.status == "undecided"
    assert replace(judged, axes=(RIGHT, replace(RIGHT, low=1.2, high=1.6), OPEN)).status == "inconsistent"
    assert replace(judged, whole=replace(RIGHT, low=1.2, high=1.6)).status == "overconfident"
    unknown = Ratio(*(float("nan"),) * 4, drives=0, windows=250)  # an axis without any error
    assert replace(judged, axes=(RIGHT, unknown, RIGHT)).status == "consistent"
    model = cs.fit_covariance(drives(rng, 5, length=300.0), SPAN)
    by_drive, counts = model.spans[0].by_drive, np.bincount(model.windows.drive)
    for axis, ratio, dof in ((3, model.spans[0].axes[2], counts), (0, model.spans[0].whole, 3 * counts)):
        assert ratio.value == pytest.approx(ratio_of(by_drive[:, axis], np.ones(3), True, dof).value)
    shown = replace(model, spans=(judged, *model.spans[1:]), lasting=(), by_motion=None)
    assert shown.status == "undecided"
    assert model_sentence(shown).endswith("; undecided: yaw")
    without_error = replace(judged, axes=(RIGHT, unknown, RIGHT))
    assert "undecided" not in model_sentence(replace(shown, spans=(without_error, *model.spans[1:])))


def test_what_decides_beside_the_ratio():
    assert decided("consistent", False, False) == "consistent"
    assert decided("consistent", True, False) == "undecided"
    assert decided("consistent", True, True) == "inconsistent"
    assert decided("conservative", True, True) == "conservative"


def test_the_mean_of_logarithms_of_few_degrees_of_freedom(rng):
    """-psi(k / 2) + log(k / 2) is 0.0405 for 25, and right on average: 4 standard errors of 4,000 ratios are 0.006."""
    values = np.array([1.0, 1.1, 0.9])
    few = ratio_of(values, np.ones(3), True, np.array([25.0, 25.0, 25.0]))
    assert np.log(few.value / ratio_of(values, np.ones(3)).value) == pytest.approx(0.04053, abs=1e-5)
    draws = rng.chisquare(4, (4000, 10)) / 4
    logs = [np.log(ratio_of(each, each, True, np.full(10, 4)).value) for each in draws]
    assert abs(np.mean(logs)) < 4 * np.std(logs) / np.sqrt(4000)


# --- clocks ---------------------------------------------------------------------------------------------


def bare(t, estimate, true_t, truth, manifold, max_dt):
    """Poses without covariances."""
    place, P = Places("row {}".format, np.arange(len(t))), unstated(len(t), 3 if manifold == "planar" else 6)
    return make_poses(place, t, estimate, *P, true_t, truth, manifold, "left", max_dt)


def uneven(rng, late, world, number):
    """Poses whose timestamps are ``late`` s early, in a world of their own, of a vehicle that does not move evenly."""
    found = []
    for drive in drives(rng, number, world, 150.0):
        t = np.cumsum(0.4 + 0.3 * np.sin(0.3 * np.arange(len(drive.t))))
        place = matrices_of(np.full((1, 3 if drive.d == 2 else 6), 0.7))
        E, M = vectors(place @ drive.estimate), vectors(drive.truth)
        poses = bare(t - late, E, t, M, "planar" if drive.d == 2 else "spatial", 0.02)
        found.append((poses, place @ drive.estimate))
    return found


@pytest.mark.parametrize("late, number", [(0.2, 3), (-0.35, 1)])
@pytest.mark.parametrize("world", [World(jumps=2), World(*SPACE)], ids=["plane", "space"])
def test_an_offset_of_clocks_is_found_from_motions(late, number, world, rng):
    made = uneven(rng, late, world, number)
    wide = [(poses.with_values(max_dt=0.5), T) for poses, T in made]
    assert clock_offset(wide) == pytest.approx(late, abs=0.02)


def test_an_offset_that_nothing_tells_is_refused():
    M = np.column_stack([np.arange(300.0), np.zeros((300, 2))])
    poses = bare(np.arange(300.0), M, np.arange(300.0), M, "planar", 0.5)
    with pytest.raises(InputError, match="--time-offset estimate: the motions do not tell it"):
        clock_offset([(poses, matrices_of(M))])


def test_drives_whose_clocks_differ_are_refused(rng):
    made = [*uneven(rng, 0.2, World(), 1), *uneven(rng, -0.8, World(), 1)]
    wide = [(poses.with_values(max_dt=1.0), T) for poses, T in made]
    with pytest.raises(InputError, match="--time-offset estimate: the motions do not tell it"):
        clock_offset(wide)


def test_the_command_reads_an_offset_that_is_estimated(tmp_path, rng):
    for name in ("est", "truth"):
        (tmp_path / name).mkdir()
    for i, (poses, _) in enumerate(uneven(rng, 0.2, World(), 3)):
        for name, t, rows in (("est", poses.own.t, poses.own.estimate), ("truth", poses.true.t, poses.true.values)):
            table = np.column_stack([t, rows])
            np.savetxt(tmp_path / name / f"{i}.csv", table, delimiter=",", header="t,x,y,heading", comments="")
    given = make_reading(truth=tmp_path / "truth", time_offset="estimate", max_dt=0.5)
    found = cs.read_drives(tmp_path / "est", reading=given)
    assert found[0].shift == pytest.approx(0.2, abs=0.02)
    fixed = cs.read_drives(tmp_path / "est", reading=given.with_options(time_offset=found[0].shift))
    assert_array_equal(found[2].t, fixed[2].t)
    assert_array_equal(found[2].truth, fixed[2].truth)
    assert fixed[0].shift == 0.0
    model = cs.fit_covariance(found, SPAN)
    assert f"clocks: {found[0].shift:.3g} s are added to the timestamps" in "\n".join(noise_lines(model))
    assert "clocks" not in "\n".join(noise_lines(replace(model, windows=replace(model.windows, drives=tuple(fixed)))))
    with pytest.raises(InputError, match="--time-offset fast: must be a number of seconds, or 'estimate'"):
        cs.read_drives(tmp_path / "est", reading=given.with_options(time_offset="fast"))
    whole = [cs.read_drives(tmp_path / "est", reading=given.with_options(time_offset=one))[0].t[0] for one in (1, 1.0)]
    assert whole[0] == whole[1]


# --- no poses ---------------------------------------------------------------------------------------------------------


def increments(T):
    return np.concatenate([np.eye(T.shape[-1])[None], inverse(T[:-1]) @ T[1:]])


def unturned(T):
    out = np.array(T)
    out[:, :-1, :-1] = np.eye(T.shape[-1] - 1)
    return out


@pytest.mark.parametrize("world", [World(), World(*SPACE)], ids=["plane", "space"])
def test_increments_and_placeholders_are_named(world, rng):
    drive = drives(rng, 1, world, 300.0)[0]
    require_poses([drive])
    cases = (
        ({"estimate": increments(drive.estimate)}, r"estimates seem to be motions.*give motions="),
        ({"truth": increments(drive.truth)}, r"truth seem to be motions.*compound them"),
        ({"estimate": unturned(drive.estimate)}, r"rows of the estimates have one orientation.*placeholder"),
        ({"truth": unturned(drive.truth)}, r"rows of the truth have one orientation.*give truth with"),
    )
    for parts, words in cases:
        with pytest.raises(InputError, match=words):
            cs.fit_covariance([drive, replace(drive, **parts)], SPAN)


def test_what_moves_without_turning_is_no_placeholder(rng):
    """A straight road with estimates that drift by a radian, and a vehicle that moves sideways as it likes."""
    steps = np.tile([0.5, 0.0, 0.0], (600, 1))
    drifting = steps + np.array([0.0, 0.0, 1e-3])
    straight, drifted = (composed(matrices_of(each)) for each in (steps, drifting))
    sideways = np.column_stack([np.cumsum(rng.normal(size=(600, 2)), axis=0), np.zeros(600)])
    turning = sideways + [0.0, 0.0, 1.0] * np.linspace(0, 1, 600)[:, None]
    for T, M in ((drifted, straight), (matrices_of(turning), matrices_of(sideways))):
        require_poses([Drive("a", np.arange(600.0), np.arange(600), T, M)])


@pytest.mark.parametrize("side", ["estimates", "truth"])
@pytest.mark.parametrize("kind", ["npz", "csv", "folder"])
def test_headings_in_degrees_are_refused(kind, side, tmp_path, rng):
    """Those of unwrapped radians are read, though they are beyond a turn."""
    drive = drives(rng, 1, length=300.0)[0]
    rows = {"estimates": vectors(drive.estimate), "truth": vectors(drive.truth)}

    def read():
        if kind == "npz":
            np.savez(tmp_path / "a.npz", t=drive.t, **rows)
            return cs.read_drives(tmp_path / "a.npz")
        paths = {each: tmp_path / each / "a.csv" for each in rows}
        for each, path in paths.items():
            path.parent.mkdir(exist_ok=True)
            table = np.column_stack([drive.t, rows[each]])
            np.savetxt(path, table, delimiter=",", header="t,x,y,heading", comments="", fmt="%.12g")
        if kind == "csv":
            return cs.read_drives(paths["estimates"], paths["truth"])
        return cs.read_drives(tmp_path / "estimates", tmp_path / "truth")

    rows[side][:, 2] += 6.0 * np.pi
    assert len(read()) == 1
    rows[side][:, 2] = np.rad2deg(rows[side][:, 2] - 6.0 * np.pi)
    with pytest.raises(InputError, match=rf"headings of the {side} .* seem to be in degrees; write headings in rad"):
        read()


@pytest.mark.parametrize("size", [1e-12, 1e-9, 1e-5])
def test_rotations_equal_to_rounding_are_no_closed_loops(size, rng):
    """Headings of the truth, rounded to a step of ``size``; positions err as they did."""
    made = []
    for drive in drives(rng, 3, length=500.0):
        E, M = vectors(drive.estimate), vectors(drive.truth)
        E[:, 2] = size * np.round((M[:, 2] + 0.3 * size) / size)
        made.append(drive_of(drive.name, E, M, drive.t))
    with pytest.raises(InputError, match=r"rotations of estimate and truth differ by .* as by rounding"):
        cs.fit_covariance(made, SPAN)
    assert windows(made).jumps == 0
    assert size < ROUNDED


def test_timestamps_in_messages_are_not_rounded(tmp_path):
    path = tmp_path / "a.tum"
    path.write_text("".join(f"1326030980.{k} {k} 0 0 0 0 0 1\n" for k in (51, 53, 53, 55)))
    with pytest.raises(InputError, match=r"line 3: timestamp 1326030980\.53 is duplicated"):
        cs.read_drives(path, path)
