"""Sections of a report on filters with an error of their own, and on maps."""

from dataclasses import replace

import pytest
from invariant import Invariant

import consistency as cs
from consistency.bench.pages import write_reports
from consistency.bench.pages.results_report import build_report
from consistency.bench.pages.sections import nees
from consistency.bench.pages.sections.study_sections import maps, of_own_errors, own_error_table
from consistency.referee.pages import verdicts
from consistency.referee.show.blocks import Name, Quantity, Status, Table, brief, written
from consistency.referee.verdicts.tables import page


@pytest.fixture(scope="module")
def results(uvd):
    return cs.run_trials(uvd, ["ekf-uvd", Invariant()], runs=6, seed=5, jobs=1)


@pytest.fixture(scope="module")
def folder(results, tmp_path_factory):
    out = tmp_path_factory.mktemp("report") / "run"
    results.write(out)
    return out


@pytest.fixture(scope="module")
def study(folder):
    return build_report(folder).studies[0]


def rows_of(blocks):
    [found] = [block for block in blocks if isinstance(block, Table)]
    [(_, rows)] = found.groups
    return rows


def test_both_errors_stand_below_each_other(study):
    track = study.tracks[1]
    v = track.verdict
    own, world = rows_of(own_error_table(study))
    name = Name("right", track.look)
    assert own[:4] == (name, "right, its own", Status(v.status), Quantity(v.scale.mean_anees))
    assert world[:4] == ("", "so2, additive", Status(v.world.status), Quantity(v.world.scale.mean_anees))
    assert brief(v.scale.inflation.low) in written(own[4])
    caption = of_own_errors(study)
    assert caption.startswith("right: Log(truth estimate^-1) of SE(2), in the world frame; so2: position difference")


def test_captions_name_the_filters_with_an_error_of_their_own(study):
    assert "Judged in an error of their own, but for the RMSE: right (right)" in verdicts.verdicts_caption(study)
    assert nees.anees_caption(nees.anees_of(study)).endswith("In the filter's own error: right (right).")
    alone = replace(study, tracks=study.tracks[:1])
    assert "own" not in nees.anees_caption(nees.anees_of(alone)).replace("shown", "")
    assert "error of their own" not in verdicts.verdicts_caption(alone)
    assert own_error_table(alone) == ()


def test_the_rmse_is_that_of_the_pose_in_the_world(study):
    track = study.tracks[1]
    [measure] = [m for m in page("") if m.column.head == "RMSE position (m)"]
    cell = written(measure.cell(track.verdict))
    assert cell == f"{track.verdict.world.accuracy.rmse_position:.3f}"
    assert cell != f"{track.verdict.accuracy.rmse_position:.3f}", "negative control"


def _of_map(score):
    return score.ratio, score.verdict.joint.both, score.verdict.joint.map


def test_maps_of_all_filters(study):
    rows = rows_of(maps(study))
    score = study.tracks[0].verdict.map
    ends = [f"{brief(i.value)} [{brief(i.low)}, {brief(i.high)}]" for i in _of_map(score)]
    count = len(study.results.map) // 2
    assert rows[0][0] == Name("ekf-uvd", study.tracks[0].look)
    assert tuple(map(written, rows[0][1:])) == (score.verdict.status, *ends, "6", str(count), "0")
    assert len(rows) == 2
    sentences = [getattr(block, "text", "") for block in maps(study)]
    assert f"Map of ekf-uvd: {score.verdict.reasons[0]}." in sentences
    without = tuple(replace(track, verdict=replace(track.verdict, map=None)) for track in study.tracks)
    assert len(rows_of(maps(replace(study, tracks=(study.tracks[0], without[1]))))) == 1
    assert maps(replace(study, tracks=without)) == ()


def test_both_formats_hold_both_sections(folder, tmp_path):
    write_reports(folder, tmp_path / "r.html", tmp_path / "r.pdf", False)
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    for text in (
        "Errors of their own",
        "right, its own",
        "so2, additive",
        "Mean NEES / 3 of landmarks",
        "no verdict on a pose depends on it",
    ):
        assert text in page
    assert (tmp_path / "r.pdf").read_bytes().startswith(b"%PDF")
