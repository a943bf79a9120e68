"""Effects of a sensor on an ideal observation, each in a file with its keys in a scenario and its ``apply``.

``field_of_view``, ``noise`` and ``search_range`` are in every sensor. The effects that a scenario may list are made
known by the imports below, one line each; docs/extending.md shows how to add one.
"""

from consistency.scenario.effects.bias_map import BiasMap
from consistency.scenario.effects.disparity_growth import DisparityGrowth
from consistency.scenario.effects.distortion import Distortion
from consistency.scenario.effects.drift import Drift as Drift
from consistency.scenario.effects.effect import EFFECTS, Effect, ListedEffect, register
from consistency.scenario.effects.field_of_view import FieldOfView
from consistency.scenario.effects.heavy_tails import HeavyTails as HeavyTails
from consistency.scenario.effects.junction import Junction as Junction
from consistency.scenario.effects.local_bias import LocalBias
from consistency.scenario.effects.mismatch import Mismatch as Mismatch
from consistency.scenario.effects.noise import Noise
from consistency.scenario.effects.observations import Context, Observations
from consistency.scenario.effects.search_range import SearchRange
from consistency.scenario.effects.selection import Selection as Selection
from consistency.scenario.effects.swap import Swap as Swap
from consistency.scenario.effects.track_error import TrackError as TrackError

BUILT_IN = (FieldOfView.label, Noise.label, SearchRange.label)

__all__ = [
    "BUILT_IN",
    "EFFECTS",
    "BiasMap",
    "Context",
    "DisparityGrowth",
    "Distortion",
    "Effect",
    "FieldOfView",
    "ListedEffect",
    "LocalBias",
    "Noise",
    "Observations",
    "SearchRange",
    "register",
]
