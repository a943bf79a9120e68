"""Every example of the page of sensor effects works in herath2007-stereo, and it has every effect and scenario."""

import re

import pytest
from documents import blocks, read

import consistency as cs
from consistency.bench.scenario import data_folder
from consistency.bench.scenario.effects import EFFECTS

PAGE = read("docs/reference/sensor-effects.md")
TABLES = [block.text for block in blocks("docs/reference/sensor-effects.md", "toml")]


@pytest.mark.parametrize("table", TABLES, ids=lambda table: re.findall(r'kind = "(.*)"|sensor\.(\w+)', table)[0])
def test_a_table_switches_something_on(tmp_path, table):
    text = (data_folder("scenarios") / "herath2007-stereo.toml").read_text(encoding="utf-8")
    (tmp_path / "mine.toml").write_text(f"{text}\n{table}", encoding="utf-8")
    plain, mine = cs.load_scenario("herath2007-stereo"), cs.load_scenario(tmp_path / "mine.toml")
    assert mine.hash != plain.hash
    a, b = cs.simulate(plain), cs.simulate(mine)
    assert (a.z.shape == b.z.shape and (a.z == b.z).all()) == ("[belief" in table)


def test_code_runs():
    pieces = blocks("docs/reference/sensor-effects.md", "python")
    assert len(pieces) == 2
    for piece in pieces:
        exec(piece.text, {})


def test_every_effect_and_scenario_is_there():
    shown = set(re.findall(r'^kind = "(.*)"', PAGE, flags=re.MULTILINE))
    assert shown == set(EFFECTS)
    for kind, effect in EFFECTS.items():
        (table,) = (table for table in TABLES if f'kind = "{kind}"' in table)
        keys = {field for field, of in effect.model_fields.items() if of.is_required()}
        assert all(re.search(rf"^{key}\w* = ", table, flags=re.MULTILINE) for key in keys), kind
    for name in set(re.findall(r"herath2007-\w+", PAGE)):
        assert name in cs.scenario_names()
