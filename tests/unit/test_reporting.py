"""Reports say what the diagnostics say, show every name literally, and appear whole or not at all."""

from __future__ import annotations

import json
import os
import re
from dataclasses import asdict, replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

import consistency as cs
from consistency.diagnostics.wording import short
from consistency.findings import Finding
from consistency.montecarlo import run_log, simulate_log
from consistency.reporting import build, captions, diagnosis, html, pdf, wording, write_reports
from consistency.reporting.build import build_report
from consistency.reporting.calibration import calibration
from consistency.reporting.thin import thin
from consistency.results import read_results

ODD = {
    "ekf-xyz": "<script>alert(1)</script><img src=x onerror=alert(2)>",
    "ekf-uvd": "#set *b* $x^2$ $$y$$ \\frac `c` @ref {{ 7*7 }} </script>",
}
FILTERS = list(ODD)
FINDING = Finding(
    "fig11b", "Herath 2007, fig. 11b", "unacceptably large <ANEES>", "mean ANEES", "large", "58", "above 3.72",
    "reproduced", 4, 0, "small",
)  # fmt: skip


@pytest.fixture(scope="session")
def results(uvd):
    return cs.run_trials(uvd, FILTERS, runs=4, seed=1, jobs=1)


@pytest.fixture
def folder(results, tmp_path) -> Path:
    results.write(tmp_path / "run")
    return tmp_path / "run"


def odd_results(results):
    """The same under odd names; one filter fails in two runs, the other in all of them at once."""
    estimates = results.estimates.assign(filter=results.estimates["filter"].map(ODD))
    first, second = ODD.values()
    late = (estimates["filter"] == first) & (estimates["run"] < 2) & (estimates["step"] >= 30)
    estimates = estimates[~late & (estimates["filter"] != second)]
    rows = [(first, run, 30, "not positive definite") for run in (0, 1)]
    rows += [(second, run, 1, "<b>broken</b> $ # " + 150 * "x") for run in range(4)]
    failures = pd.DataFrame(rows, columns=["filter", "run", "step", "reason"])
    return replace(
        results, estimates=estimates, failures=failures, manifest=results.manifest | {"filters": list(ODD.values())}
    )


def reproduction(results, folder: Path) -> Path:
    """A folder as ``consistency reproduce`` writes it."""
    folder.mkdir()
    results.write(folder / "small")
    rng = np.random.default_rng(3)
    rows = []
    for baseline in (0.09, 0.5):
        d = 150 * baseline / 10 + 0.65 * rng.standard_normal(3000)
        u = -15 + 1.34 * rng.standard_normal(3000)
        u, d = u[d > 1], d[d > 1]
        rows.append(
            pd.DataFrame({"baseline": baseline, "x": baseline * 150 / d, "y": -baseline * u / d, "u": u, "d": d})
        )
    pd.concat(rows).to_parquet(folder / "fig12.parquet")
    (folder / "findings.json").write_text(json.dumps([asdict(FINDING)]))
    manifest = results.manifest | {"studies": ["small"]}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder


class Page(HTMLParser):
    """Text, tags and whatever a browser would load."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.text: list[str] = []
        self.tags: list[str] = []
        self.loads: list[str] = []
        self.style = ""
        self.feed(source)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        given = dict(attrs)
        self.loads += [str(given[key]) for key in ("src", "srcset", "poster", "data") if key in given]
        if tag == "link":
            self.loads.append(str(given.get("href")))

    def handle_data(self, data):
        if self.tags and self.tags[-1] == "style":
            self.style += data
        self.text.append(data)


def test_the_model_is_what_analyse_says(folder):
    results = read_results(folder)
    verdicts, (study,) = cs.analyse(results), build_report(folder).studies
    for track in study.tracks:
        verdict = verdicts[track.name]
        assert track.verdict.status == verdict.status
        assert track.verdict.reasons == verdict.reasons
        np.testing.assert_array_equal(track.anees, verdict.statistics["anees"])
        np.testing.assert_array_equal(track.simultaneous, verdict.statistics["simultaneous"])
        table = results.estimates[results.estimates["filter"] == track.name]
        by_step = table.groupby("step")
        np.testing.assert_allclose(track.nis_ratio, by_step["nis"].sum() / by_step["nis_dof"].sum().replace(0, np.nan))
        first = table[table["run"] == 0]
        np.testing.assert_allclose(track.sigma[:, 2], np.rad2deg(np.sqrt(first["P_hh"])))
        np.testing.assert_allclose(track.path, first[["x", "y"]])


def test_the_odometry_is_that_of_the_trial(folder, uvd):
    (study,) = build_report(folder).studies
    trial = cs.simulate(uvd, run=0, seed=1)
    np.testing.assert_array_equal(study.true_path, trial.truth[:, :2])
    step = trial.controls[0, 0] * trial.controls[0, 1]
    np.testing.assert_allclose(np.linalg.norm(study.odometry[1] - study.odometry[0]), abs(step))


def test_verdict_cells_are_the_statistics(folder):
    (study,) = build_report(folder).studies
    cells, s = wording.verdict_row(study.tracks[0]), study.tracks[0].verdict.statistics
    assert cells[2] == short(s["mean_anees"])
    assert cells[3].startswith(f"×{short(s['ratio'])} [")
    assert cells[3].endswith(f", {short(s['ratio_interval'][1])}]")
    assert cells[5] == ("–" if s["since"] is None else str(s["since"]))
    assert cells[7] == f"{np.rad2deg(s['rmse_heading']):.2f}"
    assert cells[9] == "0 of 4"
    assert len(cells) == len(wording.VERDICT_COLUMNS)
    cells = wording.figure_row(study.tracks[0])
    assert cells[3] == " / ".join(f"{100 * share:.1f}" for share in s["coverage"])
    assert len(cells) == len(wording.FIGURE_COLUMNS)


def test_an_interval_that_says_nothing_is_shown_as_such(folder):
    (study,) = build_report(folder).studies
    track = study.tracks[0]
    s = track.verdict.statistics | {"ratio": 2.5, "ratio_interval": (0.0, np.inf)}
    assert wording.inflation(replace(track, verdict=replace(track.verdict, statistics=s))) == "×2.50 [0, ∞]"


def test_the_diagnosis_is_what_the_verdict_holds(folder):
    (study,) = build_report(folder).studies
    questions = {question: answers for question, _, answers in diagnosis.asked(study)}
    by_name = {part.name: dict(part.rows) for part in diagnosis.forests(study)}
    for number, track in enumerate(study.tracks):
        s = track.verdict.statistics
        assert {q for q, answers in questions.items() if answers[number]} == {a["question"] for a in s["answers"]}
        for answer in s["answers"]:
            assert questions[answer["question"]][number] is answer
        assert by_name["ratio"]["x"][number] == pytest.approx(s["of_axes"]["x"])
        assert by_name["ratio"][diagnosis.WHOLE][number] == pytest.approx((s["ratio"], *s["ratio_interval"]))
        assert by_name["coverage"]["y"][number][0] == pytest.approx(100 * s["coverage_one_step"][1])
        if "bias" in s:
            assert by_name["bias"]["heading"][number] == pytest.approx(s["bias"]["heading"])
        of = diagnosis.steps(track, lambda values: np.arange(len(values)))
        np.testing.assert_array_equal(of.x[1:-1], s["pit"])
        np.testing.assert_allclose(of.y, [0, 0.25, 0.5, 0.75, 1, 1])
    text = "".join(Page(html.render_html(build_report(folder))).text)
    assert all(question in text and about in text for question, about, _ in diagnosis.asked(study))


@pytest.mark.parametrize(
    ("answer", "cell"),
    [
        (None, ("–", "")),
        ({"adjusted": 3e-7, "found": True}, ("✗", "< 1e-6")),
        ({"adjusted": 0.0123, "found": True}, ("✗", "0.012")),
        ({"adjusted": 1.0, "found": False}, ("○", "1")),
    ],
)
def test_answers_have_a_mark_and_not_colour_alone(answer, cell):
    assert wording.answer_cell(answer) == cell


@pytest.mark.parametrize("ends", [(0.0, np.inf), (1e-12, 1e12), (19.0, 21.0)])
def test_windows_are_finite_and_hold_every_value(folder, ends):
    (study,) = build_report(folder).studies
    track = study.tracks[0]
    s = track.verdict.statistics | {"of_axes": {"x": (20.0, *ends)}, "ratio": 0.5, "ratio_interval": ends}
    s["bias"] = {"x": (-4.0, -ends[1], ends[1])}
    study = replace(study, tracks=(replace(track, verdict=replace(track.verdict, statistics=s)),))
    for part in diagnosis.forests(study):
        low, high = part.window
        assert np.isfinite(part.window).all()
        values = [interval[0] for _, row in part.rows for interval in row if interval] + [part.expected]
        assert low < min(values) <= max(values) < high


@pytest.mark.parametrize("empty", [{}, {"ratio": np.nan, "pit": np.empty(0), "pit_half_width": np.nan}])
def test_a_verdict_without_figures_is_drawn_all_the_same(folder, empty):
    report = build_report(folder)
    (study,) = report.studies
    tracks = tuple(
        replace(
            t, verdict=replace(t.verdict, status="undecided", statistics=least(t.verdict.statistics) | empty),
            anees=None, band=None, simultaneous=None,
        )
        for t in study.tracks
    )  # fmt: skip
    report = replace(report, studies=(replace(study, tracks=tracks),))
    assert "There was nothing to ask" in html.render_html(report)
    assert pdf.render_pdf(report).startswith(b"%PDF")


def least(statistics):
    """What every verdict has."""
    return {key: statistics[key] for key in ("runs", "steps", "false_alarm", "failures")} | {"answers": []}


def test_nees_alone_without_axes(folder):
    report = build_report(folder)
    (study,) = report.studies
    whole = cs.diagnostics.judge("nees", nees=np.random.default_rng(0).chisquare(3, (30, 60)), dof=3)
    track = replace(study.tracks[0], verdict=whole)
    study = replace(study, tracks=(track,))
    (part,) = diagnosis.forests(study)
    assert [label for label, _ in part.rows] == [diagnosis.WHOLE]
    assert pdf.render_pdf(replace(report, studies=(study,))).startswith(b"%PDF")


def test_the_captions_state_the_rates_in_force(folder):
    report = build_report(folder)
    s = report.studies[0].tracks[0].verdict.statistics
    (share,) = (a["share"] for a in s["answers"] if a["question"] == "scale in some step")
    assert f"at most {100 * share * s['false_alarm']:.2g} %" in captions.anees_caption(report.studies[0])
    assert "probability 5 % at most" in captions.method(report)


CALIBRATION = {
    "steps": 100, "dof": 3, "seed": 1, "wall_time_s": 1.0,
    "questions": {"false alarm": "a right filter is found at fault", "power": "`plan` keeps its word"},
    "worlds": {"independent": "independent steps", "elsewhere": "steps that <depend> on each other"},
    "rows": [
        {"world": "independent", "question": "power", "ratio": 1.5, "runs": 61, "looks": 1, "stated": 0.95,
         "bound": ">=", "gates": 100, "found": 100},
        {"world": "independent", "question": "false alarm", "ratio": 1.0, "runs": 21, "looks": 1, "stated": 0.05,
         "bound": "<=", "gates": 200, "found": 2},
        {"world": "elsewhere", "question": "false alarm", "ratio": 1.0, "runs": 21, "looks": 1, "stated": 0.05,
         "bound": "<=", "gates": 200, "found": 9},
        {"world": "elsewhere", "question": "power", "ratio": 1.5, "runs": 500, "looks": 0, "mean_runs": 19.0,
         "late_runs": 30.0, "stated": 0.95, "bound": ">=", "gates": 100, "found": 80},
    ],
}  # fmt: skip


def test_the_calibration_is_a_table_of_promises_with_the_interval_of_the_worst_world(folder, tmp_path):
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(CALIBRATION))
    found = calibration(path)
    assert found.gates == 600
    (first, (alarm,)), (second, (power, decided)) = wording.calibration_groups(found)
    assert (first, second) == ("false alarm: a right filter is found at fault", "power: plan keeps its word")
    # Clopper & Pearson of 9 in 200 at 99 %
    low, high = stats.beta.ppf(0.005, 9, 192), stats.beta.ppf(0.995, 10, 191)
    interval = f"{100 * low:.1f} to {100 * high:.1f} %"
    assert alarm == ("1, right", "21", "≤ 5 %", "200 in 2 worlds", "1.0 to 4.5 %", "elsewhere", interval)
    assert power[:6] == ("1.5", "61", "≥ 95 %", "100", "100.0 %", "independent")
    assert decided[1] == "19, 500 at most"
    assert [promise.worst.broken for promise in found.promises] == [False, False, True]
    assert {len(row) for row in (alarm, power, decided)} == {len(wording.CALIBRATION_COLUMNS)}
    report = replace(build_report(folder), calibration=found)
    page = html.render_html(report)
    assert "How far the referee can be trusted" in page
    assert "steps that &lt;depend&gt; on each other" in page
    assert "plan keeps its word" in page
    assert pdf.render_pdf(report).startswith(b"%PDF")


def test_without_a_calibration_the_appendix_says_nothing(folder, tmp_path):
    assert calibration(tmp_path / "none.json") is None
    report = replace(build_report(folder), calibration=None)
    assert "How far the referee" not in html.render_html(report)
    assert pdf.render_pdf(report).startswith(b"%PDF")


def test_the_answer_names_every_filter(folder):
    report = build_report(folder)
    assert all(name in report.answer for name in FILTERS)
    assert report.studies[0].tracks[0].verdict.status in report.answer.lower()


def test_both_files_are_written_and_refused_a_second_time(folder):
    targets = [folder / "report.html", folder / "report.pdf"]
    assert write_reports(folder, *targets, overwrite=False) == targets
    assert targets[1].read_bytes().startswith(b"%PDF")
    before = sorted(os.listdir(folder))
    with pytest.raises(cs.InputError, match=r"report\.html: exists already; .*--overwrite"):
        write_reports(folder, *targets, overwrite=False)
    contents = [path.read_bytes() for path in targets]
    assert write_reports(folder, *targets, overwrite=True) == targets
    assert contents[1] == targets[1].read_bytes()
    assert sorted(os.listdir(folder)) == before


def test_one_of_the_two_alone(folder, tmp_path):
    assert write_reports(folder, None, tmp_path / "new" / "r.pdf", overwrite=False) == [tmp_path / "new" / "r.pdf"]
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["r.pdf"]


def test_targets_that_cannot_be_written(folder, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(cs.InputError, match="cannot be written"):
        write_reports(folder, tmp_path / "file" / "r.html", None, overwrite=True)
    with pytest.raises(cs.InputError, match="is a folder"):
        write_reports(folder, folder, None, overwrite=True)
    with pytest.raises(cs.InputError, match="both"):
        write_reports(folder, tmp_path / "r", tmp_path / "r", overwrite=True)


def test_nothing_is_left_of_a_report_that_breaks(folder, monkeypatch):
    monkeypatch.setattr(pdf, "render_pdf", lambda report: 1 / 0)
    before = sorted(os.listdir(folder))
    with pytest.raises(ZeroDivisionError):
        write_reports(folder, folder / "report.html", folder / "report.pdf", overwrite=False)
    assert sorted(os.listdir(folder)) == before


def test_a_file_that_exists_survives_a_write_that_breaks(folder, monkeypatch):
    target = folder / "report.html"
    target.write_text("before")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(cs.InputError, match=r"cannot be written \(No space left on device\)"):
        write_reports(folder, target, None, overwrite=True)
    assert target.read_text() == "before"
    assert not list(folder.glob(".report*"))


def test_folders_without_results(tmp_path, uvd):
    with pytest.raises(cs.InputError, match="no such folder"):
        write_reports(tmp_path / "none", tmp_path / "none" / "report.html", None, overwrite=False)
    assert not (tmp_path / "none").exists()
    simulate_log(uvd, 1, 0, tmp_path / "log")
    with pytest.raises(cs.InputError, match="holds no filter results"):
        write_reports(tmp_path / "log", tmp_path / "r.html", None, overwrite=False)


def test_odd_names_are_shown_literally(results, tmp_path):
    odd_results(results).write(tmp_path / "odd")
    report = build_report(tmp_path / "odd")
    source = html.render_html(report)
    page = Page(source)
    text = "".join(page.text)
    for name in ODD.values():
        assert name in text
    assert "img" not in page.tags
    assert "49" not in report.answer
    assert "<script>alert" not in source
    assert pdf.render_pdf(report).startswith(b"%PDF")


def test_failed_runs_are_listed(results, tmp_path):
    odd_results(results).write(tmp_path / "odd")
    (study,) = build_report(tmp_path / "odd").studies
    assert len(study.failures) == 6
    assert study.tracks[1].verdict.status == "failed"
    assert not np.isfinite(study.tracks[1].path).any()
    assert "6 of 8 runs" in build_report(tmp_path / "odd").answer


def test_only_failed_runs_give_a_filter_bands_of_its_own(results, tmp_path):
    late = (
        (results.estimates["filter"] == "ekf-xyz") & (results.estimates["run"] == 0) & (results.estimates["step"] > 29)
    )
    rows = [("ekf-xyz", 0, 30, "not positive definite")]
    failures = pd.DataFrame(rows, columns=["filter", "run", "step", "reason"])
    replace(results, estimates=results.estimates[~late], failures=failures).write(tmp_path / "run")
    report = build_report(tmp_path / "run")
    assert [track.own_band for track in report.studies[0].tracks] == [True, False]
    assert report.studies[0].common_band.name == "ekf-uvd"
    assert "Fewer runs carry the curve of ekf-xyz" in html.render_html(report)
    assert pdf.render_pdf(report).startswith(b"%PDF")


def test_html_loads_nothing_and_is_small(results, tmp_path):
    report = build_report(reproduction(results, tmp_path / "all"))
    source = html.render_html(report)
    page = Page(source)
    assert len(source.encode()) <= 6_000_000
    assert page.loads == ["data:,"]
    assert not re.search(r"@import|url\((?!['\"]?data:)", page.style)
    assert "default-src 'none'" in source
    assert page.tags.count("h1") == 1


def test_many_long_studies_stay_below_six_megabytes(results, tmp_path):
    results.write(tmp_path / "run")
    report = build_report(tmp_path / "run")
    steps = 20_000
    rng = np.random.default_rng(0)

    def long(track):
        anees = rng.random(steps)
        anees[7_777] = 99.0
        return replace(
            track, path=rng.random((steps, 2)), error=rng.random((steps, 3)), sigma=rng.random((steps, 3)), anees=anees,
            band=np.tile([2.0, 4.0], (steps, 1)), simultaneous=np.tile([1.0, 5.0], (steps, 1)), nis_ratio=anees,
        )  # fmt: skip

    study = replace(
        report.studies[0], steps=np.arange(1, steps + 1), tracks=tuple(long(t) for t in report.studies[0].tracks * 4)
    )
    limit = html.points_a_line(replace(report, studies=(study,) * 6))
    assert 120 <= limit < 2000
    source = html.render_html(replace(report, studies=(study,) * 6))
    assert len(source.encode()) <= 6_000_000
    assert "peaks and troughs are kept" in source


def test_thin_keeps_extremes_ends_and_short_lines():
    line = np.sin(np.linspace(0, 60, 30_000))
    line[12_345], line[23_456] = 7.0, -7.0
    line[5_000:6_000] = np.nan
    keep = thin(line, limit=500)
    assert len(keep) <= 500
    assert {0, 12_345, 23_456, 29_999} <= set(keep.tolist())
    assert (np.diff(keep) > 0).all()
    np.testing.assert_array_equal(thin(line[:400], limit=500), np.arange(400))


def test_findings_and_distributions(results, tmp_path):
    report = build_report(reproduction(results, tmp_path / "all"))
    assert "1 reproduced" in report.answer
    narrow, wide = report.distributions
    # first order: sigma_x = x^2 sigma_d / (f B)
    np.testing.assert_allclose(np.sqrt(narrow.linear.covariance[0, 0]), 100 * 0.65 / (150 * 0.09))
    np.testing.assert_allclose(np.sqrt(wide.linear.covariance[0, 0]), 100 * 0.65 / (150 * 0.5))
    np.testing.assert_allclose(np.sum(wide.density * np.diff(wide.edges)), 1.0, atol=0.02)
    source = html.render_html(report)
    assert "unacceptably large &lt;ANEES&gt;" in source
    assert pdf.render_pdf(report).startswith(b"%PDF")


def test_findings_alone(tmp_path, results):
    folder = reproduction(results, tmp_path / "all")
    manifest = json.loads((folder / "manifest.json").read_text()) | {"studies": []}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    report = build_report(folder)
    assert report.studies == ()
    assert "No study was run" in html.render_html(report)
    assert pdf.render_pdf(report).startswith(b"%PDF")


def test_damaged_distributions_are_named(results, tmp_path):
    folder = reproduction(results, tmp_path / "all")
    (folder / "fig12.parquet").write_bytes(b"PAR1")
    with pytest.raises(cs.InputError, match=r"fig12\.parquet: cannot be read"):
        build_report(folder)


def front_end_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Small tables as the experiments on the stereo front-end write them."""
    tables = {
        "frontend_fig22": pd.DataFrame({"depth": [4.0, 2.0], "share": [0.8, 0.95]}).assign(
            expected=0.95, low=0.9, high=0.985, false_alarm=0.01, noise=2.0, samples=300, repetitions=200
        ),
        "frontend_fig23": pd.DataFrame(
            {
                "far": [3.0, 6.0], "noise": [2.0, 0.5], "repetitions": [200, 12], "ratio": [1.01, 1.2],
                "ratio_least": [0.97, 1.1], "ratio_most": [1.05, 1.3],
            }
        ).assign(region_low=0.96, region_high=1.04, confidence=0.95, near=1.5, points=100, samples=1000, dof=6000),
        "first_order": pd.DataFrame(
            {
                "estimator": ["svd", "$x$ <b>", "svd"], "status": ["consistent", "failed", "overconfident"],
                "ratio": [0.01, 0.5, 0.3], "nees_ratio": [1.02, np.nan, 7.0], "failed": [0, 80, 3],
            }
        ).assign(runs=80, points=30, false_alarm=1e-3, holds=0.05),
    }  # fmt: skip
    for name, table in tables.items():
        table.to_parquet(folder / f"{name}.parquet")
    return tables


def test_the_front_end_is_what_its_tables_hold(results, tmp_path):
    folder = reproduction(results, tmp_path / "all")
    front_end_tables(folder)
    report = build_report(folder)
    shares, scenes, cells = report.front_end.shares, report.front_end.scenes, report.front_end.first_order
    np.testing.assert_array_equal(shares.depth, [2.0, 4.0])
    np.testing.assert_array_equal(shares.share, [0.95, 0.8])
    assert shares.accepted == (0.9, 0.985)
    assert [(scene.far, scene.noise, scene.ratio) for scene in scenes.scenes] == [(3.0, 2.0, 1.01), (6.0, 0.5, 1.2)]
    assert scenes.window[0] < 0.96 < 1.3 < scenes.window[1]
    svd, odd = cells.estimators
    assert (svd.title, odd.title) == ("svd: 1 of 2 accepted", "$x$ <b>: 0 of 1 accepted")
    np.testing.assert_array_equal(svd.nees, [1.02, 7.0])
    assert cells.failed == 83
    text = "".join(Page(html.render_html(report)).text)
    for caption in (
        captions.shares_caption(shares), captions.scenes_caption(scenes), captions.first_order_caption(cells)
    ):  # fmt: skip
        assert caption in text
    assert "Cells without a run that is left, not drawn: 1." in text
    assert "probability 0.1 % at most" in text
    assert "$x$ <b>: 0 of 1 accepted" in text
    assert pdf.render_pdf(report).startswith(b"%PDF")


@pytest.mark.parametrize("alone", ["frontend_fig22", "frontend_fig23", "first_order"])
def test_a_table_of_the_front_end_alone(results, tmp_path, alone):
    folder = reproduction(results, tmp_path / "all")
    for name in set(front_end_tables(folder)) - {alone}:
        (folder / f"{name}.parquet").unlink()
    report = build_report(folder)
    assert 'id="front-end"' in html.render_html(report)
    assert len(pdf._front_end(report.front_end, tmp_path)) == 1


def test_without_its_tables_there_is_no_front_end(results, tmp_path):
    report = build_report(reproduction(results, tmp_path / "all"))
    assert not report.front_end
    assert "front-end" not in html.render_html(report)
    assert pdf._front_end(report.front_end, tmp_path) == []


@pytest.mark.parametrize("name", ["frontend_fig22", "frontend_fig23", "first_order"])
def test_damaged_tables_of_the_front_end_are_named(results, tmp_path, name):
    folder = reproduction(results, tmp_path / "all")
    table, path = front_end_tables(folder)[name], folder / f"{name}.parquet"
    damaged = {
        "column 'noise' is missing" if name != "first_order" else "column 'status' is missing": table.drop(
            columns="noise" if name != "first_order" else "status"
        ),
        "has no rows": table.iloc[:0],
        rf"column '{table.columns[-1]}', row 0: not a finite number \(much\)": table.assign(
            **{table.columns[-1]: "much"}
        ),
    }
    for message, content in damaged.items():
        content.to_parquet(path)
        with pytest.raises(cs.InputError, match=rf"{name}\.parquet: {message}"):
            build_report(folder)
    path.write_bytes(b"PAR1")
    with pytest.raises(cs.InputError, match=rf"{name}\.parquet: cannot be read"):
        build_report(folder)


@pytest.mark.parametrize(("value", "message"), [(0.0, "not above zero"), (np.inf, "not a finite number")])
def test_cells_that_no_log_axis_shows_are_refused(results, tmp_path, value, message):
    folder = reproduction(results, tmp_path / "all")
    table = front_end_tables(folder)["first_order"]
    table.assign(nees_ratio=[1.0, 1.0, value]).to_parquet(folder / "first_order.parquet")
    with pytest.raises(cs.InputError, match=rf"first_order\.parquet: column 'nees_ratio', row 2: {message}"):
        build_report(folder)


@pytest.mark.parametrize(
    ("word", "pieces"),
    [
        ("first-order-reprojection", ["first-order-", "reprojection"]),
        ("frontend-fig2.2", ["frontend-", "fig2.2"]),
        (30 * "x", [14 * "x", 14 * "x", "xx"]),
        ("x = -0.5e-6 2-2", ["x = -0.5e-6 2-2"]),
    ],
)
def test_long_words_break_at_hyphens(word, pieces):
    assert pdf._soft([{"id": word}])[0]["id"].split("\u200b") == pieces


def test_a_log_without_truth_says_so(uvd, tmp_path):
    simulate_log(uvd, 1, 0, tmp_path / "log")
    for name in ("truth", "landmarks"):
        (tmp_path / "log" / f"{name}.parquet").unlink()
    from consistency.log import read_log

    run_log(read_log(tmp_path / "log"), ["ekf-uvd"], jobs=1).write(tmp_path / "run")
    report = build_report(tmp_path / "run")
    (study,) = report.studies
    assert not study.has_truth
    assert study.odometry is None
    assert str(tmp_path) not in study.name
    source = html.render_html(report)
    assert "The truth of log is not known" in source
    assert "Pose errors" not in source
    assert pdf.render_pdf(report).startswith(b"%PDF")


def test_one_run_is_a_nees(uvd, tmp_path):
    cs.run_trials(uvd, ["ekf-uvd"], runs=1, seed=0, jobs=1).write(tmp_path / "run")
    report = build_report(tmp_path / "run")
    assert report.studies[0].statistic == "NEES"
    assert "NEES of the single run 0" in html.render_html(report)


def test_a_filter_looks_the_same_in_every_study(results, tmp_path):
    folder = reproduction(results, tmp_path / "all")
    swapped = results.manifest | {"filters": FILTERS[::-1]}
    replace(results, manifest=swapped).write(folder / "other")
    manifest = json.loads((folder / "manifest.json").read_text()) | {"studies": ["small", "other"]}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    looks = [{t.name: t.style for t in study.tracks} for study in build_report(folder).studies]
    assert looks[0] == looks[1]


def test_reports_are_deterministic(folder):
    assert pdf.render_pdf(build_report(folder)) == pdf.render_pdf(build_report(folder))
    ids = re.compile(r"[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f-]{22}|p\d{4,}")
    first, second = (ids.sub("", html.render_html(build.build_report(folder))) for _ in range(2))
    assert len(first) == len(second)
