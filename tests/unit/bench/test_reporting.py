"""Reports say what the diagnostics say, show every name literally, and appear whole or not at all."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
from dataclasses import asdict, replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from edited import change_manifest
from numpy.testing import assert_allclose, assert_array_equal
from painted import by_title, legend_of, lines, panels, places, shaded, titles
from records import changed
from scipy import stats
from scripts import figures

import consistency as cs
from consistency.bench.pages import write_reports
from consistency.bench.pages.results_report import answer, build_report, compose
from consistency.bench.pages.sections import calibration_rates, nees, nis, one_run
from consistency.bench.pages.sections.study_sections import without_truth
from consistency.bench.runs.montecarlo import run_log, simulate_log
from consistency.bench.runs.reproduce_findings import Finding
from consistency.bench.store.results import read_results
from consistency.diagnostics import Answer, Interval, Settings, judge, make_record
from consistency.referee.column_names import COVARIANCE
from consistency.referee.diagnostics.number_words import short
from consistency.referee.diagnostics.verdict_parts import DIRECTION, STATUSES, STEP
from consistency.referee.pages import ratio_figures, verdicts
from consistency.referee.pages.verdicts import time_axis_of
from consistency.referee.show import as_html, pdf
from consistency.referee.show.blocks import Figure, written
from consistency.referee.types import Failure
from consistency.referee.verdicts.tables import FURTHER, page, shown_inside

front_end, stereo_noise = figures("front_end"), figures("stereo_noise")
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
def folder(results, tmp_path):
    results.write(tmp_path / "run")
    return tmp_path / "run"


@pytest.fixture(scope="module")
def report(results, tmp_path_factory):
    """Of the results as they are; nothing changes it in place."""
    at = tmp_path_factory.mktemp("built") / "run"
    results.write(at)
    return build_report(at)


def odd_results(results):
    """The same under odd names; one filter fails in two runs, the other in all of them at once."""
    estimates = results.estimates.assign(filter=results.estimates["filter"].map(ODD))
    first, second = ODD.values()
    late = (estimates["filter"] == first) & (estimates["run"] < 2) & (estimates["step"] >= 30)
    estimates = estimates[~late & (estimates["filter"] != second)]
    rows = [(first, run, 30, "not positive definite") for run in (0, 1)]
    rows += [(second, run, 1, "<b>broken</b> $ # " + 150 * "x") for run in range(4)]
    failures = pd.DataFrame(rows, columns=["filter", "run", "step", "reason"])
    manifest = results.manifest | {"filters": list(ODD.values()), "failures": len(failures)}
    return replace(results, estimates=estimates, failures=failures, manifest=manifest, map=None)


STEPS = 60  # of the small worlds
SURE = Settings(1e-6)  # chance of a false alarm


def drawn(seed, runs=60, size=1.0):
    """Errors (runs, steps, 3) that are ``size`` times as large as the covariances say."""
    error = size * np.random.default_rng(seed).standard_normal((runs, STEPS, 3))
    return error, np.broadcast_to(np.eye(3), (runs, STEPS, 3, 3))


def judged(track, error, covariance, settings=SURE, **given):
    """The track with the verdict on other errors in place of its own."""
    evidence = make_record(track.name, error, covariance, axes=("x", "y", "heading"), **given)
    verdict = judge(evidence, settings)
    assert verdict.scale is not None
    assert verdict.location is not None
    return replace(track, verdict=verdict, failures=verdict.failures)


def shown(report):
    return as_html.render(compose(report))


def words(report):
    """The page without its figures, whose drawing takes most of the time."""
    made = compose(report)
    chapters = []
    for chapter in made.chapters:
        blocks = tuple(block for block in chapter.blocks if not isinstance(block, Figure))
        chapters.append(replace(chapter, blocks=blocks))
    return as_html.render(replace(made, chapters=tuple(chapters)))


def printed(report):
    return pdf.render_pdf(compose(report))


def without_studies(folder):
    """What a folder holds beside its studies, which take most of the time to draw."""
    return replace(build_report(folder), studies=())


def axis_caption(study):
    return ratio_figures.axis_caption(study, ratio_figures.forests(study))


def with_tracks(report, *tracks):
    return replace(report, studies=(replace(report.studies[0], tracks=tracks),))


@pytest.fixture(scope="module")
def page_of_results(report):
    return shown(report)


@pytest.fixture
def reproduced(results, tmp_path):
    """A folder as ``consistency reproduce`` writes it."""
    folder = tmp_path / "all"
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

    def __init__(self, source):
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
        self.text.append(data.replace("\u00a0", " "))


def test_the_model_is_what_analyse_says(folder):
    results = read_results(folder)
    by_filter, (study,) = cs.analyse(results), build_report(folder).studies
    parts = zip(
        nees.anees_of(study).curves, map(one_run.pose_error_series, study.tracks),
        one_run.world_of(study).paths, strict=True,
    )  # fmt: skip
    for track, (curve, error, (_, path)) in zip(study.tracks, parts, strict=True):
        verdict = by_filter[track.name]
        assert track.verdict.status == verdict.status
        assert track.verdict.reasons == verdict.reasons
        assert_array_equal(curve.values, verdict.scale.anees)
        assert_array_equal(curve.simultaneous, verdict.location.simultaneous)
        assert curve.expected == 3.0
        table = results.estimates[results.estimates["filter"] == track.name]
        by_step = table.groupby("step")
        assert_allclose(track.nis_ratio, by_step["nis"].sum() / by_step["nis_dof"].sum().replace(0, np.nan))
        first = table[table["run"] == 0]
        assert_allclose(error.sigma[:, 2], np.rad2deg(np.sqrt(first["P_hh"])))
        assert_allclose(path, first[["x", "y"]])


def test_the_odometry_is_that_of_the_trial(report, uvd):
    (study,) = report.studies
    trial = cs.simulate(uvd, run=0, seed=1)
    assert_array_equal(one_run.world_of(study).truth, trial.truth[:, :2])
    step = trial.controls[0, 0] * trial.controls[0, 1]
    odometry = one_run.world_of(study).odometry
    assert_allclose(np.linalg.norm(odometry[1] - odometry[0]), abs(step))


def row(study, track):
    """Cells of the table of verdicts by their heads."""
    return said(page(verdicts.equivalence_interval(study)), track.verdict)


def further_row(track):
    return said(FURTHER, track.verdict)


def said(view, verdict):
    return {measure.column.head: written(measure.cell(verdict)) for measure in view}


def test_verdict_cells_are_the_records(report):
    (study,) = report.studies
    track = study.tracks[0]
    v, cells = track.verdict, row(study, track)
    assert cells["Mean ANEES"] == short(v.scale.mean_anees)
    assert cells["True / stated covariance"].startswith(f"×{short(v.inflation)} [")
    assert cells["True / stated covariance"].endswith(f", {short(v.inflation_interval[1])}]")
    assert cells["Shown inside [0.67,\u00a01.50]"] == "no"
    assert cells["Since step"] == ("–" if v.location.since is None else str(v.location.since))
    assert cells["RMSE heading (deg)"] == f"{np.rad2deg(v.accuracy.rmse_heading):.2f}"
    assert cells["NIS / dof"] == f"({v.innovations.ratio:.3f})"
    assert cells["Failed runs"] == "0 of 4"
    cells = further_row(track)
    assert cells["2-sigma coverage, all steps (%)"] == " / ".join(f"{100 * c:.1f}" for c in v.accuracy.coverage)
    assert cells["Mean ANEES accepted"] == " to ".join(short(end) for end in v.threshold)
    assert cells["NIS / dof (95 % expected)"] == f"{v.innovations.ratio:.3f} (not judged)"


def test_the_diagnosis_is_what_the_verdict_holds(report):
    (study,) = report.studies
    asked = {question.name: question.answers for question in verdicts.asked(study)}
    by_name = {part.name: dict(part.rows) for part in ratio_figures.forests(study)}
    for number, track in enumerate(study.tracks):
        v = track.verdict
        assert {q for q, answers in asked.items() if answers[number]} == {a.question for a in v.answers}
        for one in v.answers:
            assert asked[one.question][number] is one
        assert by_name["ratio"]["x"][number] == v.axes.inflation["x"]
        assert by_name["ratio"][ratio_figures.WHOLE][number] == v.scale.inflation
        assert by_name["coverage"]["y"][number][0] == pytest.approx(100 * v.accuracy.coverage_one_step[1])
        assert by_name["bias"]["heading"][number] == v.bias.by_axis["heading"]
        of = nees.steps(track)
        assert_array_equal(of.x[1:-1], v.tails.pit)
        assert_allclose(of.y, [0, 0.25, 0.5, 0.75, 1, 1])
        assert nis.lags(track) is None  # four runs of 60 steps have too few innovations
    text = "".join(Page(words(report)).text)
    assert all(question.name in text and question.about in text for question in verdicts.asked(study))


@pytest.mark.parametrize(
    "answer, cell",
    [
        (None, ("–", "")),
        (Answer("scale", 1e-7, 0.5, 3e-7, True), ("✗", "< 1e-6")),
        (Answer("scale", 0.006, 0.5, 0.0123, True), ("✗", "0.012")),
        (Answer("scale", 0.006, 0.5, 0.0123, True, tolerated=True), ("≈", "0.012")),
        (Answer("scale", 0.9, 0.5, 1.0, False), ("○", "1")),
    ],
)
def test_answers_have_a_mark_and_not_colour_alone(answer, cell):
    assert verdicts.answer_cell(answer) == cell
    assert cell[0] in verdicts.MARKS
    assert len(set(verdicts.MARKS.values())) == 4


@pytest.mark.parametrize("ends", [(0.0, np.inf), (1e-12, 1e12), (19.0, 21.0)])
def test_windows_are_finite_and_hold_every_value(report, ends):
    (study,) = report.studies
    track = study.tracks[0]
    v = track.verdict
    v = replace(
        v,
        axes=replace(v.axes, inflation={"x": Interval(20.0, *ends)}),
        scale=replace(v.scale, inflation=Interval(0.5, *ends)),
        bias=replace(v.bias, by_axis={"x": Interval(-4.0, -ends[1], ends[1])}),
    )
    study = replace(study, tracks=(replace(track, verdict=v),))
    assert {part.name for part in ratio_figures.forests(study)} == {"ratio", "bias", "coverage"}
    for part in ratio_figures.forests(study):
        low, high = part.window
        assert np.isfinite(part.window).all()
        values = [interval[0] for _, row in part.rows for interval in row if interval] + [part.expected]
        assert low < min(values) <= max(values) < high


EMPTY = dict.fromkeys(("scale", "axes", "bias", "shape", "tails", "innovations", "location", "accuracy"))


@pytest.mark.parametrize("all_steps_failed", [False, True])
def test_a_verdict_without_figures_is_drawn_all_the_same(report, all_steps_failed):

    def bare(track):
        v = replace(track.verdict, answers=(), **EMPTY)
        if all_steps_failed:
            v = judge(make_record(track.name, np.full((4, STEPS, 3), np.nan), np.full((4, STEPS, 3, 3), np.nan)))
            v = replace(v, answers=())
            assert v.status == "failed"
            assert np.isnan(v.scale.inflation.value)
        return replace(track, verdict=v)

    report = with_tracks(report, *map(bare, report.studies[0].tracks))
    if not all_steps_failed:
        (study,) = report.studies
        assert {*row(study, study.tracks[0]).values()} == {study.tracks[0].verdict.status, "–", "0 of 4"}
        assert {*further_row(study.tracks[0]).values()} == {"–"}
    assert "There was nothing to ask" in shown(report)
    assert printed(report).startswith(b"%PDF")


def test_nees_alone_without_axes(report):
    (study,) = report.studies
    whole = judge(make_record("nees", nees=np.random.default_rng(0).chisquare(3, (30, 60)), dof=3))
    track = replace(study.tracks[0], verdict=whole)
    study = replace(study, tracks=(track,))
    (part,) = ratio_figures.forests(study)
    assert [label for label, _ in part.rows] == [ratio_figures.WHOLE]


def test_the_captions_state_the_rates_in_force(report):
    v = report.studies[0].tracks[0].verdict
    (share,) = (a.share for a in v.answers if a.question == STEP)
    assert f"at most {100 * share * v.settings.false_alarm:.2g} %" in nees.anees_caption(
        nees.anees_of(report.studies[0])
    )
    assert "probability 5 % at most" in verdicts.method(report.studies)
    assert "two one-sided tests, each at 5 %, put the ratio of true to stated covariance between 0.67 and 1.50" in (
        verdicts.method(report.studies)
    )
    track = judged(report.studies[0].tracks[0], *drawn(1), Settings(1e-3, 2.0, 0.9))
    other = with_tracks(report, track)
    assert "probability 0.1 % at most" in verdicts.method(other.studies)
    assert "each at 10 %, put the ratio of true to stated covariance between 0.50 and 2.00" in verdicts.method(
        other.studies
    )
    assert "Shown inside [0.50,\u00a02.00]" in verdicts.verdicts_caption(other.studies[0])


# --- what the referee can say -----------------------------------------------------------------


def every_status(track):
    """A verdict of each status, by false-alarm rates of 1e-6 on errors as different as can be."""
    error, P = drawn(2)
    heavy = error * np.where(np.arange(60) == 7, 12.0, 1.0)[:, None, None]
    linked = error.copy()
    linked[..., 1] = 0.7 * error[..., 0] + np.sqrt(0.51) * error[..., 1]
    broken = (Failure(track.name, 0, 9, "LinAlgError: singular"),)
    return {
        "consistent": judged(track, error, P),
        "overconfident": judged(track, 2.0 * error, P),
        "conservative": judged(track, 0.5 * error, P),
        "biased": judged(track, error + np.array([1.0, 0.0, 0.0]), P),
        "heavy-tailed": judged(track, heavy, P),
        "inconsistent": judged(track, linked, P),
        "undecided": judged(track, error[:3], P[:3]),
        "failed": judged(track, error, P, failures=broken),
    }


def test_every_status_is_shown_with_its_meaning(report):
    tracks = every_status(report.studies[0].tracks[0])
    assert set(tracks) == set(STATUSES)
    assert [track.verdict.status for track in tracks.values()] == list(tracks)
    report = with_tracks(report, *(replace(t, name=status, style=k) for k, (status, t) in enumerate(tracks.items())))
    text = answer([replace(report.studies[0], runs=60)], ())
    assert "1 of 8 filters is shown to be honest" in text
    assert "1 of 480 runs through a filter broke down" in text
    for part in (f"({meaning})" for meaning in STATUSES.values()):
        assert part in text
    source = words(report)
    assert "LinAlgError: singular" in source
    assert "a hang or a crash is counted there, in whatever step it was" in source
    for status in STATUSES:
        assert f'<span class="verdict {status}">{status}</span>' in source


def test_consistent_has_been_shown_and_undecided_says_what_would_decide(report):
    tracks = every_status(report.studies[0].tracks[0])
    assert written(shown_inside(tracks["consistent"].verdict)) == "yes"
    assert written(shown_inside(tracks["overconfident"].verdict)) == "no"
    shown = tracks["undecided"].verdict.scale.equivalence
    assert written(shown_inside(tracks["undecided"].verdict)) == "no"
    sentence = tracks["undecided"].verdict.reasons[0]
    assert f"{shown.runs} such runs would probably decide" in sentence
    low, high = shown.interval
    assert f"90 % interval {short(low)} to {short(high)}" in sentence


def test_a_fault_within_the_tolerance_has_a_mark_of_its_own(report):
    assert "≈" not in verdicts.marks_caption(report.studies[0])
    error, P = drawn(3, 300, np.sqrt(1.1))
    track = judged(report.studies[0].tracks[0], error, P, Settings(0.05, tolerance=1.3))
    marks = {a.question: verdicts.answer_cell(a)[0] for a in track.verdict.answers}
    assert track.verdict.consistent
    assert marks["scale"] == "≈"
    assert set(marks.values()) == {"≈", "○"}
    report = with_tracks(report, track)
    assert "≈ one was found, but is shown to lie within the tolerance of ×1.3" in (
        verdicts.marks_caption(report.studies[0])
    )
    source = words(report)
    cell = (
        r'<td class="number tolerated" data-head="[^"]*"><span role="img" aria-label="found, within the tolerance">≈<'
    )
    assert len(re.findall(cell, source)) == sum(mark == "≈" for mark in marks.values())


def test_where_only_too_small_is_a_fault_the_worst_direction_is_shown(report):
    error, P = drawn(4)
    error[..., :2] = error[..., :2] @ np.array([[1.25, 0.95], [0.95, 1.25]])  # x and y err together
    track = judged(report.studies[0].tracks[0], 0.7 * error, P, Settings(0.05, allow="conservative"))
    (study,) = with_tracks(report, track).studies
    ratios = dict(ratio_figures.forests(study)[0].rows)
    assert ratios[ratio_figures.DIRECTION] == (track.verdict.axes.largest,)
    assert DIRECTION in {question.name for question in verdicts.asked(study) if question.answers[0].found}
    assert "Shown inside (0,\u00a01.50]" in row(study, track)
    assert "Worst direction: chosen by one half of the runs" in axis_caption(study)
    assert "a one-sided test at 5 %, put" in verdicts.method((study,))
    assert "orst direction" not in axis_caption(report.studies[0])


# --- innovations ------------------------------------------------------------------------------


def bounds_of(axes):
    """Bounds that are shaded in a panel of autocorrelations."""
    return [patch.get_y() + patch.get_height() for patch in axes.patches]


def test_innovations_are_judged_only_where_an_optimal_gain_is_declared(report, linear, tmp_path):
    (study,) = report.studies
    for track in study.tracks:
        assert not track.innovations_judged
    caption = nis.innovations_caption(study)
    assert "No filter here declares one: its innovations are reported and not judged." in caption
    assert "shaded bound" not in caption
    assert "NIS in parentheses: reported and not judged" in verdicts.verdicts_caption(study)

    results = cs.run_trials(linear, ["kf"], runs=20, seed=1, jobs=1)
    both = pd.concat([results.estimates, results.estimates.assign(filter="silent")], ignore_index=True)
    manifest = results.manifest | {"filters": ["kf", "silent"]}  # only kf declares an optimal gain
    replace(results, estimates=both, manifest=manifest).write(tmp_path / "kf")
    report = build_report(tmp_path / "kf")
    (study,) = report.studies
    kf, silent = study.tracks
    assert kf.innovations_judged
    found = kf.verdict.innovations
    low, high = found.interval
    assert row(study, kf)["NIS / dof"] == f"{found.ratio:.3f}"
    assert further_row(kf)["NIS / dof (95 % expected)"] == f"{found.ratio:.3f} ({low:.3f} to {high:.3f})"
    assert nis.lags(kf).bound == found.bound
    assert_array_equal(nis.lags(kf).values, found.autocorrelation)
    assert nis.lags(silent).bound is None
    assert_array_equal(nis.lags(silent).values, found.autocorrelation)
    asked = [question.answers for question in verdicts.asked(study)]
    (innovation,) = {first.question for first, second in asked if second is None and "scale" in first.question}
    assert innovation == "innovation scale"
    assert "Only kf declares one; the innovations of the others are reported" in nis.innovations_caption(study)
    (both_filters,) = nis.innovations(study)
    assert [bounds_of(panels(both_filters, number)[1]) for number in (0, 1)] == [[found.bound], []]
    assert [titles(panels(both_filters, number))[0] for number in (0, 1)] == ["kf", "silent"]
    assert words(report).count("(not judged)") == 1


def test_without_truth_only_a_declared_optimal_gain_is_put_to_the_test(report):
    first, second = report.studies[0].tracks
    rng = np.random.default_rng(5)
    nis, dof = rng.chisquare(4, (1, STEPS)), np.full((1, STEPS), 4)

    def by_nis(track, size, optimal):
        evidence = make_record(track.name, nis=size * nis, nis_dof=dof, optimal_gain=optimal)
        return replace(track, verdict=judge(evidence, SURE))

    def text(*tracks):
        study = replace(report.studies[0], runs=1, tracks=tracks)
        return answer([study], ())

    good, bad, unknown = by_nis(first, 1.0, True), by_nis(second, 5.0, True), by_nis(second, 5.0, False)
    assert "1 of 2 filters passes the test of the innovations" in text(good, bad)
    assert "no filter can be judged: the truth is not known, and none declares an optimal gain" in text(unknown)
    assert "test of the innovations" not in text(unknown)
    assert unknown.verdict.status == "undecided"
    assert written(shown_inside(unknown.verdict)) == "–"
    assert written(shown_inside(good.verdict)).startswith("yes")
    study = replace(report.studies[0], tracks=(unknown,))
    assert "reported and not judged" in without_truth(study)[0].text
    assert "all that can be judged" in without_truth(replace(study, tracks=(good, unknown)))[0].text
    assert "Without truth the ratio is that of the NIS" in verdicts.method((study,))


# --- until decided ----------------------------------------------------------------------------


def test_a_run_until_decided_shows_each_verdict_at_its_look(linear, tmp_path):
    results = cs.run_trials(linear, ["kf"], runs=24, seed=1, jobs=1)
    small = results.estimates.assign(filter="small", nees=20 * results.estimates["nees"])
    small[list(COVARIANCE)] /= 20.0
    plan = {"dof": 3, "detect": 1.5, "false_alarm": 0.05, "power": 0.95, "max_runs": 24}
    manifest = results.manifest | {"filters": ["kf", "small"], "until_decided": plan, "failures": 1}
    small = small[(small["run"] != 20) | (small["step"] < 30)]
    estimates = pd.concat([results.estimates, small], ignore_index=True)
    late = pd.DataFrame([("small", 20, 30, "diverged")], columns=["filter", "run", "step", "reason"])
    replace(results, estimates=estimates, failures=late, manifest=manifest).write(tmp_path / "run")
    report = build_report(tmp_path / "run")
    (study,) = report.studies
    kf, wrong = study.tracks
    assert study.until_decided
    assert (kf.verdict.runs, wrong.verdict.runs) == (24, 12)
    assert wrong.verdict.status == "overconfident"
    curves = nees.anees_of(study)
    assert curves.common.track is kf
    assert [curve.own_band for curve in curves.curves] == [False, True]
    assert study.failures == [("small", 20, 30, "diverged")]  # after the look that decided, and still listed
    assert row(study, wrong)["Failed runs"] == "0 of 12"
    first = results.estimates[results.estimates["run"] < 12].groupby("step")
    assert_allclose(study.tracks[1].nis_ratio, first["nis"].sum() / first["nis_dof"].sum().replace(0, np.nan))
    assert "kf after 24 runs and small after 12 runs" in verdicts.verdicts_caption(study)
    assert "Average NEES over 24 runs" in nees.anees_caption(nees.anees_of(study))
    assert "judged by an e-process" in verdicts.method(report.studies)
    assert "they are listed below and counted in the verdicts that looked at them" in compose(report).answer
    assert "asks scale alone" in verdicts.marks_caption(study)


def test_the_common_band_is_that_of_most_runs_and_then_of_fewest_failures():
    error, P = drawn(6, 24)
    lost = (Failure("any", 3, 9, "singular"),)
    late, early, whole = (
        judge(make_record("any", error[:runs], P[:runs], failures=failures))
        for runs, failures in ((24, lost), (12, ()), (24, ()))
    )
    assert nees.common({"early": early, "late": late}) is late
    assert nees.common({"late": late, "whole": whole, "early": early}) is whole


def test_runs_of_a_fixed_number_say_nothing_of_looks(report):
    assert not report.studies[0].until_decided
    for text in (verdicts.verdicts_caption(report.studies[0]), verdicts.method(report.studies), compose(report).answer):
        assert "look" not in text


# --- colours ----------------------------------------------------------------------------------


def luminance(colour):
    """Relative luminance of #rrggbb (WCAG 2.2)."""
    parts = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def contrast(a, b):
    high, low = sorted((luminance(a), luminance(b)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def rule(css, name):
    """Declarations of the class, of all rules that begin with it."""
    found = {}
    for heads, body in re.findall(r"^([^{}@\n]+)\{([^{}]*)\}", css, re.MULTILINE):
        if name in [head.strip() for head in heads.split(",")]:
            found |= dict((part.strip() for part in item.split(":", 1)) for item in body.split(";") if item.strip())
    return found


def full(colour):
    """#rgb as #rrggbb."""
    return colour if len(colour) == 7 else "#" + "".join(2 * digit for digit in colour[1:])


def template(name):
    return (Path(as_html.__file__).parent / "templates" / name).read_text(encoding="utf-8")


@pytest.mark.parametrize("dark", [False, True])
def test_every_status_reads_well_in_html_and_differs_by_more_than_colour(dark):
    css, looks = template("report.css"), set()
    light, night = (dict(re.findall(r"--(\w+): (#[0-9a-f]{3,6})", part)) for part in css.split("@media")[:2])
    shades = {name: full(colour) for name, colour in (light | (night if dark else {})).items()}
    assert set(night) == set(light)

    def shade(value):
        name = value.removeprefix("var(--").removesuffix(")")
        return shades[name] if name in shades else full(value)

    def reads_well(look):
        return contrast(shade(look["color"]), shade(look.get("background", "var(--paper)"))) > 4.5

    for status in STATUSES:
        look = rule(css, f".{status}")
        assert reads_well(look), status
        looks.add((look["color"], look.get("border-style", "solid")))
    assert len(looks) == len(STATUSES)
    for name in (".marks .found", ".marks .tolerated", "body", "a", ".small", ".caption", ".worse", ".not-worse"):
        assert reads_well(rule(css, name)), name


def test_every_status_reads_well_in_print():
    shades = dict(re.findall(r'"([a-z -]+)": rgb\("(#[0-9a-f]{6})"\)', template("report.typ")))
    for status in STATUSES:
        assert contrast(shades[status], "#ffffff") > 4.5, status


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


def test_the_calibration_is_a_table_of_promises_with_the_interval_of_the_worst_world(folder, tmp_path, monkeypatch):
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(CALIBRATION))
    found = calibration_rates.calibration(path)
    assert found.gates == 600
    (first, (alarm,)), (second, (power, decided)) = calibration_rates.promise_groups(found)
    assert (first, second) == ("false alarm: a right filter is found at fault", "power: plan keeps its word")
    # Clopper & Pearson of 9 in 200 at 99 %
    low, high = stats.beta.ppf(0.005, 9, 192), stats.beta.ppf(0.995, 10, 191)
    interval = f"{100 * low:.1f} to {100 * high:.1f} %"
    assert alarm == ("1, right", "21", "≤ 5 %", "200 in 2 worlds", "1.0 to 4.5 %", "elsewhere", interval)
    assert power[:6] == ("1.5", "61", "≥ 95 %", "100", "100.0 %", "independent")
    assert decided[1] == "19, 500 at most"
    assert {len(row) for row in (alarm, power, decided)} == {len(calibration_rates.COLUMNS)}
    monkeypatch.setattr(calibration_rates, "shipped", lambda: path)
    report = build_report(folder)
    page = words(report)
    assert "How far the referee can be trusted" in page
    assert "<details><summary>Measured rates</summary>" in page
    assert "steps that &lt;depend&gt; on each other" in page
    assert "plan keeps its word" in page


def test_without_a_calibration_the_appendix_says_nothing(folder, tmp_path, monkeypatch):
    assert calibration_rates.calibration(tmp_path / "none.json") is None
    monkeypatch.setattr(calibration_rates, "shipped", lambda: None)
    report = build_report(folder)
    assert "How far the referee" not in words(report)


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


def test_targets_that_cannot_be_written(folder, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(cs.InputError, match="cannot be written"):
        write_reports(folder, tmp_path / "file" / "r.html", None, overwrite=True)
    with pytest.raises(cs.InputError, match="is a folder"):
        write_reports(folder, folder, None, overwrite=True)
    with pytest.raises(cs.InputError, match="both"):
        write_reports(folder, tmp_path / "r", tmp_path / "r", overwrite=True)


def test_nothing_is_left_of_a_report_that_breaks(folder, monkeypatch):
    monkeypatch.setattr(pdf, "render_pdf", lambda *_: 1 / 0)
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


def test_odd_names_are_shown_literally_and_failed_runs_are_listed(results, tmp_path):
    odd_results(results).write(tmp_path / "odd")
    report = build_report(tmp_path / "odd")
    source = shown(report)
    page = Page(source)
    text = "".join(page.text)
    for name in ODD.values():
        assert name in text
    assert "img" not in page.tags
    assert "49" not in compose(report).answer
    assert "<script>alert" not in source
    assert printed(report).startswith(b"%PDF")
    (study,) = report.studies
    assert len(study.failures) == 6
    assert study.tracks[1].verdict.status == "failed"
    assert not np.isfinite(one_run.world_of(study).paths[1][1]).any()
    assert "6 of 8 runs" in compose(report).answer


def test_only_failed_runs_give_a_filter_bands_of_its_own(results, tmp_path):
    late = (
        (results.estimates["filter"] == "ekf-xyz") & (results.estimates["run"] == 0) & (results.estimates["step"] > 29)
    )
    rows = [("ekf-xyz", 0, 30, "not positive definite")]
    failures = pd.DataFrame(rows, columns=["filter", "run", "step", "reason"])
    manifest = results.manifest | {"failures": 1}
    replace(results, estimates=results.estimates[~late], failures=failures, manifest=manifest, map=None).write(
        tmp_path / "run"
    )
    report = build_report(tmp_path / "run")
    curves = nees.anees_of(report.studies[0])
    assert [curve.own_band for curve in curves.curves] == [True, False]
    assert curves.common.track.name == "ekf-uvd"
    assert "Fewer runs carry the curve of ekf-xyz" in nees.anees_caption(curves)


def test_html_loads_nothing_and_is_small(page_of_results):
    source = page_of_results
    page = Page(source)
    assert len(source.encode()) <= 350_000
    assert page.loads == ["data:,"]
    assert not re.search(r"@import|url\((?!['\"]?(?:data:|#))", page.style)
    assert "default-src 'none'" in source
    assert page.tags.count("h1") == 1


def test_a_page_allows_its_own_script_and_no_other(report, page_of_results):
    """By its hash, as Content Security Policy Level 3 takes it."""
    source = page_of_results
    (script,) = re.findall(r"<script>(.*?)</script>", source, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}';" in source
    assert "script-src 'none'" in as_html.render(replace(compose(report), chapters=()))


def test_clips_of_a_page_have_names_of_their_own(page_of_results):
    """Equal ones would clip a figure by the panel of another."""
    clips = re.findall(r'<clipPath id="(\w+)"', page_of_results)
    assert len(clips) > 10
    assert len(set(clips)) == len(clips)


def test_a_long_study_takes_a_third_of_a_megabyte_of_a_page(results, tmp_path):
    results.write(tmp_path / "run")
    report = build_report(tmp_path / "run")
    steps = 4_000
    rng = np.random.default_rng(0)
    peak = rng.random(steps)
    peak[777] = 99.0

    def long(track):
        scale = replace(track.verdict.scale, anees=peak, band=np.tile([2.0, 4.0], (steps, 1)))
        location = replace(track.verdict.location, simultaneous=np.tile([1.0, 5.0], (steps, 1)))
        shown = changed(
            track.shown, numbers=np.zeros(1, int), t=np.arange(1.0, steps + 1), error=rng.random((1, steps, 3)),
            covariance=np.tile(np.eye(3), (1, steps, 1, 1)),
        )  # fmt: skip
        verdict = replace(track.verdict, scale=scale, location=location)
        return replace(track, shown=shown, nis_ratio=peak, verdict=verdict)

    study = replace(
        report.studies[0],
        steps=np.arange(1, steps + 1),
        clock=time_axis_of(0.1 * np.arange(1, steps + 1)),
        tracks=tuple(long(t) for t in report.studies[0].tracks * 2),
    )
    made = compose(replace(report, studies=(study,)))
    chapter = [each for each in made.chapters if each.anchor == "study-0"]
    bare, one = (len(as_html.render(replace(made, chapters=tuple(each))).encode()) for each in ([], chapter))
    assert 100_000 < one - bare <= 295_000  # of a study with four filters


def test_findings_and_distributions(reproduced):
    report = without_studies(reproduced)
    assert "1 reproduced" in compose(report).answer
    narrow, wide = stereo_noise.read(report)
    # first order: sigma_x = x^2 sigma_d / (f B)
    assert_allclose(np.sqrt(narrow.linear.covariance[0, 0]), 100 * 0.65 / (150 * 0.09))
    assert_allclose(np.sqrt(wide.linear.covariance[0, 0]), 100 * 0.65 / (150 * 0.5))
    cloud, histogram = panels(stereo_noise.blocks(report)[0])
    linear, fitted = lines(cloud)
    assert_array_equal(linear.get_xydata(), stereo_noise.ellipse(narrow.linear))
    assert_array_equal(fitted.get_xydata(), stereo_noise.ellipse(narrow.fitted))
    assert_array_equal(places(cloud)[0], narrow.drawn)
    height, edges, _ = histogram.patches[0].get_data()
    assert_allclose(np.sum(height * np.diff(edges)), 1.0, atol=0.02)
    for line, gaussian in zip(lines(histogram), (narrow.linear, narrow.fitted), strict=True):
        x, sd = line.get_xdata(), np.sqrt(gaussian.covariance[0, 0])
        assert_allclose(line.get_ydata(), stats.norm.pdf(x, gaussian.mean[0], sd))
    source = shown(report)
    assert "unacceptably large &lt;ANEES&gt;" in source
    assert "front-end" not in source  # without its tables


def test_findings_alone(reproduced):
    change_manifest(reproduced, studies=[])
    report = build_report(reproduced)
    assert report.studies == ()
    assert "No study was run" in shown(report)


def test_damaged_distributions_are_named(reproduced):
    (reproduced / "fig12.parquet").write_bytes(b"PAR1")
    with pytest.raises(cs.InputError, match=r"fig12\.parquet: cannot be read"):
        compose(build_report(reproduced))


def front_end_tables(folder):
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


def test_the_front_end_is_what_its_tables_hold(reproduced):
    front_end_tables(reproduced)
    report = without_studies(reproduced)
    depths, registrations, cells = (read(report) for read in (front_end.shares, front_end.scenes, front_end.cells_of))
    assert_array_equal(depths.depth, [2.0, 4.0])
    assert_array_equal(depths.share, [0.95, 0.8])
    assert cells["failed"].sum() == 83
    text = "".join(Page(shown(report)).text)
    for caption in (
        front_end.depth_caption(depths.iloc[0]), front_end.scene_caption(registrations), front_end.cells_caption(cells)
    ):  # fmt: skip
        assert caption in text
    assert "Cells without a run that is left, not drawn: 1." in text
    assert "probability 0.1 % at most" in text
    assert "$x$ <b>: 0 of 1 accepted" in text
    assert printed(report).startswith(b"%PDF")
    by_depth, by_scene, first_order = (panels(figure) for figure in front_end.blocks(report))
    (curve,) = lines(by_depth[0], "measured")
    assert_allclose(curve.get_ydata(), [95.0, 80.0])
    (accepted,) = by_depth[0].patches
    assert [accepted.get_y(), accepted.get_y() + accepted.get_height()] == pytest.approx([90.0, 98.5])
    (means,) = lines(by_scene[0], "mean, middle 95 %")
    assert_array_equal(means.get_xydata(), [[1.01, 0.0], [1.2, 1.0]])
    bars = [segment[:, 0].tolist() for segment in by_scene[0].collections[0].get_segments()]
    assert bars == [[0.97, 1.05], [1.1, 1.3]]
    low, high = by_scene[0].get_xlim()
    assert low < 0.96 < 1.3 < high
    assert titles(first_order) == ["svd: 1 of 2 accepted", "$x$ <b>: 0 of 1 accepted"]
    (good,), (bad,) = lines(first_order[0], "accepted"), lines(first_order[0], "not accepted")
    assert_allclose([*good.get_xydata(), *bad.get_xydata()], [[1.0, 1.02], [30.0, 7.0]])


def test_the_forest_has_the_interval_of_each_axis_in_its_row(report):
    (study,) = report.studies
    found = ratio_figures.forests(study)
    labels = ratio_figures.row_labels(found)
    drawn_panels = panels(ratio_figures.by_axis(study)[0])
    assert [label.get_text() for label in drawn_panels[0].get_yticklabels()] == list(labels)
    right = {"ratio": 1.0, "bias": 0.0, "coverage": 95.45}
    for axes, forest in zip(drawn_panels, found, strict=True):
        assert lines(axes)[0].get_xdata()[0] == pytest.approx(right[forest.name], abs=0.005)
        for number, track in enumerate(study.tracks):
            (values,) = lines(axes, track.name)
            rows = [(label, row[number]) for label, row in forest.rows]
            for (label, interval), (x, y) in zip(rows, values.get_xydata(), strict=True):
                assert labels[round(y)] == label
                assert interval[0] == x


def test_the_anees_is_drawn_with_the_bands_of_the_study(report):
    (study,) = report.studies
    (axes,) = panels(by_title(compose(report))["ANEES of the pose"])
    for track in study.tracks:
        (curve,) = lines(axes, track.name)
        assert_array_equal(curve.get_ydata(), track.verdict.scale.anees)
        assert curve.get_gid() == f"filter:{track.tag}"
    common = nees.anees_of(study).common
    assert shaded(axes) == (np.nanmin(common.band), np.nanmax(common.band))
    (band,) = lines(axes, "band of all steps at once")
    assert_array_equal(band.get_ydata(), common.simultaneous[:, 0])
    assert {"95 % band of one step", "expected", *(track.name for track in study.tracks)} < {*legend_of(axes.figure)}


def test_runs_that_decide_the_average_are_told_and_left_out_of_a_thin_curve(report):
    (study,) = report.studies
    track = study.tracks[0]
    far_nees = track.record().errors.nees.copy()
    far_nees[[0, 2]] *= 1e4
    scale = replace(track.verdict.scale, median_run=2.5, worst_run=3e4, mean_anees=4321.0)
    verdict = replace(track.verdict, scale=scale)
    far = replace(track, verdict=verdict, record=lambda: changed(track.record(), nees=far_nees))
    with_far = replace(study, tracks=(far, *study.tracks[1:]))
    curves = nees.anees_of(with_far).curves
    assert [curve.far for curve in curves] == [2] + [0] * (len(curves) - 1)
    others = np.ma.masked_invalid(np.delete(far_nees, [0, 2], axis=0)).mean(axis=0)
    assert_allclose(curves[0].others, others.filled(np.nan))
    (figure,) = nees.anees_curves(with_far)
    assert f" 2 runs of {verdict.runs} decide the average of {track.name}, 4321 over all steps" in figure.caption
    (axes,) = panels(figure)
    (thin,) = lines(axes, f"{track.name} without 2 runs")
    assert_array_equal(thin.get_ydata(), curves[0].others)
    assert "decide" not in nees.anees_caption(nees.anees_of(study))


def test_pose_errors_have_a_row_for_each_filter(report):
    (study,) = report.studies
    figure = by_title(compose(report))["Pose errors, run 0"]
    for number, track in enumerate(study.tracks):
        drawn_panels = panels(figure, number)
        assert titles(drawn_panels)[0] == track.name
        of = one_run.pose_error_series(track)
        stated = track.shown.in_world.errors
        assert_allclose(of.error[:, 2], np.rad2deg(stated.error[0, :, 2]))
        assert_allclose(of.sigma[:, 2], np.rad2deg(np.sqrt(stated.covariance[0, :, 2, 2])))
        for axes, error, sigma in zip(drawn_panels, of.error.T, of.sigma.T, strict=True):
            _, low, high, curve = axes.lines
            assert_array_equal(curve.get_ydata(), error)
            assert_array_equal([low.get_ydata(), high.get_ydata()], [-2.0 * sigma, 2.0 * sigma])


def test_the_map_shows_truth_and_estimates(report):
    (study,) = report.studies
    found = one_run.world_of(study)
    (axes,) = panels(by_title(compose(report))["Scenario and estimates, run 0"])
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (m)", "y (m)")
    (truth,), (odometry,) = lines(axes, "true path"), lines(axes, "odometry alone")
    assert_array_equal(truth.get_xydata(), found.truth)
    assert_array_equal(odometry.get_xydata(), found.odometry)
    for track, path in found.paths:
        assert_array_equal(lines(axes, track.name)[0].get_xydata(), path)


@pytest.mark.parametrize("alone", ["frontend_fig22", "frontend_fig23", "first_order"])
def test_a_table_of_the_front_end_alone(reproduced, alone):
    for name in set(front_end_tables(reproduced)) - {alone}:
        (reproduced / f"{name}.parquet").unlink()
    report = without_studies(reproduced)
    assert 'id="front-end"' in shown(report)
    (chapter,) = [chapter for chapter in compose(report).chapters if chapter.anchor == "front-end"]
    assert len(chapter.blocks) == 1


@pytest.mark.parametrize("name", ["frontend_fig22", "frontend_fig23", "first_order"])
def test_damaged_tables_of_the_front_end_are_named(reproduced, name):
    table, path = front_end_tables(reproduced)[name], reproduced / f"{name}.parquet"
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
            compose(build_report(reproduced))
    path.write_bytes(b"PAR1")
    with pytest.raises(cs.InputError, match=rf"{name}\.parquet: cannot be read"):
        compose(build_report(reproduced))


@pytest.mark.parametrize("value, message", [(0.0, "not above zero"), (np.inf, "not a finite number")])
def test_cells_that_no_log_axis_shows_are_refused(reproduced, value, message):
    table = front_end_tables(reproduced)["first_order"]
    table.assign(nees_ratio=[1.0, 1.0, value]).to_parquet(reproduced / "first_order.parquet")
    with pytest.raises(cs.InputError, match=rf"first_order\.parquet: column 'nees_ratio', row 2: {message}"):
        compose(build_report(reproduced))


@pytest.mark.parametrize(
    "word, pieces",
    [
        ("first-order-reprojection", ["first-order-", "reprojection"]),
        ("frontend-fig2.2", ["frontend-", "fig2.2"]),
        (30 * "x", [14 * "x", 14 * "x", "xx"]),
        ("x = -0.5e-6 2-2", ["x = -0.5e-6 2-2"]),
    ],
)
def test_long_words_break_at_hyphens(word, pieces):
    assert pdf.soft(word).split("\u200b") == pieces


def test_a_log_without_truth_says_so(uvd, tmp_path):
    simulate_log(uvd, 1, 0, tmp_path / "log")
    for name in ("truth", "landmarks"):
        (tmp_path / "log" / f"{name}.parquet").unlink()
    from consistency.bench.store.recorded_log import read_log

    run_log(read_log(tmp_path / "log"), ["ekf-uvd"], jobs=1).write(tmp_path / "run")
    report = build_report(tmp_path / "run")
    (study,) = report.studies
    assert not study.has_truth
    assert one_run.world_of(study).odometry is None
    assert str(tmp_path) not in study.name
    source = shown(report)
    assert "The truth of log is not known" in source
    assert "Pose errors" not in source


def test_one_run_is_a_nees(uvd, tmp_path):
    cs.run_trials(uvd, ["ekf-uvd"], runs=1, seed=0, jobs=1).write(tmp_path / "run")
    report = build_report(tmp_path / "run")
    assert report.studies[0].statistic == "NEES"
    assert "NEES of the single run 0" in shown(report)


def test_a_filter_looks_the_same_in_every_study(reproduced, results):
    swapped = results.manifest | {"filters": FILTERS[::-1]}
    replace(results, manifest=swapped).write(reproduced / "other")
    change_manifest(reproduced, studies=["small", "other"])
    studies = build_report(reproduced).studies
    looks = [{t.name: t.style for t in study.tracks} for study in studies]
    assert looks[0] == looks[1]
    tags = [{track.tag for track in study.tracks} for study in studies]  # its check boxes leave other studies alone
    assert tags == [{"0-0", "0-1"}, {"1-0", "1-1"}]
