"""The report of another estimator's files, and the same from Python."""

import json
import re
import shlex
from xml.etree import ElementTree

import numpy as np
import pytest
from command import consistency, refused
from matplotlib.figure import Figure as Drawn
from numpy.testing import assert_allclose
from painted import by_title, legend_of, lines, panels, places, shaded
from recorded import read_recordings
from records import changed
from scipy import stats

import consistency as cs
from consistency.referee.diagnostics.bias_and_shape import observed_coverage
from consistency.referee.pages.record_figures import record_figures, shown_run, unit_of
from consistency.referee.pages.verdicts import time_axis_of
from consistency.referee.pages.write_pages import compose_files
from consistency.referee.show import as_html
from consistency.referee.show.blocks import Details, Figure, Status, Table, Text
from consistency.referee.verdicts.judge_sources import judge_all

RUNS, STEPS = 30, 25


def errors_of(rng, n=2, ratio=1.0):
    P = np.diag(0.1 * np.arange(1, n + 1))
    errors = np.sqrt(ratio) * rng.multivariate_normal(np.zeros(n), P, size=(RUNS, STEPS))
    return {"errors": errors, "covariances": np.broadcast_to(P, (RUNS, STEPS, n, n)).copy()}


def pictured(folder, **arrays):
    """The record of an archive of these arrays, and its figures by title."""
    np.savez(folder / "e.npz", **arrays)
    record = cs.read(folder / "e.npz")
    return record, {of.title: of for of in record_figures(record, cs.judge(record))}


@pytest.fixture
def archive(tmp_path, rng):
    np.savez(tmp_path / "mine.npz", **errors_of(rng), axes=["x", "yaw"], t=1.7e9 + 0.1 * np.arange(STEPS))
    return tmp_path / "mine.npz"


@pytest.fixture
def rng():
    return np.random.default_rng()


def document(path):
    records = read_recordings(path)
    return compose_files(records, judge_all(records), path.name, {"command": "consistency analyse"})


def test_the_verdict_stands_on_top_and_the_pictures_first(archive):
    made = document(archive)
    sentence = cs.judge(cs.read(archive)).reasons[0]
    assert made.answer == f"mine is {sentence}."
    assert made.badges == (Status(cs.judge(cs.read(archive)).status),)
    *shown, on_demand = made.chapters[0].blocks
    titles = ["NEES", "Errors and stated bounds", "Which run, and when", "Coverage"]
    assert [block.title for block in shown] == titles
    assert on_demand.summary == "Errors over their stated sigma"
    assert [figure.title for figure in made.figures] == [*titles, "By axis", on_demand.summary]  # all are drawn
    assert [chapter.anchor for chapter in made.chapters] == ["estimator-0", "verdicts", "provenance"]


def test_notes_are_sentences_and_paths_stay_as_they_are(archive):
    record = changed(cs.read(archive), notes=("g2/est/a.csv: read as poses", "error convention so3"))
    made = compose_files([record], {"mine": cs.judge(record)}, "mine.npz", {})
    texts = [block.text for block in made.chapters[-1].blocks if isinstance(block, Text)]
    assert texts == ["g2/est/a.csv: read as poses.", "Error convention so3."]


def test_ratios_by_axis_stand_in_numbers_too(archive):
    verdict = cs.judge(cs.read(archive))
    (found,) = [block for block in document(archive).chapters[1].blocks if isinstance(block, Details)]
    (shown,) = found.blocks
    for name, quantity in shown.rows:
        ratio = verdict.scale.inflation if name == "all axes" else verdict.axes.inflation[name]
        assert (quantity.value, *quantity.interval) == tuple(ratio)
    assert [name for name, _ in shown.rows][-1] == "all axes"


def test_what_the_files_do_not_tell_has_no_column(archive):
    (shown,) = [block for block in document(archive).chapters[1].blocks if isinstance(block, Table)][:1]
    heads = [column.head for column in shown.columns]
    assert {"Filter", "Verdict", "Mean ANEES", "RMSE position (m)", "Failed runs"} <= set(heads)
    assert "NIS / dof" not in heads
    assert [len(row) for _, rows in shown.groups for row in rows] == [len(heads)]


def test_the_cells_of_a_wide_table_name_their_heads(archive):
    """A narrow screen shows each row of it by itself."""
    source = as_html.render(document(archive))
    wide, narrow, _ = re.findall(r"<table.*?</table>", source, re.S)
    heads = [re.sub(r"<.*?>", "", head) for head in re.findall(r"<th scope=\"col\".*?>(.*?)</th>", wide)]
    assert re.findall(r'data-head="(.*?)"', wide) == heads[1:]
    assert 'wide">' in wide
    assert 'wide">' not in narrow


def test_errors_are_drawn_in_seconds_and_degrees_with_their_bounds(archive):
    record = read_recordings(archive)[0]
    drawn = panels(by_title(document(archive))["Errors and stated bounds"])
    assert [axes.get_ylabel() for axes in drawn] == ["x (m)", "yaw (deg)"]
    for axes, factor, variance, error in zip(
        drawn, (1.0, 180 / np.pi), (0.1, 0.2), record.errors.error[0].T, strict=True
    ):
        (line,), (below,) = lines(axes, "run 0"), lines(axes, "2-sigma bounds")
        assert_allclose(line.get_xdata(), 0.1 * np.arange(STEPS), atol=1e-6)
        assert_allclose(line.get_ydata(), factor * error)
        assert_allclose(below.get_ydata(), -2.0 * factor * np.sqrt(variance))
    assert "Time 0 is 1700000000.00 s." in by_title(document(archive))["NEES"].caption


def test_without_times_steps_are_on_the_axis(tmp_path, rng):
    np.savez(tmp_path / "e.npz", **errors_of(rng))
    clock = time_axis_of(read_recordings(tmp_path / "e.npz")[0].runs.t)
    assert (clock.word, clock.values[0], clock.values[-1]) == ("step", 1, STEPS)
    assert unit_of("axis 0") == ("", 1.0)


def test_coverage_is_that_of_the_errors(tmp_path):
    """Errors at the quantiles of a Gaussian with 4 times the stated variance: known shares, without chance."""
    n = 4000
    z = 2.0 * stats.norm.ppf((np.arange(n) + 0.5) / n)
    np.savez(tmp_path / "e.npz", errors=z.reshape(40, 100, 1), covariances=np.ones((40, 100, 1, 1)))
    p = np.array([0.1, 0.5, 0.9])
    found = observed_coverage(read_recordings(tmp_path / "e.npz")[0], p)
    expected = 2.0 * stats.norm.cdf(stats.norm.ppf(0.5 + 0.5 * p) / 2.0) - 1.0
    assert set(found) == {"axis 0", "all together"}
    for shares in found.values():
        assert_allclose(shares, expected, atol=2e-3)


def test_the_longest_run_is_shown(tmp_path, rng):
    np.savez(tmp_path / "e.npz", **errors_of(rng), lengths=np.array([STEPS - 3] * 4 + [STEPS] * (RUNS - 4)))
    assert shown_run(read_recordings(tmp_path / "e.npz")[0]) == 4


def test_a_single_run_has_a_nees_and_no_other_runs(tmp_path, rng):
    _, found = pictured(tmp_path, **{key: value[0] for key, value in errors_of(rng).items()})
    assert list(found) == ["NEES", "Errors and stated bounds", "Coverage", "Errors over their stated sigma"]
    assert found["NEES"].caption.startswith("NEES; 2 is expected")
    assert legend_of(panels(found["Errors and stated bounds"])[0].figure) == ["2-sigma bounds", "run 0"]
    assert legend_of(panels(found["Errors over their stated sigma"])[0].figure) == ["2 sigma", "run 0"]


def test_the_nees_is_drawn_between_the_bands_of_a_right_filter(archive):
    """The shade is of single steps, the dashes of all at once, the line at the degrees of freedom."""
    record = cs.read(archive)
    verdict = cs.judge(record)
    (axes,) = panels(record_figures(record, verdict)[0])
    (expected,), (own,) = lines(axes, "expected"), lines(axes, record.name)
    assert set(expected.get_ydata()) == {2.0}
    assert_allclose(own.get_ydata(), verdict.scale.anees)
    assert shaded(axes) == pytest.approx((verdict.scale.band.min(), verdict.scale.band.max()))
    (low,) = lines(axes, "band of all steps at once")
    assert_allclose(low.get_ydata(), verdict.location.simultaneous[:, 0])
    assert legend_of(axes.figure) == ["95 % band of one step", "band of all steps at once", "expected", "mine"]


def test_the_worst_run_is_named_and_drawn(tmp_path, rng):
    data = errors_of(rng)
    data["errors"][7] *= 5.0
    record, found = pictured(tmp_path, **data)
    of_runs, of_steps = panels(found["Which run, and when"])
    assert of_steps.get_ylabel() == "NEES of run 7"
    assert_allclose(places(of_runs)[0][:, 1], record.errors.nees.mean(axis=1))
    assert_allclose(places(of_runs)[1], [[7.0, record.errors.nees[7].mean()]])


def test_the_first_steps_set_no_axis(tmp_path, rng):
    """A filter that starts with a large error and says so."""
    data = errors_of(rng)
    usual = np.abs(data["errors"]).max()
    data["errors"][:, :2] *= 1000.0
    data["covariances"] = data["covariances"] * np.where(np.arange(STEPS) < 2, 1e6, 1.0)[:, None, None]
    _, found = pictured(tmp_path, **data)
    assert panels(found["Errors and stated bounds"])[0].get_ylim()[1] < 10.0 * usual
    assert panels(found["Errors over their stated sigma"])[0].get_ylim()[1] < 10.0


def test_runs_of_one_step_stand_side_by_side(tmp_path, rng):
    """A factor or a calibration: no curve along the steps, which would be a point."""
    errors = rng.normal(size=(RUNS, 1, 2))
    covariances = np.broadcast_to(np.diag([0.25, 4.0]), (RUNS, 1, 2, 2))
    _, found = pictured(tmp_path, errors=errors, covariances=covariances, axes=["x", "yaw"])
    of_nees, of_errors, _ = found.values()
    for axes, factor, sigma, error in zip(
        panels(of_errors), (1.0, 180 / np.pi), (0.5, 2.0), errors[:, 0].T, strict=True
    ):
        assert_allclose(places(axes)[0], np.column_stack([np.arange(RUNS), factor * error]))
        assert_allclose(shaded(axes), (-2 * factor * sigma, 2 * factor * sigma))
    (axes,) = panels(of_nees)
    assert_allclose(places(axes)[0][:, 1], errors[:, 0] ** 2 @ [4.0, 0.25])
    span = axes.patches[0]
    ends = span.get_y(), span.get_y() + span.get_height()
    assert_allclose(stats.chi2.cdf(ends, 2), (0.025, 0.975))


@pytest.mark.parametrize("steps", [1, STEPS])
def test_a_plot_has_one_legend_outside_its_panels(steps, tmp_path, rng):
    np.savez(tmp_path / "e.npz", **{key: value[:, :steps] for key, value in errors_of(rng).items()})
    record = cs.read(tmp_path / "e.npz")
    unnamed = changed(record, axes=())
    for figure, many in ((record.plot(), 3), (unnamed.plot(), 3), (cs.judge(record).plot(), 4)):
        shown = [axes for axes in figure.axes if axes.axison]
        assert len(shown) == many
        assert not any(axes.get_legend() for axes in shown)
        (legend,) = figure.legends
        texts = [text.get_text() for text in legend.get_texts()]
        assert len(set(texts)) == len(texts)
        assert {"expected", "axis 0", "axis 1", "all together"} <= set(texts)


def test_what_is_not_there_is_not_drawn(tmp_path, rng):
    np.savez(tmp_path / "n.npz", nees=rng.chisquare(3, (RUNS, STEPS)), dof=3)
    assert set(by_title(document(tmp_path / "n.npz"))) >= {"NEES", "Coverage"}
    assert "Errors and stated bounds" not in by_title(document(tmp_path / "n.npz"))
    rows = "".join(f"{r},{k},{rng.chisquare(2)},2\n" for r in range(RUNS) for k in range(1, STEPS + 1))
    (tmp_path / "i.csv").write_text("run,step,nis,nis_dof\n" + rows)
    made = document(tmp_path / "i.csv")
    assert [f.title for f in made.chapters[0].blocks if isinstance(f, Figure)] == ["Innovations"]
    with pytest.raises(cs.InputError, match="neither errors nor NEES to draw"):
        cs.read(tmp_path / "i.csv").plot()


def test_each_of_several_estimators_has_its_sentence(tmp_path, rng):
    lines = ["filter,run,step,a,P_a_a"]
    for name, scale in (("good", 1.0), ("bad", 3.0)):
        lines += [
            f"{name},{r},{k},{scale * rng.normal()},1" for r in range(RUNS) for k in range(1, STEPS + 1)
        ]  # fmt: skip
    (tmp_path / "e.csv").write_text("\n".join(lines))
    (tmp_path / "t.csv").write_text("step,a\n" + "".join(f"{k},0\n" for k in range(1, STEPS + 1)))
    records = read_recordings(tmp_path / "e.csv", tmp_path / "t.csv", state=["a"])
    made = compose_files(records, judge_all(records), "e.csv", {})
    assert [chapter.title for chapter in made.chapters[:2]] == ["good", "bad"]
    assert isinstance(made.chapters[1].blocks[0], Text)
    assert made.chapters[1].blocks[0].text.startswith("bad is overconfident")
    with pytest.raises(cs.InputError, match=r"holds several estimators \(good, bad\); choose one with filter="):
        cs.read(tmp_path / "e.csv", tmp_path / "t.csv", state=["a"])
    with pytest.raises(cs.InputError, match="filter 'ugly' is not in"):
        cs.read(tmp_path / "e.csv", tmp_path / "t.csv", state=["a"], filter="ugly")
    assert (
        cs.judge(cs.read(tmp_path / "e.csv", tmp_path / "t.csv", state=["a"], filter="bad")).status == "overconfident"
    )


# --- the command ------------------------------------------------------------------------------------


def test_one_command_writes_page_paper_and_numbers(archive, capsys):
    out = archive.parent / "deep" / "out"
    printed, _ = consistency(capsys, "analyse", archive, "--report", out)
    assert sorted(path.name for path in out.iterdir()) == [
        "manifest.json", "report.html", "report.pdf", "verdict.json",
    ]  # fmt: skip
    assert str(out / "report.html") in printed
    verdict = cs.judge(cs.read(archive))
    assert json.loads((out / "verdict.json").read_text())["mine"]["reasons"] == list(verdict.reasons)
    assert verdict.reasons[0].split(",")[0] in (out / "report.html").read_text()
    assert (out / "report.pdf").read_bytes().startswith(b"%PDF")
    (out / "report.pdf").unlink()
    shown, _ = consistency(capsys, "analyse", archive, "--report", out)  # it replaces what it has written itself
    assert shown == printed
    assert (out / "report.pdf").exists()
    (out / "mine.txt").write_text("mine")
    assert "exists already" in refused(capsys, "analyse", archive, "--report", out)


def test_a_report_that_is_not_replaced_is_refused_before_the_work(archive, tmp_path, capsys):
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "mine.txt").write_text("mine")
    why = f"--report {taken}: exists already; choose another folder or add --overwrite (overwrite=True in Python)"
    assert why in refused(capsys, "analyse", archive, "--report", taken)
    other = tmp_path / "junit.xml"
    other.write_text("<testsuites></testsuites>\n")
    why = f"{other}: exists already; name another file or add --overwrite"
    assert why in refused(capsys, "analyse", tmp_path / "not-there.npz", "--report", other)
    assert (taken / "mine.txt").read_text() == "mine"


def test_a_file_that_analyse_has_written_is_replaced(archive, tmp_path, capsys):
    report = tmp_path / "r.xml"
    consistency(capsys, "analyse", archive, "--report", report)
    first = report.read_text()
    consistency(capsys, "analyse", archive, "--report", report)
    assert report.read_text() == first
    report.write_text(f"{first}more")
    assert "exists already" in refused(capsys, "analyse", archive, "--report", report)
    consistency(capsys, "analyse", archive, "--report", report, "--overwrite")


def test_results_of_the_bench_have_another_report(tmp_path, capsys):
    scenario = cs.load_scenario("linear-gaussian").variant("short", truth__steps=5)
    cs.run_trials(scenario, ["kf"], runs=2, jobs=1).write(tmp_path / "results")
    _, err = consistency(capsys, "analyse", tmp_path / "results", "--report", tmp_path / "r", status=2)
    assert f"use 'consistency report {tmp_path / 'results'}'" in err
    assert not (tmp_path / "r").exists()


# --- Python -----------------------------------------------------------------------------------------


def test_a_record_and_its_verdict_draw_themselves(archive, tmp_path):
    record = cs.read(archive)
    assert repr(record) == f"<Record mine: {RUNS} runs x {STEPS} steps, error - of x, yaw>"
    verdict = cs.judge(record, false_alarm=0.01, detect=2.0)
    assert (verdict.settings.false_alarm, verdict.settings.detect) == (0.01, 2.0)
    assert isinstance(record.plot(), Drawn)
    assert len(verdict.plot(tmp_path / "v.png").axes) == 4  # x, yaw, NEES, coverage
    assert (tmp_path / "v.png").read_bytes().startswith(b"\x89PNG")
    assert "<svg" in verdict._repr_html_()
    assert "<dt>runs</dt><dd>30</dd>" in record._repr_html_()
    with pytest.raises(cs.InputError, match=r"must end in \.png, \.pdf, \.svg"):
        record.plot(tmp_path / "v.jpg")
    with pytest.raises(cs.InputError, match="false_alarm must lie between 0 and 1"):
        cs.judge(record, false_alarm=2.0)


def test_names_of_files_are_shown_as_they_are(tmp_path, rng):
    np.savez(tmp_path / "<b>a&b.npz", **errors_of(rng))
    record = cs.read(tmp_path / "<b>a&b.npz")
    assert "<b>" not in record._repr_html_()
    assert "<b>" not in cs.judge(record)._repr_html_()


def test_a_junit_file_names_the_command_that_wrote_it(tmp_path, monkeypatch, capsys):
    rng = np.random.default_rng(1)
    np.savez(tmp_path / "est.npz", errors=rng.normal(size=(40, 5, 2)), covariances=np.tile(np.eye(2), (40, 5, 1, 1)))
    words = ["analyse", str(tmp_path / "est.npz"), "--report", str(tmp_path / "a <b>.xml")]
    monkeypatch.setattr("sys.argv", ["/somewhere/consistency", *words])
    consistency(capsys, *words)
    suite = ElementTree.parse(tmp_path / "a <b>.xml").find("testsuite")
    command = suite.find("properties/property[@name='command']").get("value")
    assert shlex.split(command) == ["consistency", *words]
    assert suite.find("testcase") is not None
