"""The worked example "Add a sensor effect" of docs/extending.md, followed in a copy of the package."""

import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import forks
import pytest
from documents import ROOT, blocks, read

import consistency
import consistency.bench.filters

PACKAGE = Path(consistency.__file__).parent
PAGE = "docs/extending.md"
EFFECTS = Path("consistency/bench/scenario")


def code(heading):
    """Code blocks of one part of the document."""
    return [block.text for block in blocks(PAGE, "python", "toml", part=heading)]


def example(name):
    """A file to copy, to which the document links."""
    assert f"(examples/extending/{name})" in read(PAGE)
    return (ROOT / "docs/examples/extending" / name).read_text(encoding="utf-8")


@pytest.fixture
def copy(tmp_path):
    ignore = shutil.ignore_patterns("__pycache__", "*.nbi", "*.nbc")
    for name in ("consistency", "scenarios"):
        shutil.copytree(PACKAGE.parent / name, tmp_path / name, ignore=ignore)
    (tmp_path / "est.csv").write_text(
        "run,step,a,P_a_a\n" + "".join(f"{r},{k},{r},1\n" for r in (3, 7) for k in (1, 2))
    )
    (tmp_path / "truth.csv").write_text("step,a\n1,0\n2,0\n")
    return tmp_path


def python(folder, code, imports="import scipy.stats, typer"):
    """Code that finds the copy, in a fork of a process that has imported nothing of ours."""
    return forks.done(imports, f"sys.path.insert(0, {str(folder)!r})\n{code}", "-c", cwd=folder)


def test_the_command_of_the_document_works(copy):
    """One new file and one row; it is in the help, reads files, and loads nothing heavy before it is called."""
    module, (row,) = example("worst.py"), code("Add a command")
    assert row.count("\n") == 1
    (copy / "consistency/commands/worst.py").write_text(module, encoding="utf-8")
    first = "    # the laboratory\n"
    changed(copy / "consistency/commands/app.py", first, f"{row.rstrip()},\n{first}")
    told = python(
        copy,
        "import sys\nfrom consistency.commands import main\n"
        "try:\n    main(['worst', '--help'])\nfinally:\n    print('numpy' in sys.modules)",
        imports="",
    )
    assert "The run with the largest mean NEES" in told.stdout
    assert told.stdout.splitlines()[-1] == "False"
    done = python(
        copy,
        "from consistency.commands import main\nmain(['worst', 'est.csv', '--truth', 'truth.csv', '--state', 'a'])",
    )
    assert done.stdout == "est: run 7, mean NEES 49\n", done.stderr


def changed(path, old, new):
    """Replace the one place where ``old`` stands."""
    text = path.read_text(encoding="utf-8")
    assert text.count(old) == 1
    path.write_text(text.replace(old, new), encoding="utf-8")


def test_the_question_of_the_document_is_asked(copy):
    """Two files; runs whose errors grow are found at fault, the same runs in random order are not."""
    statistic, (table, line) = example("trend.py"), code("Add a question of the verdict")
    folder = copy / "consistency/referee/diagnostics"
    (folder / "trend.py").write_text(statistic, encoding="utf-8")
    tests = folder / "error_parts.py"
    first = "    distribution = pit(sample.nees, sample.dof)\n"
    changed(tests, first, f"    {line.strip()}\n{first}")
    changed(tests, "\n\n@dataclass(frozen=True)\nclass Tests", f"\n{table}\n\n@dataclass(frozen=True)\nclass Tests")
    changed(
        tests, "from consistency.referee.diagnostics.whitening",
        "from consistency.referee.diagnostics.trend import trend\n"
        "from consistency.referee.diagnostics.verdict_parts import ABOUT, ALONE, SHARES\n"
        "from consistency.referee.diagnostics.whitening",
    )  # fmt: skip
    done = python(
        copy,
        """
import numpy as np
from scipy import stats
from consistency.diagnostics import judge, make_record

n = 200
size = np.sqrt(stats.chi2.ppf((np.arange(n) + 0.5) / n, 1))  # errors of a right estimator by their size
for order in (np.arange(n), np.arange(n) * 37 % n):
    error = (size * np.resize([1, -1, -1, 1], n))[order].reshape(n, 1, 1)
    v = judge(make_record("f", error=error, covariance=np.ones((n, 1, 1, 1)), nees=error[..., 0] ** 2, dof=1))
    print(v.faults, v.reasons[0], "trend" in [a["question"] for a in v.statistics["answers"]])
""",
    )
    assert done.returncode == 0, done.stderr
    grows, mixed = done.stdout.splitlines()
    assert "trend" in grows
    assert "the NEES depends on the order of the runs" in grows
    assert "the NEES depends" not in mixed
    assert grows.endswith("True")
    assert mixed.endswith("True")


def test_the_renderer_of_the_document_works(copy):
    """One file; the command line and the gates have the format at once."""
    (copy / "consistency/referee/show/as_csv.py").write_text(example("as_csv.py"), encoding="utf-8")
    words = ["analyse", "est.csv", "--truth", "truth.csv", "--state", "a", "--report", "out.csv"]
    done = python(copy, f"from consistency.commands import main\nmain({words})")
    assert done.stdout.endswith("out.csv\n"), done.stderr
    heads, cells, *_ = (copy / "out.csv").read_text().splitlines()
    assert heads == "filter,verdict,ANEES,true / stated,RMSE m,RMSE deg,NIS/dof,failed"
    assert cells.startswith("est,overconfident,29.00,")
    imports = "from pathlib import Path\nfrom consistency.referee.gating.session import path_fault"
    refusal = f"{imports}\nprint(path_fault(Path('a.b')))"
    assert ".csv" in python(copy, refusal).stdout


def test_the_kind_of_files_of_the_document_is_read(copy):
    """One file and a row; what is refused of it is refused, and what is broken is said."""
    load, row = code("Add a kind of files")
    module = copy / "consistency/referee/readers/formats/run_lines.py"
    module.write_text(example("run_lines.py"), encoding="utf-8")
    kinds = copy / "consistency/referee/readers/pipeline/read_files.py"
    changed(kinds, "KINDS = (", f"{load}\n\nKINDS = (")
    last = ")\n\n\ndef kind_of"
    changed(kinds, last, f"    {row.strip()},\n{last}")
    lines = [f'{{"errors": [[{run}], [{run}]], "covariances": [[[1]], [[1]]]}}' for run in (3, 7)]
    (copy / "est.runs").write_text("\n".join(lines), encoding="utf-8")
    (copy / "bad.runs").write_text("\n".join([*lines, "{}"]), encoding="utf-8")
    call = "from consistency.commands import main\nmain({})"
    assert "overconfident  29.00" in python(copy, call.format(["analyse", "est.runs"])).stdout
    refused = python(copy, call.format(["analyse", "est.runs", "--truth", "truth.csv"])).stderr
    assert "--truth: does not go with est.runs" in refused
    assert "each line must be an object" in python(copy, call.format(["analyse", "bad.runs"])).stderr


def test_a_default_stands_once(copy):
    """One file: the command line, its help, Python and the gates have it."""
    changed(copy / "consistency/referee/defaults.py", "FALSE_ALARM = 0.05", "FALSE_ALARM = 0.037")
    asked = ["analyse", "est.csv", "--truth", "truth.csv", "--state", "a"]
    for words in ([*asked, "--verbose"], ["analyse", "--help"]):
        assert "0.037" in python(copy, f"from consistency.commands import main\nmain({words})").stdout
    gate = "import consistency as cs\nprint(cs.judge(cs.read('est.csv', truth='truth.csv', state='a')).statistics)"
    assert "0.037" in python(copy, gate).stdout


def test_the_bias_of_the_document_works(copy):
    """One new file, one line elsewhere, a key in a scenario; and the document's own test passes."""
    effect, test, (line, key) = example("bias.py"), example("check_bias.py"), code("Add a sensor effect")
    assert line.count("\n") == 1
    (copy / EFFECTS / "bias.py").write_text(effect, encoding="utf-8")
    names, first = copy / EFFECTS / "effects.py", "from consistency.bench.scenario.observations"
    changed(names, first, line + first)
    scenario = (copy / "scenarios" / "herath2007-stereo.toml").read_text(encoding="utf-8")
    (copy / "mine.toml").write_text(f"{scenario}\n{key}", encoding="utf-8")
    (copy / "test_bias.py").write_text(test, encoding="utf-8")
    program = (
        "import consistency as cs, test_bias\n"
        "test_bias.test_a_bias_shifts_every_disparity()\n"
        "print(cs.__file__, cs.load_scenario('mine.toml').truth.sensor.effects)"
    )
    done = python(copy, program)
    assert done.returncode == 0, done.stderr
    assert str(copy) in done.stdout
    assert "Bias(kind='bias', name=None, bias=(0.0, 0.0, 1.0))" in done.stdout
    changed(names, line, "")
    assert "'bias' is not one of" in python(copy, program).stderr  # negative control


METHODS = PACKAGE / "bench" / "filters" / "methods"


def test_excerpts_of_filters_are_the_code_that_runs():
    registry = (PACKAGE / "bench" / "filters" / "__init__.py").read_text(encoding="utf-8")
    sources = [registry, *(path.read_text(encoding="utf-8") for path in METHODS.glob("*.py"))]
    excerpts = code("Add a filter")
    assert len(excerpts) == 2
    for excerpt in excerpts:
        pieces = re.split(r"\n{3,}", excerpt.strip("\n"))
        assert all(any(piece in source for source in sources) for piece in pieces), excerpt


@pytest.mark.parametrize("method, names", [("iekf", {"iekf"}), ("riekf", {"ri-ekf"}), ("anchored", {"anchored-ekf"})])
def test_a_filter_is_one_file_and_a_line_for_each_name(method, names):
    """Nothing else in the package but its textbook knows the file or what it defines."""
    registered = {name: module for name, (module, _) in consistency.bench.filters.MODULES.items()}
    mine = {name for name, module in registered.items() if module == f"methods.{method}"}
    assert {name.rpartition("-")[0] for name in mine} == names
    source = (METHODS / f"{method}.py").read_text(encoding="utf-8")
    defined = set(re.findall(r"^class (\w+)", source, flags=re.MULTILINE)) | {f"methods.{method}"}
    for path in PACKAGE.rglob("*.py"):
        if path.name != f"{method}.py" and path != PACKAGE / "bench" / "filters" / "__init__.py":
            assert not defined & words_of_code(path.read_text(encoding="utf-8")), path
    assert defined & words_of_code(source)  # negative control


def words_of_code(source):
    """Names, attributes, what is imported and defined, and texts: all but comments, and words in a docstring."""
    words = set()
    for node in ast.walk(ast.parse(source)):
        words |= {str(getattr(node, key)) for key in ("id", "attr", "name", "value") if hasattr(node, key)}
    return words


def test_the_experiment_of_the_document_runs(tmp_path):
    (tmp_path / "e13_iterated.py").write_text(example("e13_iterated.py"), encoding="utf-8")
    program = "import sys, runpy; sys.argv = ['e13', '2', '0']; runpy.run_path('e13_iterated.py', run_name='__main__')"
    environment = os.environ | {"PYTHONPATH": str(PACKAGE.parent)}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert "iterated-update" in done.stdout
