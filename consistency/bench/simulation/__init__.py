"""The simulated world: truth, controls and observations from a scenario and random generators.

Nothing here imports a filter.
"""

from consistency.bench.simulation.world import (
    World,
    draw_landmarks,
    planned_controls,
    planned_path,
    require_landmarks_in_view,
    simulate,
)

__all__ = ["World", "draw_landmarks", "planned_controls", "planned_path", "require_landmarks_in_view", "simulate"]
