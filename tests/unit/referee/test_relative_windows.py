"""Relative poses over windows: groups, covariances by finite differences, windows, broken rows and notes."""

from dataclasses import replace

import numpy as np
import pytest
import relative_poses as world
from numpy.testing import assert_allclose, assert_array_equal
from relative_poses import AXES, DECLARED, drive, exp, motion_stretch, pose_stretch, recorded, vectors

import consistency as cs
from consistency.referee.geometry import (
    PLANAR,
    SPATIAL,
    adjoint,
    composed,
    inverse,
    log,
    matrices,
    planar_error,
    spatial_error,
    to_left,
)
from consistency.referee.readers.pipeline.relative_motions import windows_of
from consistency.referee.readers.runs_to_record import Relative, relative_of, windows
from consistency.referee.verdicts.judge_sources import judge_all

GROUPS = tuple(world.SIGMA)
NEXT = Relative(1, "step")


def random_poses(rng, group, number):
    return exp(rng.normal(size=(number, len(AXES[group]))))


def error_of(group, truth, estimate, convention):
    of = planar_error if group == "SE(2)" else spatial_error
    return of(vectors(truth), vectors(estimate), convention)


# --- groups ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("group", GROUPS)
def test_matrices_inverse_log_and_adjoint(group, rng):
    T, U = random_poses(rng, group, 20), random_poses(rng, group, 20)
    assert_allclose(matrices(vectors(T)), T, atol=1e-12)
    assert_allclose(inverse(T) @ T, np.broadcast_to(np.eye(T.shape[-1]), T.shape), atol=1e-12)
    assert_allclose(exp(log(T)), T, atol=1e-9)
    e = 0.1 * rng.normal(size=(20, len(AXES[group])))
    moved = np.einsum("nij,nj->ni", adjoint(T), e)
    assert_allclose(T @ exp(e) @ inverse(T), exp(moved), atol=1e-9)
    assert_allclose(adjoint(T) @ adjoint(U), adjoint(T @ U), atol=1e-9)
    assert_allclose(composed(np.stack([T[0], U[0], T[1]]))[2], T[0] @ U[0] @ T[1], atol=1e-12)


@pytest.mark.parametrize(
    "group, convention", [("SE(2)", c) for c in PLANAR if c != "vector"] + [("SE(3)", c) for c in SPATIAL]
)
def test_every_convention_becomes_the_left_error(group, convention, rng):
    T = random_poses(rng, group, 10)
    truth = T @ exp(1e-6 * rng.normal(size=(10, len(AXES[group]))))
    left, own = (error_of(group, truth, T, c) for c in ("left", convention))
    assert_allclose(np.einsum("nij,nj->ni", to_left(T, convention), own), left, atol=1e-10)


# --- covariances, by finite differences --------------------------------------------------------------


def numerical(of, n, step=1e-6):
    """Jacobian of a function of (n,) at zero, by central differences."""
    return np.stack([(of(step * u) - of(-step * u)) / (2.0 * step) for u in np.eye(n)], axis=-1)


@pytest.mark.parametrize("group", GROUPS)
def test_motions_make_up_the_covariance_of_a_window(group, rng):
    simulated, n, size = drive(rng, group, 8), len(AXES[group]), 4
    found = windows_of(motion_stretch(simulated), Relative(size, "step", True, True))
    assert len(found.t) == 2
    for window in range(2):
        D = simulated.motions[window * size : (window + 1) * size]

        def end(e, D=D):
            return log(inverse(composed(D)[-1:]) @ composed(D @ exp(e.reshape(size, n)))[-1:])[0]

        J = numerical(end, size * n)
        S = np.kron(np.eye(size), simulated.covariance[0])
        assert_allclose(found.covariance[window], J @ S @ J.T, rtol=1e-6, atol=1e-11)
        true = inverse(simulated.truth[window * size]) @ simulated.truth[(window + 1) * size]
        assert_allclose(found.error[window], log(inverse(composed(D)[-1]) @ true[None])[0], atol=1e-10)


@pytest.mark.parametrize("group", GROUPS)
def test_joint_covariance_of_two_poses_makes_up_that_of_a_window(group, rng):
    stretch, n, kind = pose_stretch(rng, group, 3, 5, 1.0, 0), len(AXES[group]), DECLARED[group]
    found = windows_of(stretch, NEXT)
    T = matrices(stretch.own.estimate)
    for k in (1, 2):

        def window(e, k=k):
            both = np.stack([e[:n], e[n:]])
            moved = T[k - 1 : k + 1] @ exp(np.einsum("nij,nj->ni", to_left(T[k - 1 : k + 1], kind), both))
            return log(inverse(inverse(T[k - 1]) @ T[k])[None] @ (inverse(moved[0]) @ moved[1]))[0]

        J = numerical(window, 2 * n)
        joint = np.block(
            [[stretch.own.covariance[k - 1], stretch.own.cross[k]], [stretch.own.cross[k].T, stretch.own.covariance[k]]]
        )  # fmt: skip
        assert_allclose(found.covariance[k - 1], J @ joint @ J.T, rtol=1e-6, atol=1e-10)


# --- windows -------------------------------------------------------------------------------------------


def test_windows_in_steps_seconds_and_metres():
    t, rows = np.arange(11) * 0.5, np.arange(11)
    place = np.column_stack([np.cumsum([0, 1, 1, 1, 3, 1, 1, 1, 1, 1, 1.0]), np.zeros(11)])

    def cut(text):
        relative = relative_of(text)
        first, last, _ = windows(t, place, rows, relative, "f")
        return list(zip(first.tolist(), last.tolist(), strict=True))

    assert cut("4") == [(0, 4), (4, 8)]
    assert cut("2s") == [(0, 4), (4, 8)]
    assert cut("1.2s") == [(0, 3), (3, 6), (6, 9)]
    assert cut("3m") == [(0, 3), (3, 4), (4, 7), (7, 10)]


def test_a_window_over_missing_rows_is_left_out():
    rows = np.array([0, 2, 4, 9, 11, 13])
    first, last, left_out = windows(np.arange(14.0), np.zeros((6, 2)), rows, Relative(2, "s"), "f")
    assert (first.tolist(), last.tolist(), left_out) == ([0, 2, 9, 11], [2, 4, 11, 13], 1)


def test_rows_without_truth_change_no_other_window(rng):
    stretch, size = motion_stretch(drive(rng, "SE(2)", 12)), Relative(2, "step", True, True)
    there = np.delete(np.arange(13), 3)
    whole, some = windows_of(stretch, size), windows_of(stretch.beside(there), size)
    same, here = np.nonzero((whole.t[:, None] == some.t) & (whole.track.t[:, None] == some.track.t))
    assert len(here) >= 4
    assert_array_equal(some.error[here], whole.error[same])
    assert_array_equal(some.covariance[here], whole.covariance[same])


def test_time_on_a_common_clock_of_1970_is_no_matter_of_rounding():
    t = 1.7e9 + np.arange(101) * 0.1
    first, last, _ = windows(t, np.zeros((101, 2)), np.arange(101), Relative(1, "s"), "f")
    assert (last - first == 10).all()
    assert len(first) == 10


@pytest.mark.parametrize("text", ["0", "-1", "1.5", "ten", "10h", "nan", "inf", "1e", "s", ""])
def test_sizes_that_are_none(text):
    with pytest.raises(cs.InputError, match="must be a whole number of steps"):
        relative_of(text)


@pytest.mark.parametrize("text, shown", [("100", "100 steps"), ("1", "1 step"), ("10s", "10 s"), ("0.5 m", "0.5 m")])
def test_sizes_as_they_are_shown(text, shown):
    relative = relative_of(text)
    assert relative.text == shown


def test_a_window_that_cross_covariances_do_not_reach_over_is_named(rng):
    stretch = pose_stretch(rng, "SE(2)", 8, 5, 1.0, 0)
    truth = np.column_stack([[0.0, 2.0, 2.5, 3.0, 4.1, 6.2, 7.0, 8.3], np.zeros((8, 2))])  # windows of 1, 3, 1, 2 rows
    with pytest.raises(cs.InputError, match="row 4: --relative 2m: the window spans 3 rows"):
        windows_of(stretch.with_values(truth=truth), Relative(2.0, "m"))


# --- what breaks a run ---------------------------------------------------------------------------------


@pytest.mark.parametrize("row", [1, 7, 12, 29])
def test_a_broken_row_is_a_failed_window(row, rng):
    stretch = motion_stretch(drive(rng, "SE(3)", 29))
    stretch.own.estimate[row] = np.nan
    record = recorded([stretch], "5", True)
    assert [f.reason for f in record.failures] == [f"estimate is not finite (row {row})"]
    found = windows_of(stretch, Relative(5, "step", True))
    assert (found.track.t[-1], found.t[-1]) == (stretch.own.t[row - 1], stretch.own.t[row])
    verdict = judge_all([record])["log"]
    assert verdict.runs == (row - 1) // 5 + 1
    assert verdict.status != "consistent"
    assert any(f"1 of {verdict.runs} windows failed, first window {verdict.runs}: " in r for r in verdict.reasons)


def test_a_covariance_that_is_not_finite_is_named(rng):
    stretch = motion_stretch(drive(rng, "SE(2)", 20))
    stretch.own.covariance[8, 0, 0] = np.inf
    assert recorded([stretch], "5", True).failures[0].reason == "covariance is not finite (row 8)"
    found = windows_of(stretch, Relative(5, "step", True))
    assert_array_equal(found.error[-1], 0.0)
    assert np.isnan(found.covariance[-1]).all()


def test_a_log_that_is_broken_from_the_start(rng):
    for group in GROUPS:
        stretch = pose_stretch(rng, group, 6, 5, 1.0, 0)
        stretch.own.estimate[0] = np.nan
        record = recorded([stretch], "1", False)
        assert [f.reason for f in record.failures] == ["estimate is not finite (row 0)"]
        assert not any("first order" in note for note in record.origin.notes)
        assert windows_of(stretch, NEXT).track.t.tolist() == [stretch.own.t[0]]
        assert judge_all([record])["log"].status == "failed"


def test_neighbours_that_go_together_are_named(rng):
    """Errors of a bias of three sigma, and of a noisy truth: certain but for 1e-5."""
    simulated = drive(rng, "SE(2)", 200)
    biased = simulated.motions @ exp(np.array([[0.1, 0.0, 0.0]]) + 0.01 * rng.normal(size=(200, 3)))
    truth = composed(np.concatenate([np.eye(3)[None], biased]))
    notes = recorded([motion_stretch(replace(simulated, truth=truth))], "1", True).origin.notes
    assert any("neighbouring windows go the same way" in note for note in notes)
    steps = Relative(1, "step", True)
    stretch = motion_stretch(replace(simulated, truth=truth))
    undeclared = world.relative_recording("log", "log", [stretch], AXES["SE(2)"], range(3), steps)
    assert not any("neighbouring" in note for note in undeclared.origin.notes)
    jitter = simulated.truth @ exp(rng.normal(size=(201, 3)) * [0.3, 0.3, 0.0])
    notes = recorded([motion_stretch(replace(simulated, truth=jitter))], "1", True).origin.notes
    assert any("neighbouring windows go opposite ways" in note for note in notes)


def test_motions_are_judged_however_few(rng):
    assert recorded([motion_stretch(drive(rng, "SE(2)", 20))], "1", True).origin.unshown == ""


def test_windows_whose_sizes_go_on_are_doubted_in_the_sentence(rng):
    """True motions that err by 0.2 or 5 sigma for 50 windows at a time: certain but for 1e-5."""
    simulated = drive(rng, "SE(2)", 400)
    n = 3
    root = np.linalg.cholesky(simulated.covariance[0])
    size = np.where(np.arange(400) // 50 % 2, 5.0, 0.2)[:, None]
    moved = simulated.motions @ exp(size * rng.normal(size=(400, n)) @ root.T)
    truth = composed(np.concatenate([np.eye(3)[None], moved]))
    record = recorded([motion_stretch(replace(simulated, truth=truth))], "1", True)
    assert any("errors of neighbouring windows are of like size" in note for note in record.origin.notes)
    verdict = judge_all([record])["log"]
    assert verdict.reasons[0].endswith("the motions do not seem to be independent, on which this rests")
    plain_one = recorded([motion_stretch(drive(rng, "SE(2)", 19))], "1", True)
    assert (plain_one.fit.caption, plain_one.origin.unshown) == ("", "")


def test_windows_too_wide_for_first_order_are_named(rng):
    simulated = drive(rng, "SE(2)", 200, sigma=np.array([0.01, 0.01, 0.05]))
    assert any(
        "to first order is doubtful" in note for note in recorded([motion_stretch(simulated)], "50", True).origin.notes
    )
    assert not any("first order" in note for note in recorded([motion_stretch(simulated)], "1", True).origin.notes)


def test_a_cross_covariance_that_is_not_finite_breaks_the_window_that_ends_there(rng):
    stretch = pose_stretch(rng, "SE(2)", 8, 5, 1.0, 0)
    whole = windows_of(stretch, NEXT)
    stretch.own.cross[4, 2, 0] = np.inf
    found = windows_of(stretch, NEXT)
    assert_array_equal(found.t, stretch.own.t[1:5])
    assert_array_equal(found.covariance[:3], whole.covariance[:3])
    assert np.isnan(found.covariance[3]).all()
    assert_array_equal(found.error[3], 0.0)
    assert recorded([stretch], "1", False).failures[0].reason == "covariance is not finite (row 4)"


def test_the_first_row_of_motions_is_only_where_they_start(rng):
    stretch = motion_stretch(drive(rng, "SE(3)", 12))
    whole = windows_of(stretch, Relative(4, "step", True))
    stretch.own.estimate[0], stretch.own.covariance[0] = 7.0, np.nan
    found = windows_of(stretch, Relative(4, "step", True))
    assert_array_equal(found.error, whole.error)
    assert_array_equal(found.covariance, whole.covariance)
    stretch.own.covariance[1] = np.nan
    assert windows_of(stretch, Relative(4, "step", True)).t.tolist() == [stretch.own.t[1]]


def test_poses_need_a_cross_covariance_of_the_very_next_row(rng):
    stretch = pose_stretch(rng, "SE(2)", 9, 5, 1.0, 0)
    with pytest.raises(cs.InputError, match=r"^row 2: --relative 2: the window spans 2 rows, .* reaches one row back"):
        windows_of(stretch, Relative(2, "step"))
    with pytest.raises(cs.InputError, match="poses: --relative: covariances of two poses do not tell"):
        windows_of(stretch.with_values(cross=None), NEXT)


def test_runs_have_windows_by_their_times_where_those_are_known(rng):
    """The second run has no truth before its fifth row, and so no first two windows."""
    first, second = (motion_stretch(drive(rng, "SE(2)", 12), run) for run in range(2))
    late = second.beside(np.arange(4, 13))
    record = recorded([first, late], "2", True)
    assert_allclose(record.runs.t, first.own.t[[2, 4, 6, 8, 10, 12]])
    assert_array_equal(np.isnan(record.errors.error[:, :, 0]).sum(axis=1), [0, 2])
    assert np.isnan(record.errors.error[1, :2]).all()
    timeless = [each.with_values(numbered=True) for each in (first, late)]
    record = recorded(timeless, "2", True)
    assert np.isnan(record.runs.t).all()
    assert np.isnan(record.errors.error[1, 4:]).all()


# --- notes ---------------------------------------------------------------------------------------------


def test_notes_say_what_windows_are_of(rng):
    planar = recorded([motion_stretch(drive(rng, "SE(2)", 19)), motion_stretch(drive(rng, "SE(2)", 19), 1)], "2", True)
    assert planar.origin.notes[0] == (
        "log: relative poses over 18 windows of 2 steps; the error is Log(estimated^-1 true motion) of SE(2), in the "
        "frame of the body at the end of a window; covariances of motions are of the error so2"
    )
    assert planar.origin.notes[2:] == (
        "log: errors of different motions are declared to be independent: each window is a run",
    )
    spatial = recorded([pose_stretch(rng, "SE(3)", 9, 5, 1.0, 0)], "1", False)
    assert "over 8 windows of 1 step; the error is Log(estimated^-1 true motion) of SE(3)" in spatial.origin.notes[0]
    assert "covariances of poses, with cross-covariances, are of the error so3" in spatial.origin.notes[0]
    assert [note.split(";")[0] for note in spatial.origin.notes[1:]] == [
        "log: what is constant over a window, or drifts more slowly than it, is not seen",
        "log: windows are steps of their run, as their errors may depend on each other",
    ]
    assert (planar.runs.independent, spatial.runs.independent) == (True, False)


def test_windows_that_are_left_out_are_counted(rng):
    stretches = [motion_stretch(drive(rng, "SE(2)", 12), run) for run in range(2)]
    there = np.delete(np.arange(13), 3)
    some = [stretch.beside(there) for stretch in stretches]
    size = "0.1s"
    found = [windows_of(stretch, Relative(0.1, "s", True, True)) for stretch in some]
    assert [each.left_out for each in found] == [1, 1]
    said = "log: 2 windows left out, too long because rows or truth are missing"
    assert said in recorded(some, size, True).origin.notes
    assert not any("left out" in note for note in recorded(stretches, size, True).origin.notes)


def test_the_rotation_of_a_window_is_that_of_its_widest_axis(rng):
    """A median over windows, of the greatest standard deviation about any axis."""
    for group, sigma in (("SE(2)", (9.0, 9.0, 0.12)), ("SE(3)", (9.0, 9.0, 9.0, 0.01, 0.12, 0.02))):
        stretch = motion_stretch(drive(rng, group, 30))
        P = np.broadcast_to(np.diag(np.square(sigma)), stretch.own.covariance.shape)
        large = [
            stretch.with_values(covariance=P * np.where(np.arange(31) < few, 100.0, 1.0)[:, None, None])
            for few in (9, 25)
        ]
        near, far = (next(n for n in recorded([each], "1", True).origin.notes if "first order" in n) for each in large)
        assert "has a sigma of 0.12 rad in the median; beyond 0.1 a covariance" in near
        assert "has a sigma of 1.2 rad in the median" in far
