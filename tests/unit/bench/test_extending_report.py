"""The worked example "Add a report section" of docs/extending.md works as it is printed."""

from types import ModuleType

import numpy as np
import pytest
from documents import ROOT, blocks
from numpy.testing import assert_allclose
from painted import by_title, lines, panels

import consistency as cs
from consistency.bench.pages import results_report, write_reports
from consistency.bench.pages.results_report import build_report
from consistency.bench.pages.sections import study_sections


@pytest.fixture
def example(monkeypatch):
    """The module of sections with the example and its place, as the guide says."""
    code = (ROOT / "docs/examples/extending/position_errors.py").read_text(encoding="utf-8")
    (order,) = (block.text for block in blocks("docs/extending.md", "python") if "`pose_errors`" in block.before)
    module = ModuleType("with_example")
    module.__dict__.update(vars(study_sections))
    exec(compile(code + order, "example.py", "exec"), module.__dict__)
    monkeypatch.setattr(results_report, "SECTIONS", module.SECTIONS)
    return module


def test_the_section_with_one_plot_is_in_both_reports(uvd, tmp_path, example):
    cs.run_trials(uvd, ["ekf-uvd", "ekf-xyz"], runs=3, seed=0, jobs=1).write(tmp_path / "run")
    report = build_report(tmp_path / "run")
    (study,) = report.studies
    error = study.tracks[0].record().in_world.errors.error
    expected = np.sqrt((error[..., :2] ** 2).sum(-1).mean(axis=0))
    assert_allclose(example.rmse(study.tracks[0]), expected)

    document = results_report.compose(report)
    titles = [figure.title for figure in document.figures]
    assert titles.index("Error of the position") == titles.index("Pose errors, run 0") + 1
    (axes,) = panels(by_title(document)["Error of the position"])
    assert_allclose(lines(axes, "ekf-uvd")[0].get_ydata(), expected)
    targets = tmp_path / "r.html", tmp_path / "r.pdf"
    write_reports(tmp_path / "run", *targets, overwrite=False)
    page = targets[0].read_text(encoding="utf-8")
    assert "<h3>Error of the position</h3>" in page
    assert "Root mean square error of the position over 3 runs, step by step." in page
    assert ">RMSE (m)</text>" in page
    assert targets[1].read_bytes().startswith(b"%PDF")


def test_the_section_does_not_apply_without_truth(example):
    class Blind:
        has_truth = False

    assert example.position_errors(Blind()) == ()
