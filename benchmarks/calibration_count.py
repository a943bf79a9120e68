"""A counted row of the table of calibration."""

from __future__ import annotations

from typing import Any


def row(
    world: str, question: str, ratio: float, runs: int, stated: float, bound: str, gates: int, found: int
) -> dict[str, Any]:
    """``found`` of ``gates`` gates, and the share that is ``stated`` with its ``bound``, "<=" or ">="."""
    return {
        "world": world, "question": question, "ratio": ratio, "runs": runs, "looks": 1, "stated": stated,
        "bound": bound, "gates": gates, "found": found,
    }  # fmt: skip
