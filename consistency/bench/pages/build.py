"""From an output folder to what the sections read, and from that to the document."""

from __future__ import annotations

from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from consistency.bench.pages.answer import answer
from consistency.bench.pages.contents import SECTIONS
from consistency.bench.pages.report_input import Report, Study, Track
from consistency.bench.runs.findings import read_findings
from consistency.bench.runs.results_to_records import design_of, record_of, steps_of
from consistency.bench.runs.run_scores import nis_ratio
from consistency.bench.store.results import open_results
from consistency.referee.diagnostics import Settings
from consistency.referee.diagnostics.verdict.judge import judge_runs, with_map
from consistency.referee.document.blocks import Block, Chapter, Document
from consistency.referee.errors import InputError
from consistency.referee.pages.clock import clock_of
from consistency.referee.pages.section import OPENING, STUDY, Section
from consistency.referee.system.folders import read_manifest
from consistency.referee.system.progress import Advance


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
    scenario, design, steps = results.scenario, design_of(results), steps_of(results)
    runs = np.unique(np.concatenate([results.runs_of(name) for name in results.filters]))
    shown_run = int(runs[0]) if len(runs) else 0

    def track(name: str) -> Track:
        number, read = styles.setdefault(name, len(styles)), partial(record_of, results, name, steps)
        record = read()
        verdict, ends = judge_runs(record, Settings(), design), record.ends
        shown = record.of_runs(np.flatnonzero(record.run_numbers == shown_run))
        ratio = nis_ratio(record, verdict.runs)
        del record  # its arrays are free before the maps are read
        verdict = with_map(verdict, ends, Settings(), design)
        return Track(name, number, f"{index}:{number}", verdict, ends.failures, shown, ratio, read)

    tracks = tuple(track(name) for name in results.filters)
    return Study(
        name=scenario.name if scenario else Path(str(results.manifest.get("log", folder.name))).name,
        summary=scenario.summary if scenario else "Recorded log",
        runs=len(runs),
        shown_run=shown_run,
        clock=clock_of(tracks[0].shown.t if tracks else np.full(steps, np.nan)),
        steps=np.arange(1, steps + 1),
        tracks=tracks,
        results=results,
        until_decided=design is not None,
    )


def compose(report: Report, sections: tuple[Section[Any, Any], ...] | None = None) -> Document:
    """The document that HTML and PDF show: every section that applies, in the order of ``sections``."""
    chapters: list[Chapter] = []
    opening: tuple[Block, ...] = ()
    for part, group in groupby(SECTIONS if sections is None else sections, key=lambda section: section.part):
        members = tuple(group)
        if part is STUDY:
            for index, study in enumerate(report.studies):
                shown = tuple(block for section in members for block in section.blocks(study))
                anchor = f"{STUDY.anchor}-{index}"
                chapters.append(Chapter(anchor, study.name, study.name, shown, study.summary, study.keys()))
        elif blocks := tuple(block for section in members for block in section.blocks(report)):
            if part is OPENING:
                opening = blocks
            else:
                chapters.append(Chapter(part.anchor, part.title, part.link, blocks))
    return Document(report.title, answer(report.studies, report.findings), tuple(chapters), opening)
