"""A scenario as the text of a TOML file."""

from __future__ import annotations

import re

import tomli_w

from consistency.scenario.record import Scenario

NUMBERS = re.compile(r"\[\n((?: +[-+.\w]+,\n)+) *\]")  # an array of numbers, each on a line


def scenario_text(scenario: Scenario, comment: str = "") -> str:
    """The text of a file that :func:`load_scenario` reads as the same world and belief, in SI units and radians.

    The name is not in it, because it follows from the file's name. Each line of ``comment`` becomes one at the top.
    """
    text = tomli_w.dumps(scenario.model_dump(mode="json", exclude_none=True, exclude={"name"}))
    text = NUMBERS.sub(lambda array: f"[{', '.join(array[1].replace(',', ' ').split())}]", text)
    return "".join(f"# {line}\n" for line in comment.splitlines()) + text
