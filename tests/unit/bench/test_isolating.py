"""Whatever a filter does to its process, its run is a result, and the filter beside it has its bits."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import closing
from dataclasses import replace
from typing import Any

import cloudpickle
import numpy as np
import pandas as pd
import pytest
from misbehaving import KINDS, MEMORY, STEP, TIME_OUT, Still, answers, forks, is_gone, raises
from numpy.testing import assert_array_equal
from threadpoolctl import threadpool_info

import consistency as cs
from consistency.bench.filters.run_filter import run_filter
from consistency.bench.runs import isolation as filter_process
from consistency.bench.runs.isolation import Isolation
from consistency.bench.runs.outcomes_to_results import Gathered, Interrupted
from consistency.bench.runs.run_outcome import outcome_of
from consistency.bench.store.journal import IN_MEMORY, Journal

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="signals, and limits of memory")
cloudpickle.register_pickle_by_value(sys.modules[__name__])  # no process of a filter imports all of this, for seconds

RUNS, DOOMED = 3, 1  # of the runs the one that misbehaves
LONG = 60.0  # s, a time-out that is not expected


@pytest.fixture(scope="module")
def world():
    return cs.load_scenario("herath2007-xyz").variant("short", truth__steps=12)


@pytest.fixture(scope="module")
def doomed(world):
    return cs.simulate(world, DOOMED).control(1)


@pytest.fixture(scope="module")
def calm(world):
    return cs.run_trials(world, [Still("calm"), "ekf-xyz"], runs=RUNS, jobs=1).estimates


def rows(estimates, *names):
    return estimates[estimates["filter"].isin(names)].reset_index(drop=True)


@pytest.mark.parametrize("kind", KINDS)
def test_a_filter_that_misbehaves_is_contained(kind, world, doomed, calm):
    """One failed run with its step and reason; all other rows as they are without it, to the bit."""
    act, reason = KINDS[kind]
    filters = [Still("bad", act, doomed), Still("calm"), "ekf-xyz"]
    timeout = 1.0 if reason == TIME_OUT else LONG
    results = cs.run_trials(world, filters, runs=RUNS, jobs=1, timeout=timeout, memory=MEMORY)
    ends = reason == TIME_OUT or reason.startswith("its process")
    step = 1 if ends else STEP  # what a process that ends has said is lost with it
    assert results.failures[["filter", "run", "step"]].to_numpy().tolist() == [["bad", DOOMED, step]]
    assert results.failures["reason"][0].startswith(reason)
    assert len(results.failures["reason"][0]) < len(reason) + 100
    pd.testing.assert_frame_equal(rows(results.estimates, "calm", "ekf-xyz"), calm, check_exact=True)
    expected = rows(calm, "calm").assign(filter="bad")
    expected = expected[(expected["run"] != DOOMED) | (expected["step"] < step)].reset_index(drop=True)
    pd.testing.assert_frame_equal(rows(results.estimates, "bad"), expected, check_exact=True)


def test_a_filter_that_copies_its_process_is_heard_once(world, doomed, calm):
    results = cs.run_trials(world, [Still("bad", forks, doomed)], runs=RUNS, jobs=1, timeout=LONG)
    assert len(results.failures) == 0
    pd.testing.assert_frame_equal(results.estimates, rows(calm, "calm").assign(filter="bad"), check_exact=True)


# --- each filter has arrays of its own ---------------------------------------------------------


def scribbles(self, observation):
    for array in (self.problem.start, observation.z, observation.landmarks):
        array.flags.writeable = True
        array[...] = 7


@pytest.mark.parametrize("apart", [True, False])
def test_arrays_made_writable_change_nothing_for_others(world, doomed, apart):
    trial = cs.simulate(world, DOOMED)
    before = {name: array.copy() for name, array in vars(trial).items() if isinstance(array, np.ndarray)}
    bad = Still("bad", scribbles, doomed)
    if apart:
        with Isolation([bad], world.belief) as isolation:
            isolation.run(trial)
    else:
        run_filter(bad, trial, world.belief)
    assert len(before) >= 7
    for name, array in before.items():
        assert_array_equal(getattr(trial, name), array)


# --- what a run leaves ---------------------------------------------------------------------------


def test_nothing_of_the_failed_step_is_kept(world, doomed):
    """No pose, no NIS, no degrees of freedom."""
    trial = cs.simulate(world, DOOMED)
    with_info = next(k for k in range(1, 13) if len(trial.observation(k).landmarks))
    assert with_info < STEP  # negative control: there is something to keep
    with Isolation([Still("bad", answers(mean=np.full(3, np.nan)), doomed)], world.belief) as isolation:
        [said] = isolation.run(trial)
    assert said.failure.step == STEP
    for array in (said.pose, said.covariance, said.nis):
        assert np.isnan(array[STEP - 1 :]).all()
    assert not said.nis_dof[STEP - 1 :].any()
    assert np.isfinite(said.pose[: STEP - 1]).all()
    assert np.isfinite(said.nis[with_info - 1])


def test_a_nees_that_no_number_holds_fails_any_filter(world):
    """Also one whose own error is out of bounds, or whose NIS is, as a kernel may say it."""
    trial = cs.simulate(world)
    with Isolation([Still("calm")], world.belief) as isolation:
        [said] = isolation.run(trial)
    assert outcome_of(trial, [said]).failures == ()
    for array, value, name in ((said.pose, 1e200, "NEES"), (said.nis, np.inf, "NIS")):
        kept, array[STEP - 1] = array[STEP - 1].copy(), value
        said.nis_dof[STEP - 1] = 3
        outcome = outcome_of(trial, [said])
        assert [(f.step, f.reason) for f in outcome.failures] == [(STEP, f"the {name} is not finite")]
        assert {len(values) for values in outcome.estimates["calm"].values()} == {STEP - 1}
        array[STEP - 1] = kept


def test_names_and_reasons_stand_on_one_line(world, doomed):
    with pytest.raises(cs.InputError, match=r"filter: the name 'two\\nlines' has a control character"):
        cs.run_trials(world, [Still("two\nlines")], runs=1)
    exception = RuntimeError("one\n::error::two\x1b[2J\udc80")
    failure = run_filter(Still("bad", raises(exception), doomed), cs.simulate(world, DOOMED), world.belief).failure
    assert failure.reason.startswith("RuntimeError: one ::error::two [2J\\udc80 (in update, misbehaving.py:")


def inverts(*_):
    np.linalg.inv(np.zeros((2, 2)))


def test_an_algebra_error_of_the_users_is_theirs_and_only_a_wrong_s_is_said_of_s(world, doomed):
    trial = cs.simulate(world, DOOMED)
    line = inverts.__code__.co_firstlineno + 1
    failure = run_filter(Still("bad", inverts, doomed), trial, world.belief).failure
    assert failure.reason == f"LinAlgError: Singular matrix (in update, test_isolating.py:{line})"
    wrong = answers(innovation=np.ones(3), S=-np.eye(3))
    failure = run_filter(Still("bad", wrong, doomed), trial, world.belief).failure
    assert failure.reason == "the innovation covariance is not positive definite"


def test_an_error_of_the_map_names_the_map(world):
    class Mapping(Still):
        def map(self, state):
            return {}["x"]

    failure = run_filter(Mapping("bad"), cs.simulate(world), world.belief).failure
    assert failure.reason.startswith("KeyError: 'x' (in map, test_isolating.py:")


@pytest.mark.parametrize("entry", [(0, 0), (2, 1)])
def test_a_covariance_that_is_not_finite_is_told_from_a_pose(world, doomed, entry):
    P = np.eye(3)
    P[entry] = np.nan
    failure = run_filter(Still("bad", answers(covariance=P), doomed), cs.simulate(world, DOOMED), world.belief).failure
    assert (failure.step, failure.reason) == (STEP, "the pose covariance is not finite")


def test_a_class_that_travels_by_value_has_the_file_it_came_from(world, doomed):
    """Some versions of cloudpickle keep the name of the file, others write one of their own; the script has it."""
    names = {}
    exec(compile("def act(*_):\n    raise KeyError('landmark 17')\n", "<dynamic-code>", "exec"), names)
    with Isolation([Script("bad", names["act"], doomed)], world.belief) as isolation:
        [said] = isolation.run(cs.simulate(world, DOOMED))
    assert said.failure.step == STEP
    assert said.failure.reason == "KeyError: 'landmark 17' (in update, test_isolating.py:2)"


class Script(Still):
    """A filter whose file is this one."""


@pytest.mark.parametrize("exception", [SystemExit("enough"), GeneratorExit("gone"), RuntimeError("x" * 10**6)])
def test_what_a_filter_throws_is_a_result_in_any_process(world, doomed, exception):
    failure = run_filter(Still("bad", raises(exception), doomed), cs.simulate(world, DOOMED), world.belief).failure
    assert failure.step == STEP
    assert failure.reason.startswith(f"{type(exception).__name__}: {str(exception)[:1000]}")
    assert len(failure.reason) < 1100


def test_ctrl_c_in_this_process_is_ctrl_c(world, doomed):
    with pytest.raises(KeyboardInterrupt):
        run_filter(Still("bad", raises(KeyboardInterrupt()), doomed), cs.simulate(world, DOOMED), world.belief)


class Cut(dict[str, Any]):
    """Ctrl-C comes while a run is taken in."""

    def items(self):
        raise KeyboardInterrupt


def test_a_run_that_was_cut_off_leaves_nothing_and_others_all(world, doomed):
    with Isolation([Still("bad", raises(RuntimeError("out of ideas")), doomed)], world.belief) as isolation:
        whole, cut = (
            (trial, isolation.run(trial)) for trial in (cs.simulate(world, run) for run in (DOOMED, DOOMED + 1))
        )
    with closing(Journal(IN_MEMORY)) as journal:
        gathered = Gathered(["bad"], {}, journal)
        gathered.add(outcome_of(*whole))
        with pytest.raises(KeyboardInterrupt):
            gathered.add(replace(outcome_of(*cut), maps=Cut()))
        results = gathered.results({"filters": ["bad"]}, None)
    assert results.estimates["run"].unique().tolist() == [DOOMED]
    assert results.truth["run"].unique().tolist() == [DOOMED]
    assert results.failures[["run", "step"]].to_numpy().tolist() == [[DOOMED, STEP]]


def shouts(self, _):
    for number in range(20000):
        print("out", number)
        print("err", number, file=sys.stderr)
    if self.kept:
        sys.stdout.flush()
        os.abort()


@pytest.mark.usefixtures("no_supervisors")
@pytest.mark.parametrize("dies", [False, True])
def test_what_a_filter_prints_is_bounded(world, doomed, capfd, dies):
    loud = Still("loud", shouts, doomed, kept=[1] * dies)
    results = cs.run_trials(world, [Prints("quiet"), loud], runs=RUNS, jobs=1)
    assert len(results.failures) == dies
    out, err = capfd.readouterr()
    assert "out" not in out
    assert err.count("filters print more than 16384 bytes; the rest is not shown\n") == 1
    assert "\nout 0\n" in f"\n{err}"
    assert 16384 < len(err) < 16384 + 1000


class Prints(Still):
    def init(self, problem):
        print("a word of quiet")
        return problem.start


class Counts(Still):
    """Each run says how many runs its object has seen."""

    def init(self, problem):
        self.kept.append(1)
        return np.full(3, len(self.kept))


def test_no_run_depends_on_those_before_it(world):
    results = [cs.run_trials(world, [Counts("counts")], runs=4, jobs=jobs) for jobs in (1, 2)]
    for result in results:
        assert (result.estimates["x"] == 1.0).all()
    pd.testing.assert_frame_equal(results[0].estimates, results[1].estimates, check_exact=True)


def test_trials_that_differ_share_a_process(world):
    """More steps than before have room, and nothing is left of what was said in an earlier trial."""
    short, long = (cs.simulate(world.variant(f"w{n}", truth__steps=n)) for n in (12, 60))
    blind = [
        replace(trial, first=np.zeros_like(trial.first), landmark=trial.landmark[:0], z=trial.z[:0])
        for trial in (short, long)
    ]
    assert len(short.landmark)
    with Isolation([Still("calm")], world.belief) as isolation:
        for trial in (short, *blind, short, long):
            [said], expected = isolation.run(trial), run_filter(Still("calm"), trial, world.belief)
            assert said.failure is None
            for name in ("pose", "covariance", "nis", "nis_dof"):
                assert_array_equal(getattr(said, name), getattr(expected, name))


# --- killed from outside ---------------------------------------------------------------------------


def kills_once(folder):
    """SIGKILL as if from outside; ``folder`` has a file for each process that came to it."""

    def act(*_):
        (folder / str(os.getpid())).touch()
        if len(list(folder.iterdir())) == 1:
            os.kill(os.getpid(), signal.SIGKILL)
            time.sleep(100)

    return act


def test_a_killed_worker_costs_nothing(world, doomed, calm, tmp_path):
    results = cs.run_trials(world, [Still("bad", kills_once(tmp_path), doomed)], runs=RUNS, jobs=2)
    assert len(list(tmp_path.iterdir())) == 2
    assert len(results.failures) == 0
    expected = rows(calm, "calm").assign(filter="bad")
    pd.testing.assert_frame_equal(results.estimates, expected, check_exact=True)


# --- processes -------------------------------------------------------------------------------------


class Threads(Still):
    """Says how many threads BLAS has in its process."""

    def init(self, problem):
        counts = [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]
        return np.array([max(counts), 0.0, 0.0])


@pytest.fixture
def no_supervisors():
    """New ones, and those of before set aside: starting one takes a second or more."""
    before = filter_process._idle[:]
    filter_process._idle.clear()
    yield
    filter_process.dismiss()
    filter_process._idle.extend(before)


@pytest.mark.usefixtures("no_supervisors")
def test_blas_has_one_thread(world, monkeypatch):
    for library in ("OPENBLAS_NUM", "MKL_NUM", "OMP_NUM", "BLIS_NUM", "VECLIB_MAXIMUM"):
        monkeypatch.setenv(f"{library}_THREADS", "2")
    results = cs.run_trials(world, [Threads("threads")], runs=1, jobs=1)
    assert (results.estimates["x"] == 1.0).all()


def hangs(folder):
    """Leaves its process number in ``folder``, and does not end."""

    def act(*_):
        (folder / str(os.getpid())).touch()
        while True:
            pass

    return act


@pytest.mark.parametrize("jobs", [1, 2])
def test_ctrl_c_ends_what_hangs(world, doomed, tmp_path, jobs):
    """What is finished is handed over, and no process is left."""

    def interrupt():
        while not list(tmp_path.iterdir()):
            time.sleep(0.05)
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(Interrupted) as stop:
        cs.run_trials(world, [Still("bad", hangs(tmp_path), doomed)], runs=RUNS, jobs=jobs)
    signal.signal(signal.SIGINT, before)
    finished = stop.value.results.manifest["finished_runs"]
    assert finished == DOOMED if jobs == 1 else finished < RUNS
    assert all(is_gone(int(path.name)) for path in tmp_path.iterdir())


SCRIPT = """
import numpy as np
import consistency as cs

WORD = "here"

class Mine:
    def init(self, problem):
        return problem.start
    def predict(self, state, control):
        print(WORD, flush=True)
        while True:
            pass
    def update(self, state, observation):
        return state, None
    def pose(self, state):
        return cs.Gaussian(state, np.eye(3))

world = cs.load_scenario("herath2007-xyz").variant("short", truth__steps=5)
cs.run_trials(world, [Mine()], runs=2, jobs=1)
"""


def test_a_filter_that_hangs_ends_with_the_study(tmp_path):
    """A script without a guard on ``__main__`` is killed: its standard error is closed when all its processes are."""
    (tmp_path / "mine.py").write_text(SCRIPT)
    process = subprocess.Popen([sys.executable, "mine.py"], cwd=tmp_path, stderr=subprocess.PIPE)
    with process:
        assert process.stderr.readline() == b"here\n"
        process.kill()
        reader = threading.Thread(target=process.stderr.read, daemon=True)
        reader.start()
        reader.join(30.0)
        assert not reader.is_alive()


# --- refused ---------------------------------------------------------------------------------------


def test_a_filter_that_cannot_be_pickled_is_refused(world):
    with pytest.raises(cs.InputError, match=r"'lock' runs in a process of its own and cannot be pickled.*init"):
        cs.run_trials(world, [Still("lock", kept=[threading.Lock()])], runs=1, jobs=1)


@pytest.mark.usefixtures("no_supervisors")
def test_a_worker_of_a_pool_is_refused(world, monkeypatch):
    """A daemonic process can start no other."""
    monkeypatch.setitem(vars(multiprocessing.current_process())["_config"], "daemon", True)
    with pytest.raises(cs.InputError, match=r"worker of multiprocessing.Pool cannot start; use"):
        cs.run_trials(world, [Still("calm")], runs=1, jobs=1)


@pytest.mark.parametrize("option", ["timeout", "memory"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_limits_are_positive(world, option, value):
    with pytest.raises(cs.InputError, match=f"{option} must be positive, got"):
        cs.run_trials(world, ["ekf-xyz"], runs=1, jobs=1, **{option: value})  # type: ignore[call-overload]


def takes_most(*_):
    np.ones(int(0.75 * MEMORY * 2**27))


@pytest.mark.parametrize("run", [0, DOOMED])
def test_a_filter_within_its_limits_has_the_same_bits(world, calm, run):
    """Also in the first trial of a new process, where libraries take memory that is not the filter's."""
    filter_process.dismiss()
    filters = [Still("calm", takes_most, cs.simulate(world, run).control(1)), "ekf-xyz"]
    limited = cs.run_trials(world, filters, runs=RUNS, jobs=2, timeout=LONG, memory=MEMORY)
    assert not len(limited.failures), limited.failures
    pd.testing.assert_frame_equal(limited.estimates, calm, check_exact=True)
