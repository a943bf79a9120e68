"""Runs until decided and runs of a log, on a journal: whatever ends them, a resume gives the bytes of one go."""

import json
import weakref

import pandas as pd
import pytest
from edited import content

import consistency as cs
from consistency.bench.runs import montecarlo as deciding
from consistency.bench.runs import outcomes_to_results
from consistency.bench.runs.montecarlo import run_log, run_until_decided, simulate_log
from consistency.bench.runs.run_outcome import RunOutcome
from consistency.bench.store.journal import Unfinished
from consistency.bench.store.recorded_log import read_log
from consistency.bench.store.results import open_results
from consistency.diagnostics import Record
from consistency.referee.diagnostics import judge_record
from consistency.referee.show.as_json import render
from consistency.referee.verdicts.tables import document

OPEN = {"detect": 1.05, "false_alarm": 1e-6, "max_runs": 20, "seed": 3, "jobs": 1}  # looks at 12 to 20


@pytest.fixture(scope="module")
def world():
    return cs.load_scenario("linear-gaussian").variant("short", truth__steps=40)


@pytest.fixture(scope="module")
def whole(world, tmp_path_factory):
    """Results of one go."""
    out = tmp_path_factory.mktemp("looks") / "whole"
    run_until_decided(world, ["kf"], out=out, **OPEN)
    return out


def plan_in(folder):
    return json.loads((folder / "manifest.json").read_text())["until_decided"]


# --- until decided -----------------------------------------------------------------------------------


def test_the_folder_is_that_of_a_plain_run_with_the_plan(world, whole, tmp_path):
    results, verdicts = run_until_decided(world, ["kf"], **OPEN)
    cs.run_trials(world, ["kf"], runs=20, seed=3, jobs=1, out=tmp_path / "plain")
    assert content(whole) == content(tmp_path / "plain")
    stored = open_results(whole)
    assert render(document(cs.analyse(stored))) == render(document(verdicts))
    assert plan_in(whole) == results.manifest["until_decided"]
    assert (stored.manifest["runs"], stored.manifest["complete"]) == (20, True)
    assert [path.name for path in whole.parent.iterdir()] == ["whole"]


@pytest.mark.parametrize("run", [5, 19], ids=["before a look", "the last"])
def test_what_ends_the_process_takes_no_finished_run(world, whole, tmp_path, stop_at, monkeypatch, run):
    with monkeypatch.context() as patch:
        patch.setattr(outcomes_to_results.Gathered, "results", None)  # as SIGKILL: nothing is written any more
        stop_at(run, RuntimeError("killed"))
        with pytest.raises(RuntimeError, match="killed"):
            run_until_decided(world, ["kf"], out=tmp_path / "out", **OPEN)
    monkeypatch.undo()
    assert [path.name for path in tmp_path.iterdir()] == [".out.unfinished"]
    done = stop_at(-1, RuntimeError())
    _, verdicts = run_until_decided(world, ["kf"], out=tmp_path / "out", resume=True, **OPEN)
    assert done[0] == run
    assert set(done) <= set(range(run, 20))  # runs after it may have been finished meanwhile
    assert content(tmp_path / "out") == content(whole)
    assert render(document(verdicts)) == render(document(cs.analyse(open_results(whole))))
    assert plan_in(tmp_path / "out") == plan_in(whole)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("look", [False, True])
def test_ctrl_c_keeps_what_is_finished(world, whole, tmp_path, stop_at, monkeypatch, look):
    """While runs are done, and while a look is taken after the last of them."""
    with monkeypatch.context() as patch:
        if look:
            inspected = judge_record._inspected

            def pressed(design, record, spent):
                if len(record.run_numbers) == 20:
                    raise KeyboardInterrupt
                return inspected(design, record, spent)

            patch.setattr(judge_record, "_inspected", pressed)
        else:
            stop_at(14, KeyboardInterrupt())
        with pytest.raises(KeyboardInterrupt):
            run_until_decided(world, ["kf"], out=tmp_path / "out", **OPEN)
    monkeypatch.undo()
    count = 20 if look else 14
    with Unfinished(tmp_path / "out", resume=True) as unfinished:
        assert unfinished.journal.runs == set(range(count))
    run_until_decided(world, ["kf"], out=tmp_path / "out", resume=True, **OPEN)
    assert content(tmp_path / "out") == content(whole)
    assert open_results(tmp_path / "out").manifest["complete"]


def test_another_plan_is_refused(world, whole, tmp_path, stop_at, monkeypatch):
    stop_at(14, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        run_until_decided(world, ["kf"], out=tmp_path / "out", **OPEN)
    monkeypatch.undo()
    for change in ({"max_runs": 21}, {"false_alarm": 1e-5}, {"detect": 1.06}, {"power": 0.9}):
        with pytest.raises(cs.InputError, match="have another plan of looks; use the same command as before"):
            run_until_decided(world, ["kf"], out=tmp_path / "out", resume=True, **OPEN | change)
    run_until_decided(world, ["kf"], out=tmp_path / "out", resume=True, **OPEN)
    assert content(tmp_path / "out") == content(whole)


def test_a_plain_run_goes_on_until_decided(world, whole, tmp_path):
    """More runs than the first looks take are there: a look sees its own only, so that what it says is the same."""
    cs.run_trials(world, ["kf"], runs=17, seed=3, jobs=1, out=tmp_path / "out")
    run_until_decided(world, ["kf"], out=tmp_path / "out", resume=True, **OPEN)
    assert content(tmp_path / "out") == content(whole)
    one = {"max_runs": 12, "seed": 3, "jobs": 1}
    for runs, message in ((17, "have 17 runs; the plan looks for the last time at 12"), (12, "have 12 runs")):
        cs.run_trials(world, ["kf"], runs=runs, seed=3, jobs=1, out=tmp_path / str(runs))
        with pytest.raises(cs.InputError, match=message):
            run_until_decided(world, ["kf"], out=tmp_path / str(runs), resume=True, **one)
    runs_seen = []
    read = deciding.record_of

    def seen(tables, name, steps):
        runs_seen.append(len(tables.runs_of(name)))
        return read(tables, name, steps)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(deciding, "record_of", seen)
        previous = open_results(tmp_path / "17")
        _, verdicts = run_until_decided(world, ["kf"], previous=previous, **OPEN)
    assert runs_seen == [12, 15, 18, 20]
    assert verdicts["kf"].runs == 20


def test_a_look_holds_one_filter_and_no_outcome(uvd, tmp_path, monkeypatch):
    records = weakref.WeakSet()
    outcomes = weakref.WeakSet()
    most, read, add = [0, 0], deciding.record_of, outcomes_to_results.Gathered.add

    class Counted(RunOutcome):
        __hash__ = object.__hash__

    class Held(Record):
        __hash__ = object.__hash__

    def held(*arguments):
        record = Held(**vars(read(*arguments)))
        records.add(record)
        most[0] = max(most[0], len(records))
        return record

    def counted(self, outcome):
        known = Counted(**vars(outcome))
        outcomes.add(known)
        most[1] = max(most[1], len(outcomes))
        add(self, known)

    monkeypatch.setattr(deciding, "record_of", held)
    monkeypatch.setattr(outcomes_to_results.Gathered, "add", counted)
    run_until_decided(uvd, ["ekf-uvd", "ekf-xyz"], max_runs=14, jobs=1, out=tmp_path / "out")
    assert most == [1, 1]


# --- a log -------------------------------------------------------------------------------------------


@pytest.fixture
def log(world, tmp_path):
    simulate_log(world, 6, 4, tmp_path / "log")
    return tmp_path / "log"


def test_a_log_goes_on(log, tmp_path, stop_at, monkeypatch):
    memory = run_log(read_log(log), ["kf"], jobs=1)
    memory.write(tmp_path / "memory")
    whole = run_log(read_log(log), ["kf"], jobs=2, out=tmp_path / "whole")
    assert content(tmp_path / "whole") == content(tmp_path / "memory")
    assert whole.manifest["log_sha256"] == memory.manifest["log_sha256"]
    stop_at(4, RuntimeError("killed"))
    with pytest.raises(RuntimeError):
        run_log(read_log(log), ["kf"], jobs=1, out=tmp_path / "out")
    monkeypatch.undo()
    assert not (tmp_path / "out").exists()
    done = stop_at(-1, RuntimeError())
    run_log(read_log(log), ["kf"], jobs=1, out=tmp_path / "out", resume=True)
    assert done in ([4], [4, 5]), "run 5 may have been finished meanwhile"
    assert content(tmp_path / "out") == content(tmp_path / "whole")


def test_another_log_is_refused(world, log, tmp_path, stop_at, monkeypatch):
    stop_at(4, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        run_log(read_log(log), ["kf"], jobs=1, out=tmp_path / "out")
    monkeypatch.undo()
    simulate_log(world, 6, 5, tmp_path / "other")
    with pytest.raises(cs.InputError, match="the results to resume have another log"):
        run_log(read_log(tmp_path / "other"), ["kf"], jobs=1, out=tmp_path / "out", resume=True)
    with pytest.raises(cs.InputError, match="the results to resume have another scenario"):
        cs.run_trials(world, ["kf"], 6, 4, 1, out=tmp_path / "out", resume=True)
    run_log(read_log(log), ["kf"], jobs=1, out=tmp_path / "out", resume=True)
    assert open_results(tmp_path / "out").manifest["complete"]


def test_a_log_whose_runs_are_not_numbered_from_zero(log, tmp_path, stop_at):
    for name in ("controls", "observations", "truth"):
        table = pd.read_parquet(log / f"{name}.parquet")
        table[table["run"].isin([1, 4, 5])].to_parquet(log / f"{name}.parquet", index=False)
    done = stop_at(-1, RuntimeError())
    results = run_log(read_log(log), ["kf"], jobs=1, out=tmp_path / "out")
    assert done == [1, 4, 5]
    assert results.finished_runs(["kf"]) == {1, 4, 5}
    assert results.manifest["runs"] == 3
