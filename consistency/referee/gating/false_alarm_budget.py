"""One false-alarm rate for a whole session of tests, split over gates whose number is known at the end."""

from __future__ import annotations

from collections.abc import Sequence

FIRST = 10  # gates of each test that may fail in place


def in_place_rate(budget: float, tests: int, before: int = 0) -> float:
    """False-alarm rate at which the gate after ``before`` others of its test fails without waiting for the end.

    The first 10 gates of each of ``tests`` collected tests share half of the budget; later ones wait (0).
    """
    return 0.5 * budget / (FIRST * max(tests, 1)) if before < FIRST else 0.0


def final_rate(budget: float, in_place: Sequence[float]) -> float:
    """False-alarm rate r of every gate, known when all have run: the sum of max(in_place, r) is the budget.

    With up to 20 gates a test this is budget / number of gates (Bonferroni). Where more ran, the gates that
    could fail in place have had their larger share, and the others split what is left: half the budget at least.

    Parameters
    ----------
    in_place : rate of each gate of :func:`in_place_rate`
    """
    rate = budget / max(len(in_place), 1)
    larger = [each for each in in_place if each > rate]
    return (budget - sum(larger)) / (len(in_place) - len(larger)) if larger else rate
