"""Two filters in rows and columns."""

from __future__ import annotations

from typing import TYPE_CHECKING

from consistency.referee.document.blocks import Column, Table, table

if TYPE_CHECKING:
    from consistency.referee.diagnostics.comparison import Comparison, Difference

LENGTHS, ANGLES = ("x", "y", "z"), ("heading", "roll", "pitch", "yaw")  # components of poses


def comparison_table(a: str, b: str, c: Comparison) -> Table:
    """Both values of each quantity, their ratio or difference with its interval."""
    heads = (a, f"{b} (reference)") if b not in (a, "the reference") else ("now", "reference")
    numbers = (Column(head, number=True) for head in (*heads, "ratio", "difference", "95 % interval"))
    return table((Column(""), *numbers), [_row(d) for d in c.differences], f"{heads[0]} and {heads[1]}")


def _unit(name: str) -> str:
    """The unit of an RMSE of a pose, as it stands behind its name."""
    component = name.removeprefix("RMSE ")
    if component == name:
        return ""
    if component in LENGTHS:
        return " (m)"
    return " (rad)" if component in ANGLES else ""


def _row(d: Difference) -> tuple[str, ...]:
    if "coverage" in d.name:
        values = (f"{100 * v:.1f} %" for v in (d.a, d.b))
        return d.name, *values, "", f"{100 * d.difference:+.1f} %", f"{100 * d.low:+.1f} to {100 * d.high:+.1f} %"
    return (
        d.name + _unit(d.name),
        f"{d.a:.3g}",
        f"{d.b:.3g}",
        f"x{d.difference:.3g}",
        "",
        f"{d.low:.3g} to {d.high:.3g}",
    )
