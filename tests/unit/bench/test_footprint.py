"""How much memory a trial takes, how much there is, and what is done where the one exceeds the other."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import consistency as cs
from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.covariance_update.local import Local as Locally
from consistency.bench.filters.covariance_update.parking import Parking
from consistency.bench.filters.kernel.part_functions import Data, Slam, make_factors, make_local
from consistency.bench.runs import memory_needed as module
from consistency.bench.runs.backends.local import LocalThreads
from consistency.bench.runs.isolation.filter_process import Isolation
from consistency.bench.runs.memory_needed import footprint, memory_here, trial_bytes, workers_that_fit
from consistency.bench.runs.trial_work import Recorded, TrialWork
from consistency.referee.errors import InputError

GIB = 2**30


def compiled(name: str) -> Compiled:
    filter_ = cs.get_filter(name)
    assert isinstance(filter_, Compiled)
    return filter_


@pytest.fixture
def has(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Let the machine have so many bytes."""
    return lambda size: monkeypatch.setattr(module, "memory_here", lambda: int(size))


def test_the_covariance_counts_as_the_kernel_makes_it(linear: cs.Scenario) -> None:
    filter_, trial = compiled("kf"), cs.simulate(linear)
    _, _, size = filter_._arguments(trial, linear.belief)
    seen = len(set(trial.landmark))
    assert size == 3 + 3 * seen
    covariance = 8 * size**2
    whole = footprint(filter_, trial, linear.belief)
    assert whole.joint == 8 * (3 + 3 * seen) ** 2
    assert whole.scoring == 3 * whole.joint, "a copy, the factor and LAPACK's copy"
    assert whole.working > covariance + whole.joint
    assert whole.working < 2.0 * (covariance + whole.joint) + 300_000


def test_a_trial_fills_its_covariance_and_outcome(
    linear: cs.Scenario, parts: Slam, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 18 variables and one spare one; 5 steps of pose, its two covariances, NIS; 12 numbers of 7 landmarks."""
    monkeypatch.setattr(module, "touched", lambda slam, data, size, spare: 1000 * size + spare)
    monkeypatch.setattr(module, "spare_width", lambda covariance, steps, labels: 1)
    data = seen([[0, 6], [], [], [], [1]])
    assert module._working(parts, data, 18) == 18_001 + 8 * (19**2 + 5 * (3 + 2 * 9 + 3) + 12 * 7)


def test_maps_of_filters_before_are_held(linear: cs.Scenario) -> None:
    trial, filter_ = cs.simulate(linear), compiled("kf")
    one = footprint(filter_, trial, linear.belief)
    two = trial_bytes([filter_, filter_], trial, linear.belief)
    arrays = trial_bytes([], trial, linear.belief)
    assert two == arrays + max(2 * one.joint + one.scoring, one.joint + one.working)


def test_workers_that_have_room(
    linear: cs.Scenario, has: Callable[[float], None], capsys: pytest.CaptureFixture[str]
) -> None:
    trial, filters = cs.simulate(linear), [compiled("kf")]
    needed = trial_bytes(filters, trial, linear.belief)
    has(20 * needed)
    assert workers_that_fit(filters, [trial], linear.belief, 8) == 8
    assert capsys.readouterr().err == ""
    has(3.5 * needed)
    assert workers_that_fit(filters, [trial], linear.belief, 8) == 3
    assert "takes about 0.0 GiB of 0.0 GiB; 3 of 8 workers have room" in capsys.readouterr().err
    has(needed)
    assert workers_that_fit(filters, [trial], linear.belief, 8) == 1
    has(needed - 1)
    with pytest.raises(InputError, match=r"about 0\.0 GiB, and there are 0\.0 GiB; take fewer landmarks or steps"):
        workers_that_fit(filters, [trial], linear.belief, 8)


def test_all_runs_of_a_log_are_looked_at(linear: cs.Scenario, has: Callable[[float], None]) -> None:
    filters = [compiled("kf")]
    wide = linear.variant("wide", truth__sensor__range=(0.0, 50.0), truth__steps=5)
    small, large = cs.simulate(linear.variant("short", truth__steps=2)), cs.simulate(wide, 1)
    work = TrialWork(Recorded({0: small, 1: large}), Isolation(filters, linear.belief))
    has(2 * trial_bytes(filters, large, linear.belief))
    assert work.room_for(0, 8) == 2
    has(trial_bytes(filters, small, linear.belief))
    with pytest.raises(InputError, match="fewer landmarks"):
        LocalThreads().prepare(work, 0)


def test_jobs_that_were_asked_for_are_not_made_fewer(
    linear: cs.Scenario, has: Callable[[float], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(TrialWork, "compile", lambda *_: None)
    monkeypatch.setattr("joblib.cpu_count", lambda: 8)
    trial, filters = cs.simulate(linear), [compiled("kf")]
    has(2.5 * trial_bytes(filters, trial, linear.belief))
    for jobs, workers in ((-1, 2), (4, 4)):
        local = LocalThreads(jobs)
        local.prepare(TrialWork(Recorded({0: trial}), Isolation(filters, linear.belief)), 0)
        assert local._room == workers


def test_limits_of_control_groups(tmp_path: Path) -> None:
    groups, proc = tmp_path / "groups", tmp_path / "cgroup"
    (groups / "a" / "b").mkdir(parents=True)
    (groups / "a" / "memory.max").write_text("3000\n")
    (groups / "a" / "b" / "memory.max").write_text("max\n")
    proc.write_text("0::/a/b\n")
    assert module._of_groups(proc, groups) == [3000]
    (groups / "memory" / "c").mkdir(parents=True)
    (groups / "memory" / "c" / "memory.limit_in_bytes").write_text("2000\n")
    (groups / "memory" / "memory.limit_in_bytes").write_text("9000\n")
    proc.write_text("5:cpu:/c\n4:memory:/c\n")
    assert module._of_groups(proc, groups) == [2000, 9000]
    assert module._of_groups(tmp_path / "none", groups) == []


def test_what_ulimit_leaves_counts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    assert 0 < memory_here() < 2**60
    status = tmp_path / "status"
    status.write_text("VmPeak:\t 9999 kB\nVmSize:\t 3000 kB\nVmData:\t 2000 kB\n")
    assert [module._taken(name, status) for name in ("VmSize", "VmData", "none")] == [3072000, 2048000, 0]
    assert module._taken("VmSize", tmp_path / "absent") == 0
    monkeypatch.setattr(module, "_taken", lambda name: {"VmSize": 1000, "VmData": 500}[name])
    for own in (resource.RLIMIT_AS, resource.RLIMIT_DATA):
        monkeypatch.setattr(resource, "getrlimit", lambda kind, own=own: (GIB // 8 if kind == own else -1, -1))
        assert memory_here() == GIB // 8 - (1000 if own == resource.RLIMIT_AS else 500)
    monkeypatch.setattr(module, "_taken", lambda name: GIB)
    assert memory_here() == 0


def seen(steps: list[list[int]]) -> Data:
    """A trial in which these landmarks are observed."""
    first, landmark = np.cumsum([0, *map(len, steps)]), np.array([label for step in steps for label in step], int)
    M, most = len(landmark), 1 + max(landmark)
    return Data(
        np.zeros((len(steps), 3)), first, landmark, np.zeros((M, 3)), np.zeros((M, 3, 3)), np.zeros(M), np.zeros(3),
        most, np.zeros(1, int),
    )  # fmt: skip


@pytest.fixture
def parts(linear: cs.Scenario) -> Slam:
    """Of a filter without local updating."""
    return compiled("kf")._arguments(cs.simulate(linear), linear.belief)[0]


def test_rows_are_touched_for_what_is_known(parts: Slam) -> None:
    data = seen([[0, 1, 2], [1], [0, 2, 3, 4], [0, 1, 2]])
    reach = module._reach(parts, data, 3, 18, module._tally(parts, 3, 18))
    assert reach == (3, 3, 18, 12 * 18, 0, 0), "in the last step, with three of the five that are known"
    S, rows = module.half(9), 12 * 18
    assert module.touched(parts, data, 18, 0) == 8 * (S + 2 * rows)
    assert module.touched(parts, seen([[0, 1, 2], [3, 4]]), 18, 0) == 0, "nothing known is seen"


def test_half_a_matrix_is_whole_pages() -> None:
    assert module.half(9) == 81
    assert module.half(512) == 512**2
    assert module.half(5120) == 5120 * (5120 + 512) // 2


def test_a_local_base_grows_until_it_is_due(parts: Slam) -> None:
    slam = parts._replace(covariance=Locally(60))
    every = list(range(40))
    data = seen([every, [0, 1], [2, 1], [2, 3], [3, 40]])
    local = module._tally(slam, 3, 126)
    assert len(local.x) == len(make_local(slam.covariance, 3, 126, 5, 41).x)
    reach = module._reach(slam, data, 3, 126, local)
    assert (reach.base, reach.active) == (15, 15), "the robot and four landmarks; what is new is active after the step"
    assert reach.width == 30
    a, b = reach.active, reach.base
    numbers = module.half(6) + 2 * 9 * 30 + a * a + a * b + module.half(b) + (a + b) * 126
    assert module.touched(slam, data, 126, 0) == 8 * numbers
    dense = seen([every, every, every])
    assert module._reach(slam, dense, 3, 123, module._tally(slam, 3, 123)).base == 0


def test_parked_landmarks_are_left_alone() -> None:
    parking = Parking(every=5, unseen=3, doubt=0.1, adrift=1.0, whole=False, patience=True, start=60)
    data = seen([list(range(40)), *[[0, 1, 2]] * 12, [5, 0]])
    factors = make_factors(63, 126, 42)
    reach = module._parked(parking, data, 126, factors)
    assert (reach.seen, reach.back, reach.base) == (3, 1, 12)
    assert reach.width == 3 + 3 * 40 + 3, "all of it, with a clone, before the others are parked"
    again = module._parked(parking, seen([list(range(40)), *[[0, 1, 2]] * 12, [5, 6, 7, 8, 0]]), 126, factors)
    assert (again.seen, again.back, again.cells) == (5, 4, 12 * 126), "the active part and its base are narrow"
    often = seen([list(range(40)), *[[0, 1]] * 3, [0, 2]])
    assert [module._parked(parking._replace(unseen=n), often, 126, factors).back for n in (1, 2, 3)] == [1, 1, 0]
    still = module._parked(parking._replace(every=0), data, 126, factors)
    assert (still.back, still.base, still.width) == (0, 0, 123)


def test_arrays_that_cannot_be_made_count_by_the_square(parts: Slam, monkeypatch: pytest.MonkeyPatch) -> None:
    def watch(guard: object, s: int, m: int, rows: int, n_landmarks: int) -> list[np.ndarray]:
        if m > 10:
            raise MemoryError
        return [np.zeros((m, m))]

    monkeypatch.setattr(module, "make_watch", watch)
    data = seen([list(range(40))])
    assert module.touched(parts, data, 123, 0) == 16 * 8 * 100
