"""What a report of several studies opens with: one picture and one table of all verdicts."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from painted import lines, panels

import consistency as cs
from consistency.bench.pages.results_report import answer, build_report, compose
from consistency.bench.pages.sections import several_studies
from consistency.bench.pages.sections.report_input import STEREO
from consistency.referee.show import pdf
from consistency.referee.show.as_html import render
from consistency.referee.show.blocks import Figure, Name, Status, Table, written

FILTERS = ("ekf-uvd", "ekf-xyz")


@pytest.fixture(scope="module")
def report(uvd, tmp_path_factory):
    """Two worlds with two filters, the second of them judged in the first world alone."""
    folder = tmp_path_factory.mktemp("overview") / "run"
    cs.run_trials(uvd, FILTERS, runs=4, seed=61, jobs=1).write(folder)
    one = build_report(folder)
    (study,) = one.studies
    second = replace(study, name="second", tracks=study.tracks[:1])
    return replace(one, manifest={"studies": ["first", "second"]}, studies=(replace(study, name="first"), second))


def opening(report):
    _, picture, verdicts = several_studies.opening(report)
    assert isinstance(picture, Figure)
    assert isinstance(verdicts, Table)
    return picture, verdicts


def test_every_verdict_is_in_the_table(report):
    [(_, rows)] = opening(report)[1].groups
    expected = [
        (study.name, track.name, track.verdict.status, track.verdict.scale.mean_anees, track.verdict.scale.median_run)
        for study in report.studies
        for track in study.tracks
    ]
    found = [(world, name.text, status.text, *map(written, values)) for world, name, status, *values, _ in rows]
    assert [row[:3] for row in found] == [row[:3] for row in expected]
    for found_row, expected_row in zip(found, expected, strict=True):
        assert [float(value) for value in found_row[3:]] == pytest.approx(expected_row[3:], rel=1e-2)
    assert all(isinstance(row[1], Name) and isinstance(row[2], Status) for row in rows)


def test_the_picture_has_every_ratio_in_the_row_of_its_world(report):
    (axes,) = panels(opening(report)[0])
    worlds = [label.get_text() for label in axes.get_yticklabels()]
    assert worlds == ["first", "second"]
    drawn = {
        (worlds[round(float(y))], name): x
        for name in FILTERS
        for line in lines(axes, name)
        for x, y in line.get_xydata()
    }
    ratios = {
        (study.name, track.name): track.verdict.scale.inflation for study in report.studies for track in study.tracks
    }
    assert drawn == {key: ratio.value for key, ratio in ratios.items()}
    assert {place.ratio for place in several_studies.places(report)} == set(ratios.values())
    low, high = axes.get_xlim()
    assert all(low < ratio.value < high for ratio in ratios.values())


def test_what_is_tolerated_is_shaded(report):
    (axes,) = panels(opening(report)[0])
    factor = report.studies[0].tracks[0].verdict.settings.factor
    (shade,) = [patch for patch in axes.patches if str(patch.get_label()).startswith("consistent if")]
    assert (shade.get_x(), shade.get_x() + shade.get_width()) == pytest.approx((1.0 / factor, factor))


def test_a_filter_without_a_ratio_stays_in_the_table(report):
    study = report.studies[1]
    blind = replace(study.tracks[0], verdict=replace(study.tracks[0].verdict, scale=None))
    changed = replace(report, studies=(report.studies[0], replace(study, tracks=(blind,))))
    picture, verdicts = opening(changed)
    assert all(round(place.y) == 0 for place in several_studies.places(changed))
    assert len(lines(panels(picture)[0], "ekf-uvd")[0].get_xdata()) == 1
    assert tuple(map(written, verdicts.groups[0][1][-1][3:])) == ("–",) * 3


def test_one_study_opens_with_its_answer_alone(report):
    single = replace(report, studies=report.studies[:1])
    assert several_studies.opening(single) == ()
    assert compose(single).opening == ()


def test_the_opening_stands_before_the_contents_of_the_page(report):
    document = compose(report)
    assert document.figures[0].title == several_studies.TITLE
    page = render(document)
    first = page.index("<section")
    assert (
        page.index('class="answer"')
        < page.index(several_studies.TITLE)
        < page.index("Every verdict of this report")
        < first
    )
    assert page[:first].count('class="chart') == 1


def test_the_opening_is_printed(report, monkeypatch):
    monkeypatch.setattr(pdf.typst, "compile", lambda path, **_: Path(path).with_name("data.json").read_bytes())
    data = json.loads(pdf.render_pdf(compose(report)))
    assert [block["kind"] for block in data["opening"]] == ["Text", "Figure", "Table"]
    assert pdf.soft(several_studies.TITLE) == data["opening"][1]["title"]


@pytest.fixture
def of_paper(report):
    """The same with the sensor of the paper as its first world."""
    first, second = report.studies
    manifest = report.manifest | {"date": "2026-01-02", "command": "consistency reproduce", "git_commit": "abc"}
    return replace(report, manifest=manifest, studies=(replace(first, name=STEREO), second))


def test_the_first_page_has_question_answer_curves_and_origin(of_paper):
    made = compose(of_paper)
    question, curves, origin, picture, _ = made.opening
    assert "Herath, Kodagoda and Dissanayake (2007)" in question.text
    assert curves.title == "NEES over time at a baseline of 9 cm"
    assert origin.text == "command: consistency reproduce; date: 2026-01-02; git commit: abc."
    assert picture.title == several_studies.TITLE
    statuses = {track.name: track.verdict.status for track in of_paper.studies[0].tracks}
    assert made.answer.startswith("At a baseline of 9 cm, ")
    assert all(name in made.answer and status in made.answer for name, status in statuses.items())


def test_of_several_studies_the_paper_has_verdicts_and_their_first_figure(of_paper):
    made = compose(of_paper)
    on_paper = {chapter.anchor: chapter.blocks for chapter in made.paper}
    assert list(on_paper) == ["study-0", "study-1"]
    assert [type(block).__name__ for block in on_paper["study-0"]] == ["Table", "Reasons", "Figure"]
    assert not any(entry.others for entry in on_paper["study-0"][1].entries)
    whole = {chapter.anchor: chapter.blocks for chapter in made.chapters}
    assert {"verdicts", "calibration", "provenance"} < set(whole)
    assert on_paper["study-0"][2] in whole["study-0"]


def test_one_study_is_printed_whole_but_for_the_rates_of_the_referee(report):
    made = compose(replace(report, studies=report.studies[:1]))
    assert {chapter.anchor for chapter in made.chapters} - {chapter.anchor for chapter in made.paper} == {"calibration"}


def test_the_answer_counts_where_the_table_names(report):
    text = answer(report.studies, ())
    assert text.startswith("3 verdicts in 2 worlds: ")
    assert "ekf-uvd" not in text
    assert "ekf-uvd" in answer(report.studies[:1], ())


def test_ends_that_are_not_known_are_no_reason_for_a_wider_picture(report):
    track = report.studies[0].tracks[0]
    scale = track.verdict.scale
    wide = replace(scale, inflation=scale.inflation._replace(value=2.0, low=0.5, high=np.inf))
    changed = replace(track, verdict=replace(track.verdict, scale=wide))
    studies = (replace(report.studies[0], tracks=(changed,)), replace(report.studies[1], tracks=(changed,)))
    (axes,) = panels(opening(replace(report, studies=studies))[0])
    assert axes.get_xlim()[1] == pytest.approx(3.0)


def test_findings_on_paper_leave_the_rules_out(report):
    finding = {
        "id": "one", "claim": "it holds", "accept": "p above 0.05", "source": "a paper", "scenario": "none",
        "published": "yes", "measured": "yes", "verdict": "reproduced", "runs": 4, "seed": 0,
    }  # fmt: skip
    made = compose(replace(report, findings=(finding,)))
    [(_, [on_page])] = made.chapters[0].blocks[0].groups
    [(_, [on_paper])] = made.paper[0].blocks[0].groups
    assert [line.text for line in on_page[1].below] == ["Accepted if: p above 0.05", "a paper. "]
    assert [line.text for line in on_paper[1].below] == ["a paper"]
    assert on_paper[2:] == on_page[2:]
