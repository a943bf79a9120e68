"""What an effect is, and the kinds that a scenario may list under ``[[truth.sensor.effects]]``."""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, Any, ClassVar, TypeVar

import numpy as np
from pydantic import Field, ModelWrapValidatorHandler, TypeAdapter, model_validator
from pydantic_core import PydanticCustomError

from consistency.bench.scenario.effects.observations import Context, Observations
from consistency.bench.scenario.tables.toml_tables import Table

E = TypeVar("E", bound="ListedEffect")


class ListedEffect(Table):
    """An effect that a scenario lists: its fields are the keys of its table.

    A subclass gives ``kind`` a value, adds keys of its own and defines :meth:`apply`. Two effects of one kind need
    different names, because the random numbers of an effect depend on seed, run and name, and on nothing else.
    """

    models: ClassVar[tuple[str, ...]] = ("xyz", "uvd", "linear", "relative-xy", "range-bearing")  # that it works on
    draws: ClassVar[bool] = True  # whether it needs random numbers
    before_noise: ClassVar[bool] = False  # whether it is applied before the sensor's noise or after it
    errs: ClassVar[bool] = True  # whether what is measured then differs from what a belief without it expects

    kind: str
    name: Annotated[str, Field(min_length=1)] | None = None

    @property
    def label(self) -> str:
        return self.name or self.kind

    @abstractmethod
    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        """What becomes of ``observations``; ``rng`` is this effect's own in this run."""

    @classmethod
    def kinds(cls) -> list[type[Table]]:
        return list(EFFECTS.values())

    @model_validator(mode="wrap")
    @classmethod
    def _by_kind(cls, data: Any, handler: ModelWrapValidatorHandler[ListedEffect]) -> ListedEffect:
        """The effect that ``kind`` names, in the place of this base."""
        if cls is not ListedEffect or isinstance(data, ListedEffect):
            return handler(data)
        if not isinstance(data, dict):
            raise ValueError("an effect is a table that begins with [[truth.sensor.effects]]")
        context = {"discriminator": "'kind'", "tag": data.get("kind")}
        if "kind" not in data:
            raise PydanticCustomError("union_tag_not_found", "kind is missing", context)
        effect = EFFECTS.get(str(data["kind"]))
        if effect is None:
            known_kinds = ", ".join(f"'{kind}'" for kind in sorted(EFFECTS)) or "the known kinds: there are none yet"
            context["expected_tags"] = known_kinds
            raise PydanticCustomError("union_tag_invalid", "'{tag}' is not one of {expected_tags}", context)
        # as a tagged union would, with the kind in the location of an error
        effects = TypeAdapter[dict[str, ListedEffect]](dict[str, effect])  # type: ignore[valid-type]
        return effects.validate_python({str(data["kind"]): data})[str(data["kind"])]


class UvdEffect(ListedEffect):
    """An effect on the pixels of a stereo sensor."""

    models: ClassVar[tuple[str, ...]] = ("uvd",)


EFFECTS: dict[str, type[ListedEffect]] = {}  # by kind


def register_effect(effect: type[E]) -> type[E]:
    """Decorator that makes the kind of an effect known to scenarios."""
    EFFECTS[effect.model_fields["kind"].default] = effect
    return effect
