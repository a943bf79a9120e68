"""A scenario as the text of a TOML file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import tomli_w

from consistency.bench.scenario.scenario import Scenario

NUMBERS = re.compile(r"\[\n((?: +[-+.\w]+,\n)+) *\]")  # an array of numbers, each on a line


def toml_text(data: Mapping[str, Any]) -> str:
    """Data as TOML, with arrays of numbers on one line."""
    return NUMBERS.sub(lambda array: f"[{', '.join(array[1].replace(',', ' ').split())}]", tomli_w.dumps(data))


def scenario_text(scenario: Scenario, comment: str = "") -> str:
    """The text of a file that :func:`load_scenario` reads as the same world and belief, in SI units and radians.

    The name is not in it, because it follows from the file's name. Each line of ``comment`` becomes one at the top.
    """
    text = toml_text(scenario.model_dump(mode="json", exclude_none=True, exclude={"name"}))
    return "".join(f"# {line}\n" for line in comment.splitlines()) + text
