"""Files in a world of their own: frames that are found, errors that are left, and verdicts on them."""

import itertools

import numpy as np
import pandas as pd
import pytest
from draws import autoregression, identities
from numpy.testing import assert_allclose, assert_array_equal
from records import changed
from scipy import linalg
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import consistency as cs
from consistency.commands.app import app
from consistency.diagnostics import Settings, TruthFit, judge, make_record
from consistency.referee.diagnostics import residuals_of_fit
from consistency.referee.diagnostics.residuals_of_fit import (
    _at_most,
    _binned,
    _bins,
    _expected,
    _kernels,
    _left,
    _oscillate,
    _slower,
    inflation_of_mean,
    left_covariances,
)
from consistency.referee.diagnostics.scale import equivalence
from consistency.referee.diagnostics.verdict_parts import BIAS
from consistency.referee.errors import InputError
from consistency.referee.geometry import wrap
from consistency.referee.readers import alignment as residuals
from consistency.referee.readers.alignment import (
    ALL_BUT_SCALE,
    FREE,
    Aligned,
    WorldTransform,
    aligned,
    clocks_and_frames,
    frame_of_least_nees,
    moved,
    orthonormal,
    sound_of,
    tangent,
)
from consistency.referee.readers.places import Places
from consistency.referee.readers.truth_matching import make_poses

STEPS = 30
SIGMA = {"planar": np.array([0.1, 0.2, 0.02]), "spatial": np.array([0.1, 0.2, 0.15, 0.01, 0.02, 0.03])}
WORLD = {
    "planar": WorldTransform.about_z(2.2, np.array([30.0, -7.0])),
    "spatial": WorldTransform(Rotation.from_rotvec([0.3, -0.4, 2.0]), np.array([30.0, -7.0, 4.0])),
    "yaw": WorldTransform.about_z(-2.9, np.array([30.0, -7.0, 4.0])),
}
KINDS = [("planar", c) for c in ("so2", "left", "right")] + [
    ("spatial", c) for c in ("so3", "so3-body", "left", "right")
]


@pytest.fixture
def rng():
    return np.random.default_rng(20271)


def run_of(rng, kind, convention, noise=1.0, steps=STEPS):
    """A drive whose errors are independent; of the stated size where ``noise`` is 1, to first order."""
    t, heading = 0.1 * np.arange(steps), rng.uniform(-3, 3) + np.cumsum(rng.normal(0, 0.2, steps))
    at = np.cumsum(np.column_stack([np.cos(heading), np.sin(heading), 0.2 * np.cos(t)]), axis=0)
    sigma = SIGMA[kind]
    mixing = np.eye(len(sigma)) + 0.2 * rng.normal(size=(len(sigma),) * 2)
    root = sigma[:, None] * mixing
    if kind == "planar":
        own = np.column_stack([at[:, :2], wrap(heading)])
    else:
        own = np.hstack(
            [at, Rotation.from_euler("ZYX", np.column_stack([heading, 0.1 * np.sin(t), 0.1 * t])).as_quat()]
        )
    p = make_poses(
        Places("line {}".format, np.arange(steps)), t, own, np.tile(root @ root.T, (steps, 1, 1)),
        np.ones(steps, bool), t, own.copy(), kind, convention, 0.01,
    )  # type: ignore[arg-type]  # fmt: skip
    w = rng.normal(size=(steps, len(sigma))) * noise
    return p.with_values(truth=own) if noise == 0 else _with_errors(p, w @ root.T)


def _with_errors(p, errors):
    """Truth such that the errors are these in the convention, by Newton's method."""
    truth, rows = p.true.values.copy(), np.arange(len(p.own.t))
    for _ in range(6):
        gap = errors - p.error_of(rows, truth)
        if p.manifold == "planar":
            if p.convention == "left":
                c, sn = np.cos(p.own.estimate[:, 2]), np.sin(p.own.estimate[:, 2])
                gap[:, :2] = np.column_stack([c * gap[:, 0] - sn * gap[:, 1], sn * gap[:, 0] + c * gap[:, 1]])
            elif p.convention == "right":
                gap[:, :2] += gap[:, 2:] * np.column_stack([-truth[:, 1], truth[:, 0]])
            truth += gap
        else:
            body = p.convention in ("left", "so3-body")
            at = Rotation.from_quat(p.own.estimate[:, 3:])
            small = Rotation.from_rotvec(gap[:, 3:])
            turn = Rotation.from_quat(truth[:, 3:])
            shift = at.apply(gap[:, :3]) if p.convention == "left" else gap[:, :3]
            if p.convention == "right":
                shift = shift + np.cross(gap[:, 3:], truth[:, :3])
            truth = np.hstack([truth[:, :3] + shift, (turn * small if body else small * turn).as_quat()])
    return p.with_values(truth=truth)


# --- frames ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind, convention", KINDS)
def test_a_frame_is_found_and_undone(kind, convention, rng):
    runs = [run_of(rng, kind, convention, noise=0.0) for _ in range(3)]
    mode, world = ("posyaw-all", WORLD["planar"]) if kind == "planar" else ("se3-all", WORLD["spatial"])
    found = aligned("est", [moved(p, world) for p in runs], mode, range(runs[0].own.covariance.shape[-1]))
    for back, p in zip(found.runs, runs, strict=True):
        assert_allclose(back.errors(), 0.0, atol=1e-8)
        assert_allclose(back.own.covariance, p.own.covariance, atol=1e-10)


def test_a_turn_about_z_of_each_run_is_found(rng):
    runs = [run_of(rng, "spatial", "so3", noise=0.0) for _ in range(3)]
    worlds = [WorldTransform.about_z(rng.uniform(-3, 3), rng.uniform(-50, 50, 3)) for _ in runs]
    found = aligned("est", [moved(p, f) for p, f in zip(runs, worlds, strict=True)], "posyaw", range(6))
    for back in found.runs:
        assert_allclose(back.errors(), 0.0, atol=1e-8)
    assert "each of 3 runs by itself: turned by" in found.notes[0]


@pytest.mark.parametrize("kind, convention", KINDS)
def test_the_nees_of_a_frame_is_least(kind, convention, rng):
    """No small motion makes it less: its gradient 2 A' w is 0, and A is the change of w."""
    p, judged = run_of(rng, kind, convention), range(len(SIGMA[kind]))
    free = FREE["posyaw" if kind == "planar" else "se3", kind]
    away = moved(p, WORLD[kind])
    there = moved(away, frame_of_least_nees("est", [away], free, judged))
    sound = sound_of(there, judged)
    A = tangent(there, sound, free)
    slopes = np.einsum("knd,kn->d", A, sound.whitened) / np.linalg.norm(A.reshape(-1, len(free)), axis=0)
    assert_allclose(slopes, 0.0, atol=2e-3)  # standard deviations
    assert np.square(sound.whitened).sum() <= np.square(sound_of(p, judged).whitened).sum()
    off = moved(p, WorldTransform(Rotation.from_rotvec(0.01 * free[:, 3:].sum(axis=0)), 0.05 * free[:, :3].sum(axis=0)))
    found, step = sound_of(off, judged), 1e-4
    A = tangent(off, found, free)
    for motion, column in zip(free, np.moveaxis(A, -1, 0), strict=True):
        sizes = [
            np.square(
                sound_of(
                    moved(off, WorldTransform(Rotation.from_rotvec(s * motion[3:]), s * motion[:3])), judged
                ).whitened
            )
            for s in (step, -step)
        ]
        slope = (sizes[0].sum() - sizes[1].sum()) / (2 * step)
        assert slope == pytest.approx(2 * (column * found.whitened).sum(), rel=1e-4, abs=1e-2)


def test_only_judged_axes_decide(rng):
    """A robot in the plane has no variance of z, roll and pitch, and a bag may say anything of them."""
    p = run_of(rng, "spatial", "so3", noise=0.0)
    P = p.own.covariance * np.outer([1, 1, 0, 0, 0, 1], [1, 1, 0, 0, 0, 1])
    away = moved(p.with_values(covariance=P), WORLD["yaw"])
    found = aligned("est", [away], "posyaw", [0, 1, 5])
    assert_allclose(found.runs[0].errors()[:, [0, 1, 5]], 0.0, atol=1e-8)
    assert "a frame of 3 degrees of freedom" in found.fit.caption


def test_broken_estimates_do_not_move_the_others(rng):
    p = run_of(rng, "planar", "so2", noise=0.0)
    p.own.estimate[20:] = np.nan
    (back,) = aligned("est", [moved(p, WORLD["planar"])], "posyaw", range(3)).runs
    assert_allclose(back.errors()[:20], 0.0, atol=1e-8)
    assert np.isnan(back.own.estimate[20:]).all()


# --- what a fit takes -----------------------------------------------------------------------------------------


def dense(bases, kernels, shared):
    """Covariances (T, n, T, n) of the residuals of each run, by whole matrices; kernel i is that of component i."""
    n = bases[0].shape[1]
    C = [linalg.block_diag(*(linalg.toeplitz(k[: len(Q)]) for k in kernels)) for Q in bases]
    order = [np.arange(n * len(Q)).reshape(n, len(Q)).T.ravel() for Q in bases]
    C = [c[np.ix_(o, o)] for c, o in zip(C, order, strict=True)]
    stacked = [linalg.block_diag(*C)] if shared else C
    flat = [Q.reshape(-1, Q.shape[-1]) for Q in bases]
    whole = [np.concatenate(flat)] if shared else flat
    out = []
    for c, q in zip(stacked, whole, strict=True):
        left = np.eye(len(q)) - q @ q.T
        out.append(left @ c @ left.T)
    if shared:
        ends = np.cumsum([0, *map(len, flat)])
        out = [out[0][a:b, a:b] for a, b in itertools.pairwise(ends)]
    return [c.reshape(len(Q), n, len(Q), n) for c, Q in zip(out, bases, strict=True)]


@pytest.fixture
def tangents(rng):
    return [rng.normal(size=(T, 3, 2)) for T in (12, 9, 12)]


@pytest.mark.parametrize("shared", [False, True])
def test_what_is_left_is_that_of_whole_matrices(shared, tangents):
    bases = orthonormal(tangents) if shared else [orthonormal([A])[0] for A in tangents]
    kernels, edges = _kernels(12, shared), _bins(12)
    three = np.array([0.3 * kernels[0] + 0.7 * kernels[-1], kernels[-1], kernels[0]])
    whole = dense(bases, three, shared)
    for M, C in zip(_left(bases, three, shared), whole, strict=True):
        assert_allclose(M, np.einsum("kakb->kab", C), atol=1e-12)
    expected = _expected(bases, kernels, edges, shared)
    shares = np.zeros((3, len(kernels)))
    shares[0, [0, -1]], shares[1, -1], shares[2, 0] = (0.3, 0.7), 1.0, 1.0
    for found, C in zip(np.einsum("iambj,bj->iam", expected, shares), whole, strict=True):
        lags = np.array([[np.trace(C[:, a, :, a], offset=lag) for lag in range(len(C))] for a in range(3)])
        assert_allclose(found, _binned(lags, edges), atol=1e-12)


@pytest.fixture
def sure(monkeypatch):
    """Errors are called oscillating by chance in one of ten million tests."""
    monkeypatch.setattr(residuals_of_fit, "DOUBT", 1e-7)


def residuals_of(rng, runs, steps, correlation):
    bases, left = [], []
    for _ in range(runs):
        (w,) = autoregression(rng, 1, steps, 3, correlation)
        A = np.zeros((steps, 3, 3))
        A[:, range(3), range(3)] = 1.0
        (Q,) = orthonormal([A])
        q, flat = Q.reshape(-1, 3), w.ravel()
        bases.append(Q)
        left.append((flat - q @ (q.T @ flat)).reshape(steps, 3))
    return left, bases


def test_what_is_left_of_white_errors_and_of_slow_ones(rng, sure):
    """1 - 1/T of white ones, and 1 - 0.17 of AR(.8) in 50 steps: the variance of a mean is 0.168.

    The correlation of 40 runs of 50 steps spreads by 0.01, so that 0.168 does by 0.008, and the margin takes twice as
    much back: five of these spreads are allowed, 6e-7.
    """
    for correlation, taken, spread in ((0.0, 0.02, 0.004), (0.8, 0.168, 0.04)):
        residuals, bases = residuals_of(rng, 40, 50, correlation)
        M = np.array(left_covariances(residuals, bases, False).covariances)
        assert 1.0 - taken - spread < M[:, :, range(3), range(3)].mean() < 1.0 - taken + spread + 0.02 * correlation
        larger = np.array(left_covariances([10.0 * r for r in residuals], bases, False).covariances)
        assert_allclose(M, larger, atol=1e-6)


# --- errors that oscillate --------------------------------------------------------------------------------------


def waves(rng, runs, steps, periods):
    """Gaussian errors of so many periods over a run, with a phase of their own in each axis."""
    angle = 2.0 * np.pi * periods * np.arange(steps)[:, None] / steps
    a, b = rng.normal(size=(2, runs, 1, 3))
    out = a * np.cos(angle) + b * np.sin(angle)
    return out


def constants(runs, steps):
    """Bases of a frame of each run that shifts its three components."""
    Q = np.zeros((steps, 3, 3))
    Q[:, range(3), range(3)] = steps**-0.5
    return [Q] * runs


@pytest.mark.parametrize("axes", [(0, 1, 2), (2,)])
@pytest.mark.parametrize("kind", ["alternating", "two periods", "one and a half"])
def test_errors_that_oscillate_are_told(kind, axes, rng):
    """Correlations of -1/2 or -1 where sums of exponentials have none: ten standard errors of 100 runs, by trial."""
    errors = rng.normal(size=(100, 30, 3))
    other = {
        "alternating": np.diff(rng.normal(size=(100, 31, 3)), axis=1) / np.sqrt(2.0),
        "two periods": waves(rng, 100, 30, 2.0),
        "one and a half": waves(rng, 100, 30, 1.5),
    }[kind]
    errors[..., list(axes)] = other[..., list(axes)]
    residuals = list(errors - errors.mean(axis=1, keepdims=True))
    left = left_covariances(residuals, constants(100, 30), False)
    assert left.oscillating
    assert_array_equal(left.covariances, np.tile(np.eye(3), (100, 30, 1, 1)))
    assert left.unseen == _at_most(residuals, constants(100, 30))
    assert not left_covariances(residuals, orthonormal(constants(100, 30)), True).oscillating


def test_slow_errors_and_constant_ones_do_not_oscillate(rng, sure):
    """Also where they last longer than what is made up for; by chance in four of ten million tests."""
    for slow in (
        rng.normal(size=(40, 30, 3)).cumsum(axis=1),
        rng.normal(size=(40, 30, 3)) + rng.normal(size=(40, 1, 3)),
        np.array(residuals_of(rng, 40, 30, 0.5)[0]),
        np.array(residuals_of(rng, 40, 30, 0.97)[0]),
    ):
        left = left_covariances(list(slow - slow.mean(axis=1, keepdims=True)), constants(40, 30), False)
        assert not left.oscillating
        assert left.unseen == 0.0
        assert np.trace(left.covariances[0][0]) < 3.0


@pytest.mark.parametrize("side, told", [(-1.0, True), (1.0, False), (0.0, False)])
def test_a_product_that_is_too_small_counts_and_one_too_large_does_not(side, told, rng):
    """One bin of one component lies 4 standard errors off, with 40 runs: a p value of 1.3e-4 times 9 bins."""
    bases, kernels, edges = constants(40, 12), _kernels(12, False), _bins(12)
    expected = _expected(bases, np.concatenate([kernels, _slower(12)]), edges, False)
    pairs = np.array([_binned(12.0 - np.arange(12), edges)] * 40)
    seen = expected[..., range(3), :].sum(axis=-1) @ np.ones(3) * 0.0 + expected[:, :, :, :, 0].sum(axis=-1)
    noise = rng.normal(size=40)
    noise = (noise - noise.mean()) / noise.std(ddof=1)
    seen[:, 1, 2] += 0.01 * (noise + side * 4.0 / np.sqrt(40))
    assert _oscillate(seen, expected, pairs) is told


def test_slower_exponentials_reach_beyond_the_run():
    found = _slower(200)
    times = -1.0 / np.log(found[:, 1])
    assert_allclose(times, 20.0 * 2.0 ** np.arange(1, 6))
    assert_array_equal(found[:, 0], 1.0)


def test_most_that_a_fit_takes_is_that_of_a_wave_it_follows():
    """One frequency in one of three components: a unit vector along it takes half of the sum of its squares."""
    wave = np.zeros((40, 3))
    wave[:, 1] = 5.0 * np.cos(np.pi * np.arange(40) / 2.0)
    assert _at_most([wave] * 3, constants(3, 40)) == pytest.approx(0.5 / 3.0, rel=1e-3)
    assert _at_most([wave] * 3, [Q[..., [0, 2]] for Q in constants(3, 40)]) == 0.0
    assert _at_most([np.ones((4, 3))], [np.ones((4, 3, 9))]) == 1.0


def test_variance_of_the_mean_is_that_of_what_each_run_adds(tangents, rng):
    """A run added a little more often moves the mean, by numbers, by what it adds to it."""
    bases = orthonormal([*tangents, *tangents])
    errors = [rng.normal(size=Q.shape[:2]) for Q in bases]

    def left(w):
        c = sum(np.einsum("kap,ka->p", Q, x) for Q, x in zip(bases, w, strict=True))
        return [x - Q @ c for Q, x in zip(bases, w, strict=True)]

    def mean(w):
        return np.mean([x.mean(axis=0) for x in left(w)], axis=0)

    r, step = left(errors), 1e-3
    more = [[(1.0 + step * (i == j)) * x for j, x in enumerate(r)] for i in range(len(r))]
    parts = np.array([(mean(w) - mean(r)) / step for w in more])
    assumed = np.cov(np.array([x.mean(axis=0) for x in r]).T) / len(r)
    worst = linalg.eigvals(np.linalg.solve(assumed, parts.T @ parts)).real.max()
    assert inflation_of_mean(r, bases) == pytest.approx(worst, rel=1e-6)
    assert inflation_of_mean([0.0 * x for x in r], bases) == pytest.approx(0.0)


def with_waves(rng, runs, steps):
    """Planar runs with errors of two periods over a run."""
    found = []
    for w in waves(rng, runs, steps, 2.0):
        p = run_of(rng, "planar", "so2", noise=0.0, steps=steps)
        found.append(_with_errors(p, np.einsum("kij,kj->ki", np.linalg.cholesky(p.own.covariance), w)))
    return found


def test_nothing_makes_up_for_a_frame_of_runs_that_oscillate(rng):
    runs = with_waves(rng, 24, 20)
    found = aligned("est", runs, "posyaw", range(3))
    for back, p in zip(found.runs, runs, strict=True):
        assert_allclose(np.linalg.det(back.own.covariance), np.linalg.det(p.own.covariance), rtol=1e-9)
    assert found.fit.reduced
    assert found.fit.unavailable == ALL_BUT_SCALE
    assert 0.3 < found.fit.unseen < 0.6  # half of the NEES of a wave, and a little more where noise makes it so
    assert "the errors alternate or oscillate; nothing makes up" in found.notes[1]
    assert f"at most about {100 * found.fit.unseen:.2g} % of the NEES)" in found.fit.caption


def test_a_frame_of_all_runs_leaves_no_bias_of_errors_that_cancel(rng):
    found = aligned("est", with_waves(rng, 24, 20), "posyaw-all", range(3))
    assert found.fit.unavailable == BIAS
    assert "nor is a bias: the errors cancel over each run" in found.fit.caption
    white = aligned("est", [run_of(rng, "planar", "so2", steps=20) for _ in range(24)], "posyaw-all", range(3))
    assert white.fit.unavailable == ()  # its ratio of 0.7 to 1.1 stays below 1.25
    assert white.fit.unseen == 0.0


def test_what_a_frame_may_have_taken_is_added_before_consistent_is_said(rng):
    """60 runs of 20 steps know their ratio to 3 %: within 1.5 with a tenth added, and not with 0.4 added."""
    error = rng.normal(size=(60, 20, 3))
    for unseen, status in ((0.0, "consistent"), (0.1, "consistent"), (0.4, "undecided"), (1.0, "undecided")):
        v = judge(
            changed(make_record("f", error, identities(error)), reduced=True, unavailable=ALL_BUT_SCALE, unseen=unseen),
            Settings(1e-6),
        )
        assert v.status == status
        assert "would probably decide" not in v.reasons[0]
    means = np.square(error).mean(axis=(1, 2))
    for unseen in (0.1, 0.25):
        wide = equivalence(means, 3, 20, Settings(), 1.5, False, unseen)
        assert wide.p_value == pytest.approx(equivalence(means / (1.0 - unseen), 3, 20, Settings(), 1.5).p_value)


def test_a_run_that_has_no_part_in_the_frame_keeps_its_covariance(rng):
    runs = [run_of(rng, "planar", "so2", steps=6) for _ in range(24)]
    runs[3].own.estimate[:] = np.nan
    found = aligned("est", runs, "posyaw-all", range(3))
    kept = [
        np.linalg.det(b.own.covariance / 1.0)[0] / np.linalg.det(p.own.covariance)[0]
        for b, p in zip(found.runs, runs, strict=True)
    ]
    assert kept[3] == pytest.approx(1.0, abs=1e-9)
    assert max(kept[:3] + kept[4:]) < 1.0 - 1e-3


# --- the first pose -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind, convention", KINDS)
def test_first_poses_are_made_true(kind, convention, rng):
    p = run_of(rng, kind, convention)
    p.own.covariance[0] = 0.0
    found = aligned("est", [moved(p, WORLD[kind])], "origin", range(len(SIGMA[kind])))
    (back,) = found.runs
    assert_allclose(back.errors()[0], 0.0, atol=1e-8)
    assert not found.fit.reduced
    assert_allclose(np.linalg.det(back.own.covariance[1:]), np.linalg.det(p.own.covariance[1:]), rtol=1e-6)


def test_a_first_pose_adds_to_the_last_components_alone(rng):
    p = run_of(rng, "spatial", "so3")
    (back,) = aligned("est", [p], "origin", [3, 4, 5]).runs
    own, wide = (each.own.covariance[1:] for each in (p, back))  # in worlds that are turned against each other
    assert (np.linalg.det(wide[:, 3:, 3:]) > np.linalg.det(own[:, 3:, 3:])).all()
    assert_allclose(np.linalg.det(wide[:, :3, :3]), np.linalg.det(own[:, :3, :3]))


@pytest.mark.parametrize("kind, convention", KINDS)
def test_what_an_uncertain_first_pose_adds_is_bounded(kind, convention, rng):
    """e_k - J e_0: J by numbers; the bound is exact for none, and holds for errors that are opposite throughout."""
    p, n, step, k = run_of(rng, kind, convention, noise=0.0, steps=8), len(SIGMA[kind]), 1e-5, 7
    J = np.zeros((n, n))
    for i in range(n):
        errors = np.zeros((8, n))
        errors[0, i] = step
        (back,) = aligned("est", [_with_errors(p, errors)], "origin", range(n)).runs
        assert_allclose(back.errors()[0], 0.0, atol=1e-9)
        J[:, i] = -back.errors()[k] / step
    found = aligned("est", [p], "origin", range(n))
    P, R = p.own.covariance[k], J @ p.own.covariance[0] @ J.T
    t = np.sqrt(np.trace(np.linalg.solve(P, R)) / n)
    assert_allclose(found.runs[0].own.covariance[k], (1 + t) * P + (1 + 1 / t) * R, rtol=1e-3, atol=1e-5 * P.max())
    opposite = np.linalg.cholesky(P) + J @ np.linalg.cholesky(p.own.covariance[0])
    ratios = linalg.eigvalsh(opposite @ opposite.T, found.runs[0].own.covariance[k])
    assert ratios.max() <= 1.0 + 1e-3
    assert ratios.max() > 0.3
    assert found.fit.reduced
    assert "the first pose is not exact" in found.notes[1]
    assert not (found.runs[0].own.covariance[0]).any()


# --- verdicts -------------------------------------------------------------------------------------------------


def tables(folder, rng, runs, ratio, world, steps=20):
    """Files of planar runs with errors of ``ratio`` times the stated variance, in worlds of each run or one of all."""
    own, true = [], []
    frame = WORLD["planar"]
    for run in range(runs):
        p = run_of(rng, "planar", "so2", np.sqrt(ratio), steps)
        frame = WorldTransform.about_z(rng.uniform(-3, 3), rng.uniform(-20, 20, 2)) if world == "each" else frame
        q = moved(p, frame)
        P = {f"P_{a}{b}": q.own.covariance[:, i, j] for i, a in enumerate("xyh") for j, b in enumerate("xyh") if i <= j}
        for table, poses, further in ((own, q.own.estimate, P), (true, p.true.values, {})):
            columns = dict(zip(("x", "y", "heading"), poses.T, strict=True))
            columns |= {"run": run, "step": np.arange(1, steps + 1), "t": p.own.t, **further}
            table.append(pd.DataFrame(columns))
    for name, parts in (("est", own), ("truth", true)):
        pd.concat(parts).to_csv(folder / f"{name}.csv", index=False)
    return [str(folder / "est.csv"), "--truth", str(folder / "truth.csv")]


def read(folder, align):
    return cs.read(folder / "est.csv", truth=folder / "truth.csv", align=align)


@pytest.mark.parametrize("step", [True, False])
def test_files_are_aligned_whatever_numbers_them(step, tmp_path, rng):
    tables(tmp_path, rng, 24, 1.0, "each")
    if not step:
        for name in ("est.csv", "truth.csv"):
            pd.read_csv(tmp_path / name).drop(columns="step").to_csv(tmp_path / name, index=False)
    record = read(tmp_path, "posyaw")
    verdict = cs.judge(record, false_alarm=1e-6)
    assert verdict.status == "consistent"  # 480 steps: their ratio is 1 to 4 %, and shown to lie within 50 %
    assert verdict.align == record.fit.align == "posyaw"
    assert "aligned by posyaw, a frame of 3 degrees of freedom for each run: what is constant" in verdict.reasons[0]
    assert {a.question for a in verdict.answers} == {"scale"}
    assert np.nanmean(record.errors.nees) == pytest.approx(3.0, abs=0.6)  # 1,440 squares: 5 of its spread of 0.11
    plain = cs.judge(read(tmp_path, "none"))
    assert plain.status == "overconfident"
    assert plain.align == "none"


def test_a_frame_of_each_run_hides_no_covariance_that_is_too_small(tmp_path, rng):
    """White errors of twice the variance: found always; of a quarter: neither a fault nor consistent."""
    for ratio, status in ((2.0, "overconfident"), (0.25, "undecided")):
        tables(tmp_path, rng, 24, ratio, "each")
        verdict = cs.judge(read(tmp_path, "posyaw"))
        assert verdict.status == status
        assert "such runs would probably decide" not in verdict.reasons[0]
    tables(tmp_path, rng, 24, 0.25, "all")
    verdict = cs.judge(read(tmp_path, "posyaw-all"))
    assert verdict.status == "conservative"
    assert "a frame of 3 degrees of freedom for all runs" in verdict.reasons[0]


def test_few_runs_are_said_to_be_few(tmp_path, rng):
    tables(tmp_path, rng, 5, 1.0, "all")
    record = read(tmp_path, "posyaw-all")
    assert record.fit.reduced
    assert any("fewer than 20 runs do not show what the frame takes" in note for note in record.origin.notes)


def test_questions_without_an_answer_are_not_asked(rng):
    error = rng.normal(size=(30, 20, 3))
    error[:, 3] += 5.0
    P = identities(error)
    every = judge(make_record("f", error, P))
    assert "bias in some step" in every.faults
    some = judge(changed(make_record("f", error, P), reduced=True, unavailable=ALL_BUT_SCALE))
    assert {a.question for a in some.answers} == {"scale"}
    low = judge(changed(make_record("f", 0.3 * rng.normal(size=(30, 20, 3)), P), reduced=True))
    assert low.status == "undecided"
    assert not low.equivalence.one_sided
    assert low.equivalence.runs is None


def test_where_the_scale_is_asked_alone_it_has_the_whole_rate(rng):
    """Its p value between half of the rate and the rate is a fault of the scale and not of a few runs."""
    w = rng.normal(size=(40, 10, 3))
    P = identities(w)
    low, high = 0.9, 1.5
    for _ in range(20):
        ratio = 0.5 * (low + high)
        v = judge(changed(make_record("f", np.sqrt(ratio) * w, P), reduced=True, unavailable=ALL_BUT_SCALE), Settings())
        (answer,) = v.answers
        if 0.026 < answer.p_value < 0.049:
            break
        low, high = (ratio, high) if answer.p_value >= 0.049 else (low, ratio)
    assert 0.026 < answer.p_value < 0.049
    assert v.status == "overconfident"
    assert v.scale.mean_anees > v.scale.accepted[1]


def test_clock_and_frame_are_found_together(rng):
    runs = []
    for _ in range(4):
        p = run_of(rng, "planar", "so2", noise=0.1)
        runs.append(moved(p.with_values(estimate=p.own.estimate + _ahead(p, 0.03) - p.true.values), WORLD["planar"]))
    shift, notes, found = clocks_and_frames("est", runs, "estimate", "posyaw-all", range(3))
    assert shift == pytest.approx(0.03, abs=2e-3)
    assert "is added to the timestamps" in notes[0]
    sizes = [np.nanmax(np.abs(p.errors(shift)[:, :2])) for p in found.runs]
    assert max(sizes) < 0.12  # in 0.03 s a robot goes 0.3 m
    assert_array_equal(found.runs[0].own.t, runs[0].own.t)
    of_the_clock_that_is_said = aligned("est", [p.later(shift) for p in runs], "posyaw-all", range(3))
    for one, other in zip(found.runs, of_the_clock_that_is_said.runs, strict=True):
        assert_allclose(one.own.estimate, other.own.estimate, rtol=0, atol=1e-12)
        assert_allclose(one.own.covariance, other.own.covariance, rtol=1e-12)


@pytest.mark.parametrize(
    "shifts, said", [([0.1, 0.15, 0.15009, 0.3], 0.15009), ([0.1, 0.2, 0.1, 0.2, 0.1, 0.3], 0.1), ([0.0], 0.0)]
)
def test_clock_and_frame_are_found_in_turn_until_the_clock_settles(shifts, said, monkeypatch):
    """To 0.1 ms, or five times."""
    then = iter(shifts)
    monkeypatch.setattr(residuals, "frames_of", lambda *_: [])
    monkeypatch.setattr(residuals, "clock_shift", lambda *_: (next(then), []))
    monkeypatch.setattr(residuals, "aligned", lambda *_: Aligned([], TruthFit()))
    assert clocks_and_frames("est", [], "estimate", "posyaw", range(3))[0] == said


def _ahead(p, seconds):
    """The truth so much later, at the timestamps of the estimates; the last one stays."""
    known = p.with_values(max_dt=1.0).known(seconds)
    out = p.own.estimate.copy()
    out[known.rows] = known.truth
    return out


# --- the command ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options, words",
    [
        (["--align", "sim3"], "--align sim3: must be one of none, origin, posyaw, posyaw-all, se3, se3-all"),
        (["--align", "se3"], "for x, y, heading it is posyaw"),
        (["--align", "posyaw", "--error", "vector"], "an error that is not 'vector'"),
        (["--align", "posyaw", "--state", "x,y"], "needs poses x,y,heading"),
    ],
)
def test_what_cannot_be_aligned_is_refused(options, words, tmp_path, rng):
    files = tables(tmp_path, rng, 2, 1.0, "all")
    with pytest.raises(InputError, match=words.replace("(", r"\(")):
        CliRunner().invoke(app, ["analyse", *files, *options], catch_exceptions=False)


def test_there_must_be_a_truth_and_poses(tmp_path):
    np.savez(tmp_path / "errors.npz", errors=np.ones((2, 3, 1)), covariances=np.ones((2, 3, 1, 1)))
    with pytest.raises(InputError, match="align=posyaw needs truth="):
        cs.read(tmp_path / "errors.npz", align="posyaw")
    with pytest.raises(InputError, match=r"does not go with"):
        cs.read(tmp_path / "errors.npz", truth=tmp_path / "errors.npz", align="posyaw")
