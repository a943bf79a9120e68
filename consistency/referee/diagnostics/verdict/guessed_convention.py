"""Errors whose convention nobody declared: which conventions the covariances do not contradict."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from consistency.referee.diagnostics.questions.scale import ratio_interval, run_means
from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.verdict.parts import Guess, Settings, Verdict
from consistency.referee.diagnostics.words.numbers import percent, plain


def judge_guesses(record: Record, settings: Settings, judge: Callable[[Record, Settings], Verdict]) -> Verdict:
    """Undecided, with every convention that is not rejected at ``settings.false_alarm``, and its ratio.

    The right convention is rejected with that probability at most, whichever it is. The intervals of the ratio hold
    together with that of the rest: of K conventions, each at 1 - false_alarm / K (Bonferroni).

    Parameters
    ----------
    record : with the same runs under each convention (:attr:`Record.guesses`); the first is the default of the files
    judge : judges one of them
    """
    verdicts = {kind: judge(one, settings) for kind, one in record.guesses.items()}
    confidence = 1.0 - settings.false_alarm / len(verdicts)
    found = {kind: _guess(record.guesses[kind], v, confidence) for kind, v in verdicts.items()}
    first = next(iter(verdicts.values()))
    shown = first.scale
    if shown is not None:
        shown = replace(shown, equivalence=replace(shown.equivalence, p_value=float("nan"), runs=None))
    return replace(
        first, status="undecided", scale=shown, answers=(), guesses=found, convention=None,
        reasons=(f"undecided: {_sentence(found, settings)}", *(f"if the error is {kind}: {v.reasons[0]}"
                                                               for kind, v in verdicts.items())),
    )  # fmt: skip


def _guess(record: Record, verdict: Verdict, confidence: float) -> Guess:
    runs = record.as_runs
    assert runs.nees is not None
    means, counts = run_means(runs.nees)
    ratio = ratio_interval(means[counts > 0] / runs.dof, runs.dof, confidence)
    return Guess(verdict.status, verdict.faults, ratio, not verdict.faults and verdict.status != "failed")


def _sentence(found: Mapping[str, Guess], settings: Settings) -> str:
    left = [f"{kind} (covariance ratio {plain(guess.ratio)})" for kind, guess in found.items() if guess.possible]
    rate = percent(settings.false_alarm)
    if not left:
        return f"no error is declared, and at a rate of {rate} each all are rejected: {', '.join(found)}"
    gone = [kind for kind, guess in found.items() if not guess.possible]
    rest = f"; rejected: {', '.join(gone)}" if gone else ""
    return (
        f"no error is declared; not rejected at a rate of {rate}: {', '.join(left)}{rest}. The filter's documentation "
        "says which it is; declare it with --error"
    )
