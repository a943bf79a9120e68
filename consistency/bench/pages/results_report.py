"""From an output folder to what the sections read, and from that to the document."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from consistency.bench.pages.sections import published_findings, several_studies
from consistency.bench.pages.sections.calibration_rates import calibration_rates
from consistency.bench.pages.sections.filters_table import filters_table
from consistency.bench.pages.sections.report_input import Report, Study, Track
from consistency.bench.pages.sections.several_studies import provenance
from consistency.bench.pages.sections.study_sections import SECTIONS
from consistency.bench.runs.reproduce_findings import figure_scripts, read_findings
from consistency.bench.runs.results_to_records import design_of, longest_run, nis_ratio, record_of
from consistency.bench.store.results import open_results
from consistency.bench.types import OURS, outcome
from consistency.referee.diagnostics.judge_record import judge
from consistency.referee.diagnostics.number_words import is_or_are, names_in_a_row, plural
from consistency.referee.diagnostics.verdict_parts import STATUSES, Settings
from consistency.referee.errors import InputError
from consistency.referee.pages.verdicts import time_axis_of
from consistency.referee.show.blocks import Chapter, Document, Status, badges
from consistency.referee.system import Advance, read_manifest

LISTED = 6  # filters that the first paragraph names one by one


def folders_of(folder: Path, manifest: dict[str, Any]) -> list[Path]:
    """Folders of results in a folder of ``consistency run``, which is one, or ``consistency reproduce``.

    Raises
    ------
    InputError
        The folder holds no results.
    """
    if "studies" in manifest:
        names = manifest["studies"]
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError(f"{folder / 'manifest.json'}: key 'studies' must be names of folders; write it again")
        return [folder / name for name in names]
    if "filters" in manifest:
        return [folder]
    raise InputError(f"{folder}: holds no filter results; write some with 'consistency run', then report those")


def build_report(folder: Path, advance: Advance = lambda _: None) -> Report:
    """Read a folder of ``consistency run`` or ``consistency reproduce`` and judge its filters.

    ``advance`` is called with 1 after each of its parts.

    Raises
    ------
    InputError
        The folder holds no results, or a file in it is damaged.
    """
    manifest, studies = read_manifest(folder), list[Study]()
    styles: dict[str, int] = {}
    for index, part in enumerate(folders_of(folder, manifest)):
        studies.append(_study(part, index, styles))
        advance(1)
    return Report(folder, manifest, tuple(studies), tuple(read_findings(folder)))


def _study(folder: Path, index: int, styles: dict[str, int]) -> Study:
    """One folder of results; ``styles`` are the numbers of filters that other studies have."""
    results = open_results(folder)
    scenario, design, steps = results.scenario, design_of(results), longest_run(results)
    runs = np.unique(np.concatenate([results.runs_of(name) for name in results.filters]))
    shown_run = int(runs[0]) if len(runs) else 0

    def track(name: str) -> Track:
        number, read = styles.setdefault(name, len(styles)), partial(record_of, results, name, steps)
        record = read()
        verdict = judge(record, Settings(), design)
        shown = record.of_runs(np.flatnonzero(record.run_numbers == shown_run))
        ratio = nis_ratio(record, verdict.runs)
        return Track(name, number, f"{index}-{number}", verdict, record.failures, shown, ratio, read)

    tracks = tuple(track(name) for name in results.filters)
    return Study(
        name=scenario.name if scenario else Path(str(results.manifest.get("log", folder.name))).name,
        summary=scenario.summary if scenario else "Recorded log",
        runs=len(runs),
        shown_run=shown_run,
        clock=time_axis_of(tracks[0].shown.runs.t if tracks else np.full(steps, np.nan)),
        steps=np.arange(1, steps + 1),
        tracks=tracks,
        results=results,
        until_decided=design is not None,
    )


def compose(report: Report) -> Document:
    """The document that HTML and PDF show: every section that applies.

    Of several studies the PDF has the findings and a part of each study; the page has all.
    """
    brief = len(report.studies) > 1
    only_page = () if brief else None
    chapters = (
        Chapter("findings", "Findings: published beside measured", "Findings", published_findings.all_findings(report),
                on_paper=published_findings.findings_on_paper(report)),
        Chapter("filters", "Filters side by side", "Filters", filters_table(report)),
        Chapter("verdicts", "Verdicts", "Verdicts", several_studies.verdicts(report), on_paper=only_page),
        *(_study_chapter(index, study, brief) for index, study in enumerate(report.studies)),
        *_of_experiments(report, brief),
        Chapter("calibration", "How far the referee can be trusted", "The referee", calibration_rates(), on_paper=()),
        Chapter("provenance", "Provenance", "Provenance", provenance(report), on_paper=only_page),
    )  # fmt: skip
    shown = tuple(chapter for chapter in chapters if chapter.blocks)
    text, opening = answer(report.studies, report.findings), several_studies.opening(report)
    return Document(report.title, text, shown, opening, badges=badges_of(report))


def badges_of(report: Report) -> tuple[Status, ...]:
    """The outcome of each finding, or of results without findings the verdict on each filter."""
    named = [(str(f["id"]), outcome(str(f["source"] or ""), str(f["verdict"]))) for f in report.findings]
    tracks = [(track.name, track.verdict.status) for study in report.studies for track in study.tracks]
    return badges(named or tracks)


def _of_experiments(report: Report, brief: bool) -> list[Chapter]:
    """Chapters that the scripts in ``experiments/figures`` make of the tables in the folder."""
    chapters = []
    for script in figure_scripts().values():
        anchor, title, link = script.CHAPTER
        on_paper = () if brief and not script.ON_PAPER else None
        chapters.append(Chapter(anchor, title, link, script.blocks(report), on_paper=on_paper))
    return chapters


def _study_chapter(index: int, study: Study, brief: bool) -> Chapter:
    blocks = tuple(block for section in SECTIONS for block in section(study))
    on_paper = several_studies.on_paper(study, blocks) if brief else None
    return Chapter(f"study-{index}", study.name, study.name, blocks, study.summary, study.switches, on_paper)


def answer(studies: Sequence[Study], findings: Sequence[dict[str, Any]]) -> str:
    """Who is honest and who is not, in one paragraph."""
    pairs = [(track, study) for study in studies for track in study.tracks]
    sentences = []
    if len(studies) > 1:
        sentences.append(several_studies.main_sentence(studies))
    if findings:
        sentences.append(_finding_sentence(findings))
    if pairs:
        sentences.append(_count_sentence(studies, [track for track, _ in pairs]))
        if len(studies) == 1:
            sentences += [sentence for status in STATUSES if (sentence := _status_sentence(status, pairs))]
        sentences.append(_failure_sentence(studies))
    if any(track.innovations_judged and not study.has_truth for track, study in pairs):
        sentences.append(
            "Where the truth is not known the innovations alone decide, if the filter declares an optimal gain; they "
            "cannot see most pose errors."
        )
    return " ".join(filter(None, sentences)) or "This folder holds neither results nor findings."


def _count_sentence(studies: Sequence[Study], tracks: Sequence[Track]) -> str:
    """How many pairs of filter and scenario passed, and what."""
    honest_filters = sum(track.verdict.consistent for track in tracks)
    is_singular = honest_filters == 1 or len(tracks) == 1
    what_passed = f"{'is' if is_singular else 'are'} shown to be honest about the uncertainty of the pose"
    nothing_judged = False
    if not any(study.has_truth for study in studies):
        what_passed = f"{'passes' if is_singular else 'pass'} the test of the innovations, the only one without truth"
        nothing_judged = not any(track.innovations_judged for track in tracks)
    unknown = "no filter can be judged: the truth is not known, and none declares an optimal gain"
    if len(studies) == 1:
        study_size = f"{plural(studies[0].runs, 'run')} of {plural(len(studies[0].steps), 'step')}"
        count = unknown if nothing_judged else f"{honest_filters} of {plural(len(tracks), 'filter')} {what_passed}"
        return f"In {studies[0].name} ({study_size}), {count}."
    if nothing_judged:
        return f"{unknown[:1].upper()}{unknown[1:]}."
    statuses = Counter(track.verdict.status for track in tracks)
    counts = [f"{statuses[status]} {status}" for status in STATUSES if statuses[status]]
    return f"{plural(len(tracks), 'verdict')} in {len(studies)} worlds: {', '.join(counts)}."


def _status_sentence(status: str, pairs: list[tuple[Track, Study]]) -> str:
    names = [track.name for track, _ in pairs if track.verdict.status == status]
    if not names:
        return ""
    if len(names) > LISTED:
        return f"{len(names)} {is_or_are(len(names))} {status} ({STATUSES[status]})."
    return f"{status.capitalize()} ({STATUSES[status]}): {names_in_a_row(names)}."


def _failure_sentence(studies: Sequence[Study]) -> str:
    failed = sum(len(study.failures) for study in studies)
    total = sum(study.runs * len(study.tracks) for study in studies)
    if not failed:
        return "No run broke down."
    where = " that looked at them" if any(study.until_decided for study in studies) else ""
    return (
        f"{failed} of {total} runs through a filter broke down; they are listed below and counted in the "
        f"verdicts{where}."
    )


def _finding_sentence(findings: Sequence[dict[str, Any]]) -> str:
    outcome_words = [outcome(str(finding["source"] or ""), str(finding["verdict"])) for finding in findings]
    is_own = [str(finding["source"] or "").startswith(OURS) for finding in findings]
    own = Counter(word for word, ours in zip(outcome_words, is_own, strict=True) if ours)
    published = Counter(word for word, ours in zip(outcome_words, is_own, strict=True) if not ours)
    parts = []
    if published:
        counts = [f"{count} {word}" for word, count in published.items()]
        parts.append(f"Of {plural(published.total(), 'published finding')}, {names_in_a_row(counts)}.")
    if own:
        counts = [f"{count} {'hold' if word == 'holds' else word}" for word, count in own.items()]
        parts.append(f"Of {plural(own.total(), 'conjecture')} of this project, {names_in_a_row(counts)}.")
    return " ".join(parts)
