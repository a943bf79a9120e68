"""Parts and the functions chosen by their types: what is refused, what is cached, who compiles."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import consistency as cs
from consistency.filters.compiled import problem_of
from consistency.filters.kernel import jit
from consistency.filters.kernel.dispatch import fits, generic, implement, part, require_fitting
from consistency.filters.kernel.slam import Slam
from consistency.filters.methods.riekf import RightInvariant
from consistency.filters.update.unscented import Unscented
from consistency.filters.upkeep.local import Local


@part()
class Doubling(NamedTuple):
    """A part of this test."""


@part()
class Twofold(NamedTuple):
    """Another part of this test."""


class Stranger(NamedTuple):
    """No part."""


@generic()
def times(rule: NamedTuple, x: float) -> float:
    """x, multiplied."""
    raise NotImplementedError


@implement(times, Doubling)
def doubled(rule: Doubling, x: float) -> float:
    return 2.0 * x


def another_doubling() -> type:
    namespace: dict[str, object] = {"__name__": __name__, "NamedTuple": NamedTuple}
    exec("class Doubling(NamedTuple):\n    pass\n", namespace)
    cls = namespace["Doubling"]
    assert isinstance(cls, type)
    return cls


def test_two_parts_of_one_name_are_refused() -> None:
    """They would run each other's compiled code, silently."""
    with pytest.raises(TypeError, match=r"a part named 'Doubling' is there already, in .*test_dispatch"):
        part()(another_doubling())


def test_a_part_must_be_a_named_tuple_at_module_level() -> None:
    class Inside(NamedTuple):
        pass

    for cls in (Inside, int):
        with pytest.raises(TypeError, match="NamedTuple at module level"):
            part()(cls)


def test_bodies_must_stand_at_module_level_and_alone() -> None:
    def body(rule: Doubling, x: float) -> float:
        return x

    with pytest.raises(TypeError, match="module level"):
        implement(times, Stranger)(body)
    with pytest.raises(TypeError, match="'times' has a body for Doubling already"):
        implement(times, Doubling)(doubled)


def test_two_bodies_of_one_name_are_refused() -> None:
    namespace: dict[str, Any] = {"__name__": __name__}
    exec("def doubled(rule, x):\n    return x\n", namespace)
    with pytest.raises(TypeError, match=r"'.*test_dispatch.doubled' must .* under a name of its own"):
        implement(times, Stranger)(namespace["doubled"])


def test_one_body_may_serve_two_parts() -> None:
    assert implement(times, Twofold)(doubled) is doubled
    assert times(Twofold(), 3.0) == 6.0


def test_a_function_without_a_body_says_what_there_is() -> None:
    assert times(Doubling(), 3.0) == 6.0
    with pytest.raises(TypeError, match="'times' has no body for Stranger; there are Doubling"):
        times(Stranger(), 3.0)


def parts(name: str, world: str) -> Slam:
    scenario = cs.load_scenario(world)
    trial = cs.simulate(scenario.variant("short", truth__steps=3))
    slam: Slam = cs.get_filter(name).parts(problem_of(trial, scenario.belief), np.array(trial.controls))
    return slam


REFUSED = [
    (
        "kf",
        "linear-gaussian",
        {"update": Unscented(1.0, 0.0, 0.0)},
        "point 'Reference' .* update 'Unscented', only with",
    ),
    ("ekf-uvd", "herath2007-stereo", {"point": parts("kf", "linear-gaussian").point}, "sensor 'Uvd'"),
    ("ri-ekf-uvd", "herath2007-stereo", {"covariance": Local(100)}, "covariance 'Local'"),
    ("ekf-uvd", "herath2007-stereo", {"error": RightInvariant(), "covariance": Local(100)}, "'RightInvariant'"),
    ("ekf-uvd", "herath2007-stereo", {"motion": Stranger()}, "motion: 'Stranger' is no registered part"),
]


@pytest.mark.parametrize(("name", "world", "changes", "message"), REFUSED, ids=lambda value: str(value)[:20])
def test_combinations_that_mean_nothing_are_refused(
    name: str, world: str, changes: dict[str, NamedTuple], message: str
) -> None:
    slam = parts(name, world)
    require_fitting(slam)
    with pytest.raises(TypeError, match=message):
        require_fitting(slam._replace(**changes))
    assert not fits(slam._replace(**changes))


SCRIPT = """
import sys, time
import numpy as np
sys.path.insert(0, {folder!r})
import kinds, rules
from consistency.filters.kernel.dispatch import outside_files
from consistency.filters.kernel.jit import Kernel

kernel = Kernel(rules.total)
ready = 0
for name in sys.argv[1].split():
    rule = getattr(kinds, name)()
    ready += kernel.is_ready(rule, 10)
    assert kernel(rule, 10) == {{"Single": 10.0, "Triple": 30.0}}[name]
    assert kernel.is_ready(rule, 10)
assert [path.name for path in outside_files()] == ["kinds.py", "rules.py"]
print(kernel.loaded, ready)
"""
KINDS = """
from typing import NamedTuple
from consistency.filters.kernel.dispatch import part

@part()
class Single(NamedTuple):
    pass

@part()
class Triple(NamedTuple):
    pass
"""
RULES = """
from typing import NamedTuple
from consistency.filters.kernel.dispatch import generic, implement
from kinds import Single, Triple

@generic()
def one(rule: NamedTuple) -> float:
    raise NotImplementedError

@implement(one, Single)
def one_single(rule: Single) -> float:
    return 1.0

@implement(one, Triple)
def one_triple(rule: Triple) -> float:
    return 3.0

def total(rule, n):
    result = 0.0
    for _ in range(n):
        result += one(rule)
    return result
"""


@pytest.fixture
def script(tmp_path: Path) -> Path:
    (tmp_path / "kinds.py").write_text(textwrap.dedent(KINDS), encoding="utf-8")
    (tmp_path / "rules.py").write_text(textwrap.dedent(RULES), encoding="utf-8")
    path = tmp_path / "uses_rules.py"
    path.write_text(textwrap.dedent(SCRIPT.format(folder=str(tmp_path))), encoding="utf-8")
    return path


def started(script: Path, order: str) -> subprocess.Popen[str]:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(script.parent / "cache")}
    return subprocess.Popen([sys.executable, script, order], env=environment, stdout=subprocess.PIPE, text=True)


def loaded(process: subprocess.Popen[str], known: bool = False) -> int:
    """Kernels read from disk; ``known`` demands that just these were ready beforehand."""
    out, _ = process.communicate(timeout=120)
    assert process.returncode == 0
    from_disk, ready = map(int, out.split())
    assert ready == from_disk or not known
    return from_disk


def hits(process: subprocess.Popen[str]) -> int:
    return loaded(process, known=True)


def test_another_order_in_another_process_hits_the_cache(script: Path) -> None:
    assert hits(started(script, "Single Triple")) == 0
    assert hits(started(script, "Triple Single")) == 2


@pytest.mark.parametrize("name", ["kinds.py", "rules.py"])
def test_an_edited_part_outside_the_package_is_compiled_anew(script: Path, name: str) -> None:
    assert hits(started(script, "Single")) == 0
    edited = script.parent / name
    edited.write_text(edited.read_text(encoding="utf-8") + "\n# edited\n", encoding="utf-8")
    assert hits(started(script, "Single")) == 0


def test_of_four_processes_that_start_at_once_one_compiles(script: Path) -> None:
    found = [loaded(process) for process in [started(script, "Single Triple") for _ in range(4)]]
    assert sorted(found)[-1] == 2
    assert sum(found) == 6, "each of the two kernels is compiled once, and loaded by the other three"


def test_the_key_of_the_cache_covers_every_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Text and time of each file, and the place of the package."""
    package, outside = tmp_path / "package", tmp_path / "rules.py"
    sources = [package / name for name in ("models/point.py", "filters/plain.py", "filters/kernel/gain.py")]
    for path in (*sources, outside):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("before", encoding="utf-8")
    monkeypatch.setattr(jit, "PACKAGE", package)
    keys = [jit._digest([outside])]
    assert jit._digest([outside]) == keys[0]
    for path in (*sources, outside):
        time = path.stat().st_mtime_ns
        path.write_text("after", encoding="utf-8")
        os.utime(path, ns=(time, time))
        keys.append(jit._digest([outside]))
        os.utime(path, ns=(time, time + 10**9))
        keys.append(jit._digest([outside]))
    shutil.copytree(package, tmp_path / "another")
    monkeypatch.setattr(jit, "PACKAGE", tmp_path / "another")
    keys.append(jit._digest([outside]))
    assert len(set(keys)) == 10
