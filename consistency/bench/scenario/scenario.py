"""A scenario as a record: one world and one belief about it, by name or from a file."""

from __future__ import annotations

import difflib
import hashlib
import json
from pathlib import Path
from typing import Any, ClassVar

from pydantic import model_validator

from consistency.bench.scenario.belief import Belief
from consistency.bench.scenario.toml_tables import Table, read_table
from consistency.bench.scenario.truth import Truth
from consistency.referee.errors import InputError
from consistency.referee.parsing import is_folder, one_line
from consistency.referee.shipped import data_folder


class Scenario(Table):
    """One world and one belief about it."""

    not_in_file: ClassVar[frozenset[str]] = frozenset({"name"})  # it follows from the file's name
    name: str
    summary: str
    truth: Truth
    belief: Belief

    @model_validator(mode="after")
    def _same_units(self) -> Scenario:
        if self.truth.sensor.model != self.belief.sensor.model:
            raise ValueError(
                f"belief.sensor.model is '{self.belief.sensor.model}' but the sensor measures "
                f"'{self.truth.sensor.model}' (truth.sensor.model); they must be the same"
            )
        return self

    @property
    def hash(self) -> str:
        """SHA-256 (16 hex digits) of what is true and believed; the name and summary do not count."""
        content = self.model_dump(mode="json", include={"truth", "belief"})
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]

    def variant(self, name: str, **changes: Any) -> Scenario:
        """A copy under a new name with values changed, keyed by dotted path with ``__`` for the dot.

        Without a ``summary`` the copy's says what it is a variant of.

        >>> load_scenario("herath2007-stereo").variant("far", truth__sensor__range=(0.5, 8.0))  # doctest: +SKIP
        """
        changes.setdefault("summary", f"{self.name} with other {', '.join(changes) or 'name'}".replace("__", "."))
        data = self.model_dump()
        data["name"] = name
        for path, value in changes.items():
            table = data
            *parents, key = path.split("__")
            for parent in parents:
                table = table[parent]
            table[key] = value
        return Scenario.model_validate(data)


def scenario_names() -> list[str]:
    """Names of the built-in scenarios."""
    return sorted(path.stem for path in data_folder("scenarios").glob("*.toml"))


def load_scenario(name: str | Path) -> Scenario:
    """Scenario by built-in name or by path to a ``.toml`` file.

    Raises
    ------
    InputError
        Unknown name, unreadable file, unknown key or a value that is not allowed.
    """
    path = Path(name)
    if str(name) in scenario_names():
        path = data_folder("scenarios") / f"{name}.toml"
    elif is_folder(path):
        raise InputError(f"{path}: a folder; give a .toml file in it, or to filter a log --log {path}")
    elif path.suffix != ".toml":
        near = difflib.get_close_matches(str(name), scenario_names(), n=1)
        hint = f" (did you mean '{near[0]}'?)" if near else ""
        known = ", ".join(scenario_names())
        raise InputError(f"unknown scenario '{one_line(name)}'{hint}; known: {known}; or give the path of a .toml file")
    return read_table(path, Scenario, name=path.stem)
