"""The filter-consistency test bench: do the errors of an estimator have the covariance that it states?"""

from importlib import import_module
from typing import Any

# where each public name stands; it is loaded when it is first used, so that `import consistency` and `--help` stay
# fast, and the core works without the packages of the bench. __init__.pyi has the same names for type checkers.
_MODULES = {
    "Alarm": "referee.diagnostics.monitor",
    "Compared": "referee.verdicts.compare_sources",
    "Control": "bench.types",
    "BoundCorrection": "referee.fit_covariance.correct_bounds",
    "Correction": "referee.fit_covariance.correct",
    "Drive": "referee.fit_covariance.drives",
    "Finding": "bench.types",
    "Gaussian": "bench.types",
    "Info": "bench.types",
    "InputError": "referee.errors",
    "Inspection": "referee.verdicts.inspect_sources",
    "Log": "bench.store.recorded_log",
    "Monitor": "referee.diagnostics.monitor",
    "NoiseModel": "referee.fit_covariance.noise_model",
    "Observation": "bench.types",
    "Record": "referee.diagnostics.record",
    "Results": "bench.store.results",
    "Scenario": "bench.scenario",
    "Study": "bench.runs.reproduce_findings",
    "Trial": "bench.types",
    "Tuning": "bench.tuning.tune",
    "Verdict": "referee.diagnostics.verdict",
    "analyse": "bench.runs.results_to_records",
    "anees": "referee.diagnostics.nees",
    "anees_interval": "referee.diagnostics.nees",
    "compare": "referee.notebook",
    "correct": "referee.fit_covariance.in_python",
    "drive_of": "referee.fit_covariance.drives",
    "filter_names": "bench.filters",
    "fit_covariance": "referee.fit_covariance.in_python",
    "get_filter": "bench.filters",
    "guarded": "bench.filters.compiled",
    "inspect": "referee.notebook",
    "judge": "referee.notebook",
    "load_scenario": "bench.scenario",
    "make_record": "referee.diagnostics.record",
    "monte_carlo": "referee.programs.study",
    "nees": "referee.diagnostics.nees",
    "plan": "referee.notebook",
    "read": "referee.notebook",
    "read_drives": "referee.fit_covariance.drives",
    "read_log": "bench.store.recorded_log",
    "read_results": "bench.store.results",
    "run_trials": "bench.runs.montecarlo",
    "scenario_names": "bench.scenario",
    "simulate": "bench.simulation",
    "tune": "bench.tuning.tune",
    "verdict_table": "referee.notebook",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"No consistency attribute {name}")
    from consistency.referee.extras import explained_import

    with explained_import(f"consistency.{name}"):
        return getattr(import_module(f"consistency.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return __all__


__all__ = sorted(_MODULES)
