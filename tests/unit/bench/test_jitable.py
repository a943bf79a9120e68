"""Functions of models: plain Python until a kernel is compiled."""

import subprocess
import sys

import numba
import pytest

from consistency.bench.scenario import models


@models.jitable
def doubled(x):
    return 2.0 * x


def test_numba_knows_what_is_jitable_once_it_is_told():
    models.register_jitables()

    @numba.njit
    def calls(x):
        return doubled(x)

    assert calls(1.5) == doubled(1.5) == 3.0


@pytest.mark.parametrize("module, loads", [("runs.results_to_records", False), ("runs.run_outcome", True)])
def test_a_verdict_on_results_loads_no_numba(module, loads):
    code = f"import sys, consistency.bench.{module}; sys.exit(('numba' in sys.modules) != {loads})"
    subprocess.run([sys.executable, "-c", code], check=True)
