"""Verdicts on results of the bench, in memory or in a folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.records.skipped_start import Skip
from consistency.referee.diagnostics.verdict.answers import Settings
from consistency.referee.diagnostics.verdict.verdict import Verdict
from consistency.referee.verdicts.judge_sources import Source, judge_all

if TYPE_CHECKING:
    from consistency.bench.store.results import Tables

    AnyResults = Source | Sequence[Record] | Tables | str | Path


def analyse(
    results: AnyResults,
    filters: Sequence[str] | None = None,
    confidence: float | None = None,
    settings: Settings | None = None,
    skip: str | float | Skip | None = None,
    optimal_gain: bool = False,
) -> dict[str, Verdict]:
    """Judge every filter of the results, or those named.

    Parameters
    ----------
    results : of ``consistency.run_trials``, a folder of them, or a sequence of records
    confidence : 1 - the false-alarm rate of a verdict, in place of ``settings``
    settings : what to ask; the defaults of :class:`Settings` where None. Results of a run until decided are then
        judged as that run was.
    skip : first steps (20) or seconds ("2s") of each run to leave out of the statistics, chosen on other data
    optimal_gain : the filters declare one, so that their innovations are judged; results say it themselves

    Raises
    ------
    InputError
        Unknown filter, a confidence outside (0, 1), or nothing is left.
    """
    if isinstance(results, Source | list | tuple):
        source: Source | Sequence[Record] = results
    else:
        from consistency.bench.runs.results_to_records import results_source

        source = results_source(cast("Tables | str | Path", results))
    return judge_all(source, filters, confidence, settings, skip, optimal_gain)
