"""What the key of a kernel covers, and who compiles: a small kernel in modules of a user's own."""

import json
import shutil
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import forks
import kernel_keys
import numba
import pytest
from numba.core import config
from numba.core.registry import cpu_target

from consistency.bench.filters.compiler import dispatch, jit
from consistency.bench.filters.compiler.jit import Content, Kernel

SCRIPT = """
import sys
from pathlib import Path
sys.path.insert(0, str(Path(__file__).parent))
import kinds, rules
from consistency.bench.filters.compiler.jit import Kernel

kernel = Kernel(rules.total)
ready = 0
for name in sys.argv[1].split():
    rule = getattr(kinds, name)()
    ready += kernel.is_ready(rule, 10)
    print(kernel(rule, 10), end=" ")
    assert kernel.is_ready(rule, 10)
assert rules.increased(1.0) == 2.0, "a function of Numba's that the kernel calls still serves Python"
print(kernel.loaded, ready)
"""
KINDS = '''
"""Kinds of rules."""
from typing import NamedTuple
from consistency.bench.filters.compiler.dispatch import part

@part()
class Single(NamedTuple):
    """One."""

@part()
class Triple(NamedTuple):
    """Three."""
'''
RULES = '''
from typing import NamedTuple
import numba
import numpy as np
import numbers_of_mine
from consistency.bench.filters.compiler.dispatch import generic, implement
from consistency.bench.filters.compiler.jit import inner
from kinds import Single, Triple
from numbers_of_mine import THREE, shift

@generic()
def one(rule: NamedTuple) -> float:
    raise NotImplementedError

@inner
def helped(x: float) -> float:
    """Twice a half."""
    return 2.0 * (x / 2.0)

@numba.njit
def increased(x: float) -> float:
    return x + 1.0

@implement(one, Single)
def one_single(rule: Single) -> float:
    return helped(numbers_of_mine.ONE) + shift(0.0)

@implement(one, Triple)
def one_triple(rule: Triple) -> float:
    return increased(THREE[0])

def total(rule, n):
    values = np.zeros(n)
    for k in range(n):
        values[k] = one(rule)
    return values.sum()
'''
NUMBERS = '''
from consistency.bench.filters.compiler.jit import inner

ONE = 1.0
THREE = (2.0,)

@inner
def shift(x: float) -> float:
    """x, where it was."""
    return x + 0.0
'''


@pytest.fixture
def script(tmp_path):
    folder = tmp_path / "scripts"
    folder.mkdir()
    for name, text in (("kinds", KINDS), ("rules", RULES), ("numbers_of_mine", NUMBERS), ("uses_rules", SCRIPT)):
        (folder / f"{name}.py").write_text(textwrap.dedent(text), encoding="utf-8")
    return folder / "uses_rules.py"


IMPORTS = """
import numba, pandas, pydantic, scipy.stats
from consistency.bench.filters.compiler.jit import Kernel

numba.njit(lambda x: x + 1.0)(1.0)  # the first of a process takes long
"""


def started(script, order, imports=IMPORTS):
    """The script in a fork."""
    cache = str(script.parents[1] / "cache")
    code = f"import runpy; os.environ['NUMBA_CACHE_DIR'] = {cache!r}; runpy.run_path(sys.argv[0], None, '__main__')"
    return forks.begun(imports, code, str(script), order, cwd=script.parent)


def ended(process):
    try:
        out, err = process.communicate()
        assert process.returncode == 0, err
        return out, err
    finally:
        process.end()


def finished(process):
    """Values of the kernels, how many were read from disk, and how many were ready beforehand."""
    *values, loaded, ready = ended(process)[0].split()
    return [float(value) for value in values], int(loaded), int(ready)


def hits(script, order, imports=IMPORTS):
    """Kernels read from disk, which are just those that were ready."""
    values, loaded, ready = finished(started(script, order, imports))
    assert values == [{"Single": 10.0, "Triple": 30.0}[name] for name in order.split()]
    assert loaded == ready
    return loaded


def test_place_and_time_are_no_content(script):
    """And another order in another process has the same keys."""
    assert hits(script, "Single Triple") == 0
    (script.parent / "rules.py").touch()
    moved = shutil.copytree(script.parent, script.parents[1] / "elsewhere") / script.name
    assert hits(moved, "Triple Single", imports="") == 2  # and hashes of texts differ


# --- keys, without compiling ------------------------------------------------------------------------------

TEXTS = {"kinds": KINDS, "numbers_of_mine": NUMBERS, "rules": RULES}
Keys = Callable[..., str]


@pytest.fixture
def key(monkeypatch):
    """Key of the kernel of a kind, with one text in a module replaced by another."""

    def of(module="rules", old="", new="", kind="Single"):
        assert not old or TEXTS[module].count(old) == 1
        parts = {}
        for owner, name in ((dispatch, "PARTS"), (jit, "PARTS"), (dispatch, "_named_bodies")):
            monkeypatch.setattr(owner, name, parts if name == "PARTS" else {})
        for name, text in TEXTS.items():
            loaded = ModuleType(name)
            monkeypatch.setitem(sys.modules, name, loaded)
            exec(compile(text.replace(old, new) if name == module and old else text, name, "exec"), vars(loaded))
        rules, kinds = sys.modules["rules"], sys.modules["kinds"]
        return Content(rules.total, (numba.typeof(getattr(kinds, kind)()), numba.typeof(10))).key

    return of


def test_comments_and_docstrings_are_no_content(key):
    assert key() == key()
    assert key() == key("rules", '"""Twice a half."""', '"""Half of it, twice."""')
    assert key() == key("numbers_of_mine", '"""x, where it was."""', '"""x."""\n    # as it was')
    assert key() == key("kinds", '"""One."""', '"""The number one."""\n\n')


EDITS = {
    "body": ("rules", "helped(numbers_of_mine.ONE)", "2.0 * helped(numbers_of_mine.ONE)"),
    "helper": ("rules", "return 2.0 *", "return 4.0 *"),
    "helper of another module": ("numbers_of_mine", "return x + 0.0", "return x + 1.0"),
    "constant of another module": ("numbers_of_mine", "ONE = 1.0", "ONE = 2.0"),
    "the kernel": ("rules", "return values.sum()", "return values.max()"),
    "a name": ("kinds", "class Single(NamedTuple):", "class Single(NamedTuple):\n    x: float = 1.0"),
}


@pytest.mark.parametrize("name", EDITS)
def test_what_the_kernel_reads_is_content(key, name):
    assert key(*EDITS[name]) != key()


def test_constants_in_tuples_and_functions_of_numba_are_content(key):
    triple = key(kind="Triple")
    assert key("numbers_of_mine", "(2.0,)", "(3.0,)", kind="Triple") != triple
    assert key("rules", "return x + 1.0", "return 1.0 + x", kind="Triple") != triple


def test_what_other_kernels_are_made_of_is_no_content(key):
    assert key("numbers_of_mine", "(2.0,)", "(3.0,)") == key()
    assert key(kind="Triple") != key()


@pytest.mark.parametrize("setting", ["OPT", "LOOP_VECTORIZE", "BOUNDSCHECK"])
def test_settings_are_content(key, monkeypatch, setting):
    before = key()
    monkeypatch.setattr(config, setting, 17)
    jit._versions.cache_clear()
    assert key() != before
    monkeypatch.undo()
    jit._versions.cache_clear()


def test_the_processor_is_content(key, monkeypatch):
    before, codegen = key(), cpu_target.target_context.codegen()
    monkeypatch.setattr(codegen, "magic_tuple", lambda: ("x86_64", "another", ""))
    jit._versions.cache_clear()
    assert key() != before
    monkeypatch.undo()
    jit._versions.cache_clear()


def test_what_cannot_be_compared_is_not_kept(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    kernel = Kernel(with_something)
    assert not kernel.is_ready(1j)
    assert kernel(1j) == 0.0
    assert kernel.is_ready(1j)
    assert not list(tmp_path.rglob("*.kernel"))


class Something:
    """Nothing that Numba or a key knows."""


real = Something()


def with_something(x):
    """Reads an attribute; to a key it might be the global of that name."""
    return x.real


# --- textbook -----------------------------------------------------------------------------------------------


def keys_with_other_numbers(folder):
    """Keys of the kernels of built-in filters, with every number in a folder of the filters doubled."""
    code = "import runpy; runpy.run_path(sys.argv[0], None, '__main__')"
    out, _ = ended(forks.begun(IMPORTS, code, kernel_keys.__file__, folder, cwd=Path.cwd()))
    keys = json.loads(out)
    return keys


def test_the_textbook_is_no_content():
    before, after = kernel_keys.keys(), keys_with_other_numbers("methods")
    assert len(before) > 30
    assert keys_with_other_numbers("textbook") == before
    assert {name for name in before if after[name] != before[name]} >= {"ekf-uvd", "ukf-xyz"}  # negative control


# --- processes --------------------------------------------------------------------------------------------


def test_of_four_processes_that_start_at_once_one_compiles(script):
    found = [finished(process)[1] for process in [started(script, "Single Triple") for _ in range(4)]]
    assert sorted(found)[-1] == 2
    assert sum(found) == 6, "each of the two kernels is compiled once, and loaded by the other three"


def test_a_killed_compiler_leaves_nothing_that_is_loaded(script):
    """Wherever it is killed: before, while or after it writes."""
    for wait in (0.05, 0.2, 0.5):
        process = started(script, "Single Triple")
        time.sleep(wait)
        process.end()
    values, loaded, ready = finished(started(script, "Single Triple"))
    assert values == [10.0, 30.0]
    assert loaded == ready
    assert hits(script, "Single Triple") == 2
