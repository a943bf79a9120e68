"""A scenario as a record: one world and one belief about it, by name or from a file."""

from __future__ import annotations

import difflib
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar

import tomli_w
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from consistency.bench.scenario.effects import LocalBias
from consistency.bench.scenario.sensor import BelievedSensor
from consistency.bench.scenario.tables.toml_tables import UNITS, Count, Finite, NonNegative, Positive, Table, read_table
from consistency.bench.scenario.truth import Truth
from consistency.referee.errors import InputError
from consistency.referee.parsing import is_folder, one_line
from consistency.referee.system.shipped import data_folder

Share = Annotated[float, Field(gt=0, lt=1, strict=True)]
# keys of both halves; of the second kind one half may have what the other leaves out
SHARED = (("motion", ("sigma_v", "sigma_omega")), ("sensor", ("sigma", "mount", "f", "B", "disparity")))
OPTIONAL = (("sensor", ("disparity_growth",)),)
ARRAYS = re.compile(r"\[\n((?: +[-+.\w]+,\n)+) *\]")  # an array of numbers, each on a line


class BelievedMotion(Table):
    sigma_v: NonNegative
    sigma_omega: NonNegative


class SigmaPoints(Table):
    """Scaled sigma points over the L variables that a transform involves (robot, or robot and seen).

    Spread alpha sqrt(L + kappa), weights after Merwe (2004). The default (1, 0, 0) is the cubature set of
    Arasaratnam & Haykin (2009): spread sqrt(L), no centre point, no weight negative, so that S stays
    positive definite however many landmarks are seen; it has no parameter to tune.
    """

    alpha: Positive = 1.0
    beta: NonNegative = 0.0
    kappa: Finite = 0.0


class GuardSettings(Table):
    """What a guarded filter takes for spurious; an unguarded one does not read it.

    ``confidence`` is the share of right observations that a gate lets pass. The default, 0.99, is that of Neira &
    Tardos (2001) and of Civera et al. (2010). ``threshold``, of ``ransac`` alone, is the distance in standard
    deviations up to which what is left of an innovation supports a hypothesis: 2, as in Civera et al. (2010).
    ``min_age`` is the number of sightings from which a track is used: with 1, the default, from the first on.
    ``forget_after`` is the number of observations of a landmark that are rejected one after the other until all later
    ones are refused; by default a landmark is never given up.
    """

    confidence: Share = 0.99
    threshold: Positive = 2.0
    min_age: Count = 1
    forget_after: Count | None = None


class Belief(Table):
    """What the filter takes to be the case."""

    motion: BelievedMotion
    sensor: BelievedSensor
    sigma_points: SigmaPoints = SigmaPoints()
    guard: GuardSettings | None = None  # None: the defaults

    @model_serializer(mode="wrap")
    def _without_guard(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """A belief without the table has the content, and so the hash, of one that knows of no guards."""
        content: dict[str, Any] = handler(self)
        if self.guard is None:
            content.pop("guard", None)
        return content


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
        default = f"{self.name} with other {', '.join(changes) or 'name'}".replace("__", ".")
        summary = changes.pop("summary", default)
        return with_changes(self, name, summary, {path.replace("__", "."): value for path, value in changes.items()})


def with_changes(base: Scenario, name: str, summary: str, changes: Mapping[str, Any]) -> Scenario:
    """A copy of the scenario with values set by dotted key; raises pydantic's ValidationError."""
    data = base.model_dump() | {"name": name, "summary": summary}
    for path, value in changes.items():
        *parents, key = path.split(".")
        table = data
        for parent in parents:
            table = table[parent]
        stem, _, unit = key.rpartition("_")
        if key not in table and f"_{unit}" in UNITS.values():
            table.pop(stem, None)  # the value comes with its unit
        table[key] = value
    return Scenario.model_validate(data)


def unknown(what: str, name: str, known: Sequence[str]) -> str:
    """That there is no such scenario, sweep or filter, and what there is."""
    near = difflib.get_close_matches(name, known, n=1)
    hint = f" (did you mean '{near[0]}'?)" if near else ""
    return f"unknown {what} '{name}'{hint}; known: {', '.join(known)}"


def scenario_names() -> list[str]:
    """Names of the built-in scenarios."""
    return sorted(path.stem for path in data_folder("scenarios").glob("*.toml"))


def load_scenario(name: str | Path | Scenario) -> Scenario:
    """Scenario by built-in name or by path to a ``.toml`` file; a scenario is returned as it is.

    Raises
    ------
    InputError
        Unknown name, unreadable file, unknown key or a value that is not allowed.
    """
    if isinstance(name, Scenario):
        return name
    path = Path(name)
    if str(name) in scenario_names():
        path = data_folder("scenarios") / f"{name}.toml"
    elif is_folder(path):
        raise InputError(f"{path}: a folder; give a .toml file in it, or to filter a log --log {path}")
    elif path.suffix != ".toml":
        raise InputError(f"{unknown('scenario', one_line(name), scenario_names())}; or give the path of a .toml file")
    return read_table(path, Scenario, name=path.stem)


def misbelief(scenario: Scenario) -> str:
    """In what the belief differs from the truth, and the remedy, in one clause; empty where the belief is right.

    A bias map must be believed if it is the case. Other effects that make observations err are in no belief.
    """
    truth, belief = scenario.truth, scenario.belief
    for keys, may_lack in ((SHARED, True), (OPTIONAL, False)):
        for table, key in ((table, key) for table, names in keys for key in names):
            believed, true = (getattr(getattr(of, table), key, None) for of in (belief, truth))
            if believed != true and not (may_lack and None in (believed, true)):
                return f"key 'belief.{table}.{key}' is not what truth.{table}.{key} is; make them the same"
    effects = truth.sensor.effects
    maps = [effect.map() for effect in effects if isinstance(effect, LocalBias)]
    if maps != ([] if belief.sensor.bias is None else [belief.sensor.bias]):
        return "key 'belief.sensor.bias' is not the bias of the effect 'local-bias' in truth.sensor; make them the same"
    unknown = [effect.label for effect in effects if effect.errs and not isinstance(effect, LocalBias)]
    return f"no belief holds the effect '{unknown[0]}' (truth.sensor.effects); leave it out" if unknown else ""


def toml_text(data: Mapping[str, Any]) -> str:
    """Data as TOML, with arrays of numbers on one line."""
    return ARRAYS.sub(lambda array: f"[{', '.join(array[1].replace(',', ' ').split())}]", tomli_w.dumps(data))


def scenario_text(scenario: Scenario, comment: str = "") -> str:
    """The text of a file that :func:`load_scenario` reads as the same world and belief, in SI units and radians.

    The name is not in it, because it follows from the file's name. Each line of ``comment`` becomes one at the top.
    """
    text = toml_text(scenario.model_dump(mode="json", exclude_none=True, exclude={"name"}))
    return "".join(f"# {line}\n" for line in comment.splitlines()) + text
