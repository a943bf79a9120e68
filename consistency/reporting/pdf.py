"""The report model as a PDF: Matplotlib figures as SVG, set by Typst; no LaTeX and no system font."""

from __future__ import annotations

import json
import re
import tempfile
import warnings
from collections.abc import Callable
from importlib import resources
from io import BytesIO
from itertools import zip_longest
from pathlib import Path
from typing import Any

import matplotlib as mpl
import typst

from consistency.reporting import captions, diagnosis, figures, wording
from consistency.reporting.model import FrontEnd, Report, Study

TEMPLATE = "report.typ"
SHORT = 4000  # characters of settings that surely fit on one page
FILES = ("image", "images")  # keys of file names
Save = Callable[[str, Any], str]  # name, figure -> file name
LONG_WORD = re.compile(r"[^\s\u200b]{1,13}-(?=[^\W\d])|[^\s\u200b]{14}")  # at a hyphen within reach, else anywhere


def render_pdf(report: Report) -> bytes:
    """The whole document; the same report gives the same bytes."""
    with tempfile.TemporaryDirectory(prefix="consistency-report-") as name, mpl.rc_context(figures.RC):
        folder = Path(name)
        data = {
            "title": report.title,
            "answer": report.answer,
            "method": captions.method(report),
            "studies": [_study(study, f"s{i}", folder) for i, study in enumerate(report.studies)],
            "findings": [{key: str(value) for key, value in finding.items()} for finding in report.findings],
            "distributions": [_distribution(d, f"d{i}", folder) for i, d in enumerate(report.distributions)],
            "front_end": _front_end(report.front_end, folder),
            "calibration": _calibration(report),
            "provenance": [list(row) for row in report.provenance],
        }
        (folder / "data.json").write_text(json.dumps(_soft(data), ensure_ascii=False), encoding="utf-8")
        template = resources.files("consistency.reporting").joinpath("templates", TEMPLATE)
        (folder / TEMPLATE).write_text(template.read_text(encoding="utf-8"), encoding="utf-8")
        pdf: bytes = typst.compile(str(folder / TEMPLATE), root=str(folder), ignore_system_fonts=True)
        return pdf


def _study(study: Study, prefix: str, folder: Path) -> dict[str, Any]:
    def save(name: str, figure: Any) -> str:
        return _svg(figure, folder / f"{prefix}-{name}.svg")

    entry: dict[str, Any] = {
        "name": study.name,
        "summary": study.summary,
        "verdict_caption": f"{study.name}: {captions.verdict_caption(study)}",
        "shown_inside": wording.equivalence_interval(study),
        "verdicts": [list(wording.verdict_row(track)) for track in study.tracks],
        "reasons": [
            {"filter": track.name, "sentence": track.verdict.reasons[0], "reasons": list(track.verdict.reasons[1:])}
            for track in study.tracks
        ],
        "failures": [[name, str(run), str(step), why] for name, run, step, why in study.failures],
        "map": {"image": save("map", figures.scenario(study)), "caption": captions.scenario_caption(study)},
        "errors": None,
        "anees": None,
        "innovations": _rows(figures.innovations(study), "nis", captions.innovation_caption(study, True), save),
        "no_truth": None if study.has_truth else captions.no_truth(study),
        "diagnosis": _diagnosis(study, save),
        "provenance": [list(row) for row in study.provenance],
        "resolved": _settings(json.loads(study.resolved)),
        "short": len(study.resolved) < SHORT,
    }
    if study.has_truth:
        entry["errors"] = _rows(figures.pose_errors(study), "error", captions.error_caption(study), save)
        entry["anees"] = {"image": save("anees", figures.anees(study)), "caption": captions.anees_caption(study)}
    return entry


def _rows(rows: list[Any], name: str, caption: str, save: Save) -> dict[str, Any]:
    return {"images": [save(f"{name}-{i}", row) for i, row in enumerate(rows)], "caption": caption}


def _diagnosis(study: Study, save: Save) -> dict[str, Any]:
    rows = [
        [question, about, [list(wording.answer_cell(answer)) for answer in answers]]
        for question, about, answers in diagnosis.asked(study)
    ]
    figure, distribution = figures.by_axis(study), figures.nees_distribution(study)
    return {
        "filters": [track.name for track in study.tracks],
        "questions": rows,
        "caption": captions.question_caption(study),
        "figures": [list(wording.figure_row(track)) for track in study.tracks] if study.has_truth else [],
        "figure_caption": captions.figure_caption(),
        "by_axis": figure and {"image": save("axes", figure), "caption": captions.axis_caption(study)},
        "nees": distribution and {"image": save("nees", distribution), "caption": captions.nees_caption(study)},
    }


def _calibration(report: Report) -> dict[str, Any] | None:
    if report.calibration is None:
        return None
    groups = [[title, [list(row) for row in rows]] for title, rows in wording.calibration_groups(report.calibration)]
    worlds = [list(world) for world in captions.calibration_worlds(report.calibration)]
    return {"text": captions.calibration_text(report.calibration), "groups": groups, "worlds": worlds}


def _distribution(distribution: Any, prefix: str, folder: Path) -> dict[str, str]:
    image = _svg(figures.distribution(distribution), folder / f"{prefix}.svg")
    return {"image": image, "caption": captions.distribution_caption(distribution)}


def _front_end(found: FrontEnd, folder: Path) -> list[dict[str, str]]:
    shown = []
    if found.shares is not None:
        shown.append(("shares", figures.shares(found.shares), captions.shares_caption(found.shares)))
    if found.scenes is not None:
        shown.append(("scenes", figures.scenes(found.scenes), captions.scenes_caption(found.scenes)))
    if (cells := found.first_order) is not None:
        shown.append(("first-order", figures.first_order(cells), captions.first_order_caption(cells)))
    return [{"image": _svg(figure, folder / f"{name}.svg"), "caption": caption} for name, figure, caption in shown]


def _svg(figure: Any, path: Path) -> str:
    buffer = BytesIO()
    with warnings.catch_warnings():
        # a name in a script that the font lacks is drawn as boxes; the tables of the HTML show it
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    path.write_bytes(buffer.getvalue())
    return path.name


def _soft(value: Any) -> Any:
    """The same data with room to break inside long words and none before %, so that nothing runs over an edge."""
    if isinstance(value, dict):
        return {key: item if key in FILES else _soft(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_soft(item) for item in value]
    if not isinstance(value, str):
        return value
    return LONG_WORD.sub(lambda match: match.group() + "\u200b", value.replace(" %", "\u00a0%"))


def _settings(resolved: dict[str, Any]) -> list[list[str]]:
    """Rows of key, value, key, value: two columns of settings, read downwards; what is not set is left out."""
    pairs = [pair for key, value in resolved.items() if key not in ("name", "summary") for pair in _pairs(value, key)]
    half = -(-len(pairs) // 2)
    return [[*left, *right] for left, right in zip_longest(pairs[:half], pairs[half:], fillvalue=("", ""))]


def _pairs(value: Any, path: str) -> list[tuple[str, str]]:
    if isinstance(value, dict):
        return [pair for key, item in value.items() for pair in _pairs(item, f"{path}.{key}")]
    return [] if value is None else [(path, json.dumps(value, ensure_ascii=False))]
