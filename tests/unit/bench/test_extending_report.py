"""The worked example "Add a report section" of docs/extending.md works as it is printed."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from documents import blocks

import consistency as cs
from consistency.bench.pages import build, write_reports
from consistency.bench.pages.build import build_report
from consistency.bench.pages.contents import SECTIONS
from consistency.bench.pages.sections import pose_errors
from consistency.referee.show import pdf


def example(path: str) -> str:
    """The code block that follows the line which names the file ``path``."""
    (found,) = (block.text for block in blocks("docs/extending.md", "python") if block.before == f"`{path}`:")
    return found


@pytest.fixture
def rmse(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The example of a section, as a module, registered where the guide says."""
    module = ModuleType("rmse")
    monkeypatch.setitem(sys.modules, "rmse", module)
    exec(compile(example("consistency/bench/pages/sections/rmse.py"), "rmse.py", "exec"), module.__dict__)
    place = SECTIONS.index(pose_errors.SECTION) + 1
    monkeypatch.setattr(build, "SECTIONS", (*SECTIONS[:place], module.SECTION, *SECTIONS[place:]))
    return module


def test_the_section_with_one_plot_is_in_both_reports(uvd, tmp_path: Path, rmse: ModuleType) -> None:
    cs.run_trials(uvd, ["ekf-uvd", "ekf-xyz"], runs=3, seed=0, jobs=1).write(tmp_path / "run")
    report = build_report(tmp_path / "run")
    (study,) = report.studies
    error = study.tracks[0].record().in_world.error
    np.testing.assert_allclose(rmse.read(study).curves[0][1], np.sqrt((error[..., :2] ** 2).sum(-1).mean(axis=0)))

    titles = [figure.title for figure in build.compose(report).figures]
    assert titles.index("Error of the position") == titles.index("Pose errors, run 0") + 1
    targets = tmp_path / "r.html", tmp_path / "r.pdf"
    write_reports(tmp_path / "run", *targets, overwrite=False)
    page = targets[0].read_text(encoding="utf-8")
    assert "<h3>Error of the position</h3>" in page
    assert "Root mean square error of the position over 3 runs, step by step." in page
    assert 'aria-label="Position error of ' in page
    assert targets[1].read_bytes().startswith(b"%PDF")
    without = build.compose(report, SECTIONS)
    assert "Error of the position" not in [figure.title for figure in without.figures]


def test_the_section_with_one_plot_is_drawn_for_the_pdf(
    uvd, tmp_path: Path, rmse: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    cs.run_trials(uvd, ["ekf-uvd"], runs=3, seed=0, jobs=1).write(tmp_path / "run")
    images: dict[str, bytes] = {}

    def compile_nothing(template: str, **_: object) -> bytes:
        folder = Path(template).parent
        images.update({path.name: path.read_bytes() for path in folder.glob("*.svg")})
        return (folder / "data.json").read_bytes()

    monkeypatch.setattr(pdf.typst, "compile", compile_nothing)
    data = json.loads(pdf.render_pdf(build.compose(build_report(tmp_path / "run"))))
    blocks = [block for chapter in data["chapters"] for block in chapter["blocks"]]
    (block,) = [block for block in blocks if block.get("caption", "").startswith("Root mean square")]
    assert images[block["images"][0]].count(b'id="axes_1"') == 1


def test_the_section_does_not_apply_without_truth(rmse: ModuleType) -> None:
    class Blind:
        has_truth = False

    assert rmse.read(Blind()) is None
