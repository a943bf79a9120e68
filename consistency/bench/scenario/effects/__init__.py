"""Effects of a sensor on an ideal observation, each with its keys in a scenario and its ``apply``.

Those of ``built_in`` are in every sensor. The effects that a scenario may list are made known by the imports below;
docs/extending.md shows how to add one.
"""

from consistency.bench.scenario.effects.built_in import FieldOfView, Noise, SearchRange
from consistency.bench.scenario.effects.distortion import Distortion
from consistency.bench.scenario.effects.effect import EFFECTS, ListedEffect, register_effect
from consistency.bench.scenario.effects.gross_errors import HeavyTails as HeavyTails
from consistency.bench.scenario.effects.gross_errors import Mismatch as Mismatch
from consistency.bench.scenario.effects.gross_errors import Swap as Swap
from consistency.bench.scenario.effects.node_tables import BiasMap, DisparityGrowth, LocalBias
from consistency.bench.scenario.effects.observations import Context, Observations
from consistency.bench.scenario.effects.occlusion_junctions import Junction as Junction
from consistency.bench.scenario.effects.selection import Selection as Selection
from consistency.bench.scenario.effects.track_errors import Drift as Drift
from consistency.bench.scenario.effects.track_errors import TrackError as TrackError
from consistency.bench.scenario.effects.visibility import Frames as Frames
from consistency.bench.scenario.effects.visibility import Occlusion as Occlusion

Effect = FieldOfView | Noise | SearchRange | ListedEffect
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
    "register_effect",
]
