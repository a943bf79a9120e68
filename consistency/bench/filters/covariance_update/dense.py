"""Every step works on the whole state."""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.compiler.dispatch import part


@part()
class Dense(NamedTuple):
    """No parameters. Nothing is kept beside the state."""
