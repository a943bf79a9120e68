"""Grids of scenarios, and the map of where which filter is consistent."""

from consistency.referee.extras import explained_import

with explained_import(__name__):
    from consistency.bench.sweeps.cell import CellResult
    from consistency.bench.sweeps.regime import Regime, read_regime

__all__ = ["CellResult", "Regime", "read_regime"]
