"""Files of a verdict that is the end of long work: refused before it, written after it."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from consistency.referee.diagnostics.record import Record
from consistency.referee.diagnostics.verdict import Verdict
from consistency.referee.errors import InputError
from consistency.referee.extras import missing, remedy
from consistency.referee.pages.write_pages import is_one_file, require_report, write_file_reports, write_text_file
from consistency.referee.show.as_json import render
from consistency.referee.show.blocks import Document


def require_reports(report: Path | None, junit: Path | None, overwrite: bool) -> None:
    """Refuse, before any work, files that cannot be written.

    Raises
    ------
    InputError
        One exists without ``overwrite``, cannot be written, or has the wrong suffix.
    """
    if junit is not None and junit.suffix.lower() != ".xml":
        raise InputError(f"--junit {junit}: must end in .xml")
    for path in (report, junit):
        if path is not None:
            require_report(path, overwrite)


def write_verdicts(
    records: Sequence[Record],
    verdicts: Mapping[str, Verdict],
    document: Document,
    report: Path | None,
    junit: Path | None,
    overwrite: bool,
) -> list[Path]:
    """Write the files that were asked for, and return their paths."""
    written: list[Path] = []
    for path in (report, junit):
        if path is None:
            continue
        if is_one_file(path):
            written.append(write_text_file(document, path))
            continue
        written += write_file_reports(
            records, verdicts, path, document.title, render(document), require_report(path, overwrite)
        )
        if missing("report"):
            print(f"consistency: pictures and the PDF need {remedy('report')}", file=sys.stderr)
    return written
