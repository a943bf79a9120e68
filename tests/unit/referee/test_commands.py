"""What is said where optional packages are missing: by commands, names, arguments and filters; help of commands."""

import json
import re
import shlex
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
import typer
from command import consistency, refused
from documents import parsed

import consistency as cs
from consistency.bench import filters
from consistency.bench.sweeps.sweep_file import load_sweep
from consistency.commands.app import COMMANDS, app
from consistency.commands.shared_options import print_next
from consistency.referee import extras
from consistency.referee.extras import (
    IMPORT_NAMES,
    MissingPackageError,
    explained,
    missing,
    remedy,
    require,
    requirements,
)
from consistency.referee.system import summaries

ROOT = Path(__file__).parents[3]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
SENTENCE = re.compile(r"consistency: .* needs? [\w>=., -]+: pip install \S.*\n")


@pytest.fixture
def nowhere(monkeypatch):
    """The package is not known to come from anywhere."""
    monkeypatch.setattr(extras, "_from_origin", lambda _: [])


def without(monkeypatch, *modules):
    """The packages are neither found nor imported."""
    for name in modules:
        monkeypatch.setitem(sys.modules, name, None)
    extras.is_installed.cache_clear()


@pytest.fixture(autouse=True)
def forgotten():
    extras.is_installed.cache_clear()


# --- the extras ------------------------------------------------------------------------------------


def listed(extra):
    """Packages and floors of an extra in pyproject.toml, those of the extras that it includes too."""
    pairs = set()
    for line in PROJECT["optional-dependencies"][extra]:
        name, _, floor = line.partition(">=")
        included = name.removeprefix("filter-consistency").strip("[]").split(",")
        pairs |= {(name, floor)} if floor else set().union(*map(listed, included))
    return pairs


@pytest.mark.parametrize("extra", PROJECT["optional-dependencies"])
def test_an_extra_brings_what_the_project_lists(extra):
    """Also a check of the installation: one that is stale is mended by ``pip install -e .``."""
    assert set(requirements(extra)) == listed(extra), "the installation is stale: pip install -e ."


def test_several_extras_bring_each_package_once():
    assert requirements("plot", "report").count(("matplotlib", "3.9")) == 1
    assert requirements() == requirements("nonsense") == []


def test_names_of_imports_that_differ_are_known():
    """Of all packages that are installed here, so that no package is missed that is there."""
    packages = {package for package, _ in requirements("all")}
    assert set(IMPORT_NAMES) <= packages
    assert [each.package for each in requirements("all") if not each.is_found and not _is_absent(each.package)] == []


def _is_absent(package):
    try:
        metadata.version(package)
    except metadata.PackageNotFoundError:
        return True
    return False


def test_a_checkout_that_is_not_installed_knows_no_extras(monkeypatch):
    monkeypatch.setattr(extras, "DISTRIBUTION", "no-such-distribution")
    assert requirements("bench") == []
    assert explained(ModuleNotFoundError(name="numba"), "this") is None


def test_the_core_is_small():
    assert {re.split("[>=]", r)[0] for r in PROJECT["dependencies"]} == {"numpy", "scipy", "typer", "rich"}


@pytest.mark.usefixtures("nowhere")
def test_a_sentence_names_what_is_missing(monkeypatch):
    require("this", "bench", "report")
    without(monkeypatch, "numba", "tomli_w", "typst")
    with pytest.raises(MissingPackageError) as refusal:
        require("this", "bench", "report")
    assert str(refusal.value) == "this needs numba, tomli-w, typst: pip install numba tomli-w typst"
    assert isinstance(refusal.value, ImportError)
    assert isinstance(refusal.value, cs.InputError)
    assert extras.is_installed("ros")
    assert not extras.is_installed("vision")


@pytest.mark.usefixtures("nowhere")
def test_a_package_that_is_too_old_is_missing(monkeypatch):
    versions = dict(requirements("bench")) | {"numpy": "1.26.4", "scipy": "1.16.0rc1", "rich": "14.1.0"}
    monkeypatch.setattr(metadata, "version", versions.__getitem__)
    assert missing("bench") == ["numpy>=2.0"]
    assert remedy("bench") == "numpy>=2.0: pip install 'numpy>=2.0'"


def test_the_python_that_the_bench_needs(monkeypatch):
    without(monkeypatch, "numba")
    monkeypatch.setattr(sys, "version_info", (3, 10, 13))
    assert remedy("vision") == "Python 3.11 or later; this is 3.10"
    assert "Python" not in remedy("plot")


@pytest.mark.parametrize("version, floor, is_met", [
    ("2.4.40", "2.4.40", True), ("2.4.39", "2.4.40", False), ("2.10", "2.9", True), ("3", "2.9", True),
    ("2025.11.1", "2025.1", True), ("1.16.0rc1", "1.16", True), ("1.15.9", "1.16", False), ("unknown", "1.0", False),
])  # fmt: skip
def test_versions_are_compared_as_numbers(version, floor, is_met, monkeypatch):
    monkeypatch.setattr(metadata, "version", lambda _: version)
    assert extras.Requirement("numpy", floor).is_met == is_met


@pytest.mark.usefixtures("nowhere")
def test_a_package_that_is_there_and_cannot_be_loaded_is_named():
    assert remedy("ulog", package="pyulog") == "pyulog: pip install pyulog"


@pytest.mark.parametrize(
    "record, expected",
    [
        ({"url": "file://{at}", "dir_info": {}}, ["{at}[bench,plot]"]),
        ({"url": "file://{at}", "dir_info": {"editable": True}}, ["-e", "{at}[bench,plot]"]),
        ({"url": "file:///no/such/place.whl", "archive_info": {}}, []),
        (
            {
                "url": "https://host/repository",
                "vcs_info": {"vcs": "git", "commit_id": "abc", "requested_revision": "v1"},
            },
            ["filter-consistency[bench,plot] @ git+https://host/repository@v1"],
        ),
        ({"url": "file://{at}", "vcs_info": {"vcs": "git", "commit_id": "a"}}, ["{at}[bench,plot]"]),
        ({"url": "file:///usr", "vcs_info": {"vcs": "git", "commit_id": "a"}}, []),  # no project is there
        ({"url": "https://host/a.whl", "archive_info": {}}, ["filter-consistency[bench,plot] @ https://host/a.whl"]),
        (None, []),
    ],
)
def test_the_place_that_it_came_from(record, expected, tmp_path, monkeypatch):
    place = tmp_path / "a place"
    place.mkdir()
    (place / "pyproject.toml").touch()

    installed = metadata.distribution

    class Installed:
        requires = installed(extras.DISTRIBUTION).requires

        def read_text(self, name):
            assert name == "direct_url.json"
            return (
                None if record is None else json.dumps(record).replace("{at}", place.as_uri().removeprefix("file://"))
            )

    found = {extras.DISTRIBUTION: Installed()}
    monkeypatch.setattr(metadata, "distribution", lambda name: found.get(name) or installed(name))
    words = [word.replace("{at}", str(place)) for word in expected]
    assert extras._from_origin(("bench", "plot")) == words
    without(monkeypatch, "typst")
    expected = [word.replace("bench,plot", "report") for word in words] or ["typst"]
    assert shlex.split(remedy("report")) == ["typst:", "pip", "install", *expected]


def test_no_text_installs_from_an_index():
    """A name with an extra stands only in pyproject.toml, and before " @ " and a place."""
    files = [
        *(path for folder in ("consistency", "docs", "tests", "benchmarks", "experiments", "scenarios", ".github")
          for path in (ROOT / folder).rglob("*")
          if path.suffix in {".py", ".md", ".ipynb", ".yml", ".toml"} and "_build" not in path.parts),
        *ROOT.glob("*.md"),
    ]  # fmt: skip
    name = "pip install " + "filter-consistency"
    place = r"(?!(\[[\w,]+\])? @ git)"
    wrong = rf"{name}{place}|{name.replace('l f', 'l .f')}{place}"
    found = [path for path in files if re.search(wrong, path.read_text("utf-8"))]
    assert found == []
    assert len(files) > 500


# --- names -----------------------------------------------------------------------------------------


@pytest.mark.usefixtures("nowhere")
def test_a_name_of_the_bench(monkeypatch):
    code = """
import sys
sys.modules |= dict.fromkeys(["pandas", "numba"])
import consistency as cs
try:
    cs.run_trials
except ImportError as error:
    print(error)
try:
    from consistency import nonsense
except ImportError as error:
    print(type(error).__name__)
print(cs.anees.__name__, "run_trials" in dir(cs))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    sentence, other, here = done.stdout.splitlines()
    assert sentence.startswith("consistency.run_trials needs numba, pandas: pip install ")
    assert (other, here) == ("ImportError", "anees True")


def test_a_failed_import_is_explained_by_the_extra_that_has_the_package(monkeypatch):
    """Not by one that collects others."""
    monkeypatch.setattr(extras, "_from_origin", lambda names: [f"here[{','.join(names)}]"])
    for module, package, extra in (("joblib", "joblib", "bench"), ("yaml", "pyyaml", "vision")):
        without(monkeypatch, module)
        error = explained(ModuleNotFoundError(name=f"{module}.part"), "this")
        assert str(error) == f"this needs {package}: pip install 'here[{extra}]'"
        monkeypatch.undo()
        monkeypatch.setattr(extras, "_from_origin", lambda names: [f"here[{','.join(names)}]"])


def test_who_needs_no_extra_does_not_wait_for_the_metadata(monkeypatch):
    monkeypatch.setattr(metadata, "requires", lambda _: pytest.fail("the metadata were read"))
    require("this")
    assert requirements() == []


def test_another_module_that_is_missing_is_not_explained():
    assert explained(ModuleNotFoundError(name="no_such_module"), "this") is None
    assert explained(ModuleNotFoundError(), "this") is None
    assert explained(ModuleNotFoundError(name="numba.no_such_module"), "this") is None  # numba is there


# --- commands --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name, row in COMMANDS.items() if row.extras])
def test_a_command_without_its_packages(name, monkeypatch, capsys):
    """Whatever its options are; its help is there."""
    module = "typst" if name == "report" else "numba"
    without(monkeypatch, module)
    err = refused(capsys, name, "--no-such-option")
    assert err.startswith(f"consistency: '{name}' needs {module}: pip install ")
    assert SENTENCE.fullmatch(err)
    for words in ([name, "--help"], [name, "--help", "--help"]):  # the second goes through typer
        out, err = consistency(capsys, *words)
        assert err == ""
        assert re.match(rf"Usage: .* {name} ", out)


def test_help_marks_what_is_missing(monkeypatch, capsys):
    before, _ = consistency(capsys, "--help")
    assert "[bench]" not in before
    without(monkeypatch, "numba", "typst")
    after, _ = consistency(capsys, "--help")
    lines = dict(re.findall(r"^  ([a-z-]+) +(\S.*)$", after, re.MULTILINE))
    assert set(COMMANDS) <= set(lines)
    for name, row in COMMANDS.items():
        mark = f"[{','.join(row.extras)}] " if row.extras else ""
        assert lines[name].startswith(mark), name
        assert row.extras or not lines[name].startswith("[")
    assert "[report,bench,vision]: needs typst, numba: pip install " in after
    assert consistency(capsys, "-h")[0] == after


@pytest.mark.parametrize("words", [["plan", "linear-gaussian", "--filter", "kf"], ["analyse", "results"]])
def test_arguments_that_need_the_bench(words, inside, monkeypatch, capsys):
    (inside / "results").mkdir()
    (inside / "results" / "manifest.json").write_text("{}")
    loaded = {
        n: m
        for n, m in sys.modules.items()
        if n.startswith(("consistency.bench.runs", "consistency.bench.store.results"))
    }
    parents = {name: sys.modules[name.rpartition(".")[0]] for name in loaded}
    for name, module in loaded.items():
        monkeypatch.setattr(parents[name], name.rpartition(".")[2], module)  # to be what it was after this test
        monkeypatch.delitem(sys.modules, name)
    without(monkeypatch, "pandas")
    err = refused(capsys, *words)
    assert err.startswith(f"consistency: '{words[0]}' with these arguments needs pandas: pip install ")


def test_only_the_called_command_is_loaded():
    code = """
import sys
from consistency.commands import main
try:
    main(["plan", "--dof", "3", "--json"])
except SystemExit as end:
    print(end.code)
print(*sorted(name for name in sys.modules if name.startswith("consistency.commands.")))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    names = ["app", "judging", "shared_options"]
    assert done.stdout.splitlines()[-2:] == ["None", " ".join(f"consistency.commands.{name}" for name in names)]


def test_a_command_is_a_row_and_a_function():
    commands = typer.main.get_command(app).commands
    assert len(commands) == len(COMMANDS)
    for name in COMMANDS:
        assert commands[name].name == name
        assert commands[name].help


# --- list ------------------------------------------------------------------------------------------


def test_the_list_says_what_the_files_say():
    listed = summaries()
    assert listed["scenarios"] == {name: cs.load_scenario(name).summary for name in cs.scenario_names()}
    assert listed["sweeps"] == {name: load_sweep(name).summary for name in listed["sweeps"]}
    assert {"regime", "small"} <= set(listed["sweeps"])
    assert all(listed["experiments"].values())
    assert len(listed["experiments"]) > 20


def test_the_list_on_the_core(monkeypatch, capsys):
    before, silent = consistency(capsys, "list")
    without(monkeypatch, "numba", "pandas")
    after, err = consistency(capsys, "list")
    assert (after, silent) == (before, "")
    assert err.startswith("consistency: to run what is listed needs numba, pandas: pip install ")
    assert "herath2007-stereo" in after
    assert "parked-ekf-uvd" in after


# --- help -----------------------------------------------------------------------------------------------------


COMMAND_LINE = typer.main.get_command(app)
SUBCOMMANDS = COMMAND_LINE.commands
LINES = [line for row in COMMANDS.values() for line in row.examples]


@pytest.mark.parametrize("line", LINES)
def test_an_example_parses(line):
    name, values = parsed(shlex.split(line))
    assert line in SUBCOMMANDS[name].epilog
    assert values


def test_every_command_that_takes_something_has_an_example():
    assert {name for name, row in COMMANDS.items() if not row.examples} == {"list"}


@pytest.mark.parametrize("name", sorted(SUBCOMMANDS))
def test_help_is_for_people(name):
    with COMMAND_LINE.make_context("consistency", [name]) as root:
        context = SUBCOMMANDS[name].make_context(name, [], parent=root, resilient_parsing=True)
        text = SUBCOMMANDS[name].get_help(context)
    assert "list[" not in text
    assert "-h, --help" in text


def test_completion_is_offered():
    options = {option for parameter in COMMAND_LINE.params for option in parameter.opts}
    assert {"--install-completion", "--show-completion"} <= options


@pytest.mark.parametrize("name", ["run", "analyse", "tune"])
def test_help_alone_is_that_of_typer(name, capsys):
    shown = []
    for words in ([name, "--help"], [name, "--help", "--help"]):  # the second goes through typer
        shown.append(consistency(capsys, *words)[0])
    assert f"Usage: consistency {name} " in shown[0]
    assert [text.partition(f" {name} ")[2] for text in shown] == [shown[0].partition(f" {name} ")[2]] * 2


def test_help_of_no_command_is_refused(capsys):
    refused(capsys, "runn", "--help")


def test_help_imports_nothing_that_checks_values():
    code = "import sys; sys.argv[1:] = ['run', '-h']; from consistency.commands.app import _show_help; \
_show_help(None) or sys.exit(3); sys.exit('pydantic' in sys.modules or 'numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0


# --- a filter of a library that is not installed --------------------------------------------------------------


@pytest.fixture
def lacking(monkeypatch):
    monkeypatch.setattr(filters, "EXTRAS", {"external.gtsam": ("no_such_package", "smoothing")})


@pytest.mark.usefixtures("lacking")
def test_without_its_library_a_filter_is_refused():
    remedy = "'gtsam-map-uvd' needs no_such_package: pip install "
    with pytest.raises(cs.InputError, match=remedy):
        cs.get_filter("gtsam-map-uvd")
    assert "gtsam-map-uvd" in filters.filter_names()
    assert set(filters.filter_names()) - set(filters.usable_names()) == {
        "gtsam-batch-uvd", "gtsam-lag-uvd", "gtsam-map-uvd",
    }  # fmt: skip


@pytest.mark.usefixtures("lacking")
def test_what_does_not_fit_a_sensor_is_said_without_it(xyz):
    with pytest.raises(cs.InputError, match="works on a sensor uvd, not 'xyz'; filters that fit: ekf-xyz") as refusal:
        cs.run_trials(xyz, ["ekf-uvd"], runs=1)
    assert "gtsam" not in str(refusal.value)


@pytest.mark.parametrize("absent", [[], ["typst"]])
def test_the_next_command_names_what_it_lacks(absent, monkeypatch, capsys):
    monkeypatch.setattr(extras, "missing", lambda *_: absent)
    print_next("runs", Path("out"))
    shown = capsys.readouterr().out
    assert shown.startswith("runs in out; next: consistency report out")
    assert ("(needs typst: pip install " in shown) == bool(absent)
