"""The tree of a document, and renderers that show the same tree."""

from __future__ import annotations

import json as standard
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from consistency.referee.diagnostics import Evidence, judge
from consistency.referee.document.blocks import (
    Answer,
    Bullets,
    Cell,
    Chapter,
    Column,
    Document,
    Facts,
    Heading,
    Name,
    Quantity,
    Reason,
    Reasons,
    Stack,
    Status,
    Text,
    table,
)
from consistency.referee.document.looks import style
from consistency.referee.document.verdict import FURTHER, TERMINAL, cells, document, page, with_values
from consistency.referee.document.wording import PLAIN, PRINTED, written
from consistency.referee.show import FORMATS, json, junit, markdown, rendered, static, text

INF, NAN = float("inf"), float("nan")
GOOD = Reason("ekf", "consistent: no fault found", ("mean NEES 3.0",))
BAD = Reason("a<b>", "overconfident: covariance too small & skewed\x1b", ("x | y", "z"), None, False, "tests/t.py::t")
HEADS = (Column("filter"), Column("verdict"), Column("n", number=True), Column(""))
TREE = Document(
    "Two `filters`",
    "One of them is honest.",
    (Chapter("c", "A chapter", "C", (Heading("More"), Facts((("runs", "2"),)), Bullets(("one", "two"))), "in short"),),
    (
        table(HEADS, [("ekf", Status("consistent"), Quantity(2.0), "")], "T"),
        table((Column("gate"), Column("why")), [("g", BAD)], "Gates"),
        Text("a paragraph", "Lead."),
        Reasons((GOOD,)),
    ),
    {"a": np.array([1.0, NAN]), "b": (np.int64(2), INF)},
)  # fmt: skip


@pytest.mark.parametrize(
    ("cell", "plain", "printed"),
    [
        ("a", "a", "a"),
        (Quantity(None), "-", "–"),
        (Quantity(NAN, (1.0, 2.0)), "-", "–"),
        (Quantity(INF), "inf", "∞"),
        (Quantity(INF, digits=".2f"), "-", "–"),
        (Quantity(INF, (1.0, 2.0)), "-", "–"),
        (Quantity(0.0), "0", "0"),
        (Quantity(2.0, (1.5, INF)), "2.00 [1.50, inf]", "2.00 [1.50, ∞]"),
        (Quantity(2.0, (0.0, NAN)), "2.00 [0, nan]", "2.00 [0, –]"),
        (Quantity(2.0, (1.5, 3.0), digits=".3g", is_factor=True), "x2 [1.5, 3]", "×2 [1.5, 3]"),
        (Quantity(2.0, (0.01, 1.1), limit=100.0), "2.00 [unknown]", "2.00 [unknown]"),
        (Quantity(2.0, (0.02, 1.1), limit=100.0), "2.00 [0.02, 1.10]", "2.00 [0.02, 1.10]"),
        (Quantity(2.0, (0.0, INF), limit=100.0), "2.00 [unknown]", "2.00 [unknown]"),
        (Quantity(1.23456, digits=".3f", is_aside=True, unit=" m"), "(1.235 m)", "(1.235 m)"),
        (Quantity(None, is_aside=True), "-", "–"),
        (Name("ekf", style(0)), "ekf", "ekf"),
        (Status("failed", " (NIS only)"), "failed (NIS only)", "failed (NIS only)"),
        (Answer("✗", "found", "0.01"), "✗ 0.01", "✗ 0.01"),
        (Stack("a", ()), "a", "a"),
        (BAD, BAD.sentence, BAD.sentence),
    ],
)
def test_a_cell_is_written_with_the_signs_of_its_medium(cell: Cell, plain: str, printed: str) -> None:
    assert written(cell, PLAIN) == plain
    assert written(cell, PRINTED) == printed


def test_what_was_judged_is_found_wherever_it_stands() -> None:
    assert list(TREE.reasons) == [BAD, GOOD]


def test_junit_has_a_case_for_each_verdict() -> None:
    suite = ET.fromstring(junit.render(TREE))[0]
    assert suite.attrib == {"name": "Two `filters`", "tests": "2", "failures": "1", "errors": "0", "skipped": "0"}
    bad, good = suite
    assert (bad.attrib, good.attrib) == (
        {"classname": "tests/t.py::t", "name": "a<b>"},
        {"classname": "Two `filters`", "name": "ekf"},
    )
    (failure,), (said,) = bad, good
    assert (failure.tag, said.tag) == ("failure", "system-out")
    assert failure.get("message") == "overconfident: covariance too small & skewed\ufffd"
    assert (failure.text or "").splitlines()[1:] == ["- x | y", "- z"]
    assert said.text == "ekf is consistent: no fault found\n- mean NEES 3.0"


def test_markdown_escapes_what_would_be_markup() -> None:
    said = markdown.render(TREE)
    assert said.startswith("## Two \\`filters\\`\n\nOne of them is honest.\n\n| filter | verdict | n |  |\n| --- | ---")
    assert "| ekf | consistent | 2.00 |  |" in said
    assert "| g | overconfident: covariance too small &amp; skewed |" in said
    assert (
        "Lead. a paragraph\n\n**ekf** is consistent: no fault found\n\n### A chapter\n\nin short\n\n#### More" in said
    )
    assert said.endswith("- runs: 2\n\n- one\n- two\n\n")


def test_json_holds_the_data_and_no_word_more() -> None:
    assert standard.loads(json.render(TREE)) == {"a": [1.0, None], "b": [2, None]}


def test_text_puts_what_did_not_pass_below_its_row() -> None:
    said = text.fragment(*TREE.opening, *TREE.chapters[0].blocks).splitlines()
    assert said[0] == "filter  verdict     n"
    assert said[1] == "ekf     consistent  2.00"
    assert said[2:5] == ["gate", "g", "    a<b> is overconfident: covariance too small & skewed\x1b"]
    assert said[-4:] == ["More", "  runs  2", "  - one", "  - two"]


def test_a_static_page_shows_every_block_and_escapes_all_text() -> None:
    said = static.render(TREE)
    for part in (
        "<h1>Two `filters`</h1>\n<p>One of them is honest.</p>", '<span class="verdict consistent">consistent</span>',
        '<td class="number">2.00</td>', "too small &amp; skewed", "<li>x | y</li><li>z</li>", "<strong>Lead.</strong>",
        "<p><strong>ekf</strong> is consistent: no fault found</p><ul><li>mean NEES 3.0</li></ul>", "<h3>More</h3>",
        "<section>\n", "<li>one</li><li>two</li>", '<th style="text-align:left">runs</th>',
    ):  # fmt: skip
        assert part in said
    assert "a<b>" not in said


def test_a_file_is_in_the_format_of_its_suffix() -> None:
    for suffix in FORMATS:
        assert rendered(TREE, Path(f"x{suffix.upper()}")).endswith("\n")
    assert rendered(TREE, Path("x.xml")).startswith("<?xml")


# --- verdicts ---------------------------------------------------------------------------------------


def verdict_of(scale: float, name: str = "f", n: int = 2):
    rng = np.random.default_rng(5)
    error = scale * rng.standard_normal((60, 4, n))
    P = np.broadcast_to(np.eye(n), (60, 4, n, n))
    return judge(Evidence(name, error=error, covariance=P, nees=(error**2).sum(-1), dof=n, axes=("x", "y")))


def test_every_view_takes_its_cells_from_the_verdict() -> None:
    v = verdict_of(2.0)
    said = {m.column.head: written(m.cell(v), PLAIN) for m in (*TERMINAL, *page("[a, b]"), *FURTHER)}
    value, low, high = v.scale.inflation
    assert said["ratio"] == f"{value:.2f} [{low:.2f}, {high:.2f}]"
    assert said["Covariance to multiply by"] == f"x{said['ratio']}"
    assert said["ANEES"] == f"{v.scale.mean_anees:.2f}"
    assert said["failed"] == "0 of 60"
    assert said["Shown inside [a, b]"].startswith("no, p ")
    assert said["NIS / dof"] == said["RMSE deg"] == "-"
    assert cells(TERMINAL[:1], v) == (Status("overconfident"),)


def test_columns_without_any_value_are_left_out() -> None:
    heads = [m.column.head for m in with_values(page(""), [verdict_of(1.0), verdict_of(2.0)])]
    assert "NIS / dof" not in heads
    assert {"Verdict", "Mean ANEES", "Worst axis"} <= set(heads)


def test_one_document_says_the_same_on_the_terminal_and_in_files() -> None:
    verdicts = {"good": verdict_of(1.0), "bad": verdict_of(2.0)}
    tree = document(verdicts, "a.csv")
    assert standard.loads(json.render(tree))["bad"]["reasons"] == list(verdicts["bad"].reasons)
    suite = ET.fromstring(junit.render(tree))[0]
    assert [len(case.findall("failure")) for case in suite] == [0, 1]
    assert suite[1][0].get("message") == verdicts["bad"].reasons[0]
    for name, v in verdicts.items():
        assert f"{name} is {v.reasons[0]}" in text.fragment(*tree.opening)
        assert f"**{name}** is {v.reasons[0]}" in markdown.render(tree)
    assert not list(document(verdicts, reasons=False).reasons)


def test_a_verdict_prints_itself_by_the_renderers() -> None:
    v = verdict_of(2.0)
    assert str(v).splitlines()[0] == f"f is {v.reasons[0]}"
    assert v._repr_html_().startswith(f"<div><p><strong>f</strong> is {v.reasons[0]}</p><table>")
