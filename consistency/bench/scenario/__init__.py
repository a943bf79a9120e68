"""Scenarios: a TOML file becomes a frozen record of what is true and what the filter believes.

``toml_tables`` reads files, ``sensor`` has the one definition of a sensor, ``truth_and_belief`` what is the case and
the belief beside it, and makes a file of both. ``effects`` holds what a sensor does to ideal ``observations``: the keys
of each effect and its ``apply``. Nothing here draws a trial; that is the simulation's.
"""

from consistency.bench.scenario.effects import BiasMap, DisparityGrowth, ListedEffect, LocalBias
from consistency.bench.scenario.observations import PLANAR_SENSORS, Mount
from consistency.bench.scenario.sensor import BelievedSensor, PicturedSensor, TrueSensor, UvdSensor
from consistency.bench.scenario.toml_tables import Count, Finite, Positive, Table, explain, read_table
from consistency.bench.scenario.truth_and_belief import (
    AnnularLandmarks,
    Belief,
    BelievedMotion,
    Circle,
    CircularLandmarks,
    Corridor,
    FigureOfEight,
    GuardSettings,
    ListedLandmarks,
    Path_,
    RoundedRectangle,
    Scenario,
    SigmaPoints,
    Truth,
    UniformLandmarks,
    Waypoints,
    load_scenario,
    misbelief,
    scenario_names,
    scenario_text,
    toml_text,
)
from consistency.referee.system import data_folder

__all__ = [
    "PLANAR_SENSORS",
    "AnnularLandmarks",
    "Belief",
    "BelievedMotion",
    "BelievedSensor",
    "BiasMap",
    "Circle",
    "CircularLandmarks",
    "Corridor",
    "Count",
    "DisparityGrowth",
    "FigureOfEight",
    "Finite",
    "GuardSettings",
    "ListedEffect",
    "ListedLandmarks",
    "LocalBias",
    "Mount",
    "Path_",
    "PicturedSensor",
    "Positive",
    "RoundedRectangle",
    "Scenario",
    "SigmaPoints",
    "Table",
    "TrueSensor",
    "Truth",
    "UniformLandmarks",
    "UvdSensor",
    "Waypoints",
    "data_folder",
    "explain",
    "load_scenario",
    "misbelief",
    "read_table",
    "scenario_names",
    "scenario_text",
    "toml_text",
]
