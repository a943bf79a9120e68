"""A sweep that is ended within a cell, and processes that work on one: nothing is lost, done twice or mixed."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import consistency as cs
from consistency.bench.runs.run_outcome import TrialWork as Runs
from consistency.bench.scenario import data_folder
from consistency.bench.store.journal import Journal, Unfinished
from consistency.bench.sweeps import run_sweep as sweeping
from consistency.bench.sweeps.run_sweep import SweepFolder, cost_of, run_sweep
from consistency.bench.sweeps.sweep_file import load_sweep

GRID = """
summary = "Three densities in a linear world"
base = "small.toml"
filters = ["kf"]
seed = 3
[rule]
false_alarm = 1e-6
detect = 1.05
max_runs = 14
[grid]
density = [0.5, 0.75, 1.0]
"""


class Killed(BaseException):
    """As SIGKILL: nobody catches it."""


@pytest.fixture
def at(tmp_path, monkeypatch):
    text = (data_folder("scenarios") / "linear-gaussian.toml").read_text()
    (tmp_path / "small.toml").write_text(text.replace("steps = 500", "steps = 30"))
    (tmp_path / "grid.toml").write_text(GRID)
    monkeypatch.setattr(sweeping, "cost_of", lambda *_: (1.0, 5.0))
    monkeypatch.setattr(sweeping, "PAUSE", 0.01)
    return tmp_path


@pytest.fixture
def stop_after(monkeypatch):
    """What is raised in the place of a run after so many; gives the list of the runs that are done."""

    def arm(count, error):
        one, done = Runs.__call__, list[int]()

        def stopped(self, number):
            if len(done) == count:
                raise error
            done.append(number)
            return one(self, number)

        monkeypatch.setattr(Runs, "__call__", stopped)
        return done

    return arm


def content(out):
    return {str(path.relative_to(out)): path.read_bytes() for path in sorted(out.rglob("runs.csv"))}


def hidden(out):
    return [path.name for path in out.rglob(".*")]


def grid(at, old="", new=""):
    assert old in GRID
    (at / "grid.toml").write_text(GRID.replace(old, new))
    return load_sweep(at / "grid.toml")


def test_what_is_left_of_a_cell_that_was_just_written_goes(at, stop_after, monkeypatch):
    run_sweep(grid(at), at / "whole", jobs=1)
    with monkeypatch.context() as patched:

        def killed(self, *_):
            self._leave()
            raise Killed

        patched.setattr(Unfinished, "__exit__", killed)
        with pytest.raises(Killed):
            run_sweep(grid(at), at / "out", jobs=1)
    assert hidden(at / "out") == [".kf.unfinished"]
    done = stop_after(100, Killed())
    run_sweep(grid(at), at / "out", jobs=1)
    assert len(done) == 2 * 14  # the other two cells
    assert hidden(at / "out") == []
    assert content(at / "out") == content(at / "whole")


@pytest.mark.parametrize("error", [Killed(), KeyboardInterrupt()], ids=["killed", "ctrl-c"])
def test_a_sweep_goes_on_within_a_cell(at, stop_after, monkeypatch, error):
    whole = run_sweep(grid(at), at / "whole", jobs=1)
    assert hidden(at / "whole") == []
    stop_after(14 + 9, error)
    with pytest.raises(type(error)):
        run_sweep(grid(at), at / "out", jobs=1)
    monkeypatch.undo()
    monkeypatch.setattr(sweeping, "cost_of", lambda *_: (1.0, 5.0))
    assert len(content(at / "out")) == 1
    done = stop_after(-1, error)
    folder = run_sweep(grid(at), at / "out", jobs=1)
    assert done == [*range(9, 14), *range(14)]
    assert content(at / "out") == content(at / "whole")
    assert repr(folder.results()) == repr(whole.results())
    assert hidden(at / "out") == []


@pytest.mark.parametrize(
    "old, new", [("max_runs = 14", "max_runs = 15"), ("seed = 3", "seed = 4"), ("1e-6", "1e-5"), ("", "code")]
)
def test_runs_of_other_inputs_are_dropped(at, stop_after, monkeypatch, old, new):
    stop_after(9, Killed())
    with pytest.raises(Killed):
        run_sweep(grid(at), at / "out", jobs=1)
    monkeypatch.undo()
    monkeypatch.setattr(sweeping, "cost_of", lambda *_: (1.0, 5.0))
    if new == "code":
        monkeypatch.setattr(sweeping, "code_digest", lambda: "another")
        new = ""
    sweep = grid(at, old, new) if old else grid(at)
    done = stop_after(-1, Killed())
    run_sweep(sweep, at / "out", jobs=1)
    assert len(done) == 3 * sweep.rule.max_runs, "none was taken over"
    run_sweep(sweep, at / "whole", jobs=1)
    assert content(at / "out") == content(at / "whole")


def test_what_the_system_refuses_is_no_result(at, monkeypatch):
    append, count = Journal.append, [0]

    def full(self, *arguments):
        count[0] += 1
        if count[0] > 14 + 9:
            raise OSError(28, "No space left on device")
        append(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Journal, "append", full)
        with pytest.raises(
            cs.InputError, match=r"--out .*out: No space left on device; what is finished is there, and"
        ):
            run_sweep(grid(at), at / "out", jobs=1)
    folder = SweepFolder(grid(at), at / "out")
    assert [result.status for result in folder.results().values()] == ["undecided"]
    run_sweep(grid(at), at / "out", jobs=1)
    run_sweep(grid(at), at / "whole", jobs=1)
    assert content(at / "out") == content(at / "whole")


def others_cell(at, place):
    """A cell, by its place in the order in which they are done."""
    folder = SweepFolder(grid(at), at / "out")
    folder.begin()
    return folder, folder.all_work()[place]


@pytest.mark.parametrize("is_done", [True, False], ids=["done by the other", "left by the other"])
def test_a_cell_that_another_process_works_on(at, monkeypatch, is_done):
    """Others are done first; it is come back to, and done only if the other has not."""
    folder, first = others_cell(at, 0)
    run_sweep(grid(at), at / "whole", jobs=1)
    run_cell, done, free = sweeping.run_cell, list[str](), threading.Event()

    def counted(sweep, cell, *rest, **how):
        done.append(cell.name)
        if len(done) == 2:
            free.set()
        return run_cell(sweep, cell, *rest, **how)

    def other():
        with folder.at_work(first) as journal:
            held.set()
            assert free.wait(60.0)
            if is_done:
                folder.write(first, run_cell(folder.sweep, first.cell, "kf", jobs=1, journal=journal), 1.0)

    held = threading.Event()
    thread = threading.Thread(target=other)
    thread.start()
    assert held.wait(60.0)
    monkeypatch.setattr(sweeping, "run_cell", counted)
    run_sweep(grid(at), at / "out", jobs=1)
    thread.join()
    order = [work.cell.name for work in folder.all_work()]
    assert done == (order[1:] if is_done else [*order[1:], order[0]])
    assert content(at / "out") == content(at / "whole")
    assert hidden(at / "out") == []


def test_a_cell_that_was_done_after_the_sweep_began(at, monkeypatch):
    """Another process has finished the last cell when it is its turn."""
    folder, last = others_cell(at, -1)
    run_cell, done = sweeping.run_cell, list[str]()

    def meanwhile(sweep, cell, *rest, **how):
        if not done:
            folder.write(last, run_cell(folder.sweep, last.cell, "kf", jobs=1), 1.0)
        done.append(cell.name)
        return run_cell(sweep, cell, *rest, **how)

    monkeypatch.setattr(sweeping, "run_cell", meanwhile)
    run_sweep(grid(at), at / "out", jobs=1)
    assert len(done) == 2


def test_the_executor_does_the_runs(at):
    done = []

    class Noted(ThreadPoolExecutor):
        def submit(self, function, /, *arguments, **options):
            done.extend(arguments[1])
            return super().submit(function, *arguments, **options)

    with Noted(1) as executor:
        run_sweep(grid(at), at / "out", executor=executor)
    assert done == [*range(14)] * 3


def test_a_filter_that_fails_apart_is_not_timed_here(uvd, monkeypatch):
    """It is not run in this process, which it could end."""

    class Crashes:
        name = "crashes"

        def init(self, problem):
            raise AssertionError("run here")

        predict = update = pose = init

    get_filter = sweeping.get_filter
    monkeypatch.setattr(sweeping, "get_filter", lambda name: Crashes() if name == "crashes" else get_filter(name))
    monkeypatch.setattr(sweeping, "run_filter", None)
    assert np.isnan(cost_of("crashes", "ekf-uvd", uvd, 0)).all()
