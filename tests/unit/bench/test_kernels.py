"""What kernels must keep to: module level, no allocation in a step, one BLAS thread."""

import importlib
import inspect
import os
import pkgutil
import re
import subprocess
import sys

import numpy as np
import pytest
from numba.core.runtime import _nrt_python, rtsys
from threadpoolctl import threadpool_info

import consistency as cs
import consistency.bench.filters
from consistency.bench.filters.compiled import one_blas_thread
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.loop import trial_kernel
from consistency.bench.filters.run_filter import step_through
from consistency.bench.scenario.models import dead_reckoning, to_robot


def test_no_kernel_is_a_closure():
    """Closures that two processes have cached can be linked to each other."""
    found = [trial_kernel.function.__qualname__]
    for module in pkgutil.walk_packages(consistency.bench.filters.__path__, "consistency.bench.filters."):
        names = vars(importlib.import_module(module.name))
        plain = [getattr(value, "py_func", value) for value in names.values()]
        found += [value.__qualname__ for value in plain if inspect.isfunction(value)]
    assert {"run_trial", "whiten", "split"} <= set(found)
    assert not [name for name in found if "<locals>" in name]
    with pytest.raises(TypeError, match=r"'.*<locals>.<lambda>' must stand at module level"):
        inner(lambda x: x)


def allocations(steps, scenario, name):
    """Arrays that a compiled trial of so many steps makes."""
    trial = cs.simulate(scenario.variant("shorter", truth__steps=steps))
    cs.get_filter(name).run(trial, scenario.belief)  # compiled before counting
    before = rtsys.get_allocation_stats().alloc
    cs.get_filter(name).run(trial, scenario.belief)
    return int(rtsys.get_allocation_stats().alloc - before)


@pytest.mark.parametrize("name", ["ekf-uvd", "ekf-xyz", "ukf-uvd"])
def test_no_step_allocates(uvd, name):
    _nrt_python.memsys_enable_stats()
    assert 0 < allocations(20, uvd, name) == allocations(60, uvd, name)


@pytest.mark.parametrize("name", ["ekf-xyz", "ri-ekf-xyz"])
def test_a_covariance_that_loses_its_rank_ends_the_run(small, name):
    """A landmark known exactly, from a pose known exactly, seen again: the pose is certain but for one direction."""
    belief = small("herath2007-xyz", belief__sensor__sigma=(1e-13,) * 3).belief
    controls = np.array([[0.0, 0.0, 0.0]] + 4 * [[0.1, 1.0, 0.2]])  # no time passes in step 1
    path, landmark = dead_reckoning(np.zeros(3), controls), np.array([3.0, 1.0, 0.5])
    z = np.array([to_robot(*path[step], *landmark) for step in (1, 4, 5)])
    first = np.array([0, 1, 1, 1, 2, 3])
    trial = cs.Trial(0, np.zeros(3), controls, first, np.zeros(3, int), z, 1, path, landmark[None])
    filter_ = cs.get_filter(name)
    ours, twin = filter_.run(trial, belief), step_through(filter_.textbook, trial, belief)
    assert (ours.failure.step, ours.failure.reason) == (4, "the pose covariance is not positive definite")
    assert (twin.failure.step, twin.failure.reason.rpartition(" is ")[2]) == (4, "not positive definite")
    assert ours.map is None
    for array in (ours.pose, ours.covariance, ours.covariance if ours.own is None else ours.own):
        assert np.isfinite(array[:3]).all()
        assert np.isnan(array[3:]).all()


def test_a_direct_run_is_that_of_run_trials(uvd):
    """One BLAS thread in both: with two the last bits could differ."""
    direct = cs.get_filter("ekf-uvd").run(cs.simulate(uvd), uvd.belief)
    among = cs.run_trials(uvd, ["ekf-uvd"], runs=1, jobs=1).estimates
    assert np.array_equal(direct.pose, among[["x", "y", "heading"]].to_numpy())


PRINTED = """
import hashlib, sys
import consistency as cs

scenario = cs.load_scenario(sys.argv[2]).variant("short", truth__steps=200)
said = cs.get_filter(sys.argv[1]).run(cs.simulate(scenario), scenario.belief)
arrays = (said.pose, said.covariance, said.nis, said.map.mean, said.map.covariance)
print(hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest())
"""


def test_lent_arrays_live_as_long_as_the_trial():
    """The loop uses what it passes by reference to the end; a C library that overwrites freed memory changes no bit."""
    source = inspect.getsource(trial_kernel.function)
    passed = re.findall(r"\bby_reference\((\w+)\)", source)
    assert len(passed) == 7
    end = source[source.index(" keep(") :]
    assert [name for name in passed if not re.search(rf"\b{name}\b", end)] == []
    found = []
    for byte in ("0", "170"):
        environment = os.environ | {"MALLOC_PERTURB_": byte}
        command = [sys.executable, "-c", PRINTED, "ekf-uvd", "herath2007-stereo"]
        found.append(subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=True))
    assert found[0].stdout == found[1].stdout


def test_the_limit_on_blas_threads_ends_with_the_last_trial():
    def threads():
        return [entry["num_threads"] for entry in threadpool_info() if entry["user_api"] == "blas"]

    before = threads()
    with one_blas_thread():
        with one_blas_thread():
            assert set(threads()) == {1}
        assert set(threads()) == {1}
    assert threads() == before
