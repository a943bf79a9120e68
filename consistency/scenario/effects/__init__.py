"""What a sensor does to an ideal observation, one effect a file: its keys in a scenario and its ``apply``.

``field_of_view``, ``noise`` and ``search_range`` are in every sensor. The effects that a scenario may list are made
known by the imports below, one line each; docs/extending.md shows how to add one.
"""

from consistency.scenario.effects.effect import EFFECTS, Effect, ListedEffect, register
from consistency.scenario.effects.field_of_view import FieldOfView
from consistency.scenario.effects.noise import Noise
from consistency.scenario.effects.observations import Context, Observations
from consistency.scenario.effects.search_range import SearchRange

BUILT_IN = (FieldOfView.label, Noise.label, SearchRange.label)

__all__ = [
    "BUILT_IN",
    "EFFECTS",
    "Context",
    "Effect",
    "FieldOfView",
    "ListedEffect",
    "Noise",
    "Observations",
    "SearchRange",
    "register",
]
