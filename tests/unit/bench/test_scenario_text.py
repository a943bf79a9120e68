"""A scenario written as TOML is read as the same scenario."""

from __future__ import annotations

from pathlib import Path

import pytest

import consistency as cs
from consistency.bench.scenario import scenario_text


@pytest.mark.parametrize("name", cs.scenario_names())
def test_a_written_scenario_is_read_as_the_same(name: str, tmp_path: Path) -> None:
    scenario = cs.load_scenario(name)
    (tmp_path / "again.toml").write_text(scenario_text(scenario, "two\nlines"), encoding="utf-8")
    again = cs.load_scenario(tmp_path / "again.toml")
    assert (again.hash, again.summary, again.name) == (scenario.hash, scenario.summary, "again")


def test_every_kind_of_path_landmarks_and_mount_is_written(tmp_path: Path) -> None:
    """Lists in lists, a mount, and a key that is not given."""
    scenario = cs.load_scenario("herath2007-stereo").variant(
        "odd",
        truth__path={
            "shape": "waypoints", "points": [(4.0, 0.5), (-1e-7, 2e22)], "turn_rate": 0.5, "start": (0.0, 0.0),
            "heading": 0.1, "speed": 0.5,
        },
        truth__landmarks={"layout": "listed", "points": [(1.0, 2.0, 3.0), (4.0, 5.0, 6.5)]},
        truth__sensor__mount={"position": (0.1, 0.0, 0.2), "rotation": (0.0, 0.0, 0.3)},
        belief__sensor__disparity=None,
    )  # fmt: skip
    text = scenario_text(scenario)
    (tmp_path / "odd.toml").write_text(text, encoding="utf-8")
    assert cs.load_scenario(tmp_path / "odd.toml").hash == scenario.hash
    assert "position = [0.1, 0.0, 0.2]" in text
    assert text.startswith("summary")
