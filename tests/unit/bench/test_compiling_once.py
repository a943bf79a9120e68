"""What is found once and used again: types and other facts of compiling, content of a kernel, the first trial."""

from __future__ import annotations

import operator
from typing import ClassVar, NamedTuple

import numba
import numpy as np
import pytest
from numba import types
from numba.core import compiler, ir, targetconfig
from numba.core.registry import cpu_target
from numba.core.types import functions

import consistency as cs
from consistency.bench.filters.compiler import jit
from consistency.bench.filters.compiler.jit import remembered_types
from consistency.bench.runs.isolation import Isolation
from consistency.bench.runs.run_outcome import Simulated, TrialWork
from consistency.bench.runs.workers import LocalThreads
from consistency.bench.simulation import World

stack = targetconfig.ConfigStack
Flags = compiler.Flags
numba_ir = ir


class Small(NamedTuple):
    value: float


class Other(NamedTuple):
    value: float


def counted(monkeypatch, owner, name):
    """Arguments of the calls of a method, as they come."""
    calls = []
    original = getattr(owner, name)

    def call(*args):
        calls.append(args[1:])
        return original(*args)

    monkeypatch.setattr(owner, name, call)
    return calls


@pytest.fixture
def asked(monkeypatch):
    """Calls whose type Numba has looked for."""
    monkeypatch.setattr("consistency.bench.filters.compiler.jit._known", {})
    return counted(monkeypatch, functions.BaseFunction, "get_call_type")


def type_of(*args, function=operator.add, fastmath=False, error_model="numpy"):
    """Signature of a function of these types, as a function that is being compiled asks for it."""
    flags = Flags()
    flags.fastmath, flags.error_model = fastmath, error_model
    context = cpu_target.typing_context
    context.refresh()
    with stack().enter(flags):
        return context.resolve_value_type(function).get_call_type(context, args, {})


def test_the_type_of_a_call_is_looked_for_once(asked):
    alone = type_of(types.float64, types.int64)
    with remembered_types():
        assert {type_of(types.float64, types.int64) for _ in range(3)} == {alone}
        assert len(asked) == 2
        assert type_of(types.int64, types.int64) != alone
        assert len(asked) == 3
    type_of(types.float64, types.int64)
    assert len(asked) == 4


def test_rules_of_arithmetic_are_not_mixed(asked):
    with remembered_types():
        for rules in ({}, {"fastmath": True}, {"error_model": "python"}, {}):
            type_of(types.float64, types.float64, **rules)
    assert len(asked) == 3


def test_functions_and_arguments_are_not_mixed():
    pairs = [(types.int64, types.int64), (types.int64, types.float64), (types.float64, types.int64)]
    cases = [(function, pair) for function in (operator.add, operator.truediv) for pair in pairs]
    alone = [type_of(*pair, function=function) for function, pair in cases]
    with remembered_types():
        for _ in range(2):
            assert [type_of(*pair, function=function) for function, pair in cases] == alone


def test_who_compiles_nothing_asks_numba(asked):
    context = cpu_target.typing_context
    context.refresh()
    with remembered_types():
        for _ in range(2):
            assert context.resolve_value_type(operator.add).get_call_type(context, (types.int64,) * 2, {})
    assert len(asked) == 2


def test_what_has_no_type_is_looked_for_again(asked):
    with remembered_types():
        for _ in range(2):
            with pytest.raises(numba.TypingError):
                type_of(types.float64, types.none)
    assert len(asked) == 2


def test_arguments_of_other_types_are_other_kinds():
    A = np.zeros((3, 4))
    frozen = A.copy()
    frozen.setflags(write=False)
    values = [A, np.zeros((1, 1)), A.T, A[:, ::2], frozen, A[0], A.astype(np.float32), A.astype(int), 1, 1.0, True,
              np.float64(1.0), Small(1.0), Small(1), Other(1.0), (1.0,), "text"]  # fmt: skip
    for a in values:
        for b in values:
            assert jit._kind(a) != jit._kind(b) or numba.typeof(a) == numba.typeof(b), (a, b)


def test_content_is_found_once(monkeypatch):
    class Unknown:
        unknown, key, found, size = "something", "", 0, 0
        functions: ClassVar[dict[str, int]] = {}

        def __init__(self, function, signature):
            type(self).found += 1

    monkeypatch.setattr(jit, "Content", Unknown)
    monkeypatch.setattr(jit.Kernel, "_compiled", lambda *_: len)
    kernel = jit.Kernel(lambda x: x)
    for x, found in ((1.0, 1), (1, 2)):
        assert not kernel.is_ready(x)
        assert kernel.compile(x) is len
        assert Unknown.found == found
        assert kernel.is_ready(x)
        assert kernel.outlook(x).is_ready
        assert Unknown.found == found


def test_a_study_draws_one_trial_before_its_runs(monkeypatch):
    world = cs.load_scenario("linear-gaussian").variant("short", truth__steps=5)
    work = TrialWork(Simulated(world, 3), Isolation([cs.get_filter("kf")], world.belief))
    monkeypatch.setattr(TrialWork, "compile", lambda *_: None)
    made = counted(monkeypatch, World, "trial")
    LocalThreads(2).prepare(work, 1)
    assert made == [(1, 3)]
    LocalThreads(2).prepare(TrialWork(work.trials, Isolation([], world.belief)), 1)
    assert made == [(1, 3)]
