"""Exhibits of the experiments on the sensor: every finding has one, with its rule, its tables and its figures."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from painted import by_title, legend_of, lines, panels, titles
from scripts import experiment, figures

import consistency as cs
from consistency.bench.pages import results_report
from consistency.bench.pages.results_report import build_report
from consistency.bench.pages.sections.published_findings import (
    P_VALUE,
    STATUS,
    Exhibit,
    Source,
    exhibit_blocks,
    listing,
)
from consistency.referee.show.blocks import Column, Heading, Stack, Status, Table, Text

images, sensor_issues = figures("images"), figures("sensor_issues")
SECTIONS = (sensor_issues, images)
SCRIPTS = ("e20_bias_or_noise", "e21_sensor_issues", "e24_image_noise", "e25_image_tracks", "e26_lens_models")
TEXT = dict.fromkeys(("source", "claim", "statistic", "published", "measured"), "")


def written(folder, tables, ids=()):
    """A folder of findings that are reproduced, with these tables."""
    study = cs.Study(jobs=1)
    study.tables |= tables
    findings = [study.finding(True, "none", id=name, **TEXT, accept=f"rule of {name}") for name in ids]
    study.write(folder, findings, 0.0)
    return folder


def rows_of(table):
    [(_, rows)] = table.groups
    return rows


def issues(folder):
    return exhibit_blocks(build_report(folder), sensor_issues.EXHIBITS)


def test_every_finding_on_the_sensor_has_one_exhibit_with_its_name_as_title():
    exhibits = [exhibit for module in SECTIONS for exhibit in module.EXHIBITS]
    named = [name for exhibit in exhibits for name in exhibit.findings]
    wanted = [name for script in SCRIPTS for name in experiment(script).FINDINGS]
    assert sorted(named) == sorted(wanted)
    for exhibit in exhibits:
        assert exhibit.title.startswith(", ".join(exhibit.findings) + ": ")


def test_an_exhibit_has_its_own_findings_and_none_without_a_table(tmp_path):
    def numbers(data):
        return listing(data, {"x": ("X", ".1f")}, "numbers")

    exhibits = (Exhibit(("a", "b"), "a, b: two", (Source("first", ("x",), (), numbers),)),
                Exhibit(("c",), "c: one", (Source("second", ("x",), (), numbers),)))  # fmt: skip
    folder = written(tmp_path / "out", {"first": pd.DataFrame({"x": [1.25]})}, ("c", "b", "a"))
    heading, findings, table = exhibit_blocks(build_report(folder), exhibits)
    assert heading == Heading("a, b: two")
    assert [row[0] for row in rows_of(findings)] == [Stack("b", (), bold=True), Stack("a", (), bold=True)]
    assert "Accepted if: rule of b" in [line.text for line in rows_of(findings)[0][1].below]
    assert rows_of(findings)[0][-1] == Status("reproduced")
    assert rows_of(table) == (("1.2",),)
    (folder / "first.parquet").unlink()
    assert exhibit_blocks(build_report(folder), exhibits) == ()


def test_chapters_of_scripts_stand_on_paper_as_they_say(tmp_path, monkeypatch):
    def script(name, on_paper):
        return SimpleNamespace(CHAPTER=(name, name.title(), "Entry"), ON_PAPER=on_paper, blocks=lambda _: (Text("x"),))

    scripts = {"first": script("first", True), "second": script("second", False)}
    monkeypatch.setattr(results_report, "figure_scripts", lambda: scripts)
    report = build_report(written(tmp_path / "out", {}, ("a",)))
    first, second = results_report._of_experiments(report, brief=True)
    assert (first.anchor, first.title, first.link, first.on_paper) == ("first", "First", "Entry", None)
    assert second.on_paper == ()
    assert [chapter.on_paper for chapter in results_report._of_experiments(report, brief=False)] == [None, None]


def test_a_listing_writes_text_numbers_and_verdicts():
    data = pd.DataFrame({"name": ["a"], "x": [2.0 / 3.0], "status": ["biased"], "y": [np.nan], "p": [1e-9]})
    heads = {"status": ("Verdict", STATUS), "name": ("Name", ""), "x": ("X", ".2f"), "y": ("Y", ".1f"),
             "p": ("p", P_VALUE)}  # fmt: skip
    table = listing(data, heads, "label", "caption")
    assert rows_of(table) == ((Status("biased"), "a", "0.67", "–", "< 1e-6"),)
    numbers = tuple(Column(head, number=True) for head in ("X", "Y", "p"))
    assert table.columns == (Column("Verdict"), Column("Name"), *numbers)


OUTCOME = {"status": "biased", "anees": 4.0, "precision": np.nan, "recall": np.nan}


def test_spurious_features_are_shown_with_their_bounds(tmp_path):
    steps = pd.DataFrame({"step": [1, 2], "x": [0.1, np.nan], "y": [0.2, 0.3], "heading": [4.0, 5.0],
                          "sigma_x": [1.0, np.nan], "sigma_y": [0.5, 0.6], "sigma_heading": [7.0, 8.0]})  # fmt: skip
    rows = pd.DataFrame([OUTCOME | {"case": "plain", "rmse_position_m": 0.1, "rmse_heading_deg": 2.0}])
    guarded = rows.assign(precision=0.9, recall=0.8)
    tables = {"fig10a": rows, "fig10a_errors": steps, "fig10b": guarded, "fig10b_errors": steps}
    blocks = issues(written(tmp_path / "out", tables))
    plain, behind = (block for block in blocks if isinstance(block, Table))
    assert rows_of(plain) == (("plain", Status("biased"), "4.00", "0.100", "2.00"),)
    assert rows_of(behind) == (("plain", Status("biased"), "4.00", "0.100", "2.00", "0.900", "0.800"),)
    _, y, heading = panels(by_title(blocks)["Errors and bounds"])
    assert_allclose(lines(y, "error")[0].get_ydata(), [0.2, 0.3])
    assert_allclose(lines(y, "2-sigma bounds")[0].get_ydata(), [-1.0, -1.2])
    assert_allclose(lines(heading, "2-sigma bounds")[0].get_ydata(), [-14.0, -16.0])


def test_lenses_and_features_are_drawn(tmp_path):
    cases = [(d, k1, name) for name in ("one", "two") for k1 in (0.0, 0.1) for d in (20.0, 90.0)]
    lenses = pd.DataFrame(cases, columns=["degrees", "k1", "filter"]).assign(
        status="biased", anees=np.arange(8.0) + 3.0, rmse_position_m=0.1, rmse_heading_deg=np.arange(8.0) + 1.0
    )
    mix = pd.DataFrame([OUTCOME | {"case": case, "rmse_position_m": m, "rmse_heading_deg": deg}
                        for case, m, deg in (("near", 0.1, 2.0), ("far", 0.2, 1.0))])  # fmt: skip
    counts = mix.assign(count=[2, 8], p=[np.nan, 1e-3])
    tables = {"field_of_view": lenses, "near_far_mix": mix, "feature_count": counts}
    blocks = issues(written(tmp_path / "out", tables))
    figures = by_title(blocks)
    heading, nees = panels(figures["Field of view"])
    assert_allclose(lines(heading)[1].get_ydata(), [3.0, 4.0])
    assert_allclose(lines(nees)[3].get_ydata(), [9.0, 10.0])
    assert lines(nees)[-1].get_ydata()[0] == 3.0
    assert legend_of(heading.figure)[1] == "one, k1 left over 0.1"
    position, turn = panels(figures["Errors over the number of features"])
    assert_allclose(lines(position)[0].get_xydata(), [[2, 0.1], [8, 0.2]])
    assert_allclose(lines(turn)[0].get_ydata(), [2.0, 1.0])
    tables_of = {block.label: rows_of(block) for block in blocks if isinstance(block, Table)}
    assert [row[-1] for row in tables_of["Counts of features"]] == ["–", "0.001"]
    assert tables_of["Outcomes"][1] == ("far", Status("biased"), "4.00", "0.200", "1.00")


def test_a_bias_map_is_drawn_row_by_row(tmp_path):
    u, v = np.meshgrid([-1.0, 0.0, 1.0], np.linspace(-60.0, 60.0, 13))
    many = pd.DataFrame({"u": u.ravel(), "v": v.ravel(), "bias_d": (u * v).ravel()}).sample(frac=1.0, random_state=1)
    few = many[many["v"].isin([-60.0, 0.0, 10.0])].assign(model="none")
    curves = pd.DataFrame({"belief": ["a", "a", "b"], "step": [1, 2, 2], "nees": [3.0, 4.0, 9.0]})
    tables = {"bias_or_noise_map": many, "lens_models_bias": few, "bias_or_noise_nees": curves}
    figures = by_title(issues(written(tmp_path / "out", tables)))
    _, *rows = lines(panels(figures["Bias of disparity"])[0])
    assert_allclose([row.get_ydata()[2] for row in rows], [0.0, 20.0, 40.0, 60.0])
    assert_allclose(rows[1].get_xdata(), [-1.0, 0.0, 1.0])
    (panel,) = panels(figures["Bias of disparity by lens model"])
    assert_allclose([row.get_ydata()[0] for row in lines(panel)[1:]], [60.0, 0.0, -10.0])
    assert titles([panel]) == ["lens model: none"]
    assert panel.get_ylim() == pytest.approx((-69.0, 69.0))
    rule, first, second = lines(panels(figures["ANEES by belief"])[0])
    assert (rule.get_ydata()[0], first.get_ydata().tolist(), second.get_xdata().tolist()) == (3.0, [3.0, 4.0], [2])


@pytest.mark.parametrize("name, module", [("bias_survivors", sensor_issues), ("guarded", sensor_issues)])
def test_a_table_that_lacks_a_column_is_refused(tmp_path, name, module):
    folder = written(tmp_path / "out", {name: pd.DataFrame({"filter": ["x"]})})
    with pytest.raises(cs.InputError, match=rf"{name}\.parquet: column '\w+' is missing"):
        exhibit_blocks(build_report(folder), module.EXHIBITS)
