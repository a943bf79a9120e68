"""What commands do, from Python: runs to plan, estimators to compare, verdicts to write and list; names in errors."""

import json
import sys

import numpy as np
import pandas as pd
import pytest
from command import consistency

import consistency as cs
from consistency.referee.errors import InputError, naming_arguments

RUNS, STEPS = 60, 5


def errors(seed, scale=1.0):
    return scale * np.random.default_rng(seed).normal(size=(RUNS, STEPS, 2))


P = np.tile(np.eye(2), (RUNS, STEPS, 1, 1))


def archive(path, error):
    np.savez(path, errors=error, covariances=P)
    return path


def test_a_verdict_is_written_as_by_the_command(tmp_path, capsys):
    verdict = cs.judge(archive(tmp_path / "est.npz", errors(1)))
    consistency(capsys, "analyse", tmp_path / "est.npz", "--report", tmp_path / "by-command")
    written = verdict.write(tmp_path / "look")
    assert {path.name for path in written} == {path.name for path in (tmp_path / "by-command").iterdir()} - {
        "manifest.json"
    }
    own, other = (json.loads((tmp_path / at / "verdict.json").read_text()) for at in ("look", "by-command"))
    assert own == other
    assert verdict.write(tmp_path / "v.xml") == [tmp_path / "v.xml"]
    assert "<testcase" in (tmp_path / "v.xml").read_text()
    assert verdict.write(tmp_path / "v.md", overwrite=True) == [tmp_path / "v.md"]
    assert "consistent" in (tmp_path / "v.md").read_text()
    verdict.write(tmp_path / "look")  # its own report is replaced
    (tmp_path / "mine.md").write_text("mine")
    with pytest.raises(InputError, match=r"mine\.md"):
        verdict.write(tmp_path / "mine.md")
    assert (tmp_path / "mine.md").read_text() == "mine"


def test_a_figure_of_the_report_is_drawn_alone():
    pytest.importorskip("matplotlib")
    verdict = cs.judge(errors(1), P, axes=["x", "y"])
    whole, one = verdict.plot(), verdict.plot(figure="NEES")
    assert len(one.axes) < len(whole.axes)
    with pytest.raises(InputError, match="NEES"):
        verdict.plot(figure="Weather")


def test_a_plan_is_that_of_the_command(tmp_path, capsys):
    shown = json.loads(
        consistency(capsys, "plan", "--dof", 3, "--detect", 1.2, "--lost", 0.05, "--groups", 4, "--json")[0]
    )
    assert cs.plan(3, detect=1.2, lost=0.05, groups=4) == shown
    path = archive(tmp_path / "est.npz", errors(1))
    like = json.loads(consistency(capsys, "plan", "--like", path, "--json")[0])
    assert cs.plan(like=path)["like"] == cs.plan(like=cs.read(path))["like"] == like["like"]
    assert cs.plan(like=path)["dof"] == 2


def test_a_comparison_is_that_of_the_command(tmp_path, capsys):
    rng = np.random.default_rng(3)
    truth = pd.DataFrame({"run": np.repeat(range(RUNS), STEPS), "step": np.tile(range(1, STEPS + 1), RUNS)})
    truth[["x", "y"]] = rng.normal(size=(RUNS * STEPS, 2))
    truth.to_csv(tmp_path / "truth.csv", index=False)
    for name, scale in (("new", 2.0), ("old", 1.0)):
        own = truth.assign(P_x_x=1.0, P_x_y=0.0, P_y_y=1.0)
        own[["x", "y"]] -= scale * errors(4).reshape(-1, 2)
        own.to_csv(tmp_path / f"{name}.csv", index=False)
    new, old = tmp_path / "new.csv", tmp_path / "old.csv"
    out, _ = consistency(capsys, "compare", new, old, "--truth", tmp_path / "truth.csv", "--state", "x,y", "--json")
    found = cs.compare(new, old, truth=tmp_path / "truth.csv", state=["x", "y"])
    assert found.worse
    assert found.comparison.paired
    assert json.loads(out)[0]["p_value"] == pytest.approx(found.comparison.p_value)
    base = tmp_path / "base.json"
    consistency(capsys, "baseline", old, "--truth", tmp_path / "truth.csv", "--state", "x,y", "--out", base)
    kept = cs.compare(new, base, truth=tmp_path / "truth.csv", state=["x", "y"])
    assert kept.comparison.p_value == pytest.approx(found.comparison.p_value)
    assert "less consistent" in str(kept)


def test_records_are_paired_where_that_is_declared(tmp_path):
    a, b = (cs.read(archive(tmp_path / f"{name}.npz", errors(1, s))) for name, s in (("a", 1.0), ("b", 1.5)))
    alike = cs.compare(b, a, same_trials=True)
    assert alike.comparison.paired
    assert alike.worse
    assert not cs.compare(a, b, same_trials=True).worse
    assert not cs.compare(b, a).comparison.paired
    with pytest.raises(InputError, match=r"^false_alarm must"):
        cs.compare(a, b, false_alarm=2.0)


def test_first_steps_of_files_are_left_out_as_those_of_records(tmp_path):
    a, b = (archive(tmp_path / f"{name}.npz", errors(1, s)) for name, s in (("a", 1.0), ("b", 1.5)))
    later = cs.compare(b, a, skip=2).comparison.p_value
    assert later == cs.compare(cs.read(b), cs.read(a), skip=2).comparison.p_value
    assert later != cs.compare(b, a).comparison.p_value


def test_verdicts_are_rows_of_a_table():
    good = cs.judge(errors(1), P, name="good")
    bad = cs.judge(errors(1, 2.0), P, name="bad")
    rows = cs.verdict_table([good, bad])
    assert list(rows.index) == ["good", "bad"]
    assert rows.loc["bad", "verdict"] == "overconfident"
    assert rows.loc["bad", "ratio"] == pytest.approx(4.0 * rows.loc["good", "ratio"])
    assert rows.loc["bad", "ratio_low"] < rows.loc["bad", "ratio"] < rows.loc["bad", "ratio_high"]
    assert rows.loc["good", "anees"] == pytest.approx(np.square(errors(1)).sum(axis=-1).mean())
    assert (rows["expected"] == 2).all()
    assert (rows["runs"] == RUNS).all()
    assert rows.loc["good", "faults"] == ""
    named = cs.verdict_table({"first": bad})
    assert list(named.index) == ["first"]
    assert "scale" in named.loc["first", "faults"]


@pytest.mark.parametrize("said, expected", [
    ("--max-dt -1: must be 0 or more", "max_dt=-1: must be 0 or more"),
    ("--time-offset needs --truth: without it", "time_offset needs truth: without it"),
    ("needs --truth FILE, or --state A,B", "needs truth=FILE, or state=A,B"),
    ("try 'consistency plan --dof 3'; or --split auto", "try 'consistency plan --dof 3'; or split=auto"),
    ("say consistency inspect est.csv --truth t; --by x", "say consistency inspect est.csv --truth t; by= x"),
    ("a -- b and x--y stay", "a -- b and x--y stay"),
])  # fmt: skip
def test_errors_name_arguments(said, expected):
    @naming_arguments
    def fails():
        raise InputError(said)

    with pytest.raises(InputError) as caught:
        fails()
    assert str(caught.value) == expected


def test_no_error_of_a_public_function_names_a_flag(tmp_path):
    path = archive(tmp_path / "est.npz", errors(1))
    calls = (
        lambda: cs.read(path, max_dt=-1.0), lambda: cs.read(path, truth="t.csv"), lambda: cs.read(path, align="x"),
        lambda: cs.judge(errors(1), P, truth_errors="odd"), lambda: cs.judge(path, false_alarm=2.0),
        lambda: cs.judge(path, skip=-1), lambda: cs.plan(3, false_alarm=2.0), lambda: cs.plan(3, allow="all"),
        lambda: cs.correct(errors(1)[:1], P[:1]), lambda: cs.correct(errors(1), P, held_out="nobody"),
        lambda: cs.fit_covariance([], "1m", cautious=2.0), lambda: cs.monte_carlo(["true"], runs=0, out=tmp_path / "o"),
        lambda: cs.inspect(path, by_file="x.csv").missing and cs.read(path, by_file="x.csv"),
    )  # fmt: skip
    for call in calls:
        with pytest.raises(InputError) as caught:
            call()
        assert "--" not in str(caught.value), caught.value


@pytest.mark.parametrize("name", ["look.html", "look.pdf", "look.JSON"])
def test_a_page_by_itself_is_refused(name, rng, tmp_path):
    verdict = cs.judge(rng.standard_normal((30, 5, 2)), np.broadcast_to(np.eye(2), (30, 5, 2, 2)))
    with pytest.raises(cs.InputError, match=f"{name}: .* folder.* FILE.xml"):
        verdict.write(tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_a_table_of_verdicts_says_that_it_needs_pandas(rng, monkeypatch):
    verdict = cs.judge(rng.standard_normal((30, 5, 2)), np.broadcast_to(np.eye(2), (30, 5, 2, 2)))
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pandas"):
        cs.verdict_table([verdict])
