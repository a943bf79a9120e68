"""Guards: their decisions against brute force and literal updates, and kernels against the plain form over trials."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from estimates import apart
from mismatch import corrupted
from scipy import stats

import consistency as cs
from consistency.bench.filters import compiled_guard as kernel_guard
from consistency.bench.filters import guard as plain_guard
from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.compiled_guard import guard_part, keep_agreeing
from consistency.bench.filters.compiler.jit import Kernel
from consistency.bench.filters.filter_inputs import problem_of
from consistency.bench.filters.guard import kept_observations, limits_of
from consistency.bench.filters.kernel import loop
from consistency.bench.filters.kernel.part_functions import make_guard_arrays
from consistency.bench.filters.run_filter import step_through
from consistency.bench.scenario import GuardSettings
from consistency.bench.types import GUARDS, Observation

SETTINGS = GuardSettings(confidence=0.95, threshold=1.5)


class Step:
    """A linear step: m landmarks with s values each of a state that is common to them, some observations far off."""

    def __init__(self, rng, m, s):
        n = 3 + s * m
        self.m, self.s, self.P = m, s, np.diag(rng.uniform(0.1, 1.0, n))
        self.H = np.hstack([rng.normal(size=(s * m, 3)) * 3.0, np.eye(s * m)])
        self.R = np.diag(rng.uniform(0.5, 2.0, s * m))
        self.S = self.H @ self.P @ self.H.T + self.R
        self.y = np.linalg.cholesky(self.S) @ rng.normal(size=s * m)
        self.y += np.repeat(rng.random(m) < 0.4, s) * rng.normal(size=s * m) * 6.0

    def rows(self, which):
        return np.concatenate([np.arange(self.s * i, self.s * i + self.s) for i in which]).astype(int)

    def after(self, which):
        """Innovation and S of all after an update with some, by the Kalman filter's equations."""
        rows = self.rows(which)
        H, S = self.H[rows], self.S[np.ix_(rows, rows)]
        K = self.P @ H.T @ np.linalg.inv(S)
        P = self.P - K @ S @ K.T
        return self.y - self.H @ (K @ self.y[rows]), self.H @ P @ self.H.T + self.R

    def far(self, which, y, S):
        rows = self.rows(which)
        return float(y[rows] @ np.linalg.inv(S[np.ix_(rows, rows)]) @ y[rows])

    def passes(self, which, y, S):
        return stats.chi2.cdf(self.far(which, y, S), self.s * len(which)) <= SETTINGS.confidence


def by_gate(step):
    return [i for i in range(step.m) if step.passes([i], step.y, step.S)]


def by_subsets(step):
    for size in range(len(by_gate(step)), 0, -1):
        sets = [c for c in itertools.combinations(by_gate(step), size) if step.passes(c, step.y, step.S)]
        if sets:
            return sorted(min(sets, key=lambda c: step.far(c, step.y, step.S)))
    return []


def by_updates(step):
    candidates = by_gate(step)
    support = {
        i: [j for j in candidates if j == i or step.far([j], *step.after([i])) <= SETTINGS.threshold**2]
        for i in candidates
    }
    if not candidates:
        return []
    best = max(candidates, key=lambda i: (len(support[i]), -step.far([i], step.y, step.S)))
    after = step.after(support[best])
    rest = [j for j in candidates if j not in support[best]]
    return sorted(support[best] + [j for j in rest if step.passes([j], *after)])


ORACLES = {"gate": by_gate, "joint": by_subsets, "ransac": by_updates}


def by_kernel(kind, step):
    guard = guard_part(kind, SETTINGS, step.s, step.m)
    watch = make_guard_arrays(guard, step.s, step.m, step.m, step.m)
    assert keep_agreeing(guard, step.s, step.m, step.y, np.triu(step.S), watch)  # the upper half alone
    return np.array(watch.kept)


@pytest.mark.parametrize("kind", GUARDS)
def test_decisions_are_those_of_the_definitions(kind, rng):
    sizes = set()
    for _ in range(150):
        step = Step(rng, int(rng.integers(1, 7)), int(rng.integers(2, 4)))
        expected = ORACLES[kind](step)
        limits = limits_of(SETTINGS, step.s, step.m)
        assert np.flatnonzero(kept_observations(kind, step.y, step.S, step.s, limits)).tolist() == expected
        assert np.flatnonzero(by_kernel(kind, step)).tolist() == expected
        sizes.add(step.m - len(expected))
    assert {0, 1, 2} <= sizes  # cases in which something happened


@pytest.mark.parametrize("nodes", [1, 3, 7, 20])
def test_a_search_that_is_cut_short_is_so_at_the_same_node(nodes, rng, monkeypatch):
    for module in (plain_guard, kernel_guard):
        monkeypatch.setattr(module, "MOST_NODES", nodes)
    for _ in range(40):
        step = Step(rng, 6, 3)
        plain = kept_observations("joint", step.y, step.S, 3, limits_of(SETTINGS, 3, 6))
        assert plain.tolist() == by_kernel("joint", step).tolist()


def test_a_covariance_that_is_not_definite_ends_the_run(rng):
    step = Step(rng, 2, 3)
    step.S[2, 2] = -1.0
    guard = guard_part("gate", SETTINGS, 3, 2)
    watch = make_guard_arrays(guard, 3, 2, 2, 2)
    assert not keep_agreeing(guard, 3, 2, step.y, step.S, watch)
    with pytest.raises(np.linalg.LinAlgError):
        kept_observations("gate", step.y, step.S, 3, limits_of(SETTINGS, 3, 2))


# --- kernels -----------------------------------------------------------------------------------------

STEPS = 100  # of the trials that Python runs
TRACKS = {"min_age": 2, "forget_after": 2}
COMPILED = [("ukf-uvd+ransac", "herath2007-stereo"), ("ekf-xy+joint", "esde-xy")]
INTERPRETED = [
    ("ekf-uvd+gate", "herath2007-stereo"), ("ekf-uvd+joint", "herath2007-stereo"),
    ("ekf-uvd+ransac", "herath2007-stereo"), ("parked-ekf-uvd+gate", "herath2007-stereo"),
    ("parked-ekf-uvd+joint", "herath2007-stereo"), ("parked-ekf-uvd+ransac", "herath2007-stereo"),
    ("robocentric-ekf-uvd+gate", "herath2007-stereo"), ("iekf-uvd+gate", "herath2007-stereo"),
    ("ispkf-uvd+gate", "herath2007-stereo"), ("eqf-uvd+gate", "herath2007-stereo"),
    ("ri-ekf-uvd+joint", "herath2007-stereo"), ("fej-ekf-uvd+gate", "herath2007-stereo"),
    ("oc-ekf-uvd+gate", "herath2007-stereo"), ("ideal-ekf-uvd+gate", "herath2007-stereo"),
    ("anchored-ekf-uvd+gate", "herath2007-stereo"), ("debiased-ekf-xyz+gate", "herath2007-stereo"),
    ("ekf-xyz+gate", "herath2007-xyz"), ("kf+gate", "linear-gaussian"), ("ekf-rb+gate", "range-bearing"),
]  # fmt: skip


def first_sightings(trial):
    """Row of the first observation of each landmark."""
    return np.unique(trial.landmark, return_index=True)[1]


def agree(name, scenario, rng):
    trial, filter_ = corrupted(cs.simulate(scenario, run=2), rng), cs.get_filter(name)
    wrong = np.concatenate([2.0 * trial.z[:1], trial.z[1:]])  # a landmark begins anew with the first row of all, too
    trial = replace(trial, z=wrong)
    ours, twin = filter_.run(trial, scenario.belief), step_through(filter_.textbook, trial, scenario.belief)
    assert ours.filter == twin.filter == name
    assert ours.rejected.tolist() == twin.rejected.tolist()
    assert (ours.rejected & trial.spurious).any()
    assert ours.rejected[first_sightings(trial)].any()  # of landmarks that began anew
    assert apart(ours, twin) < 1e-7  # rounding, which what is wrong and accepted amplifies; 2e-8 on one processor
    assert ours.nis_dof.tolist() == twin.nis_dof.tolist()
    assert ours.map.landmarks.tolist() == twin.map.landmarks.tolist()
    assert apart(filter_.run(cs.simulate(scenario, run=2), scenario.belief), twin) > 1e-6  # negative control


@pytest.fixture
def no_local_updating(monkeypatch):
    """Kernels that compile sooner; whether guards go with local updating has tests of its own."""
    monkeypatch.setattr(Compiled, "local_from", 10**9)


@pytest.fixture
def interpreted(monkeypatch):
    """Kernels as Python runs them; guards meet all filters in one place, which is compiled in other tests."""
    for name, stand_in in {"by_reference": lambda record: record, "keep": lambda _: None}.items():
        monkeypatch.setattr(loop, name, stand_in)
    monkeypatch.setattr(Kernel, "__call__", lambda kernel, *args: kernel.function(*args))


def of_tracks(scenario):
    """The world with rules on tracks in the belief."""
    return scenario.variant("tracks", belief__guard=TRACKS)


@pytest.mark.usefixtures("no_local_updating")
@pytest.mark.parametrize("name, world", COMPILED)
def test_a_guarded_kernel_is_the_guarded_twin(small, name, world, rng):
    agree(name, small(world, truth__steps=200), rng)
    agree(name, of_tracks(small(world, truth__steps=200)), rng)


@pytest.mark.usefixtures("no_local_updating", "interpreted")
@pytest.mark.parametrize("name, world", INTERPRETED)
def test_what_is_compiled_of_a_guarded_filter_is_its_guarded_twin(small, name, world, rng):
    agree(name, of_tracks(small(world, truth__steps=STEPS)), rng)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ekf-uvd+gate", "parked-ekf-uvd+gate"])
def test_a_guarded_kernel_is_its_twin_while_it_updates_locally(small, name, rng):
    agree(name, small("herath2007-stereo", truth__steps=500), rng)


AGAIN = {33: (483, 484), 42: (495, 496), 30: (48, 52)}  # steps, from 0, of the second sighting and of those after it


@pytest.mark.parametrize("name", ["parked-ekf-uvd+gate", "ekf-uvd+gate"])
def test_a_landmark_that_was_parked_begins_anew(small, name):
    """Seen once, wrongly, and again when the loop closes: nothing of it is left, neither its clone nor its place.

    One is seen again shortly before landmarks are parked, and stays in use.
    """
    scenario = small("herath2007-stereo", truth__steps=500)
    whole = cs.simulate(scenario, run=2)
    step = whole.step - 1
    keep, z = np.ones(len(step), bool), whole.z.copy()
    for label, again in AGAIN.items():
        sighted = np.flatnonzero(whole.landmark == label)
        hidden = (step[sighted] < again[0]) | ((step[sighted] > again[0]) & (step[sighted] < again[1]))
        assert step[sighted].tolist().count(again[0]) == 1
        z[sighted[0], 2] *= 3.0
        keep[sighted[1:]] = ~hidden[1:]
    first = np.append(0, np.cumsum(np.bincount(step[keep], minlength=whole.steps)))
    trial = replace(whole, first=first, landmark=whole.landmark[keep], z=z[keep])
    filter_ = cs.get_filter(name)
    ours, twin = filter_.run(trial, scenario.belief), step_through(filter_.textbook, trial, scenario.belief)
    wrong = first_sightings(trial)[np.isin(np.unique(trial.landmark), [*AGAIN])]
    assert ours.rejected[wrong].all()
    assert ours.rejected.tolist() == twin.rejected.tolist()
    assert apart(ours, twin) < 1e-8
    for label in AGAIN:  # where they are: 1e-9 of a chi-square with 3 degrees of freedom lies beyond 45
        at = ours.map.landmarks.tolist().index(label)
        gap = ours.map.mean[at] - trial.landmarks[label]
        assert gap @ np.linalg.solve(ours.map.covariance[at], gap) < 45


def test_a_parked_landmark_that_is_forgotten_takes_its_clone_along(small):
    scenario = small("herath2007-stereo", truth__steps=120)
    trial = cs.simulate(scenario, run=2)
    twin = cs.get_filter("parked-ekf-uvd").textbook
    state = twin.init(problem_of(trial, scenario.belief))
    for step in range(1, 121):
        seen = trial.observation(step)
        one = seen.landmarks == trial.landmark[0]
        state = twin.predict(state, trial.control(step))
        state, _ = twin.update(state, Observation(seen.landmarks[one], seen.z[one]))
    label = int(trial.landmark[0])
    assert state.parked
    assert len(state.x) == 9
    state = twin.forget(state, label)
    assert (len(state.x), state.P.shape, state.clones, state.places, state.parked) == (3, (3, 3), {}, {}, {})
