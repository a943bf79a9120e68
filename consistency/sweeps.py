"""Grids of scenarios, and the map of where which filter is consistent."""

from consistency.referee.extras import explained_import

with explained_import(__name__):
    from consistency.bench.sweeps.regime_map import Regime, read_regime
    from consistency.bench.sweeps.run_sweep import CellResult

__all__ = ["CellResult", "Regime", "read_regime"]
