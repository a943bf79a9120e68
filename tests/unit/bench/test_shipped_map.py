"""The map that comes with the package."""

from pathlib import Path

import pytest

from consistency.bench.sweeps import regime_map as maps
from consistency.bench.sweeps.regime_map import read_regime
from consistency.referee.errors import InputError


def test_without_a_map_it_is_said_how_to_make_one(monkeypatch):
    monkeypatch.setattr(maps, "SHIPPED", "none.json")
    with pytest.raises(InputError, match="make one with 'consistency sweep regime --out regime'"):
        read_regime()


def test_the_table_of_docs_is_the_shipped_map():
    """docs/regime.md names the cheapest filter that is consistent in all cells of a baseline and a range."""
    table = read_regime().table
    rows = table.assign(right=table["status"] == "consistent").groupby(["baseline", "range", "filter"])
    cells = rows.agg(right=("right", "all"), cost=("cost", "median")).reset_index()
    cheapest = cells[cells["right"]].sort_values("cost").groupby(["baseline", "range"])["filter"].first().unstack()
    page = (Path(__file__).parents[3] / "docs" / "regime.md").read_text(encoding="utf-8")
    for baseline, row in cheapest.iterrows():
        names = (f"`{name}`" if isinstance(name, str) else "none" for name in row)
        assert f"| {baseline:g} m | {' | '.join(names)} |" in page
