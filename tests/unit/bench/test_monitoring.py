"""Recorded innovations: what is read, which run is chosen, and what is shown of the monitor."""

import json
import math
from dataclasses import replace
from functools import partial
from io import BytesIO

import numpy as np
import pandas as pd
import pytest
from matplotlib import image
from numpy.testing import assert_allclose, assert_array_equal

import consistency as cs
from consistency.bench.runs.results_to_records import innovations_of
from consistency.referee.errors import InputError
from consistency.referee.pages.ratio_figures import POINTS, averaged, monitor_drawing
from consistency.referee.pages.write_pages import plotted, require_plot
from consistency.referee.readers.formats.innovation_files import NisLog
from consistency.referee.show.as_json import render
from consistency.referee.show.figures import drawn, saved, svg
from consistency.referee.show.terminal import show
from consistency.referee.verdicts.monitor_sources import (
    make_monitor,
    monitor_document,
    read_innovations,
    watch,
    watch_lines,
)

NIS = [1.0, 2.5, math.nan, 0.25, 7.0]
DOF = [2, 2, 0, 1, 3]


def table(**columns):
    return pd.DataFrame({"nis": NIS, "nis_dof": DOF} | columns)


def write(folder, data, kind):
    path = folder / f"log.{kind}"
    data.to_csv(path, index=False) if kind == "csv" else data.to_parquet(path)
    return path


def changed(ratio=4.0, **options):
    """Steps 11 to 410, right up to step 210."""
    nis = np.where(np.arange(400) < 200, 3.0, 3.0 * ratio)
    log = NisLog("$odd$", np.arange(11.0, 411), np.arange(400) / 10, nis, np.full(400, 3.0))
    return watch(log, make_monitor("optimal", **options))


# --- reading -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_columns_of_a_table(kind, tmp_path):
    log = read_innovations(write(tmp_path, table(t=[0.1, 0.2, 0.3, 0.4, 0.5], other="x"), kind))
    assert log.name == "log"
    assert_array_equal(log.step, [1, 2, 3, 4, 5])
    assert_array_equal(log.t, [0.1, 0.2, 0.3, 0.4, 0.5])
    assert_array_equal(log.nis, NIS)
    assert_array_equal(log.dof, DOF)


def test_rows_are_taken_in_the_order_of_their_steps(tmp_path):
    log = read_innovations(write(tmp_path, table(step=[3, 1, 2, 9, 7]), "csv"))
    assert_array_equal(log.step, [1, 2, 3, 7, 9])
    assert_array_equal(log.nis, [2.5, math.nan, 1.0, 7.0, 0.25])
    assert np.isnan(log.t).all()


def test_one_run_of_one_filter_is_chosen(tmp_path):
    rows = table(filter=["a", "a", "b", "b", "b"], run=[0, 0, 0, 4, 4])
    path = write(tmp_path, rows, "csv")
    assert_array_equal(read_innovations(path, "b", 4).nis, [0.25, 7.0])
    assert read_innovations(path, "a").name == "a"
    for given, said in (
        ((None, None), r"holds more than one filter \(a, b\); choose with --filter"),
        (("b", None), r"holds more than one run \(0, 4\); choose with --run"),
        (("c", None), r"--filter c: is not in .*log.csv; there are: a, b"),
        (("a", 4), r"--run 4: is not in .*; there are: 0$"),
    ):
        with pytest.raises(InputError, match=said):
            read_innovations(path, *given)
    plain = write(tmp_path, table(), "parquet")
    with pytest.raises(InputError, match=r"--run 1: .* has no column 'run'"):
        read_innovations(plain, None, 1)


def test_an_archive(tmp_path):
    path = tmp_path / "log.npz"
    np.savez(path, nis=[NIS, [9.0] * 5], nis_dof=2, t=np.arange(5.0), lengths=[5, 3], errors=np.zeros(3))
    log = read_innovations(path, None, 1)
    assert_array_equal(log.nis, [9.0] * 3)
    assert_array_equal(log.dof, [2.0] * 3)
    assert_array_equal(log.t, [0.0, 1.0, 2.0])
    assert_array_equal(log.step, [1, 2, 3])
    with pytest.raises(InputError, match=r"more than one run \(0, 1\)"):
        read_innovations(path)
    np.savez(path, nis=NIS, nis_dof=DOF)
    assert_array_equal(read_innovations(path).nis, NIS)
    with pytest.raises(InputError, match="--filter a: does not go with"):
        read_innovations(path, "a")


@pytest.mark.parametrize(
    "arrays, said",
    [
        (
            {"nis": NIS},
            "'nis_dof' is missing; needed are nis and nis_dof, or innovation and innovation_variance, there are: nis",
        ),
        ({"nis": ["a"], "nis_dof": [1]}, "key 'nis' holds <U1, not numbers"),
        ({"nis": np.zeros((1, 2, 3)), "nis_dof": 1}, r"key 'nis' has shape \(1, 2, 3\), needs"),
        ({"nis": [], "nis_dof": 1}, "key 'nis' has shape"),
        ({"nis": NIS, "nis_dof": [1, 2]}, r"key 'nis_dof' must be one number or of shape \(1, 5\)"),
        ({"nis": [1.0, -1.0], "nis_dof": 1}, "run 0, step 2: nis -1 with nis_dof 1"),
    ],
)
def test_refused_archives(arrays, said, tmp_path):
    np.savez(tmp_path / "log.npz", **arrays)
    with pytest.raises(InputError, match=said):
        read_innovations(tmp_path / "log.npz")


@pytest.mark.parametrize(
    "columns, said",
    [
        ({"nis": [1.0, -2.0, 1.0, 1.0, 1.0]}, "line 3: nis -2 with nis_dof 2; nis must be 0 or more and finite"),
        ({"nis": [1.0, np.inf, 1.0, 1.0, 1.0]}, "line 3: nis inf"),
        ({"nis": ["a"] * 5}, "line 2: column 'nis': not a number"),
        ({"nis_dof": [2, 2.5, 0, 1, 3]}, "line 3: nis 2.5 with nis_dof 2.5"),
        ({"nis_dof": [2, 2, -1, 1, 3]}, "line 4: nis nan with nis_dof -1"),
        ({"nis_dof": [2, None, 0, 1, 3]}, "line 3: nis 2.5 with nis_dof nan"),
        ({"step": [1, 2, 2, 3, 4]}, "line 4: step 2 is duplicated"),
        ({"t": [1, 2, 1.5, 3, 4]}, "t 1.5 is less than the one before"),
    ],
)
def test_refused_tables(columns, said, tmp_path):
    path = write(tmp_path, table(**columns), "csv")
    with pytest.raises(InputError, match=said):
        read_innovations(path)


def test_refused_files(tmp_path):
    wide = pd.DataFrame({f"c{k}": [1.0] for k in range(20)})
    for name, data, said in (
        ("a.csv", wide.assign(nis=1.0), "'nis_dof' is missing"),
        ("b.txt", table(), r"unknown kind of file; known are .csv, .parquet, .pq, .jsonl, .ndjson, .npz"),
    ):
        data.to_csv(tmp_path / name, index=False)
        with pytest.raises(InputError, match=said):
            read_innovations(tmp_path / name)
    wide.assign(nis=1.0, nis_dof=1).to_csv(tmp_path / "c.csv", index=False)  # past the columns that messages name
    assert len(read_innovations(tmp_path / "c.csv").nis) == 1
    with pytest.raises(InputError, match=r"none.csv: no such file"):
        read_innovations(tmp_path / "none.csv")
    empty = table().drop(index=2)
    empty["nis_dof"] = empty["nis_dof"].astype(float)
    empty.loc[1] = np.nan
    assert read_innovations(write(tmp_path, empty, "csv")).dof.tolist() == [2, 0, 1, 3]


def test_results_of_a_run(tmp_path):
    scenario = cs.load_scenario("linear-gaussian").variant("short", truth__steps=30)
    results = cs.run_trials(scenario, ["kf"], runs=2, seed=1)
    results.write(tmp_path / "out")
    log = innovations_of(tmp_path / "out", "kf", 1)
    rows = results.estimates.query("run == 1")
    assert_array_equal(log.nis, rows["nis"])
    assert_array_equal(log.dof, rows["nis_dof"])
    assert_array_equal(log.step, np.arange(1, 31))
    assert log.name == "kf"
    with pytest.raises(InputError, match=r"holds more than one run \(0, 1\)"):
        innovations_of(tmp_path / "out", None, None)
    with pytest.raises(InputError, match="--filter ukf-uvd: is not in"):
        innovations_of(tmp_path / "out", "ukf-uvd", None)
    assert watch(log, make_monitor("optimal")).monitor.innovations == int((rows["nis_dof"] > 0).sum())


# --- watching ------------------------------------------------------------------------------------------


def test_an_alarm_has_the_steps_and_times_of_the_file():
    watched = changed()
    alarm, monitor = watched.alarm, watched.monitor
    assert alarm.since == 211
    assert alarm.step == monitor.alarm.step + 10
    assert watched.since_t == pytest.approx(20.0)
    assert watched.alarm_t == pytest.approx((alarm.step - 11) / 10)
    assert watched.evidence[-1] == monitor.evidence
    first = int(np.flatnonzero(watched.evidence >= 1000)[0])
    assert watched.step[first] == alarm.step
    assert_array_equal(watched.nis_over_dof, np.where(np.arange(400) < 200, 1.0, 4.0))


def test_rows_without_a_nis_are_rejections_if_there_is_a_gate():
    log = NisLog("f", np.arange(1.0, 6), np.full(5, np.nan), np.array(NIS), np.array([2.0, 2, 2, 1, 3]))
    assert watch(log, make_monitor("optimal", gate=0.99)).monitor.rejections == 1
    assert watch(log, make_monitor("optimal")).monitor.rejections == 0
    none = NisLog("f", log.step, log.t, log.nis, np.array(DOF, float))
    assert watch(none, make_monitor("optimal", gate=0.99)).monitor.rejections == 0
    assert np.isnan(watch(none, make_monitor("optimal")).nis_over_dof[2])


def lines(text, read):
    """The lines of a stream; ``read`` counts those that were asked for."""
    for line in text.splitlines(keepends=True):
        read.append(1)
        yield line


def test_lines_are_judged_as_they_come():
    read = []
    at = []
    rows = "".join(f"{k};{3.0 if k < 50 else 12.0};3\n" for k in range(200))
    watched = watch_lines(
        lines("# a log\nk;nis;nis_dof\n\n" + rows, read), "stdin", make_monitor("optimal"),
        lambda alarm: at.append(len(read)),
    )  # fmt: skip
    assert watched.alarm.since == 51
    assert at == [watched.alarm.step + 3]  # the lines before the first row
    assert watched.monitor.steps == 200


@pytest.mark.parametrize(
    "text, said",
    [
        ("", "stdin: is empty"),
        ("nis,other\n1,2\n", "stdin: column 'nis_dof' is missing beside 'nis'"),
        ("nis,nis_dof,run\n1,2,0\n", "column 'run': lines as they come must be of one run"),
        ("nis,nis_dof\n1,2\n1\n", "stdin, line 3: has 1 columns, the header has 2"),
        ("nis,nis_dof\n1,2\n1,x\n", r"stdin, line 3: column 'nis_dof': not a number \(x\)"),
        ("nis,nis_dof\n1,2\n-1,2\n", "stdin, line 3: nis must be 0 or more"),
        ("nis,nis_dof\n1,2\n1,2.5\n", "stdin, line 3: dof must be a whole number"),
    ],
)
def test_refused_lines(text, said):
    with pytest.raises(InputError, match=said):
        watch_lines(lines(text, []), "stdin", make_monitor("optimal"), lambda alarm: None)


def test_empty_fields_of_a_line_are_a_step_without_an_innovation():
    watched = watch_lines(["nis,nis_dof\n", "1,2\n", ",\n", ",0\n"], "s", make_monitor("optimal"), lambda alarm: None)
    assert (watched.monitor.steps, watched.monitor.innovations) == (3, 1)


# --- showing -------------------------------------------------------------------------------------------


def document_of(w):
    return monitor_document(w.name, w.monitor, w.alarm, w.alarm_t, w.since_t)


def test_the_terminal_shows_numbers_and_a_sentence(capsys):
    show(*document_of(changed(gate=0.99, tolerance=1.0)).opening)  # a NIS of 12 is above the gate
    out = capsys.readouterr().out
    assert "rejected" in out
    assert "$odd$" in out
    assert "no alarm" in out
    assert "rejected 50 % of 400 measurements, and 0.5 % of the 201 that do not come right after a rejection (a" in out
    show(*document_of(changed()).opening)
    out = capsys.readouterr().out
    assert "rejected" not in out
    assert "overconfident since step 211" in out
    assert "since t = 20 s" in out
    assert " 2.500 " in out  # NIS / dof over all
    w, unix = changed(), 1.7e9
    late = monitor_document(w.name, w.monitor, w.alarm, w.alarm_t + unix, w.since_t + unix, unix - 1.0)
    show(*late.opening)
    assert "since t = 21 s after the start" in capsys.readouterr().out
    none = NisLog(
        "f", np.arange(1.0, 5), np.full(4, np.nan), np.array([50.0, 2.0, 3.0, np.nan]), np.array([2.0, 2, 2, 0])
    )
    show(*document_of(watch(none, make_monitor("optimal", gate=0.99))).opening)
    out = capsys.readouterr().out
    assert "rejected 33 % of 3 measurements, and 100 % of the 1 that" in out  # a step without one is none
    show(*document_of(changed(1.0)).opening)
    assert "no alarm" in capsys.readouterr().out


def test_json_has_every_number():
    watched = changed()
    data = json.loads(render(document_of(watched)))
    assert data["alarm"]["since"] == 211
    assert data["alarm"]["since_t"] == 20.0
    assert data["alarm"]["scale"] == pytest.approx(4.0)
    assert data["alarm"]["direction"] == "overconfident"
    assert (data["steps"], data["measurements"], data["judged"], data["rejected"]) == (400, 400, 400, 0)
    assert data["largest_evidence"] == data["evidence"] == watched.monitor.evidence
    assert data["nis_ratio"] == 2.5
    assert "pose" in data["note"]
    assert json.loads(render(document_of(changed(1.0))))["alarm"] is None


def test_many_innovations_are_averaged_before_they_are_drawn():
    step, ratio = np.arange(1.0, 3002), np.tile([1.0, np.nan, 3.0], 1001)[:3001]
    x, y, together = averaged(step, ratio)
    assert len(y) <= POINTS
    assert together == 4
    assert_allclose(y[:-1], 2.0)
    assert (x[-1], y[-1]) == (3001.0, 1.0)  # one is left over
    assert_allclose(x[0], np.mean([1, 3, 4, 6]))
    x, y, together = averaged(step[:30], ratio[:30])
    assert together == 1
    assert_array_equal(y, [1.0, 3.0] * 10)


@pytest.mark.parametrize("kind", ["png", "pdf", "svg"])
def test_the_plot(kind, tmp_path):
    path = tmp_path / f"plot.{kind}"
    require_plot(path, overwrite=False)
    plotted(partial(monitor_drawing, changed()), path)
    content = path.read_bytes()
    assert content[:4] == {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xm"}[kind]
    assert content == saved(drawn(partial(monitor_drawing, changed())), kind)
    if kind == "png":
        assert image.imread(BytesIO(content)).std() > 0.05
    with pytest.raises(InputError, match="exists already"):
        require_plot(path, overwrite=False)
    with pytest.raises(InputError, match=r"must end in .png, .pdf, .svg"):
        require_plot(tmp_path / "plot.jpg", overwrite=True)


def test_a_run_without_any_innovation_can_be_drawn():
    log = NisLog("f", np.arange(1.0, 6), np.full(5, np.nan), np.full(5, np.nan), np.zeros(5))
    assert svg(partial(monitor_drawing, watch(log, make_monitor("optimal"))))


def test_evidence_is_drawn_with_its_threshold_and_alarm():
    watched = changed()
    threshold = watched.monitor.threshold
    axes = drawn(partial(monitor_drawing, watched)).axes[1]
    line = axes.lines[-1]
    start = watched.t[0]
    evidence = np.minimum(watched.evidence, threshold**3)  # beyond the drawn range
    assert_array_equal(line.get_ydata(), evidence[np.searchsorted(watched.t - start, line.get_xdata())])
    assert line.get_ydata().max() == evidence.max()
    assert [line.get_ydata()[0] for line in axes.lines if list(line.get_xdata()) == [0, 1]] == [threshold]
    assert axes.get_yscale() == "log"
    assert axes.get_ylim()[1] <= threshold**2 < watched.evidence.max()
    span = axes.patches[0]
    assert (span.get_x(), span.get_x() + span.get_width()) == pytest.approx(
        (watched.since_t - start, watched.alarm_t - start)
    )
    assert [line for line in axes.lines if list(line.get_xdata()) == [watched.alarm_t - start] * 2]
    quiet = watch(
        NisLog("f", np.arange(1.0, 6), np.full(5, np.nan), np.full(5, 3.0), np.full(5, 3.0)), make_monitor("optimal")
    )
    assert not drawn(partial(monitor_drawing, quiet)).axes[1].patches


def test_innovations_with_their_covariances(tmp_path):
    rng = np.random.default_rng(3)
    v, S = rng.normal(size=(2, 40, 2)), np.broadcast_to([[2.0, 0.5], [0.5, 1.0]], (2, 40, 2, 2)).copy()
    v[1, 5] = np.nan
    np.savez(tmp_path / "a.npz", innovations=v, innovation_covariances=S)
    log = read_innovations(tmp_path / "a.npz", run=1)
    np.testing.assert_allclose(log.nis, np.einsum("ki,kij,kj->k", v[1], np.linalg.inv(S[1]), v[1]))
    assert log.dof.tolist() == [2.0] * 5 + [0.0] + [2.0] * 34
    np.savez(tmp_path / "a.npz", innovations=v[0], innovation_covariances=S[0])
    assert len(read_innovations(tmp_path / "a.npz").nis) == 40
    S[0, 7, 0, 0] = -1.0
    np.savez(tmp_path / "a.npz", innovations=v[0], innovation_covariances=S[0])
    with pytest.raises(InputError, match=r"'innovation_covariances' is not positive definite at \[7\] \(step"):
        read_innovations(tmp_path / "a.npz")
    np.savez(tmp_path / "a.npz", innovations=v[0], innovation_covariances=S[0, 0])
    with pytest.raises(InputError, match=r"must be numbers of shape \(steps, m\) and \(steps, m, m\)"):
        read_innovations(tmp_path / "a.npz")


def test_the_plot_is_over_time_where_there_is_one():
    watched = changed()
    _, below = drawn(partial(monitor_drawing, watched)).axes
    assert below.get_xlabel() == "time from the start (s)"
    assert below.lines[-1].get_xdata()[-1] == pytest.approx(watched.t[-1] - watched.t[0])
    assert below.lines[0].get_xdata()[0] == pytest.approx(watched.alarm_t - watched.t[0])
    unknown = replace(watched, t=np.full(len(watched.t), np.nan))
    assert drawn(partial(monitor_drawing, unknown)).axes[1].get_xlabel() == "step"


def test_no_alarm_says_what_analyse_asks():
    quiet = str(document_of(changed(1.0)).opening)
    assert "--tolerance 1 asks whether it is right exactly" in quiet
    assert "analyse" not in str(document_of(changed(1.0, tolerance=1.0)).opening)
