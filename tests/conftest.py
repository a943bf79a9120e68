"""Small worlds that many tests share, tiers, and settings of the property tests."""

import gc

import numpy as np
import pytest
from hypothesis import settings

import consistency as cs
from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.compiler import jit
from consistency.bench.runs.run_outcome import TrialWork

gc.set_threshold(100_000, 20, 100)  # what is collected lives to the end
pytest_plugins = ["pytester"]  # runs of pytest inside tests, for the plugin

settings.register_profile("bench", deadline=None, max_examples=60, derandomize=True, database=None)
settings.load_profile("bench")

# Files of tests/unit and tests/referee that are not quick: they run kernels, begin processes or take longer; as do
# those with slow tests.
LONGER = {
    "action", "alignment", "apart", "bags", "batches", "bench", "blas", "both_errors", "bounded_memory", "ceiling",
    "challenging", "commands_on_results", "comparison",
    "compiling", "compiling_once", "content", "conventions", "core_commands", "core_gates",
    "dask", "declared_gain", "fit_command",
    "effects", "ending", "extending", "extending_report", "filters_table", "findings", "frontend_experiment",
    "frontend_motion", "frontend_rigs", "gather", "guards", "heat", "hints", "ideal", "imaging_chain",
    "imaging_experiments", "imports", "isolating", "joint", "journal", "kept", "kept_cells", "kept_looks", "kernels",
    "lens_models", "log", "log_tables", "monitoring", "montecarlo", "offset", "overview", "own_error",
    "own_randomness", "pytest_plugin", "rig", "recording", "relative", "report_errors", "reporting", "reporting_files",
    "results", "sensor_experiments", "sequential", "skipping", "slurm", "sources", "static_limit",
    "sweeps", "testing", "tuning", "vision_experiments", "vision_shared", "vision_small", "wrong_inputs",
}  # fmt: skip

TILTED = {"position": [0.12, -0.05, 0.3], "rotation": [0.08, -0.15, 0.4]}  # m; roll, pitch, heading in rad


def is_quick(path):
    return {"unit", "referee"} & {*path.parts} != set() and path.stem.removeprefix("test_") not in LONGER


def pytest_ignore_collect(collection_path, config):
    """``-m quick`` need not import the others."""
    asked = config.option.markexpr == "quick" and collection_path.suffix == ".py"
    return True if asked and not is_quick(collection_path) else None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark what is quick; files with slow tests come first, so that workers end together."""
    slow = {item.path for item in items if item.get_closest_marker("slow") or item.get_closest_marker("browser")}
    for item in items:
        if is_quick(item.path) and item.path not in slow:
            item.add_marker("quick")
    items.sort(key=lambda item: item.path not in slow)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """Quick tests and their fixtures are refused a kernel."""
    with pytest.MonkeyPatch.context() as patch:
        if item.get_closest_marker("quick"):
            patch.setattr(jit.Kernel, "_entry", refuse)
        return (yield)


def refuse(*_):
    pytest.fail("a test that runs a kernel is not quick: its file belongs among LONGER of tests/conftest.py")


@pytest.fixture(scope="session")
def small():
    """``small("herath2007-xyz", key=value)``: a built-in world cut to 60 steps, with changes."""

    def make(name, **changes):
        return cs.load_scenario(name).variant(f"small-{name}", **{"truth__steps": 60, **changes})

    return make


@pytest.fixture(scope="session")
def xyz(small):
    return small("herath2007-xyz")


@pytest.fixture(scope="session")
def uvd(small):
    return small("herath2007-stereo")


@pytest.fixture(scope="session")
def linear(small):
    return small("linear-gaussian")


@pytest.fixture(scope="session")
def tilted():
    """A mount with every number different from zero."""
    return TILTED


@pytest.fixture(scope="module")
def dense():
    """Kernels without local updating, which small worlds do not come to and which takes longer to compile."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Compiled, "local_from", 10**9)
        yield


@pytest.fixture
def stop_at(monkeypatch):
    """Has an error raised in the place of a run; gives the list of the runs that are done."""

    def arm(run, error):
        one, done = TrialWork.__call__, list[int]()

        def stopped(self, number):
            if number == run:
                raise error
            done.append(number)
            return one(self, number)

        monkeypatch.setattr(TrialWork, "__call__", stopped)
        return done

    return arm


@pytest.fixture
def rng():
    return np.random.default_rng(20070)


@pytest.fixture
def fresh():
    """Numbers that no other run of the test has; the seed is printed where it fails."""
    seed = np.random.SeedSequence().entropy
    print(f"seed {seed}")
    return np.random.default_rng(seed)
