"""Where the numbers come from: seeds, versions, settings."""

from __future__ import annotations

import json
from typing import Any

from consistency.bench.pages.sections.report_input import Report, Study
from consistency.referee.document.blocks import Block, Details, Facts, Settings
from consistency.referee.pages.origin import facts

SHORT = 4000  # characters of settings that surely fit on one page


def provenance(report: Report) -> tuple[Block, ...]:
    """What the manifest says, and of each study what it adds."""
    rows = facts(report.manifest)
    return Facts(rows), *(_study(study, rows, len(report.studies) > 1) for study in report.studies)


def _study(study: Study, stated: tuple[tuple[str, str], ...], several: bool) -> Details:
    """Facts of one study that the report does not state already, and its settings."""
    rows = tuple(row for row in facts(study.results.manifest) if row not in stated)
    settings = resolved(study)
    what = "resolved belief" if study.is_log else "resolved scenario"
    if several:
        what = f"provenance and {what}"
    blocks = (Facts(rows), Settings(settings)) if rows else (Settings(settings),)
    return Details(f"{study.name}: {what}", blocks, whole=len(settings) < SHORT)


def resolved(study: Study) -> str:
    """The scenario, or the log's belief, as JSON."""
    manifest = study.results.manifest
    return json.dumps(_rounded(manifest.get("scenario") or manifest.get("belief") or {}), indent=2, ensure_ascii=False)


def _rounded(value: Any) -> Any:
    """Six digits of every number, to read; the manifest has them all."""
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_rounded(item) for item in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value
