"""The tree of a document, and renderers that show the same tree."""

import json as standard
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from consistency.diagnostics import Comparison, Interval, MapScore, judge, make_record
from consistency.referee.diagnostics.comparison import Difference
from consistency.referee.diagnostics.sentences import reasons
from consistency.referee.diagnostics.verdict_parts import ABOUT, ALONE, JointScore, RejectionScore
from consistency.referee.show import FORMATS, as_html, as_json, as_md, as_xml, rendered, terminal
from consistency.referee.show.blocks import (
    PLAIN,
    PRINTED,
    Answer,
    Bullets,
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
    badges,
    fragment,
    style,
    table,
    unbroken,
    written,
)
from consistency.referee.verdicts.tables import (
    FURTHER,
    MAP_COLUMNS,
    TERMINAL,
    cells,
    comparison_table,
    document,
    known_measures,
    map_cells,
    map_lines,
    map_text,
    page,
    plan_lines,
    rejection_cells,
    rejection_text,
)

INF, NAN = float("inf"), float("nan")
GOOD = Reason("ekf", "consistent: no fault found", ("mean NEES 3.0",))
BAD = Reason("a<b>", "overconfident: covariance too small & skewed\x1b", ("x | y", "z"), None, False, "tests/t.py::t")
OTHER = Reason("p|q <i>", "consistent: as well")
HEADS = (Column("filter"), Column("verdict"), Column("n", number=True), Column(""))
TREE = Document(
    "Two `filters`",
    "One of them is honest.",
    (Chapter("c", "A chapter", "C", (Heading("More"), Facts((("runs", "2"),)), Bullets(("one", "two"))), "in short"),),
    (
        table(HEADS, [("ekf", Status("consistent"), Quantity(2.0), "")], "T"),
        table((Column("gate"), Column("why")), [("g", BAD)], "Gates"),
        Text("a paragraph", "Lead."),
        Reasons((GOOD, OTHER)),
    ),
    {"a": np.array([1.0, NAN]), "b": (np.int64(2), INF)},
)  # fmt: skip


@pytest.mark.parametrize(
    "cell, plain, printed",
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
def test_a_cell_is_written_with_the_signs_of_its_medium(cell, plain, printed):
    assert written(cell, PLAIN) == plain
    assert written(cell, PRINTED) == printed


def test_what_was_judged_is_found_wherever_it_stands():
    assert list(TREE.reasons) == [BAD, GOOD, OTHER]


def test_junit_has_a_case_for_each_verdict():
    suite = ET.fromstring(as_xml.render(TREE))[0]
    assert suite.attrib == {"name": "Two `filters`", "tests": "3", "failures": "1", "errors": "0", "skipped": "0"}
    bad, good, _ = suite
    assert (bad.attrib, good.attrib) == (
        {"classname": "tests/t.py::t", "name": "a<b>"},
        {"classname": "Two `filters`", "name": "ekf"},
    )
    (failure,), (said,) = bad, good
    assert (failure.tag, said.tag) == ("failure", "system-out")
    assert failure.get("message") == "overconfident: covariance too small & skewed\ufffd"
    assert (failure.text or "").splitlines()[1:] == ["- x | y", "- z"]
    assert said.text == "ekf is consistent: no fault found\n- mean NEES 3.0"


def test_markdown_escapes_what_would_be_markup():
    said = as_md.render(TREE)
    assert said.startswith("## Two \\`filters\\`\n\nOne of them is honest.\n\n| filter | verdict | n |  |\n| --- | ---")
    assert "| ekf | consistent | 2.00 |  |" in said
    assert "| g | overconfident: covariance too small &amp; skewed |" in said
    assert "Lead. a paragraph\n\n**ekf** is consistent: no fault found\n\n**p\\|q &lt;i>** is consistent" in said
    assert "\n\n### A chapter\n\nin short\n\n#### More\n\n" in said
    assert said.endswith("- runs: 2\n\n- one\n- two\n\n")


def test_json_holds_the_data_and_no_word_more():
    assert standard.loads(as_json.render(TREE)) == {"a": [1.0, None], "b": [2, None]}


def test_text_puts_what_did_not_pass_below_its_row():
    said = fragment(*TREE.opening, *TREE.chapters[0].blocks).splitlines()
    assert said[0] == "filter  verdict     n"
    assert said[1] == "ekf     consistent  2.00"
    assert said[2:5] == ["gate", "g", "    a<b> is overconfident: covariance too small & skewed\x1b"]
    assert said[-4:] == ["More", "  runs  2", "  - one", "  - two"]


def test_a_static_page_shows_every_block_and_escapes_all_text():
    said = as_html.render(TREE)
    for part in (
        "<h1>Two `filters`</h1>", '<div class="answer"><p>One of them is honest.</p></div>',
        '<span class="verdict consistent">consistent</span>',
        '<td class="number" data-head="n">2.00</td>', "too small &amp; skewed", "<li>x | y</li><li>z</li>",
        "<strong>Lead.</strong>",
        " ekf</dt><dd>consistent: no fault found<details>", "<li>mean NEES 3.0</li>", "<h3>More</h3>",
        '<section id="c"', "<li>one</li><li>two</li>", "<dt>runs</dt><dd>2</dd>", ".wide td::before",
        "script-src 'none'",
    ):  # fmt: skip
        assert part in said
    assert "a<b>" not in said


def test_a_file_is_in_the_format_of_its_suffix():
    for suffix in FORMATS:
        assert rendered(TREE, Path(f"x{suffix.upper()}")).endswith("\n")
    assert rendered(TREE, Path("x.xml")).startswith("<?xml")


# --- verdicts ---------------------------------------------------------------------------------------


def verdict_of(scale, name="f", n=2):
    rng = np.random.default_rng(5)
    error = scale * rng.standard_normal((60, 4, n))
    P = np.broadcast_to(np.eye(n), (60, 4, n, n))
    return judge(make_record(name, error=error, covariance=P, nees=(error**2).sum(-1), dof=n, axes=("x", "y")))


def test_every_view_takes_its_cells_from_the_verdict():
    v = verdict_of(2.0)
    said = {m.column.head: written(m.cell(v), PLAIN) for m in (*TERMINAL, *page("[a, b]"), *FURTHER)}
    value, low, high = v.scale.inflation
    assert said["true / stated"] == f"{value:.2f} [{low:.2f}, {high:.2f}]"
    assert said["True / stated covariance"] == f"x{said['true / stated']}"
    assert said["ANEES"] == f"{v.scale.mean_anees:.2f}"
    assert said["failed"] == "0 of 60"
    assert said["Shown inside [a, b]"] == "no"
    assert said["NIS / dof"] == said["RMSE deg"] == "-"
    assert cells(TERMINAL[:1], v) == (Status("overconfident"),)


def test_columns_without_any_value_are_left_out():
    heads = [m.column.head for m in known_measures(page(""), [verdict_of(1.0), verdict_of(2.0)])]
    assert "NIS / dof" not in heads
    assert {"Verdict", "Mean ANEES", "Worst axis"} <= set(heads)


def test_one_document_says_the_same_on_the_terminal_and_in_files():
    verdicts = {"good": verdict_of(1.0), "bad": verdict_of(2.0)}
    tree = document(verdicts, "a.csv")
    assert standard.loads(as_json.render(tree))["bad"]["reasons"] == list(verdicts["bad"].reasons)
    suite = ET.fromstring(as_xml.render(tree))[0]
    assert [len(case.findall("failure")) for case in suite] == [0, 1]
    assert suite[1][0].get("message") == verdicts["bad"].reasons[0]
    for name, v in verdicts.items():
        assert f"{name} is {v.reasons[0]}" in fragment(*tree.opening)
        assert f"**{name}** is {v.reasons[0]}" in as_md.render(tree)
    assert not list(document(verdicts, reasons=False).reasons)


def test_intervals_and_percentages_stay_on_one_line():
    text = "too small by x3.27 [1.91, 6.60], in 95 % of runs, [a, b c]"
    assert unbroken(text) == "too small by x3.27 [1.91,\u00a06.60], in 95\u00a0% of runs, [a, b c]"
    cell = as_html.render(Document("", "", (), (table((Column("a"),), [(text,)], "t"), Text(text))))
    assert cell.count("[1.91,\u00a06.60], in 95\u00a0%") == 2


def test_a_verdict_prints_itself_by_the_renderers():
    v = verdict_of(2.0)
    assert str(v).splitlines()[0] == f"f is {v.reasons[0]}"
    assert v._repr_html_().startswith(f'<div><dl class="reasons"><div><dt> f</dt><dd>{v.reasons[0]}<')


def test_a_terminal_has_words_of_verdicts_in_colour(monkeypatch, capsys):
    terminal.show(*TREE.opening)
    said = capsys.readouterr().out
    assert said.splitlines()[1].split() == ["ekf", "consistent", "2.00"]
    assert "\n\nekf is consistent: no fault found\n  - mean NEES 3.0\n\np|q <i> is" in said
    assert terminal._cell(Status("consistent", " [x]")) == "[green]consistent[/green] \\[x]"


# --- what else is put into rows ---------------------------------------------------------------------


def test_the_score_of_a_map_in_every_view():
    bare = MapScore(Interval(1.2, 0.9, 1.6), 5, 40, 2)
    assert [written(cell) for cell in map_cells(bare)] == ["not judged", "1.20 [0.90, 1.60]", "–", "–", "5", "40", "2"]
    assert map_text(bare) == "1.20 [0.90, 1.60] (2 of 42 landmarks left out)"
    joint = JointScore(*(Interval(x, x / 2, 2 * x) for x in (1.0, 2.0, 3.0)), 5, 80)
    judged = replace(bare, verdict=replace(verdict_of(1.0), joint=joint))
    shown = dict(zip((column.head for column in MAP_COLUMNS), map(written, map_cells(judged)), strict=True))
    assert shown["Pose and map together, NEES / dof"] == "1.00 [0.50, 2.00]"
    assert shown["Map given the pose, NEES / dof"] == "3.00 [1.50, 6.00]"
    assert map_lines({"a": bare, "b": judged, "c": replace(bare, landmarks=0)}) == [
        f"map after the last step, mean NEES / 3: a {map_text(bare)}; b {judged.verdict.status}, {map_text(bare)} "
        "(together with the pose 1.00)"
    ]
    assert map_lines({}) == []


def test_what_a_guard_rejected():
    share = Interval(0.5, 0.25, 0.75)
    score = RejectionScore(share, Interval(0.9, 0.8, 1.0), Interval(0.01, 0.0, 0.02), 5, 200, 10, 20)
    shown = [written(cell) for cell in rejection_cells(score)]
    assert shown == ["200", "10", "20", "50.0 [25.0, 75.0]", "90.0 [80.0, 100]", "1.00 [0, 2.00]"]
    assert "10 of them spurious: precision 50 [25, 75] %, recall 90" in rejection_text(score)
    clean = replace(score, spurious=0)
    assert [written(cell) for cell in rejection_cells(clean)][1:5] == ["–", "20", "–", "–"]
    assert rejection_text(clean) == "20 of 200 observations (1 [0, 2] %)"


PLAN = {"runs": 9, "false_alarm": 0.05, "power": 0.95, "detect": 1.5, "one_step": 30, "looks": [12, 24], "dof": 3}


def test_heads_of_a_comparison_and_lines_of_a_plan():
    c = Comparison(9, True, (Difference("mean NEES", 3.0, 4.0, 0.75, 0.5, 1.1),), 0.1, 0.1, 0.5, 0.05)
    one, two = (comparison_table(*names, c) for names in (("a", "b"), ("a", "a")))
    assert [column.head for column in one.columns][1:3] == ["a", "b (reference)"]
    assert [column.head for column in two.columns][1:3] == ["now", "reference"]
    assert list(one.rows) == [("mean NEES", "3", "4", "x0.75", "", "0.5 to 1.1")]
    lost = plan_lines(PLAN | {"lost": 0.05, "lost_runs": 3})
    assert lost[1] == "3 runs, none of them lost, show that at most 5 % of all are"
    assert len(plan_lines(PLAN)) == 2
    assert "too large by x2 " in plan_lines(PLAN | {"detect": 0.5})[0]
    like = plan_lines(PLAN | {"like": {"kf": {"runs": 7, "pilot_runs": 40, "effective_dof": 12.0}}})[-1]
    assert like.startswith("7 runs do where steps depend on each other as those of kf")
    assert like.endswith("where some axes or some runs alone are slow, it may take up to 9")


def test_the_rate_of_several_filters_is_said():
    """Each filter has the rate; that of the call is at most their sum, and never above 1."""
    v = verdict_of(1.0)
    assert _rate_line({"a": v}) is None
    named = dict.fromkeys("abc", v)
    assert v.settings.false_alarm == 0.05
    assert _rate_line(named) == "false alarm 0.05 holds for each filter; for all 3 together it is at most 0.15"
    assert str(_rate_line({str(k): v for k in range(30)})).endswith("for all 30 together it is at most 1")


def _rate_line(verdicts):
    lines = [b.text for b in document(verdicts, reasons=False).opening if isinstance(b, Text)]
    return next((line for line in lines if line.startswith("false alarm")), None)


def test_a_fault_of_one_question_alone_has_its_sentence():
    v = verdict_of(1.0)
    answers = tuple(replace(a, found=a.question == "distribution") for a in v.answers)
    alone = replace(v, answers=answers, status="inconsistent")
    assert reasons(alone)[0] == f"inconsistent: {ALONE['distribution']}"
    both = tuple(replace(a, found=a.question in ("distribution", "outliers")) for a in v.answers)
    assert ALONE["distribution"] not in reasons(replace(alone, answers=both))[0]
    assert set(ALONE) <= set(ABOUT)


def test_a_terminal_has_numbers_at_the_right_and_verdicts_in_their_colours(capsys, monkeypatch):
    columns = (Column("name"), Column("ratio", number=True), Column("verdict"))
    rows = (("a", Quantity(1.5), Status("overconfident")), ("b", Quantity(123.4), Status("consistent")))
    monkeypatch.setenv("FORCE_COLOR", "1")
    terminal.show(table(columns, rows, "Ratios"))
    shown = capsys.readouterr().out
    assert "\x1b[31moverconfident" in shown
    assert "\x1b[32mconsistent" in shown
    first, second = (re.sub(r"\x1b\[[\d;]*m", "", line) for line in shown.splitlines()[1:])
    assert first.index("overconfident") == second.index("consistent")
    assert len(first[: first.index("overconfident")].rstrip()) == len(second[: second.index("consistent")].rstrip())


@pytest.mark.parametrize(
    "named, shown",
    [
        ([], []),
        ([("mine", "consistent")], ["consistent"]),
        ([("mine", "consistent"), ("yours", "biased")], ["consistent mine", "biased yours"]),
        ([(f"f{k}", "failed" if k else "consistent") for k in range(9)], ["consistent 1", "failed 8"]),
    ],
)
def test_badges_are_the_words_of_verdicts(named, shown):
    assert [badge.text + badge.note for badge in badges(named)] == shown
