"""Scenarios: what is true, what the filter believes, and effects of a sensor."""

from consistency.referee.extras import explained_import

with explained_import(__name__):
    from consistency.bench.scenario import (
        Belief,
        BelievedMotion,
        BelievedSensor,
        BiasMap,
        DisparityGrowth,
        GuardSettings,
        LocalBias,
        Mount,
        Scenario,
        SigmaPoints,
        TrueSensor,
        Truth,
        UvdSensor,
        load_scenario,
        scenario_names,
        scenario_text,
    )
    from consistency.bench.scenario.effects import Distortion

__all__ = [
    "Belief",
    "BelievedMotion",
    "BelievedSensor",
    "BiasMap",
    "DisparityGrowth",
    "Distortion",
    "GuardSettings",
    "LocalBias",
    "Mount",
    "Scenario",
    "SigmaPoints",
    "TrueSensor",
    "Truth",
    "UvdSensor",
    "load_scenario",
    "scenario_names",
    "scenario_text",
]
