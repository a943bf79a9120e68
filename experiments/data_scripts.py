"""What scripts on data that are not shipped have in common: options, and findings in a folder and on the terminal."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import consistency as cs
from consistency.bench.runs.reproduce_findings import findings_table
from consistency.referee.show.terminal import show
from consistency.referee.system import require_free


def options_of(
    doc: str | None, arguments: Sequence[str] | None, data: str, truth: str = "", jobs: bool = False
) -> argparse.Namespace:
    """Options of a script; ``data`` and ``truth`` are their helps. The folder to write is free."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help=data)
    if truth:
        parser.add_argument("--truth", type=Path, help=truth)
    parser.add_argument("--out", type=Path, required=True, help="folder to write")
    if jobs:
        parser.add_argument("--jobs", type=int, default=-1, help="workers; -1 is one a core")
    parser.add_argument("--overwrite", action="store_true", help="replace an output folder of this bench")
    given = parser.parse_args(arguments)
    require_free(given.out, given.overwrite, "findings")
    return given


def keep(study: cs.Study, findings: Sequence[cs.Finding], given: argparse.Namespace, started: float) -> None:
    """Write findings as `consistency reproduce` does, and show them."""
    study.write(given.out, findings, time.monotonic() - started, given.overwrite)
    show(findings_table(findings))
