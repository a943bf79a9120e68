"""Files that are mixed up in one way are told so in words, and right ones are not."""

from dataclasses import replace

import hints as world
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from recorded import notes_of, read_recordings
from records import changed
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from consistency.diagnostics import make_record
from consistency.referee.errors import InputError
from consistency.referee.geometry import composed, matrices, vectors, wrap
from consistency.referee.notebook import judge, read
from consistency.referee.readers.alignment import (
    BodyTransform,
    WorldTransform,
    fitted_body,
    fitted_frame,
    moved,
    on_body,
)
from consistency.referee.readers.mix_ups import hints as readers_hints
from consistency.referee.readers.mix_ups.hints import hints, turns
from consistency.referee.readers.mix_ups.known import Guess, _ned
from consistency.referee.readers.mix_ups.reading_fit import COST, FACTOR, PIECES, SMALL, fit_of, thinned
from consistency.referee.readers.pipeline.relative_motions import causes_of_motions
from consistency.referee.readers.places import Places
from consistency.referee.readers.runs_to_record import Relative, Track, _singular, symmetric
from consistency.referee.readers.truth_matching import make_poses
from consistency.testing import assert_consistent

RUNS, STEPS = 3, 60
SIX = ("x", "y", "z", "roll", "pitch", "yaw")
THREE = ("x", "y", "heading")
DEGREES = 180.0 / np.pi
ANGLES = np.array([1.0, 1.0, DEGREES])


@pytest.fixture
def rng():
    return np.random.default_rng(22)


def spatial(rng, convention="so3", plain=False):
    """Drives whose errors have the stated covariance in ``convention``."""
    sigma = np.array([0.05, 0.08, 0.12, 0.004, 0.006, 0.01])
    return world.log(rng, "spatial", RUNS, STEPS, 0.0, sigma=sigma, convention=convention, correlated=not plain)


def planar(rng, plain=False):
    return world.log(rng, "planar", RUNS, STEPS, 0.0, sigma=np.array([0.05, 0.08, 0.01]), correlated=not plain)


def poses(t, own, P, true, manifold, convention):
    place, stated = Places("line {}".format, np.arange(len(t))), np.ones(len(t), bool)
    return make_poses(place, t, own, np.tile(P, (len(t), 1, 1)), stated, t, true, manifold, convention, 0.01)  # type: ignore[arg-type]


def states(e, P):
    """A log of a state that is no pose, with errors (k, n) and one covariance (n, n)."""
    return poses(np.arange(float(len(e))), np.zeros_like(e), P, e, "vector", "vector")


def weighed(p, part, factor):
    scale = np.ones(p.own.covariance.shape[-1])
    scale[part] = factor
    return p.with_values(covariance=p.own.covariance * np.outer(scale, scale))


SWAP = [3, 4, 5, 0, 1, 2]
W_FIRST = [0, 1, 2, 6, 3, 4, 5]
FAR = np.array([10.0, -3.0, 1.0])
ARM = np.array([2.0, -1.0, 0.5])
MIXED = {
    "blocks": (
        spatial, world.reordered(SWAP),
        "the covariance has its two blocks in the other order (--covariance-order)",
    ),
    "gtsam": (
        lambda rng: spatial(rng, "left"),
        lambda p: world.reordered(SWAP)(p).with_values(convention="so3"),
        "the error is 'left' (--error left) and the covariance has its two blocks in the other order",
    ),
    "quaternions": (
        spatial, lambda p: p.with_values(estimate=p.own.estimate[:, W_FIRST]),
        "the quaternions of the estimates are w x y z",
    ),
    "true quaternions": (
        spatial, lambda p: p.with_values(truth=p.true.values[:, W_FIRST]), "the quaternions of the truth are w x y z",
    ),
    "world to body": (
        spatial, lambda p: p.with_values(estimate=p.own.estimate * [1, 1, 1, -1, -1, -1, 1]), "turn world into body",
    ),
    "variances in degrees": (spatial, world.degrees, "its angles are in degrees"),
    "variances in mm": (spatial, lambda p: weighed(p, slice(0, 3), 1e3), "its positions are in millimetres"),
    "estimates in mm": (
        spatial, lambda p: weighed(p.with_values(estimate=p.own.estimate * ([1e3] * 3 + [1] * 4)), slice(0, 3), 1e3),
        "the positions of the estimates and their covariance are in millimetres",
    ),
    "truth in mm": (
        spatial, lambda p: p.with_values(truth=p.true.values * ([1e3] * 3 + [1] * 4)),
        "positions of the truth are in millim",
    ),
    "deviations": (lambda rng: spatial(rng, plain=True), world.deviations, "its diagonal holds standard deviations"),
    "information": (spatial, world.information, "information matrix"),
    "inverse": (spatial, world.inverse, "the poses of the estimates are inverse"),
    "y before x": (
        spatial, lambda p: p.with_values(estimate=p.own.estimate[:, [1, 0, 2, 3, 4, 5, 6]]),
        "the positions of the estimates are in the order y, x, z; write them as x, y, z",
    ),
    "z before x in all": (
        spatial,
        lambda p: p.with_values(estimate=p.own.estimate[:, [2, 0, 1, 3, 4, 5, 6]],
                          covariance=p.own.covariance[:, [2, 0, 1, 3, 4, 5]][:, :, [2, 0, 1, 3, 4, 5]]),
        "positions and covariance of the estimates are in the order z, x, y; write them as x, y, z",
    ),
    "y before x in the plane": (
        planar, lambda p: p.with_values(estimate=p.own.estimate[:, [1, 0, 2]]),
        "the positions of the estimates are in the order y, x; write them as x, y",
    ),
    "turned world": (spatial, lambda p: moved(p, WorldTransform.about_z(-np.pi / 4.5, FAR)), "turned by 40."),
    "headings in degrees": (
        planar, world.heading_degrees, "the headings of the estimates are in degrees",
    ),
    "true headings in degrees": (
        planar, lambda p: p.with_values(truth=p.true.values * ANGLES), "the headings of the truth are in degrees",
    ),
    "planar deviations": (
        lambda rng: planar(rng, plain=True), world.deviations, "its diagonal holds standard deviations",
    ),
    "shifted world": (
        planar, lambda p: moved(p, WorldTransform.about_z(0.0, FAR[:2])), "the world of the estimates is shifted by (-",
    ),
    "lever arm": (
        spatial, lambda p: on_body(p, BodyTransform(Rotation.identity(), ARM)),
        "the body of the truth is shifted by a lever arm of (-",
    ),
    "turned body": (
        lambda rng: spatial(rng, "left"), lambda p: on_body(p, BodyTransform(Rotation.from_euler("z", -0.5), ARM)),
        "the body of the truth is turned by (0.0, 0.0, 28.",
    ),
    "planar lever arm": (
        planar, lambda p: on_body(p, BodyTransform(Rotation.from_euler("z", 0.3), ARM * [1, 1, 0])),
        "the body of the truth is turned by -17.",
    ),
}  # fmt: skip


SCALES = {  # of the covariance beside the mix-up, where it is not right
    **dict.fromkeys(["quaternions", "blocks", "gtsam", "information", "headings in degrees"], (0.25, 4.0)),
    "turned world": (0.1, 0.25, 4.0, 10.0), "shifted world": (0.1, 1.0, 10.0), "lever arm": (0.1, 1.0, 10.0),
}  # fmt: skip


@pytest.mark.parametrize("name, scale", [(name, scale) for name in MIXED for scale in SCALES.get(name, (1.0,))])
def test_a_mix_up_is_named_also_beside_a_wrong_scale(name, scale, rng):
    make, mess, words = MIXED[name]
    runs = [mess(p.with_values(covariance=p.own.covariance * scale)) for p in make(rng)]
    (said,) = hints("est", SIX if runs[0].manifold == "spatial" else THREE, runs)
    assert said.startswith("est: the NEES")
    assert words in said
    assert scale == 1.0 or said.endswith(f"too {'large' if scale < 1.0 else 'small'} in all components")


def decades(runs):
    found = fit_of([(p.errors(), p.own.covariance) for p in runs])
    assert found is not None
    return found.decades


def test_worlds_of_each_run_are_named(rng):
    runs = [moved(p, WorldTransform.about_z(0.7 * i, FAR)) for i, p in enumerate(spatial(rng))]
    (said,) = hints("est", SIX, runs)
    assert said.endswith("each run is turned about z and shifted by itself to meet the truth; add --align posyaw")


@pytest.mark.parametrize("name, factor", [(name, case[4][-1]) for name, case in world.MIXED.items()])
def test_a_mix_up_of_less_than_a_decade_is_named(name, factor, rng):
    """Far above the smallest factor in the table of the benchmark, so that chance misses none but once in 1e5."""
    kind, convention, sigma, mess, _, words = world.MIXED[name]
    plain = name.startswith("deviations")
    runs = world.log(rng, kind, 20, 50, 0.3, sigma=sigma(factor), convention=convention, correlated=not plain)
    assert hints("est", world.AXES[kind], runs) == []
    (said,) = hints("est", world.AXES[kind], [mess(p) for p in runs])
    assert words in said


@pytest.mark.parametrize("wrong", world.WRONG)
@pytest.mark.parametrize("kind", list(world.AXES))
def test_honest_logs_get_no_hint(kind, wrong, rng):
    for runs, steps, rho in ((1, 300, 0.9), (10, 50, 0.5)):
        assert hints("est", world.AXES[kind], world.log(rng, kind, runs, steps, rho, wrong)) == []


def test_both_worlds_of_north_and_east_are_named(rng):
    """In the plane and in space, there with bodies that have z down too or not."""
    down = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    for both in (False, True):
        turned = [world.north(p) for p in spatial(rng, plain=True)]
        for p in turned:
            if both:
                p.own.estimate[:, 3:] = (Rotation.from_quat(p.own.estimate[:, 3:]) * down).as_quat()
        (said,) = hints("est", SIX, turned)
        assert "x north, y east, z down" in said
        assert ("their bodies have z down" in said) == both
    swapped = []
    for p in planar(rng, plain=True):
        own = np.column_stack([p.own.estimate[:, 1], p.own.estimate[:, 0], wrap(np.pi / 2 - p.own.estimate[:, 2])])
        order = [1, 0, 2]
        swapped.append(p.with_values(estimate=own, covariance=p.own.covariance[:, order][:, :, order]))
    (said,) = hints("est", THREE, swapped)
    assert "in a plane of x north, y east" in said


@pytest.mark.parametrize("convention", ["so3-body", "left"])
def test_a_body_that_is_turned_over_takes_its_covariance_along(convention, rng):
    """NEES of a log whose estimates are undone is what it was before."""
    p = spatial(rng)[0].with_values(convention=convention)
    there = world.north(p)
    there.own.estimate[:, 3:] = (
        Rotation.from_quat(there.own.estimate[:, 3:]) * Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    ).as_quat()
    S = np.diag([1.0, 1.0, 1.0, 1.0, -1.0, -1.0]) if convention == "so3-body" else np.diag([1.0, -1.0, -1.0] * 2)
    there = there.with_values(covariance=S @ there.own.covariance @ S)
    *_, undo = _ned()
    assert_allclose(decades([undo.change(there)]), decades([p]), atol=1e-9)


def test_a_file_beside_itself_and_one_of_few_digits(rng):
    runs = spatial(rng)
    same = [p.with_values(truth=p.own.estimate.copy()) for p in runs]
    few = [p.with_values(truth=np.round(p.own.estimate, 7)) for p in runs]
    for copy in (same, few):
        (said,) = hints("est", SIX, copy)
        assert "truth and estimates seem to be the same file" in said
    near = [p.with_values(truth=p.own.estimate + 1e-4 * rng.normal(size=p.own.estimate.shape)) for p in runs]
    assert not any("same file" in said for said in hints("est", SIX, near))
    assert not any("same file" in said for said in hints("est", SIX, [p.some(2) for p in same[:1]]))


# --- how well errors fit ----------------------------------------------------------------------------


def test_independent_estimates_by_hand():
    """White errors count each, errors that are constant over a run once a run; AR(r) by (1 - r^2) / (1 + r^2).

    Of correlated errors of a single run down to a third of that is found, of ten runs 1 / 1.2.
    """
    rng = np.random.default_rng(7)
    steps = 4000
    white = rng.normal(size=(steps, 2))
    slow = lfilter([np.sqrt(1 - 0.8**2)], [1.0, -0.8], white, axis=0)
    expected = steps * (1 - 0.64) / (1 + 0.64)
    assert fit(white).size == pytest.approx(steps, rel=0.15)
    assert 0.85 * expected / 3.0 < fit(slow).size < 1.15 * expected
    assert 0.8 * expected < fit(*np.split(slow, 10)).size < 1.15 * expected
    constant = [np.full((50, 2), value) for value in rng.normal(size=5)]
    assert fit(*constant).size <= 5.0 * 1.05


def test_few_of_many_runs_are_looked_at(rng, monkeypatch):
    looked = list[int]()
    monkeypatch.setattr(readers_hints, "is_same", lambda some: bool(looked.append(len(some))) or True)
    run = planar(rng)[0]
    for runs in (1, 200, 201, 2000, 2001):
        hints("f", ("x", "y", "heading"), [run] * runs)
    assert looked == [1, 200, 101, 200, 182]


def test_simple_faults_explain_what_they_make():
    """A factor f in n components gains (f - 1 - log f) n / 2, up to the largest factor; a bias b gains b^2 / 2."""
    rng = np.random.default_rng(8)
    w = rng.normal(size=(20_000, 3))
    w = (w - w.mean(axis=0)) / w.std(axis=0)
    P = np.diag([4.0, 1.0, 0.25])
    for scale in ([3.0, 3.0, 3.0], [1.0, 3.0, 1.0], [0.4, 0.4, 1.0], [1.0, 0.4, 1.0]):
        f = np.square(scale)
        f = np.clip(f, 1.0 / FACTOR, FACTOR)
        squares = np.square(scale)
        gain = 0.5 * (squares - squares / f - np.log(f)).sum()
        found = fit(w * scale, P=P)
        assert found.simple() - found.likelihood == pytest.approx(gain, rel=0.02)
    found = fit(w + np.array([0.0, 2.0, 0.0]), P=P)
    assert found.simple() - found.likelihood >= 2.0 - 1e-6
    assert fit(w, P=P).likelihood == pytest.approx(-1.5 - 0.5 * np.log(np.linalg.det(P)), rel=1e-3)


@pytest.mark.parametrize("where", ["steps", "runs", "size"])
def test_faults_in_some_estimates_explain_what_they_make(where):
    """Errors 30 times too large in half of the steps or runs; a covariance whose changes of size mean nothing."""
    rng = np.random.default_rng(10)
    factor = np.ones((20, 100, 1))
    stated = np.ones((20, 100))
    if where == "size":
        stated = np.exp(rng.uniform(-2.0, 2.0, (20, 100)))
        stated /= np.exp(np.log(stated).mean())
    else:
        factor[(slice(None), slice(50, None)) if where == "steps" else slice(3, 13)] = 30.0
    e = factor * rng.normal(size=(20, 100, 2))
    found = fit_of([(error, P[:, None, None] * np.eye(2)) for error, P in zip(e, stated, strict=True)])
    assert found is not None
    true = -1.0 - np.log(factor**2).mean()
    assert true - COST * PIECES / found.size - 0.06 < found.simple() < true + 0.06


def test_what_is_right_and_what_is_not():
    """Each part of it: scale, an axis, the mean, correlations, the median; a right one is refused once in 1,000."""
    rng = np.random.default_rng(9)
    w = rng.normal(size=(2000, 2))
    w = np.linalg.solve(np.linalg.cholesky(np.cov(w.T)), (w - w.mean(axis=0)).T).T
    assert fit(w).right(False)
    assert fit(w).is_shown()
    assert fit(w * 3.0).is_shown(1.0)
    assert fit(w / 3.0).is_shown(1.0)
    assert not fit(w * 4.0).is_shown(1.0)
    for factor in (1.2, 1.0 / 1.2):  # is right but for the factor that all share
        assert fit(w * factor).right(False)
        assert not fit(w * factor).is_shown()
    assert not fit(w[:20]).is_shown()
    t = rng.standard_t(3, size=w.shape)
    for other in (
        w * [1.25, 0.8],
        w + np.array([0.2, 0.0]),
        w @ [[1.0, 0.2], [0.0, 0.98]],
        t / t.std(axis=0),
    ):
        assert not fit(other).right(False)
    assert fit(w).fault() == pytest.approx(0.0, abs=1e-3)
    assert fit(2.0 * w).fault() == pytest.approx(0.5 * 2 * (4.0 - np.log(4.0) - 1.0), rel=1e-2)


def fit(*whitened, P=None):
    """Errors of runs with these whitened errors (k, n) and a covariance (n, n), I where None."""
    n = whitened[0].shape[1]
    P = np.eye(n) if P is None else P
    runs = []
    for w in whitened:
        e = w @ np.linalg.cholesky(P).T
        runs.append(poses(np.arange(len(e)) * 0.1, np.zeros_like(e), P, e, "vector", "vector"))
    found = fit_of([(p.errors(), p.own.covariance) for p in runs])
    assert found is not None
    return found


def test_a_variance_in_the_row_of_another_component_is_no_reason_to_judge_that_one(rng):
    """Yaw moves and has no variance, roll has one and does not move: not --axes x,y,roll, which is conservative."""
    error, P = np.zeros((20, 6)), np.zeros((20, 6, 6))
    error[:, [0, 1, 5]] = rng.normal(size=(20, 3))
    P[:, [0, 1, 3], [0, 1, 3]] = 1.0
    track = Track(0, np.arange(20), Places("line {}".format, np.arange(20)), error, P)
    said = _singular("est", [track], SIX)
    assert "yaw has errors without a variance, and roll a variance without errors" in said
    assert "--axes" not in said
    right = replace(track, covariance=P[:, [0, 1, 2, 5, 4, 3]][:, :, [0, 1, 2, 5, 4, 3]])
    assert "--axes x,y,yaw" in _singular("est", [right], SIX)


def test_one_slow_log_with_a_constant_covariance_gets_no_hint(rng):
    """A drift of meters beside 0.001 I: the inverse, 1000 I, is as far off on the other side."""
    drift = np.cumsum(rng.normal(0.0, 0.3, (300, 3)), axis=0)
    run = states(drift, 1e-3 * np.eye(3))
    assert hints("est", ("x", "y", "z"), [run]) == []


def test_components_that_are_judged_alone_get_hints(rng):
    """Blocks in the other order beside components without a variance, which would make the whole singular."""
    runs = []
    for p in spatial(rng, plain=True):
        P = world.reordered(SWAP)(p).own.covariance
        P[:, 2], P[:, :, 2] = 0.0, 0.0
        runs.append(p.with_values(covariance=P))
    assert hints("est", SIX, runs) == []
    (said,) = hints("est", SIX, runs, judged=[0, 1, 3, 4])
    assert "other order (--covariance-order)" in said


def test_cross_terms_that_are_nearly_singular_are_named_with_their_direction(rng):
    e = rng.normal(size=(400, 3)) * [0.1, 0.2, 0.05]
    R = np.eye(3)
    R[0, 1] = R[1, 0] = 1.0 - 1e-7
    P = R * np.outer([0.1, 0.2, 0.05], [0.1, 0.2, 0.05])
    (said,) = hints("est", ("x", "y", "z"), [states(e, P)])
    assert "nearly singular in the direction +1.00 x -1.00 y" in said or "direction -1.00 x +1.00 y" in said


@pytest.mark.parametrize("n", [2, 3])
def test_a_nearly_singular_direction_that_turns_is_named_as_that(n, rng):
    """One direction of the plane is known 1,000 times too well, another in each step."""
    angle = rng.uniform(0.4, 1.2, 400) * rng.choice([-1.0, 1.0], 400)
    P = np.tile(0.04 * np.eye(n), (400, 1, 1))
    v = np.zeros((400, n))
    v[:, :2] = np.column_stack([np.cos(angle), np.sin(angle)])
    P -= (1.0 - 1e-8) * 0.04 * v[:, :, None] * v[:, None, :]
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    run = states(sigma * rng.normal(size=(400, n)), np.eye(n)).with_values(covariance=P)
    (said,) = hints("est", "xyz"[:n], [run])
    assert "nearly singular in a direction that turns from step to step; look for lost digits" in said


# --- plain faults ------------------------------------------------------------------------------------


def faulty(rng, kind, var, where, factor_of_error, factor_of_P, of_position=None):
    """20 runs of 40 steps with white errors of one variance; the fault is in the steps ``where``."""
    runs = []
    n = len(world.AXES[kind])
    for _ in range(20):
        e = np.sqrt(var) * rng.normal(size=(40, n))
        P = np.tile(var * np.eye(n), (40, 1, 1))
        if of_position is not None:
            e[:, 3:] *= of_position
            P[:, 3:, 3:] *= of_position**2
        e[where] *= factor_of_error
        P[where] *= factor_of_P
        runs.append(world.run_of(rng, kind, {"spatial": "so3", "planar": "so2"}.get(kind, "vector"), e, P))
    return runs


MIDDLE, LATE, SOME = slice(20, 25), slice(25, None), slice(3, None, 5)


@pytest.mark.parametrize(
    "kind, var, where, of_error, of_P",
    [
        ("vector", 0.49, MIDDLE, 1.0, 0.01),
        ("vector", 2.0, LATE, 1.0, 0.01),
        ("scalar", 0.25, SOME, 1.0, 0.01),
        ("scalar", 5.0, MIDDLE, 1.0, 0.1),
        ("scalar", 1.0, SOME, 3.0, 0.01),
        ("vector", 0.2, SOME, 1.0, 100.0),
    ],
)
def test_some_steps_whose_covariance_is_wrong_are_no_information_matrix(kind, var, where, of_error, of_P, rng):
    """The covariance of all other steps is right, whatever is nearer to right in these."""
    runs = faulty(rng, kind, var, where, of_error, of_P)
    assert hints("est", world.AXES[kind], runs) == []
    assert "information" in hints("est", world.AXES[kind], [inverted_and_right(rng, kind, p) for p in runs])[0]


def inverted_and_right(rng, kind, p):
    """A run whose errors have the covariances of another, which are stated as their inverses."""
    e = np.einsum("kij,kj->ki", np.linalg.cholesky(p.own.covariance), rng.normal(size=p.own.covariance.shape[:2]))
    return world.information(world.run_of(rng, kind, "vector", e, p.own.covariance))


@pytest.mark.parametrize("where, sigma", [(slice(20, 26), 2.0), (slice(0, 8), 4.0), (slice(30, None), 1.0)])
def test_large_errors_in_some_steps_are_no_millimetres(where, sigma, rng):
    """On a path of some m, whose positions would vanish in millimetres."""
    runs = faulty(rng, "spatial", sigma**2, where, 10.0, 1.0, of_position=0.01 / sigma)
    assert hints("est", SIX, runs) == []


@pytest.mark.parametrize("number", range(16))
def test_plain_faults_get_no_hint(number, rng):
    """Two of each kind, of any size and shape; at most 1 % of 400 such logs may get one (benchmarks/hints.py)."""
    assert world.plain(rng, number)[1] == []


# --- axes and orders of the covariance ---------------------------------------------------------------


@pytest.mark.parametrize(
    "order, words",
    [
        ([0, 1, 2, 5, 4, 3], "the rotations of the covariance are in the order yaw, pitch, roll"),
        ([0, 1, 2, 4, 5, 3], "the rotations of the covariance are in the order pitch, yaw, roll"),
        ([0, 1, 2, 5, 3, 4], "the rotations of the covariance are in the order yaw, roll, pitch"),
        ([2, 1, 0, 3, 4, 5], "the positions of the covariance are in the order z, y, x"),
    ],
)
def test_one_block_in_another_order_is_named(order, words, rng):
    (said,) = hints("est", SIX, [world.reordered(order)(p) for p in spatial(rng, plain=True)])
    own = "roll, pitch, yaw" if "rotations" in words else "x, y, z"
    assert said.endswith(f"{words}; write them as {own}")


@pytest.mark.parametrize(
    "place, turn",
    [
        ([0.1, 0.1, 0.1], [0.01, 0.02, 0.05]),
        ([0.3, 0.3, 0.3], [0.01, 0.01, 0.06]),
        ([2.0, 2.0, 2.0], [0.03, 0.001, 0.01]),
    ],
)
def test_orders_that_fit_equally_are_all_said(place, turn, rng):
    runs = world.log(rng, "spatial", 20, 50, 0.0, sigma=np.array(place + turn), correlated=False)
    (said,) = hints("est", SIX, [world.reordered([0, 1, 2, 5, 4, 3])(p) for p in runs])
    assert "the rotations of the covariance are in the order yaw, pitch, roll; write them as" in said
    assert "(rotations alike)" in said
    assert said.endswith("(4 causes fit equally)") == (turn[0] == turn[1])


TURNED = {
    "orbital": ("place", world.orbital, "the covariance of x, y, z is along radius, track and normal; turn it into"),
    "along": ("place", world.along, "the covariance of x, y, z is along and across the motion; turn it into the axes"),
    "heading": ("planar", world.twice_the_heading, "the covariance of x, y is turned by the negative heading; turn it"),
    "yaw": ("spatial", world.twice_the_heading, "the covariance of x, y, z is turned by the negative heading"),
}


@pytest.mark.parametrize("name", list(TURNED))
@pytest.mark.parametrize("scale", [0.25, 4.0])
def test_covariances_in_axes_of_the_motion_are_named(name, scale, rng):
    kind, axes, words = TURNED[name]
    sigma = np.array([0.05, 0.4, 0.1, 0.01, 0.01, 0.01] if kind == "spatial" else [0.05, 0.4, 0.1])
    right = [p.with_values(covariance=scale * p.own.covariance) for p in world.log(rng, kind, 10, 60, 0.0, sigma=sigma)]
    assert not any("covariance of" in said for said in hints("est", world.AXES[kind], right))
    (said,) = hints("est", world.AXES[kind], [world.turned(axes)(p) for p in right])
    assert words in said


def orbits(rng, sigma, names):
    """A state of names in any order, whose errors have deviations along radius, track and normal, and that state."""
    angle = 0.2 * np.arange(60)
    zero = np.zeros(60)
    radius = np.column_stack([np.cos(angle), np.sin(angle), zero])
    track = np.column_stack([-np.sin(angle), np.cos(angle), zero])
    columns = {"x": 0, "y": 1, "z": 2, "vx": 3, "vy": 4, "vz": 5}
    order = [columns[name] for name in names]
    own = np.hstack([7e6 * radius, 7e3 * track])[:, order]
    R = np.stack([radius, track, np.tile([0.0, 0.0, 1.0], (60, 1))], axis=-1)
    runs = []
    for _ in range(10):
        w = rng.normal(size=(60, 6)) * sigma
        e = np.hstack([np.einsum("kij,kj->ki", R, w[:, :3]), np.einsum("kij,kj->ki", R, w[:, 3:])])[:, order]
        P = np.diag(np.square(sigma)[order])
        runs.append(poses(np.arange(60.0), own - e, P, own, "vector", "vector"))
    return runs


@pytest.mark.parametrize("state", ["x y z", "x y z vx vy vz", "x vx y vy z vz"])
def test_velocities_are_turned_with_positions(state, rng):
    names = state.split()
    sigma = np.array([1.0, 20.0, 0.5, 0.02, 0.001, 0.0005])
    (said,) = hints("est", names, orbits(rng, sigma, names))
    assert "the covariance of x, y, z is along radius, track and normal; turn it into the axes of x, y, z" in said
    assert "too" not in said.partition("about right if")[2]


def test_errors_without_places_have_no_motion(rng):
    """The errors would be a path that each covariance is turned along."""
    e = rng.normal(size=(400, 3)) * 0.1
    assert not any("along" in said for said in hints("est", ("x", "y", "z"), [states(e, np.diag([0.01, 1e-4, 1e-4]))]))


def test_the_motion_of_a_robot_that_stands_is_that_before(rng):
    sigma = np.array([0.05, 0.4, 0.1])
    runs = []
    for p in world.log(rng, "place", 10, 60, 0.0, sigma=sigma, correlated=False):
        stays = np.minimum(np.arange(60), 30)
        error = p.true.values - p.own.estimate
        R = world.along(p.with_values(truth=p.own.estimate))
        R = R[np.minimum(np.arange(60), 29)]
        P = np.swapaxes(R, 1, 2) @ p.own.covariance @ R
        at = p.own.estimate[stays]
        runs.append(p.with_values(truth=at, estimate=at - error, covariance=P))
    (said,) = hints("est", ("x", "y", "z"), runs)
    assert "along and across the motion" in said


@pytest.mark.parametrize("sigma", [[0.1, 0.02], [3.0, 5.0, 20.0], [0.5, 0.02, 7.0, 0.1, 1.0, 2.0]])
def test_deviations_with_correlations_are_named(sigma, rng):
    """Positive definite as a covariance or not."""
    n = len(sigma)
    root = np.eye(n) + 0.5 * rng.normal(size=(n, n))
    R = root @ root.T
    P = R * np.outer(sigma, sigma) / np.sqrt(np.outer(np.diag(R), np.diag(R)))
    e = rng.normal(size=(400, n)) @ np.linalg.cholesky(P).T
    (run,) = [world.correlations(states(e, P))]
    (said,) = hints("est", [f"e{k}" for k in range(n)], [run])
    assert "its diagonal holds standard deviations, and correlations are beside them; multiply each" in said


def test_a_unit_quaternion_with_four_variances_is_named(rng):
    turn = Rotation.random(400, random_state=rng.integers(2**31))
    true = (turn * Rotation.from_rotvec(0.02 * rng.normal(size=(400, 3)))).as_quat()
    true *= np.sign((true * turn.as_quat()).sum(axis=1))[:, None]
    run = poses(np.arange(400.0), turn.as_quat(), 0.01**2 * np.eye(4), true, "vector", "vector")
    (said,) = hints("est", ("qx", "qy", "qz", "qw"), [run])
    assert "qx, qy, qz, qw are a unit quaternion (x y z w) with three degrees of freedom" in said


def test_blocks_of_an_inertial_state_in_another_order_are_named(rng):
    runs = []
    for p in spatial(rng):
        P = np.zeros((STEPS, 9, 9))
        P[:, :6, :6], P[:, 6:, 6:] = p.own.covariance, 0.3**2 * np.eye(3)
        own, error = rng.normal(size=(STEPS, 3)), 0.3 * rng.normal(size=(STEPS, 3))
        estimate, truth = np.hstack([p.own.estimate, own]), np.hstack([p.true.values, own + error])
        runs.append(p.with_values(estimate=estimate, truth=truth, covariance=P))
    axes, order = (*SIX, "vx", "vy", "vz"), [0, 1, 2, 6, 7, 8, 3, 4, 5]
    assert hints("est", axes, runs) == []
    (said,) = hints("est", axes, [p.with_values(covariance=p.own.covariance[:, order][:, :, order]) for p in runs])
    assert said.endswith("in the order p,v,R; add --covariance-order p,v,R")


def test_half_angles_are_named_as_one_of_two(rng):
    runs = [weighed(p, slice(3, 6), 0.5) for p in world.log(rng, "spatial", 20, 50, 0.0)]
    (said,) = hints("est", SIX, runs)
    assert "its angles are half angles" in said
    assert said.endswith("a covariance of a wrong scale looks the same")


def test_causes_are_shown_by_print_and_gate(rng):
    sigma = np.array([0.1, 0.05, 0.02])
    errors, P = rng.normal(size=(40, 50, 3)) * sigma, np.broadcast_to(np.diag(sigma), (40, 50, 3, 3))
    verdict = judge(errors, P)
    (cause,) = verdict.causes
    assert "standard deviations" in cause
    assert cause in verdict.reasons
    assert cause in verdict.notes
    assert cause in str(verdict)
    assert cause in verdict._repr_html_()
    with pytest.raises(AssertionError, match="its diagonal holds standard deviations"):
        assert_consistent(errors, P)


def sized(rng, factors, runs=40, steps=50):
    """Errors of components whose mean squares are those numbers, with no chance in it, beside I."""
    e = rng.normal(size=(runs, steps, len(factors)))
    e *= np.sqrt(np.array(factors) / np.square(e).mean(axis=(0, 1)))
    return e, np.broadcast_to(np.eye(len(factors)), (*e.shape, len(factors)))


@pytest.mark.parametrize(
    "factor, n, words",
    [
        (1.96**2, 2, "deviations stated at 95 % (1.96 sigma)"),
        (1.96**2, 3, "deviations stated at 95 % (1.96 sigma)"),
        (1.96**2, 1, "deviations stated at 95 % (1.96 sigma)"),
        (4.0, 2, "deviations of 2 sigma"),
        (4.0, 5, "deviations of 2 sigma"),
        (2.0 * np.log(2.0), 2, "a CEP in place of deviations (the radius of 50 % in the plane, 1.1774 sigma)"),
    ],
)
def test_a_ratio_of_a_usual_level_is_perhaps_that_level(factor, n, words, rng):
    (cause,) = judge(*sized(rng, [1.0 / factor] * n)).causes
    assert words in cause
    assert cause.startswith("perhaps")
    assert {3: "is 3.84 ", 4: "4 times", 1: "is 1.386 times"}[int(factor)] in cause


@pytest.mark.parametrize(
    "factors, runs",
    [
        ([1 / 2.5] * 2, 40),
        ([1 / 7.0] * 3, 40),
        ([1 / 1.386] * 3, 40),  # there is no radius of so many
        ([1 / 3.84] * 2, 8),  # too few to tell
        ([1 / 3.84, 1 / 2.5], 40),
        ([3.84] * 2, 40),
    ],
)
def test_other_ratios_are_no_level(factors, runs, rng):
    assert judge(*sized(rng, factors, runs)).causes == ()


def test_a_cause_that_is_known_leaves_no_perhaps(rng):
    e, P = sized(rng, [1 / 3.84] * 2)
    assert judge(changed(make_record("est", error=e, covariance=P), causes=("known",))).causes == ("known",)


# --- frames -----------------------------------------------------------------------------------------


def test_one_error_that_is_constant_over_a_log_is_no_reason_against_a_cause(rng):
    """One effective estimate, whose components differ by chance; with as many runs they would not."""
    sigma, w = np.repeat([1.0, 1e-3], 3), np.array([1.0, 0.05, 2.0, -0.1, 0.5, 1.5])
    right = world.run_of(rng, "spatial", "so3", np.tile(w * sigma, (60, 1)), np.tile(np.diag(sigma**2), (60, 1, 1)))
    swapped = world.reordered(SWAP)(right)
    (said,) = hints("est", SIX, [swapped])
    assert "other order (--covariance-order)" in said
    assert not fit(*[np.tile(w, (60, 1)) * sign for sign in rng.choice([-1.0, 1.0], 60)]).right(True)


def test_runs_are_independent_however_their_nees_spreads(rng):
    """Five constant errors whose P is of the body: each run alone says too little, and one of them nearly all."""
    runs, sigma = [], np.array([0.3, 0.03, 0.01])
    for size in (0.3, 0.3, 0.4, 0.4, 1.8):
        e = np.tile(size * sigma * [1.0, -1.0, 1.0], (90, 1))
        runs.append(world.run_of(rng, "planar", "left", e, np.tile(np.diag(sigma**2), (90, 1, 1))))
    turned = [p.with_values(convention="so2") for p in runs]
    (said,) = hints("est", THREE, turned)
    assert "the error is 'left'" in said
    assert hints("est", THREE, turned[:1]) == []


def test_the_likeliest_cause_is_named_whatever_its_size():
    """Of two that are both right, the one of the larger likelihood, though its NEES spreads more."""
    rng = np.random.default_rng(12)
    w = rng.normal(size=(400, 3))
    better, worse = fit(w * np.exp(rng.normal(size=(400, 1)))), fit(w, P=9.0 * np.eye(3))
    assert better.size < worse.size
    assert better.near() > worse.near()
    one, other = (Guess(text, lambda p: p) for text in ("one", "other"))
    declared = fit(30.0 * w * [1.0, 10.0, 0.1])
    assert str(readers_hints._cause([(other, worse), (one, better)], declared)).startswith("one")


@pytest.mark.parametrize("size", [30.0, 100.0, 300.0])
def test_a_truth_is_not_shrunk_into_errors_of_any_size(size, rng):
    """A path of some 10 m beside deviations of as many: the truth in mm would leave errors like the path."""
    sigma = np.array([size, 0.7 * size, 1.4 * size, 0.01, 0.02, 0.015])
    runs = world.log(rng, "spatial", 5, 100, 0.0, sigma=sigma, correlated=False)
    (said,) = hints("est", SIX, [world.deviations(p) for p in runs])
    assert "its diagonal holds standard deviations" in said


def test_a_bias_of_few_standard_deviations_explains_a_large_nees(rng):
    """3 sigma of one axis, growing with sigma, beside a covariance in which a sum is known 1,000 times better."""
    R = np.array([[1.0, 1.0 - 1e-6], [1.0 - 1e-6, 1.0]])
    grown = np.exp(0.5 * np.sin(np.linspace(0.0, 6.0, 400)))[:, None]
    e = (rng.normal(size=(400, 2)) @ np.linalg.cholesky(R).T + [3.0, 0.0]) * grown
    P = R * np.square(grown)[:, :, None]
    run = states(e, R).with_values(covariance=P)
    assert decades([run])[0] > 5.0
    assert hints("est", ("a", "b"), [run]) == []
    found, unbiased = fit_of([(e, P)]), fit_of([(e - [3.0, 0.0] * grown, P)])
    assert found is not None
    assert unbiased is not None
    assert found.simple() >= unbiased.likelihood


def test_one_number_for_all_variances_is_no_covariance_of_an_estimator(rng):
    sigma = np.repeat([0.3, 0.3 * np.pi / 180.0], 3)
    right = world.log(rng, "spatial", 20, 50, 0.0, sigma=sigma, correlated=False)
    runs = [world.degrees(p) for p in right]
    dummy = [p.with_values(covariance=np.broadcast_to(0.09 * np.eye(6), p.own.covariance.shape)) for p in runs]
    assert hints("est", SIX, dummy) == []
    sigma[0] *= 3.0
    right = world.log(rng, "spatial", 20, 50, 0.0, sigma=sigma, correlated=False)
    (said,) = hints("est", SIX, [world.degrees(p) for p in right])
    assert "its angles are in degrees" in said


def test_many_components_are_fitted_like_few(rng):
    """Each matrix by itself where they are large; one without a factor is left out, and the others stay."""
    n = SMALL + 5
    A = rng.normal(size=(4, n, n))
    P, e = A @ np.swapaxes(A, 1, 2), rng.normal(size=(4, n))
    P[1, 0, 1] = P[1, 1, 0] = 2.0 * np.sqrt(P[1, 0, 0] * P[1, 1, 1])
    found = fit_of([(e[:2], P[:2]), (e[2:], P[2:])])
    assert found is not None
    assert [len(w) for w in found.whitened] == [1, 2]
    nees = [float(e[k] @ np.linalg.solve(P[k], e[k])) for k in (0, 2, 3)]
    assert_allclose(np.square(found.w).sum(axis=1), nees, rtol=1e-6)
    log_det = np.mean([np.linalg.slogdet(P[k])[1] for k in (0, 2, 3)])
    assert found.likelihood == pytest.approx(-0.5 * (np.mean(nees) + log_det), rel=1e-9)
    many = [states(np.ones((1, 400)), np.eye(400))] * 40
    assert len(thinned(many)) == 20


def assert_named(causes, said):
    """One cause in these words, or none."""
    assert len(causes) == (said is not None)
    assert all(str(said) in cause for cause in causes)


# --- motions ----------------------------------------------------------------------------------------


def wheels(rng, steps=2000):
    """An archive of planar motions of two robots, with the true poses."""
    sigma = np.array([0.01, 0.004, 0.003])
    told = np.tile([0.15, 0.0, 0.02], (2, steps, 1)) + rng.normal(size=(2, steps, 3)) * [0.02, 0.001, 0.02]
    true = told + sigma * rng.normal(size=told.shape)
    start = np.zeros((2, 1, 3))
    poses = [vectors(composed(matrices(np.concatenate([start[0], one])))) for one in true]
    P = np.broadcast_to(np.diag(sigma**2), (2, steps + 1, 3, 3))
    return {"estimates": np.concatenate([start, told], axis=1), "truth": np.array(poses), "covariances": P}


@pytest.mark.parametrize(
    "key, mess, said",
    [
        ("covariances", lambda P: P, None),
        ("covariances", lambda P: P * np.outer(ANGLES, ANGLES), "its angles are in degrees"),
        ("covariances", lambda P: P[..., [1, 0, 2], :][..., [1, 0, 2]], "in the order y, x, heading"),
        ("estimates", lambda motions: motions * [1e3, 1e3, 1.0], "positions of the estimates are in millimetres"),
    ],
)
def test_mix_ups_of_motions_are_named(key, mess, said, tmp_path, rng):
    arrays = wheels(rng)
    np.savez(tmp_path / "wheels.npz", **arrays | {key: mess(arrays[key])})  # type: ignore[arg-type]
    record = read(tmp_path / "wheels.npz", relative=20, motions=True)
    assert_named(record.origin.causes, said)
    assert set(record.origin.causes) <= set(record.origin.notes)


def test_mix_ups_of_poses_with_cross_covariances_are_named(rng):
    """A walk whose steps are independent: E e_before e' is the covariance before; both have their rows in one order."""
    sigma = np.array([0.02, 0.05, 0.001])
    pose = np.column_stack([np.arange(400) * 0.4, np.zeros(400), np.zeros(400)])
    e = np.cumsum(rng.normal(size=(400, 3)) * sigma, axis=0)
    P = np.arange(1, 401)[:, None, None] * np.diag(sigma**2)
    before = np.concatenate([np.zeros((1, 3, 3)), P[:-1]])
    order = [2, 0, 1]

    def causes(some):
        P_, C = (M[:, some][:, :, some] for M in (P, before))
        t = np.arange(400.0)
        place = Places("line {}".format, np.arange(400))
        track = make_poses(place, t, pose, P_, np.ones(400, bool), t, pose + e, "planar", "so2", 0.0, cross=C)
        return causes_of_motions("est", [track], THREE, range(3), Relative(1.0, "step"))

    assert causes([0, 1, 2]) == []
    (said,) = causes(order)
    assert "in the order heading, x, y" in said


# --- roots, innovations ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "root, said",
    [
        (lambda P: np.linalg.cholesky(P), "it holds the lower root L of the covariance; write L L'"),
        (lambda P: np.linalg.cholesky(np.linalg.inv(P)), "it holds the upper root U of an information matrix U'U"),
        (lambda P: np.swapaxes(np.linalg.cholesky(np.linalg.inv(P)), 1, 2), "the upper root U of an information"),
        (lambda P: np.triu(P), None),
    ],
)
def test_one_triangle_of_36_numbers_is_read(root, said, tmp_path, rng):
    """The upper or lower triangle of a covariance, or of a root, whose mirrored matrix may be no covariance at all."""
    (p,) = world.log(rng, "spatial", 1, 400, 0.0, sigma=np.repeat([0.1, 0.01], 3))
    M = root(p.own.covariance).reshape(400, 36)
    np.savetxt(tmp_path / "est.txt", np.column_stack([p.own.t, p.own.estimate, M]), fmt="%.15g")
    np.savetxt(tmp_path / "truth.txt", np.column_stack([p.own.t, p.true.values]), fmt="%.15g")
    record = read(tmp_path / "est.txt", tmp_path / "truth.txt")
    assert_named(record.origin.causes, said)


def test_a_matrix_with_two_triangles_that_differ_is_still_refused():
    both, upper = np.array([[[1.0, 0.2], [0.4, 1.0]]]), np.array([[[1.0, 0.4], [0.0, 2.0]]])
    with pytest.raises(InputError, match="line 3: the covariance is not symmetric"):
        symmetric(both, lambda row: f"line {row + 3}")
    assert_array_equal(symmetric(upper, str, one_triangle=True), [[[1.0, 0.4], [0.4, 2.0]]])
    with pytest.raises(InputError, match="not symmetric"):
        symmetric(np.concatenate([upper, np.eye(2)[None]]), str, one_triangle=True)


def gated(nis):
    """Without the largest 5 % of two components."""
    return np.where(nis > 5.99, np.nan, nis)


@pytest.mark.parametrize("optimal", [True, False])
@pytest.mark.parametrize(
    "nis_of, said",
    [
        (lambda v: np.square(v[..., :2]).sum(axis=-1), None),
        (lambda v: np.square(v).sum(axis=-1), "like chi-square with 3 degrees of freedom, not 2 as stated"),
        (lambda v: np.square(v[..., 0]), "like chi-square with 1 degrees of freedom, not 2 as stated"),
        (lambda v: 0.25 * np.square(v[..., :2]).sum(axis=-1), "are the innovations residuals after the update"),
        (lambda v: 1.5 * np.square(v[..., :2]).sum(axis=-1), None),  # a wrong R
        (lambda v: gated(np.square(v[..., :2]).sum(axis=-1)), None),
    ],
)
def test_causes_of_innovations(nis_of, said, optimal, rng):
    """A filter of right errors in 2,400 steps; neither a wrong R nor a gate that rejects 5 % is named."""
    e, v = rng.normal(size=(40, 60, 2)), rng.normal(size=(40, 60, 3))
    P, dof = np.broadcast_to(np.eye(2), (40, 60, 2, 2)), np.full((40, 60), 2.0)
    record = make_record("est", error=e, covariance=P, nis=nis_of(v), nis_dof=dof, optimal_gain=optimal)
    verdict = judge(record)
    assert_named(verdict.causes, said)
    assert set(verdict.causes) <= set(verdict.reasons)
    wrong = changed(record, error=3.0 * e)
    assert not any("after the update" in cause for cause in judge(wrong).causes)


@pytest.mark.parametrize("angle", [-2.0, 0.3])
def test_the_frame_is_found(angle, rng):
    for make, shift in ((spatial, FAR), (planar, FAR[:2])):
        runs = make(rng)
        for p in runs:
            p.true.values[:, : len(shift)] = p.own.estimate[:, : len(shift)]
        frame = WorldTransform.about_z(angle, shift)
        found = fitted_frame([moved(p, frame) for p in runs])
        assert found.heading == pytest.approx(-angle, abs=1e-9)
        back = moved(moved(runs[0], frame), found)
        assert_allclose(back.own.estimate[:, : len(shift)], runs[0].own.estimate[:, : len(shift)], atol=1e-9)
        assert not any("world" in note for note in hints("est", SIX if len(shift) == 3 else THREE, runs))


OF_POSES = [("planar", error) for error in ("so2", "left", "right")]
OF_POSES += [("spatial", error) for error in ("so3", "so3-body", "left", "right")]


@pytest.mark.parametrize("kind, convention", OF_POSES)
def test_the_nees_is_the_same_in_another_world_and_of_another_body(kind, convention, rng):
    """Errors of 1e-5, since covariances are carried over to first order."""
    n = len(world.AXES[kind])
    (p,) = world.log(rng, kind, 1, 20, 0.0, sigma=np.full(n, 1e-5), convention=convention)
    within = np.array([1.0, 1.0, kind == "spatial"])
    turn = Rotation.from_rotvec([0.2, -0.5, 0.9] if kind == "spatial" else [0.0, 0.0, 0.9])
    truth = p.with_values(estimate=p.true.values)
    for change in (
        lambda p: moved(p, WorldTransform(turn, FAR * within)),
        lambda p: on_body(p, BodyTransform(turn, ARM * within)),
    ):
        there = change(p).with_values(truth=change(truth).own.estimate)
        assert_allclose(nees_of(there), nees_of(p), rtol=1e-3)


def nees_of(p):
    return fit_of([(p.errors(), p.own.covariance)]).nees


def test_no_runs_have_no_frame_and_no_body():
    assert fitted_frame([]) is None
    assert fitted_body([]) is None


# --- files ------------------------------------------------------------------------------------------


def trials(rng, runs=20, steps=40):
    """Truth and estimates (runs, steps, 3) of planar poses that turn past pi, and right covariances."""
    sigma = np.array([0.2, 0.3, 0.02])
    truth = np.cumsum(rng.normal(size=(runs, steps, 3)) * [0.1, 0.1, 0.2], axis=1) + np.array([0, 0, 3.0])
    return truth, truth - sigma * rng.normal(size=truth.shape), np.broadcast_to(np.diag(sigma**2), (*truth.shape, 3))


def write_steps(path, pose, P):
    """A table with runs and steps, and no times."""
    pairs = [("xx", 0, 0), ("xy", 0, 1), ("xh", 0, 2), ("yy", 1, 1), ("yh", 1, 2), ("hh", 2, 2)]
    lines = ["run,step,x,y,heading," + ",".join(f"P_{name}" for name, *_ in pairs)]
    for run, step in np.ndindex(pose.shape[:2]):
        numbers = [*pose[run, step], *(P[run, step, i, j] for _, i, j in pairs)]
        lines.append(f"{run},{step + 1}," + ",".join(f"{value:.12g}" for value in numbers))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda pose, P: (pose, P), None),
        (
            lambda pose, P: (pose * [1, 1, DEGREES], P),
            "the headings of the estimates are in degrees; multiply them by pi / 180",
        ),
        (
            lambda pose, P: (pose * [1e3, 1e3, 1], P),
            "the positions of the estimates are in millimetres; divide them by 1000",
        ),
        (lambda pose, P: (pose, np.linalg.inv(P)), "it is an information matrix; invert it"),
    ],
)
def test_files_that_know_steps_and_no_times_get_hints(change, said, tmp_path, rng):
    truth, right, P = trials(rng)
    estimates, stated = change(right, P)
    write_steps(tmp_path / "truth.csv", truth, P)
    write_steps(tmp_path / "est.csv", estimates, stated)
    np.savez(tmp_path / "est.npz", truth=truth, estimates=estimates, covariances=stated)
    (table,) = read_recordings(tmp_path / "est.csv", tmp_path / "truth.csv")
    (archive,) = read_recordings(tmp_path / "est.npz", error="so2")
    for record in (table, archive):
        hints_given = [note for note in record.origin.notes if "about right if" in note]
        assert [note.partition("about right if ")[2] for note in hints_given] == ([] if said is None else [said])


def test_errors_alone_get_the_hints_of_covariances(tmp_path, rng):
    truth, estimates, P = trials(rng)
    np.savez(tmp_path / "errors.npz", errors=truth - estimates, covariances=np.linalg.inv(P))
    (record,) = read_recordings(tmp_path / "errors.npz")
    assert any(note.endswith("it is an information matrix; invert it") for note in record.origin.notes)


@pytest.mark.parametrize("wrapped", [True, False])
def test_an_angle_whose_errors_jump_by_a_turn_is_named(wrapped, tmp_path, rng):
    truth, estimates, P = trials(rng)
    if wrapped:
        truth, estimates = (np.dstack([pose[..., :2], wrap(pose[..., 2])]) for pose in (truth, estimates))
    np.savez(tmp_path / "poses.npz", truth=truth, estimates=estimates, covariances=P)
    np.savez(tmp_path / "errors.npz", errors=truth - estimates, covariances=P, axes=["x", "y", "yaw"])
    jumps = int((np.abs(truth - estimates)[..., 2] > np.pi).sum())
    for name, axis, remedy in (
        ("poses", "axis 2", "add --error so2, if these are x, y, heading"),
        ("errors", "yaw", "wrap it to [-pi, pi]"),
    ):
        (record,) = read_recordings(tmp_path / f"{name}.npz")
        said = f"{name}: the error of {axis} is off by 2 pi in {jumps} of 800 steps, as that of an angle; {remedy}"
        assert [note for note in record.origin.notes if "2 pi" in note] == ([said] if wrapped else [])
    assert jumps == 0 or wrapped
    assert jumps > 2 or not wrapped
    (judged,) = read_recordings(tmp_path / "poses.npz", error="so2")
    assert "2 pi" not in notes_of(judged)


def test_errors_that_are_far_off_by_themselves_are_no_angle(rng):
    error = 6.0 + 0.3 * rng.normal(size=(10, 40, 1))
    assert turns("name", ["e1"], error, np.full((10, 40, 1, 1), 0.01**2), "wrap it") == []
    assert turns("name", ["e1"], error, np.full((10, 40, 1, 1), 0.5**2), "wrap it") == []


def test_steps_are_no_clock(tmp_path, rng):
    truth, estimates, P = trials(rng)
    along = np.arange(40)[:, None] * [2.0, 1.0, 0.0]
    write_steps(tmp_path / "truth.csv", truth + along, P)
    write_steps(tmp_path / "late.csv", np.roll(estimates + along, 1, axis=1)[:, 1:], P[:, 1:])
    (record,) = read_recordings(tmp_path / "late.csv", tmp_path / "truth.csv")
    notes = [note.replace(str(tmp_path), "") for note in record.origin.notes]
    assert not any("offset" in note or "clock" in note for note in notes), notes
