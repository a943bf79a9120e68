"""Noise models of odometry: windows, means and variances against finite differences and known truth, folds, ratios.

Drives that no white noise describes are refused or named, with the reason and the remedy.
"""

from dataclasses import replace

import fit_covariance as world
import numpy as np
import pytest
import relative_poses as spatial
from fit_covariance import PER_M, World, drives, matrices_of
from numpy.testing import assert_allclose
from odometry import windows
from scipy.spatial.transform import Rotation

import consistency as cs
from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.covariance_ratios import Ratio, folds_of, ratio_of
from consistency.referee.fit_covariance.drives import (
    Drive,
    cut_windows,
    drive_of,
    in_plane,
    jackknife_blocks,
    span_of,
    vectors_of,
)
from consistency.referee.fit_covariance.drives import motion_matrices as pieces_of
from consistency.referee.fit_covariance.estimation import interval_of, nees_of
from consistency.referee.fit_covariance.mean_and_noise import (
    FORWARD,
    Mean,
    carriers,
    estimate,
    fit_mean,
    fit_noise,
    fit_terms,
    jacobian_of_mean,
    jitter_of,
    normal_equations,
    terms_of,
)
from consistency.referee.fit_covariance.noise_model import caution, model_sentence, noise_lines
from consistency.referee.fit_covariance.refusals import (
    TERMS,
    PersistentError,
    RotationGrowth,
    body_turn,
    errors_of_second,
    persistent_errors,
    rotation_growth,
    variance_between,
)
from consistency.referee.geometry import composed, inverse, log, vectors

GROUPS = ("SE(2)", "SE(3)")


def drive_in(group, rng, steps=400, name="a"):
    """A drive in the plane or in space whose motions err independently."""
    made = spatial.drive(rng, group, steps)
    T = composed(np.concatenate([np.eye(made.motions.shape[-1])[None], made.motions]))
    return drive_of(name, spatial.vectors(T), spatial.vectors(made.truth), 0.1 * np.arange(len(T)))


def cut(group, rng, span="3m"):
    return windows([drive_in(group, rng)], span)


# --- windows ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("group", GROUPS)
def test_errors_are_those_of_whole_motions(group, rng):
    drive = drive_in(group, rng)
    w = windows([drive], "3m")
    D, M = (inverse(T[w.first]) @ T[w.last] for T in (drive.estimate, drive.truth))
    assert_allclose(w.motions, D, atol=1e-12)
    assert_allclose(w.errors, log(inverse(D) @ M), atol=1e-10)
    assert (w.first[1:] == w.last[:-1]).all()


def test_pieces_of_other_spans_have_the_same_size(rng):
    w = windows(drives(rng, 1, length=200.0))
    for size, pieces in ((10.0, 20), (20.0, 40), (2.5, 5), (0.1, 1)):
        found = w.over(size)
        assert found is None or found.pieces.shape[1] == pieces
        assert (found is None) == (size < 0.5)  # m, a step
    assert w.over(500.0) is None


def test_a_jump_is_cut_and_counted(rng):
    clean, jumpy = (windows(drives(np.random.default_rng(7), 1, World(jumps=n))) for n in (0, 2))
    assert clean.jumps == 0
    assert jumpy.jumps in (1, 2)
    assert np.abs(jumpy.errors[:, :2]).max() < 0.7


def test_jumps_are_those_of_their_own_drive():
    """A drive that errs a hundred times as much has none."""
    rng = np.random.default_rng(1)
    rough = drives(rng, 1, World(times=1e4))[0]
    assert windows([*drives(rng, 4), rough]).jumps == 0


def test_windows_without_motion_are_left_out(rng):
    drive = drives(rng, 1)[0]
    T = np.concatenate([drive.estimate[:1000], np.repeat(drive.estimate[999:1000], 400, 0)])
    M = np.concatenate([drive.truth[:1000], np.repeat(drive.truth[999:1000], 400, 0)])
    whole = Drive("a", 0.5 * np.arange(1400.0), np.arange(1400), T, M)
    w = windows([whole], "10s")
    assert w.still == 19
    assert w.long == 0


def test_gaps_are_left_out_and_counted(rng):
    drive = drives(rng, 1)[0]
    keep = np.r_[0:500, 700:1200]
    part = Drive("a", drive.t[keep], drive.row[keep], drive.estimate[keep], drive.truth[keep])
    for span in ("10s", "20", "10m"):
        assert windows([part], span).long == 1


def test_spans_are_refused():
    for bad in ("0m", "-1m", "1km", "m", "", "1.5"):
        with pytest.raises(InputError, match="--span"):
            span_of(bad)


@pytest.mark.parametrize("group", GROUPS)
def test_motions_as_vectors_are_the_same_motions(group, rng):
    """Also of none at all."""
    w = cut(group, rng)
    T = pieces_of(w.pieces)
    turn = T[..., :-1, :-1]
    assert_allclose(turn @ np.swapaxes(turn, -1, -2), np.broadcast_to(np.eye(w.d), turn.shape), atol=1e-12)
    assert_allclose(vectors_of(T), w.pieces, atol=1e-12)
    assert_allclose(T[..., :-1, -1], w.pieces[..., : w.d])
    assert vectors_of(T[:0]).shape == w.pieces[:0].shape
    assert pieces_of(w.pieces[:0]).shape == T[:0].shape


def test_planar_part_of_motions_in_space(rng):
    """Poses on a plane give the same windows in either form, whatever the world frame is."""
    drive = drives(rng, 1)[0]
    tilt = Rotation.from_euler("xyz", [0.3, -0.2, 1.0])

    def raised(T):
        pose = np.zeros((len(T), 7))
        pose[:, :3] = tilt.apply(np.column_stack([T[:, :2, 2], np.zeros(len(T))]))
        yaw = Rotation.from_rotvec(np.arctan2(T[:, 1, 0], T[:, 0, 0])[:, None] * [0, 0, 1])
        pose[:, 3:] = (tilt * yaw).as_quat()
        return pose

    space = drive_of("a", raised(drive.estimate), raised(drive.truth), drive.t)
    flat, cut = windows([drive]), cut_windows([space], span_of("10m"), planar=True)
    assert_allclose(cut.errors, flat.errors, atol=1e-9)
    assert in_plane(space.estimate).shape == (len(drive.t), 3, 3)


# --- means ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("group", GROUPS)
def test_an_error_of_a_piece_is_carried_to_the_end(group, rng):
    w = cut(group, rng)
    A, n = carriers(pieces_of(w.pieces)), len(w.axes)
    perfect = replace(w, true=w.motions)
    for k in (0, 7, 20):
        e = 1e-6 * rng.normal(size=(len(A), n))
        rest = pieces_of(w.pieces)
        before = np.eye(w.d + 1)[None].repeat(len(A), 0)
        for j in range(k):
            before = before @ rest[:, j]
        after = inverse(before) @ w.motions
        moved = replace(perfect, true=before @ spatial.exp(e) @ after)
        assert_allclose(moved.errors, np.einsum("wij,wj->wi", A[:, k], e), atol=1e-10)


@pytest.mark.parametrize("group", GROUPS)
def test_derivatives_of_the_mean(group, rng):
    w = cut(group, rng)
    w = replace(w, true=w.motions)
    X, step = jacobian_of_mean(w.pieces), 1e-6
    for p in range(X.shape[-1]):
        ends = []
        for sign in (1, -1):
            values = np.zeros(X.shape[-1])
            values[p] = sign * step
            mean = Mean(1 + values[0], 1 + values[1], tuple(values[2:]))
            ends.append(mean.applied(w).errors)
        assert_allclose(
            -(ends[0] - ends[1]) / (2 * step), X[..., p], atol=1e-7 if group == "SE(2)" else 0.02 * np.abs(X).max()
        )


@pytest.mark.parametrize("group", GROUPS)
def test_a_mean_alone_is_found(group, rng):
    w = cut(group, rng)
    drift = (0.01,) if group == "SE(2)" else (0.01, -0.02, 0.005)
    known = Mean(0.95, 1.04, drift)
    w = replace(w, true=known.applied(w).motions)
    found = fit_mean(w)
    assert (found.way, found.turn, *found.drift) == pytest.approx((0.95, 1.04, *drift), abs=2e-4)
    again = estimate(w, found, normal_equations(w, found, None, [FORWARD])[FORWARD]).mean
    assert (again.way, again.turn, *again.drift) == pytest.approx((0.95, 1.04, *drift), abs=1e-6)
    assert_allclose(again.applied(w).errors, 0.0, atol=1e-5)


# --- likelihood ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("group", GROUPS)
def test_terms_are_sums_over_pieces(group, rng):
    w = cut(group, rng)
    F, A, n = terms_of(w.pieces), carriers(pieces_of(w.pieces)), len(w.axes)
    d = w.d
    for k, axis in ((3, 0), (5, n - 1)):
        by_hand = np.zeros((2, n, n))
        for piece in range(20):
            T = pieces_of(w.pieces)[k, piece]
            turn = np.arctan2(T[1, 0], T[0, 0]) if d == 2 else Rotation.from_matrix(T[:3, :3]).magnitude()
            for size, out in zip((np.linalg.norm(T[:d, d]), abs(turn)), by_hand, strict=True):
                out += 0.5 * size * sum(np.outer(A[k, j][:, axis], A[k, j][:, axis]) for j in (piece, piece + 1))
        assert_allclose(F[k, axis], by_hand[0], atol=1e-12)
        assert_allclose(F[k, n + axis], by_hand[1], atol=1e-12)


@pytest.mark.parametrize("least", [(1e-9,) * 3, (4e-3, 1e-4, 1e-8)], ids=["hardly any floor", "as large as the noise"])
def test_fitted_variances_are_a_fixed_point_and_the_best(least, rng):
    """theta = theta (sum u'Fu / sum tr C^-1 F)^.5 where it is positive, and no neighbour is likelier."""
    made = drives(rng, 3, World(offset=float(np.sqrt(least[0] / 2))))
    w = windows(made)
    F, e, floor = terms_of(w.pieces), w.errors, np.array(least)
    theta = fit_terms(e, F, floor)
    C = np.diag(floor) + np.tensordot(theta, F, (0, 1))
    u = np.linalg.solve(C, e[..., None])[..., 0]
    up = np.einsum("wi,wpij,wj->p", u, F, u)
    down = np.einsum("wij,wpji->p", np.linalg.inv(C), F)
    positive = theta > 1e-3 * theta.max()
    assert_allclose((up / down)[positive], 1.0, atol=2e-3)  # 2e-4 at most in 60 draws
    assert (up[~positive] <= 1.002 * down[~positive]).all()

    def value(t):
        P = np.diag(floor) + np.tensordot(t, F, (0, 1))
        return float(-0.5 * (np.linalg.slogdet(P)[1].sum() + nees_of(e, P).sum()))

    for p in range(6):
        for times in (0.9, 1.1):
            other = theta.copy()
            other[p] = max(other[p] * times, 1e-9)
            assert value(other) <= value(theta) + 1e-3


def test_known_noise_is_recovered(rng):
    """6 drives, 600 windows: the terms a metre, which make up most of their axes, within 40 % (6 sigma)."""
    model = cs.fit_covariance(drives(rng, 6), "10m")
    assert_allclose(model.noise.per_m, world.PER_M, rtol=0.4)
    assert all(each.low < each.value < each.high for each in model.per_m)
    assert abs(np.log(model.ratio.value)) < 0.25
    assert model.counts == {"windows": len(model.windows.drive), "long": 0, "still": 0, "jumps": 0}


def test_intervals_of_the_jackknife():
    assert interval_of(8.0, [8.0] * 5).low == 0.0
    assert np.isnan(interval_of(0.0, [0.0] * 5).high)
    some = interval_of(8.0, [7.0, 8.0, 9.0, 8.5, 7.5])
    assert 0 < some.low < 8.0 < some.high
    assert [len(b) for b in jackknife_blocks(np.repeat(np.arange(6), 4))] == [4] * 6
    assert [len(b) for b in jackknife_blocks(np.zeros(40, int))] == [2] * 20


def test_jitter_of_both_ends_is_the_floor(rng):
    quiet, shaky = (drives(rng, 3, World(offset=offset)) for offset in (0.0, 0.05))
    for made, low, high in ((quiet, 0.0, 1e-3), (shaky, 2.5e-3, 1e-2)):
        w = windows(made)
        assert low <= jitter_of(fit_noise(w), w)[0] <= high


# --- folds and ratios -----------------------------------------------------------------------------------------


def test_what_is_judged_chose_nothing(rng):
    """Another content of the judged drive, or half, changes no fit that judges it."""
    made, others = drives(rng, 3), drives(rng, 3)
    mixed = [*made[:2], replace(others[2], name=made[2].name)]
    for held_out in (None, "drive 3"):
        first, second = (folds_of(windows(each), held_out, fit_noise)[1][-1] for each in (made, mixed))
        assert np.array_equal(first.noise.per_m, second.noise.per_m)
        assert first.judged.tolist() == [2]
    one = made[:1]
    w = windows(one)
    fold = folds_of(w, "half", fit_noise)[1][0]
    judged = fold.judges(w)
    assert 0.4 < judged.mean() < 0.6
    late = replace(w, true=np.where(judged[:, None, None], w.true[::-1], w.true))
    assert np.array_equal(folds_of(late, "half", fit_noise)[1][0].noise.per_m, fold.noise.per_m)


def test_ratio_over_drives():
    values = np.exp([0.1, -0.2, 0.3, 0.0, 0.2])
    r = ratio_of(values, np.repeat(values, 10))
    logs = np.log(values)
    assert r.value == pytest.approx(np.exp(logs.mean()))
    assert np.log(r.high / r.value) == pytest.approx(2.7764451 * logs.std(ddof=1) / np.sqrt(5))
    assert r.value * r.value == pytest.approx(r.low * r.high)
    assert r.reach == pytest.approx((r.value * np.exp(-2 * r.spread), r.value * np.exp(2 * r.spread)))
    single = ratio_of(np.array([np.nan, 1.2]), np.array([1.0, 1.4, 1.1, 1.3] * 5))
    assert (single.drives, single.windows) == (1, 20)
    assert np.isnan(single.spread)
    error = np.std([1.0, 1.4, 1.1, 1.3] * 5, ddof=1) / np.sqrt(20) / 1.2
    assert single.value == pytest.approx(1.2)
    assert np.log([single.value / single.low, single.high / single.value]) == pytest.approx(2.0930241 * error)
    assert np.isnan(ratio_of(np.array([np.nan]), np.array([])).value)


@pytest.mark.parametrize(
    "low, high, drives_, windows, general, status",
    [
        (0.8, 1.3, 5, 20, True, "consistent"), (0.8, 1.3, 2, 60, True, "consistent"),
        (0.8, 1.3, 4, 49, True, "undecided"), (0.8, 1.3, 5, 500, False, "undecided"),
        (0.8, 1.3, 1, 500, True, "undecided"), (1.1, 1.6, 5, 500, True, "overconfident"),
        (1.1, 1.4, 5, 500, True, "consistent"), (0.5, 0.9, 5, 500, True, "conservative"),
        (0.5, 1.2, 5, 500, True, "undecided"), (np.nan, np.nan, 5, 500, True, "undecided"),
        (1.1, 1.6, 1, 500, False, "overconfident"),
    ],
)  # fmt: skip
def test_status_of_a_ratio(low, high, drives_, windows, general, status):
    assert Ratio(1.0, low, high, 0.1, drives_, windows, general).status == status


def test_halves_and_unknown_drives(rng):
    made = drives(rng, 2, length=300.0)
    model = cs.fit_covariance(made, "10m", held_out="half")
    assert model.status in ("undecided", "overconfident", "conservative")
    assert "halves" in repr(model)
    for bad, word in (("drive 9", "no drive"), ("drive 1,drive 2", "no window to fit")):
        with pytest.raises(InputError, match=word):
            cs.fit_covariance(made, "10m", held_out=bad)


def test_cautious_raises_all_covariances(rng):
    made = drives(rng, 5, World(spread=0.5), 500.0)
    plain, raised = (cs.fit_covariance(made, "10m", cautious=p) for p in (None, 0.9))
    factor = raised.noise.factor
    assert factor > 1.2
    assert raised.ratio.value == pytest.approx(plain.ratio.value / factor)
    assert_allclose(raised.covariance([10.0, 0, 0]), factor * plain.covariance([10.0, 0, 0]))
    with pytest.raises(InputError, match="--cautious"):
        caution(replace(plain.ratio, drives=4), 0.9)
    with pytest.raises(InputError, match="between"):
        cs.fit_covariance(made, "10m", cautious=2.0)


# --- the model ---------------------------------------------------------------------------------------------------


def test_covariance_of_a_motion_is_that_of_its_steps(rng):
    model = cs.fit_covariance(drives(rng, 2, length=400.0), "10m")
    step = np.array([0.5, 0.0, 0.04])
    whole = composed(np.repeat(world.matrices_of(step[None]), 20, 0))[-1]
    motion = [whole[0, 2], whole[1, 2], np.arctan2(whole[1, 0], whole[0, 0])]
    C = model.covariance(np.repeat(step[None], 20, 0))
    assert_allclose(model.covariance(motion), C, rtol=1e-9)
    n = model.noise
    assert C[2, 2] == pytest.approx(10 * n.per_m[2] + 0.8 * n.per_rad[2] + n.floor[2])
    still = model.covariance([0.0, 0.0, 0.0])
    assert_allclose(still, np.diag(n.floor))
    assert (n.floor > 0).all()
    corrected = model.correct([[1.0, 0.0, 0.1]])[0]
    assert corrected[0, 2] == pytest.approx(n.mean.way)
    for bad in ([1.0, 2.0], [1.0, 2.0, np.nan], np.zeros((2, 7))):
        with pytest.raises(InputError, match="motion"):
            model.covariance(bad)


def test_in_space_and_an_axis_that_never_moved(rng):
    """z, roll and pitch of planar poses have no error, and yet a variance."""
    flat = [drive_in("SE(2)", rng, 600, name) for name in "ab"]

    def raised(T):
        yaw = np.arctan2(T[:, 1, 0], T[:, 0, 0])
        zero = np.zeros(len(T))
        return np.column_stack([T[:, :2, 2], zero, zero, zero, np.sin(yaw / 2), np.cos(yaw / 2)])

    space = [drive_of(d.name, raised(d.estimate), raised(d.truth), d.t) for d in flat]
    model, planar = cs.fit_covariance(space, "3m"), cs.fit_covariance(space, "3m", axes=3)
    assert model.noise.axes == ("x", "y", "z", "roll", "pitch", "yaw")
    assert planar.noise.axes == ("x", "y", "yaw")
    C = model.covariance([3.0, 0, 0, 0, 0, 0, 1])
    assert np.linalg.eigvalsh(C)[0] > 0
    assert_allclose(planar.noise.per_m, cs.fit_covariance(flat, "3m").noise.per_m, rtol=1e-6)
    with pytest.raises(InputError, match="axes=6"):
        cs.fit_covariance(flat, "3m", axes=6)
    with pytest.raises(InputError, match="axes=4"):
        cs.fit_covariance(flat, "3m", axes=4)


# --- drives that no white noise describes ---------------------------------------------------------------------


SPAN = "10m"
RIGHT = Ratio(1.0, 0.8, 1.25, 0.1, 6, 600)


@pytest.mark.parametrize(
    "world, words",
    [
        (World(closed=True), ("loops are closed", "record the live odometry")),
        (World(metric=2.2), ("2.2 times", "not metric", "scale state")),
        (World(metric=0.5), ("0.5 times", "not metric")),
        (World(turned=0.1), ("constant turn of the body by 5.7", "calibration")),
        (World(turned=np.pi / 2), ("constant turn of the body by 90", "calibration")),
        (World(jumps=8), ("have a jump", "more than 5 %", "clocks of estimates and truth differ", "time_offset=")),
    ],
)
def test_a_drive_that_is_refused(world, words, rng):
    with pytest.raises(InputError) as error:
        cs.fit_covariance(drives(rng, 2, world), SPAN)
    assert all(word in str(error.value) for word in words), str(error.value)
    assert "\n" not in str(error.value)


def test_scale_is_the_users_matter_without_correction(rng):
    model = cs.fit_covariance(drives(rng, 2, World(metric=2.2), 400.0), SPAN, correct=False)
    assert (model.noise.mean.way, model.noise.mean.turn, model.noise.mean.drift) == (1.0, 1.0, (0.0,))


def test_too_few_windows(rng):
    short = drives(rng, 1, length=40.0)
    with pytest.raises(InputError, match=r"too few to fit|fewer than|5 drives"):
        cs.fit_covariance(short, SPAN)
    with pytest.raises(InputError, match="only 40 m"):
        cs.fit_covariance(short, "100m")
    with pytest.raises(InputError, match="at least one drive"):
        cs.fit_covariance([], SPAN)
    with pytest.raises(InputError, match=r"of cs\.read_drives"):
        cs.fit_covariance(["wheels"], SPAN)


def test_estimate_and_truth_are_the_same(rng):
    drive = drives(rng, 1)[0]
    with pytest.raises(InputError, match="same positions"):
        fit_noise(windows([replace(drive, estimate=drive.truth)]))


def test_growth_of_white_noise_and_of_a_persistent_drift(rng):
    """Power 1 within 4 standard errors of 0.1; nearly 2 where the drift of a drive outweighs its noise."""
    for drift, low, high in ((World(), 0.6, 1.4), (World(memory=2000.0, coloured=3e-3), 1.6, 2.1)):
        model = cs.fit_covariance(drives(rng, 5, drift), SPAN)
        assert low < model.growth.power < high
        assert model.growth.persists == (low > 1)
        told = [each for each in model.warnings if "errors last longer than a window" in each]
        assert len(told) == (low > 1)
        assert not model.growth.shrinks
    short = drives(rng, 1, length=150.0)
    w = windows(short)
    assert np.isnan(rotation_growth(w, fit_noise(w).mean).power)


def test_growth_is_the_slope_of_logarithms(rng):
    """Weighted by numbers of windows, whose mean squares vary by 2 / W; the variance is doubled."""
    w = windows(drives(rng, 1, length=300.0))
    cut = [w.over(10.0 * times) for times in (1, 2, 3)]  # 30, 15 and 10 windows
    counts = np.array([len(each.drive) for each in cut])
    squares = [(each.errors[:, 2:] ** 2).mean(axis=0).sum() for each in cut]
    x, y, weight = np.log([1.0, 2.0, 3.0]), np.log(squares), counts / 2
    x = x - np.average(x, weights=weight)
    growth = rotation_growth(w, Mean())
    assert growth.power == pytest.approx((weight * x * y).sum() / (weight * x**2).sum())
    assert growth.error == pytest.approx(np.sqrt(2.0 / (weight * x**2).sum()))


def test_growth_needs_its_standard_errors():
    assert RotationGrowth(0.3, 0.1).shrinks
    assert not RotationGrowth(0.3, 0.3).shrinks
    assert not RotationGrowth(0.6, 0.01).shrinks
    assert RotationGrowth(1.6, 0.1).persists
    assert not RotationGrowth(1.6, 0.3).persists


@pytest.mark.parametrize(
    "world, word",
    [(World(scale=0.02), "the scale of the way"), (World(memory=5000.0, coloured=3e-3), "drift of the heading")],
)
def test_terms_that_persist_are_named_from_five_drives_on(world, word, rng):
    made = drives(rng, 6, world)
    model = cs.fit_covariance(made, SPAN)
    assert persistent_errors(model.noise, windows(made[:4])) == ()
    told = [each for each in model.warnings if word in each]
    assert told
    assert "add a state" in told[0]
    assert [word in each.term and each.decides for each in model.lasting].count(True) == 1
    right = replace(model, spans=(replace(model.spans[0], whole=RIGHT, axes=(RIGHT,) * 3), *model.spans[1:]))
    assert right.status == "undecided"
    assert "of the variance of an axis, so that new drives may have another covariance" in model_sentence(right)
    for term, decides in zip(TERMS, (True, True, False), strict=True):
        small = replace(right, lasting=(PersistentError(term, 0.1, 0.2),))
        assert small.status == ("undecided" if decides else "consistent")
        assert ("new drives may" in model_sentence(small)) == decides
    assert replace(right, lasting=()).status == "consistent"
    wrong = replace(RIGHT, low=2.0, value=2.5, high=3.0)
    assert replace(model, spans=(replace(model.spans[0], whole=wrong), *model.spans[1:])).status == "overconfident"


def test_variance_between_drives():
    """Five values with a variance of 0.1 each have Q = 100 with 4 degrees of freedom; weights sum to 50."""
    values, variances = 7.0 + np.arange(5.0), np.full(5, 0.1)
    assert variance_between(values, variances, 0.01) == pytest.approx((100 - 4) / (50 - 10))
    unknown = np.append(values, 1e3), np.append(variances, np.inf)
    assert variance_between(*unknown, 0.01) == pytest.approx((100 - 4) / (50 - 10))
    assert variance_between(values, 100 * variances, 0.01) == 0.0  # Q = 1
    assert variance_between(values[:4], variances[:4], 0.01) == 0.0


def test_a_second_estimator_with_the_same_errors(rng):
    """Errors of the truth are in both; of another odometry they are not."""
    made = drives(rng, 5, length=500.0)
    same = cs.fit_covariance(made, SPAN, second=made)
    noise, w = same.noise, same.windows
    assert_allclose(same.second.correlation, 1.0, atol=0.05)
    assert_allclose(same.second.size, 1.0, atol=0.05)
    assert same.status != "consistent"
    assert "correlate" in repr(same)

    def steps(T):
        return inverse(T[:-1]) @ T[1:]

    def twin(drive, error):
        """Another estimate of the same truth, with errors (N - 1, 3) of its steps."""
        T = np.concatenate([drive.truth[:1], steps(drive.truth) @ matrices_of(error)])
        return replace(drive, estimate=composed(T))

    def own(times):
        """With noise of its own: in x and y ``times`` as large."""
        sigma = np.sqrt(0.5 * np.array(PER_M)) * [times, times, 1.0]
        return [twin(drive, sigma * rng.normal(size=(len(drive.t) - 1, 3))) for drive in made]

    larger = [twin(d, 3 * vectors(inverse(steps(d.truth)) @ steps(d.estimate))) for d in made]
    found, other, rough = (errors_of_second(noise, w, each) for each in (larger, own(1.0), own(5.0)))
    assert_allclose(found.correlation, 1.0, atol=0.1)
    assert_allclose(found.size, 3.0, rtol=0.1)
    assert np.abs(other.correlation).max() < 0.4
    assert other.is_rough.tolist() == [False] * 3
    assert rough.is_rough.tolist() == [True, True, False]
    of_other, of_rough = (list(noise_lines(replace(same, second=each)))[1] for each in (other, rough))
    assert of_rough.endswith("above 0.7 they are the truth's; it errs too much to tell in x, y")
    assert "too much" not in of_other
    with pytest.raises(InputError, match="second"):
        errors_of_second(noise, w, [replace(each, name="else") for each in made])


def test_a_second_estimator_in_space_beside_three_axes(rng):
    made = drives(rng, 2, World(per_m=(1e-3,) * 3 + (1e-5,) * 3, per_rad=(1e-9,) * 6), 400.0)
    model = cs.fit_covariance(made, SPAN, axes=3, second=made)
    assert (model.second.correlation > 0.8).all()


def test_the_turn_of_a_straight_drive_is_the_least(rng):
    """A camera that looks 3 degrees to the side on a straight road, which tells nothing of a roll."""
    world = World(per_m=(1e-5,) * 3 + (1e-7,) * 3, per_rad=(1e-9,) * 6)
    made = drives(rng, 1, world, 400.0)[0]
    T = np.tile(np.eye(4), (len(made.t), 1, 1))
    T[:, 0, 3] = np.arange(len(made.t))
    T[:, 1:3, 3] = 0.001 * rng.normal(size=(len(T), 2))
    noise = inverse(made.truth) @ made.estimate
    side = matrices_of(np.array([[0.0, 0, 0, 0, 0, np.deg2rad(3.0)]]))
    straight = replace(made, truth=T, estimate=inverse(side) @ T @ noise @ side)
    angle, share, _ = body_turn(windows([straight]))
    assert 2.0 < np.rad2deg(angle) < 5.0
    assert share > 0.5
