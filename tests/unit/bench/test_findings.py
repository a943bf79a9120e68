"""How reproduce runs scripts: which of them, in which process, and what becomes of one that breaks."""

import json
import os
import time
from dataclasses import replace

import pandas as pd
import pytest
import typer

from consistency import InputError
from consistency.bench.pages.results_report import build_report, compose
from consistency.bench.runs import reproduce_findings
from consistency.bench.runs import reproduce_findings as module
from consistency.bench.runs.reproduce_findings import Study, reproduce
from consistency.commands.studies import reproduce_command
from consistency.referee.show.blocks import Heading
from consistency.referee.system import read_manifest

SCRIPT = '''"""A question."""
import os
import numpy as np
import pandas as pd
from consistency import InputError

FINDINGS = {ids}
{constants}

def main(study):
    {before}
    rng = np.random.default_rng([study.seed, {number}])
    study.tables["table{number}"] = pd.DataFrame({{"x": rng.normal(size=3), "process": os.getpid()}})
    text = dict.fromkeys(("source", "claim", "statistic", "published", "accept"), "text")
    return [study.finding(True, "none", id=name, measured=str(rng.normal()), **text) for name in FINDINGS]
'''


@pytest.fixture
def scripts(tmp_path, monkeypatch):
    """Folder of experiments: two that share trials, two in processes of their own, of which one takes long."""
    folder = tmp_path / "experiments"
    folder.mkdir()
    monkeypatch.setattr(reproduce_findings, "data_folder", lambda _: folder)
    write(folder, 1, ("one", "uno"))
    write(folder, 2, ("two",), "OWN_PROCESS = True")
    write(folder, 3, ("three",), "OWN_PROCESS = True\nLONG = True")
    write(folder, 4, ("four",))
    return folder


def write(folder, number, ids, constants="", before="pass"):
    text = SCRIPT.format(number=number, ids=ids, constants=constants, before=before)
    (folder / f"e{number:02}_script.py").write_text(text)


def measured(findings):
    return {finding.id: finding.measured for finding in findings}


def processes(folder):
    return {path.stem: int(pd.read_parquet(path)["process"].iloc[0]) for path in folder.glob("*.parquet")}


def test_the_same_findings_with_any_number_of_workers(scripts, tmp_path):
    alone = reproduce(None, 5, 3, 1, tmp_path / "alone", long=True)
    beside = reproduce(None, 5, 3, 2, tmp_path / "beside", long=True)
    assert [finding.id for finding in beside] == ["one", "uno", "two", "three", "four"]
    assert beside == alone
    assert (tmp_path / "alone/findings.json").read_bytes() == (tmp_path / "beside/findings.json").read_bytes()
    assert set(processes(tmp_path / "alone").values()) == {os.getpid()}
    where = processes(tmp_path / "beside")
    assert where["table1"] == where["table4"] == os.getpid()
    assert len({where["table2"], where["table3"], os.getpid()}) == 3


@pytest.mark.parametrize(
    "only, long, expected",
    [
        (None, False, ["one", "uno", "two", "four"]),
        (["e03_script", "uno"], False, ["uno", "three"]),
        (["e01_script"], False, ["one", "uno"]),
        (None, True, ["one", "uno", "two", "three", "four"]),
        (["three"], False, ["three"]),
        (["four", "uno"], False, ["uno", "four"]),
    ],
)
def test_long_scripts_wait_to_be_asked_for(scripts, tmp_path, only, long, expected):
    assert list(measured(reproduce(only, 5, 0, 1, tmp_path / "out", long=long))) == expected


def test_what_was_not_run_is_listed_with_how_to_run_it(scripts, tmp_path):
    write(scripts, 5, ("five", "cinq"), "NOT_SHIPPED = 'images of a drive'")
    write(scripts, 6, (), "NOT_SHIPPED = 'a log'")
    write(scripts, 7, ("seven",), "NEEDS = 'OpenCV'", "return []")
    reproduce(None, 5, 0, 1, tmp_path / "short")
    reproduce(None, 5, 0, 1, tmp_path / "all", long=True)
    reproduce(["one"], 5, 0, 1, tmp_path / "one")
    listed = {name: read_manifest(tmp_path / name)["not_run"] for name in ("short", "all", "one")}
    assert {entry["experiment"]: entry["how"] for entry in listed["short"]} == {
        "e03_script": "consistency reproduce --only e03_script",
        "e05_script": "python experiments/e05_script.py --data DIR --out DIR; not shipped: images of a drive",
        "e06_script": "python experiments/e06_script.py --data DIR --out DIR; not shipped: a log",
        "e07_script": "consistency reproduce --only e07_script; needs OpenCV",
    }
    assert [entry["findings"] for entry in listed["short"]] == ["three", "five, cinq", "", "seven"]
    assert {entry["question"] for entry in listed["short"]} == {"A question."}
    assert [entry["experiment"] for entry in listed["all"]] == ["e05_script", "e06_script", "e07_script"]
    assert listed["one"] == []


@pytest.mark.parametrize(
    "name, said",
    [
        ("e05_script", r"its data are not shipped; python .*e05_script\.py --help"),
        ("cinq", "its data are not shipped"),
        ("e99", "no such finding or experiment; known: one, uno"),
    ],
)
def test_what_cannot_be_reproduced_is_refused(scripts, tmp_path, name, said):
    write(scripts, 5, ("five", "cinq"), "NOT_SHIPPED = 'images of a drive'")
    with pytest.raises(InputError, match=f"--only {name}: {said}"):
        reproduce([name], 5, 0, 1, tmp_path / "out")


def test_the_report_lists_what_was_not_run(scripts, tmp_path):
    reproduce(None, 5, 0, 1, tmp_path / "out")
    chapter = next(each for each in compose(build_report(tmp_path / "out")).chapters if each.anchor == "findings")
    for shown in (chapter.blocks, chapter.on_paper):
        _, heading, table = shown
        assert heading == Heading("Not run")
        ((_, rows),) = table.groups
        assert rows == (("e03_script", "A question.", "three", "consistency reproduce --only e03_script"),)
    manifest = tmp_path / "out/manifest.json"
    content = json.loads(manifest.read_text())
    for broken in (["three"], [{"experiment": "e03"}], 7, {"a": 1}):
        manifest.write_text(json.dumps(content | {"not_run": broken}))
        with pytest.raises(InputError, match=r"manifest\.json: key 'not_run'"):
            compose(build_report(tmp_path / "out"))


@pytest.mark.parametrize(
    "source, verdict, status, said",
    [
        ("Herath 2007", "reproduced", 0, ""),
        ("Herath 2007", "not shown", 0, "not shown: one"),
        ("Herath 2007", "not reproduced", 1, "not reproduced: one"),
        ("Herath 2007", "refuted", 1, "refuted: one"),
        ("this project", "not shown", 0, "not shown: one"),
        ("this project", "not reproduced", 0, "not shown: one"),
        ("this project", "refuted", 0, "refuted: one (conjectures of this project, which may be refuted: no failure)"),
    ],
)
def test_exit_status_of_each_verdict(tmp_path, monkeypatch, capsys, source, verdict, status, said):
    text = dict.fromkeys(("claim", "statistic", "published", "measured", "accept"), "text")
    finding = replace(Study(jobs=1).finding(None, "none", id="one", source=source, **text), verdict=verdict)
    monkeypatch.setattr(module, "reproduce", lambda *_: [finding])
    monkeypatch.setattr("consistency.bench.pages.write_reports", lambda *_, **__: ())
    ended = 0
    try:
        reproduce_command(["one"], jobs=1, out=tmp_path)
    except typer.Exit as exit_:
        ended = exit_.exit_code
    assert ended == status
    assert capsys.readouterr().err.strip() == said


def test_the_terminal_lists_what_was_not_run(scripts, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("consistency.bench.pages.write_reports", lambda *_, **__: ())
    reproduce_command(None, jobs=1, out=tmp_path / "out")
    assert "consistency reproduce --only e03_script" in " ".join(capsys.readouterr().out.split())


def test_a_finding_of_none_is_not_shown():
    text = dict.fromkeys(("id", "source", "claim", "statistic", "published", "measured", "accept"), "text")
    verdicts = [Study(jobs=1).finding(holds, "none", "refuted", **text).verdict for holds in (True, False, None)]
    assert verdicts == ["reproduced", "refuted", "not shown"]


def test_scripts_are_said_as_they_begin(scripts, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(module, "WAITING", 0.2)
    said = "import time; from consistency.referee.system import say; say('inside'); time.sleep(1)"
    write(scripts, 2, ("two",), "OWN_PROCESS = True", said)
    reproduce(["one", "two"], 5, 0, 2, tmp_path / "out")
    lines = capfd.readouterr().err.splitlines()
    assert lines[:2] == ["[1 of 2] e01_script: A question.", "[2 of 2] e02_script: A question."]
    assert lines[2].startswith("still at it in a process of its own")
    assert "inside" not in lines


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_script_that_breaks_is_a_finding(scripts, tmp_path, jobs):
    write(scripts, 2, ("two",), "OWN_PROCESS = True", "raise ZeroDivisionError('no')")
    findings = {finding.id: finding for finding in reproduce(None, 5, 0, jobs, tmp_path / "out")}
    assert findings["two"].verdict == "not reproduced"
    assert findings["two"].measured == "ZeroDivisionError: no"
    assert findings["four"].verdict == "reproduced"


def test_a_process_that_dies_is_a_finding(scripts, tmp_path):
    write(scripts, 2, ("two",), "OWN_PROCESS = True", "os._exit(7)")
    found = measured(reproduce(["two", "four"], 5, 0, 2, tmp_path / "out"))
    assert found["two"].startswith("TerminatedWorkerError: ")
    assert "EXIT(7)" in found["two"]
    assert found["four"] != found["two"]


@pytest.mark.parametrize("jobs", [1, 2])
def test_unusable_input_ends_everything(scripts, tmp_path, jobs):
    write(scripts, 2, ("two",), "OWN_PROCESS = True", "raise InputError('file.toml: key x')")
    with pytest.raises(InputError, match=r"file\.toml: key x"):
        reproduce(None, 5, 0, jobs, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_script_apart_runs_no_filter(scripts):
    write(scripts, 2, ("two",), "OWN_PROCESS = True", "study.kept['world'] = None")
    with pytest.raises(ValueError, match="OWN_PROCESS is for scripts that run no filter"):
        module._contribution(str(scripts / "e02_script.py"), 5, 0, 1)


def test_jobs_out_of_range():
    with pytest.raises(InputError, match="jobs must be at least 1, or -1"):
        Study(jobs=0)


def test_processes_end_with_the_work(scripts, tmp_path):
    """As Ctrl-C does it: the process of the long script is not waited for."""
    mark = tmp_path / "started"
    before = f"import pathlib, time; pathlib.Path({str(mark)!r}).write_text(str(os.getpid())); time.sleep(120)"
    write(scripts, 3, ("three",), "OWN_PROCESS = True", before)
    wait = f"import pathlib, time\n    while not pathlib.Path({str(mark)!r}).exists(): time.sleep(0.1)\n"
    write(scripts, 4, ("four",), before=wait + "    raise KeyboardInterrupt")
    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        reproduce(["three", "four"], 5, 0, 2, tmp_path / "out")
    assert time.monotonic() - begun < 60
    with pytest.raises(ProcessLookupError):
        os.kill(int(mark.read_text()), 0)


def test_what_nobody_published_holds_or_does_not():
    from consistency.bench.types import outcome

    assert [outcome("Herath 2007", verdict) for verdict in ("reproduced", "refuted")] == ["reproduced", "refuted"]
    assert outcome("this project, measured", "reproduced") == "holds"
    assert outcome("this project", "refuted") == "refuted"
    assert outcome("this project", "not reproduced") == "not shown"


@pytest.mark.parametrize("content", ["{}", "[1]", '[{"id": "one"}]', '[{"other": 1}]'])
def test_findings_of_other_keys_are_refused(tmp_path, content):
    (tmp_path / "findings.json").write_text(content)
    with pytest.raises(InputError, match=r"findings\.json: not a list of findings"):
        module.read_findings(tmp_path)
