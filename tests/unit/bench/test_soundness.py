"""Results folders that were changed: refused unless every run of every filter is there, step by step, each once."""

import numpy as np
import pandas as pd
import pytest
from edited import change_manifest
from hostile import RUNS, write_results
from mutations import copied

import consistency as cs


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sound") / "results"
    write_results(folder, np.random.default_rng(4))
    return folder


@pytest.fixture
def folder(written, tmp_path):
    return copied(written, tmp_path / "copy")


def change(folder, name, edit):
    path = folder / f"{name}.parquet"
    edit(pd.read_parquet(path)).to_parquet(path, index=False)


def only(condition):
    return lambda table: table.query(condition)


def value(condition, column, new):
    def edit(table):
        table.loc[table.query(condition).index, column] = new
        return table

    return edit


def twice(table):
    return table.iloc[[0, *range(len(table))]]


def test_what_was_written_is_accepted(folder):
    assert cs.read_results(folder).filters == ["one", "two"]


TABLES = [
    ("estimates", twice, r"estimates\.parquet: step 1 of run 0 of 'one' is not what comes next"),
    ("estimates", only("run != 4 or filter != 'two'"), r"estimates\.parquet: run 4 of 'two' is missing"),
    ("estimates", only("filter == 'one'"), r"run 0 of 'two' is missing"),
    ("estimates", only("step < 12 or run != 1"), r"run 1 of 'one' has 11 steps, not 12"),
    ("estimates", only("step > 1 or run != 1"), r"step 2 of run 1 of 'one' is not what comes next"),
    ("estimates", only("run != 3 or step < 7 or filter == 'one'"), r"run 3 of 'two' has 6 steps, not 7"),
    ("estimates", value("run == 5 and step == 7", "step", 10**12), r"step 1000000000000 of run 5"),
    ("estimates", value("run == 5 and filter == 'one'", "run", 10**12), r"run 6 of 'one' is not what comes next"),
    ("estimates", value("filter == 'two' and run == 8", "filter", "three"), r"12 of 211 rows are of no filter"),
    ("estimates", value("filter == 'two' and run == 8", "run", 9), r"run 8 of 'two' is missing"),
    ("estimates", lambda t: t.drop(columns="P_xh"), r"column 'P_xh' is missing; needed: filter, run"),
    ("estimates", value("run == 5", "P_xx", np.nan), r"column 'P_xx', row \d+: not a finite number"),
    ("estimates", value("run == 5", "P_xx", np.inf), r"column 'P_xx', row \d+: not a finite number"),
    ("estimates", lambda t: t.assign(x="far"), r"estimates\.parquet: column 'x', row 0: not a"),
    ("truth", lambda t: t.assign(step=t["step"] + 0.5), r"column 'step', row 0: not a whole number \(0\.5\)"),
    ("truth", only("step <= 5"), r"truth\.parquet: run 0 has 5 steps, the scenario 12"),
    ("truth", only("run < 8"), r"counts 9 runs, the tables hold 8"),
    ("truth", twice, r"truth\.parquet: step 0 of run 0 is not what comes next"),
    ("truth", lambda t: t.iloc[::-1], r"truth\.parquet: step 12 of run 8 is not what comes next"),
    ("failures", only("run < 0"), r"failures\.parquet: has 0 rows, manifest\.json counts 1 failures"),
    ("failures", value("run == 3", "filter", "three"), r"failures\.parquet: 'three' is not a filter"),
    ("failures", value("run == 3", "step", 0), r"step 0: a run fails once"),
    ("failures", value("run == 3", "step", 13), r"has steps that truth\.parquet lacks"),
    ("failures", value("run == 3", "step", 9), r"run 3 of 'two' has 7 steps, not 8"),
    ("map", twice, r"map\.parquet: landmark 0 of run 0 of 'one' is duplicated"),
    ("map", value("filter == 'two' and run == 4", "run", 3), r"map\.parquet: 'two' has no finished run 3"),
    ("map", value("filter == 'two' and run == 4", "filter", "three"), r"map\.parquet: 5 of \d+ rows are of no filter"),
    ("rejections", only("run != 2"), r"rejections\.parquet: must have each run of 'two' once"),
    ("rejections", only("run < 0"), r"rejections\.parquet: has no rows"),
    ("rejections", twice, r"must have each run of 'two' once"),
    ("rejections", value("run == 2", "rejected", 50), r"counts of rejected observations"),
    ("rejections", value("run == 2", "rejected_spurious", 4), r"counts of rejected observations"),
    ("landmarks", twice, r"landmarks\.parquet: column 'landmark': a landmark is duplicated"),
]  # fmt: skip


@pytest.mark.parametrize("name, edit, said", TABLES)
def test_a_changed_table_is_refused(folder, name, edit, said):
    change(folder, name, edit)
    with pytest.raises(cs.InputError, match=said):
        cs.read_results(folder)


def singular_start(table):
    """Each run begins as those of the bench do: known exactly, without a NEES."""
    names = ["P_xx", "P_xy", "P_xh", "P_yy", "P_yh", "P_hh"]
    table.loc[table["step"] == 1, names] = 0.0
    table.loc[table["step"] == 1, "nees"] = np.nan
    return table


NUMBERS = [
    (value("filter == 'one' and run == 3", "nees", np.nan), r"'one', run 3: column 'nees' is null or NaN"),
    (value("filter == 'one' and run == 8 and step == 7", "nees", None), r"'one', run 8: column 'nees'"),
    (value("filter == 'one' and run == 2 and step == 12", "nees", np.nan), r"'one', run 2: column 'nees'"),
    (value("filter == 'one' and run == 2 and step == 2", "nees", np.nan), r"'one', run 2: column 'nees'"),
    (value("filter == 'one' and run == 5 and step < 9", "nees", np.nan), r"'one', run 5: column 'nees'"),
    (value("filter == 'one' and run == 4 and step == 6", "nis", np.nan), r"'one', run 4: column 'nis' is null"),
]


@pytest.mark.parametrize("edit, said", NUMBERS)
def test_a_missing_nees_or_nis_is_refused(folder, edit, said):
    """A run without a NEES would otherwise count as one that was never judged."""
    change(folder, "estimates", singular_start)
    assert set(cs.analyse(cs.read_results(folder))) == {"one", "two"}
    change(folder, "estimates", edit)
    with pytest.raises(cs.InputError, match=said):
        cs.analyse(cs.read_results(folder), ["one"])


def test_a_run_that_is_never_uncertain_has_no_nees(folder):
    def exact(table):
        table.loc[table["run"] == 3, [*(name for name in table if name.startswith("P_")), "nis_dof"]] = 0.0
        table.loc[table["run"] == 3, ["nees", "nis"]] = np.nan
        return table.astype({"nis_dof": int})

    change(folder, "estimates", exact)
    assert cs.analyse(cs.read_results(folder), ["one"])["one"].runs == RUNS


MANIFESTS = [
    ({"filters": "one"}, r"key 'filters': Input should be a valid list"),
    ({"filters": []}, r"key 'filters': "),
    ({"filters": ["one", "one"]}, r"key 'filters': .*a name is duplicated"),
    ({"filters": ["one", "two\u2028"]}, r"key 'filters': .*the name 'two\\u2028' has a control character"),
    ({"filters": ["one"]}, r"failures\.parquet: 'two' is not a filter"),
    ({"filters": ["one", "two", "three"]}, r"run 0 of 'three' is missing"),
    ({"complete": "yes"}, r"key 'complete'"),
    ({"complete": None}, r"key 'complete'"),
    ({"complete": False}, r"key 'finished_runs': missing"),
    ({"complete": False, "finished_runs": 4}, r"counts 4 runs, the tables hold 9"),
    ({"runs": 10}, r"counts 10 runs, the tables hold 9"),
    ({"runs": 2**63}, r"key 'runs'"),
    ({"complete": False, "finished_runs": RUNS, "runs": 5}, r"key 'runs' is 5, the tables hold run 8"),
    ({"tables": ["estimates", "failures"]}, r"key 'tables' lacks 'landmarks'"),
    ({"tables": "estimates"}, r"key 'tables'"),
    ({"seed": "a"}, r"key 'seed'"),
    ({"failures": 2}, r"failures\.parquet: has 1 rows, manifest\.json counts 2"),
    ({"optimal_gain": ["three"]}, r"key 'optimal_gain': 'three' is not a filter"),
    ({"scenario_hash": "0" * 16}, r"key 'scenario_hash' is not that of key 'scenario'"),
    ({"kind": "log"}, r"key 'kind'"),
    ({"contents": []}, r"manifest\.json: key 'contents' must have tables as keys"),
    ({"contents": {"poses": {}}}, r"key 'contents' must have tables as keys"),
    ({"contents": "all"}, r"key 'contents' must have tables as keys"),
    ({"versions": 5}, r"key 'versions'"),
]


@pytest.mark.parametrize("edit, said", MANIFESTS, ids=lambda value: str(value)[:40])
def test_a_changed_manifest_is_refused(folder, edit, said):
    change_manifest(folder, **edit)
    with pytest.raises(cs.InputError, match=said):
        cs.read_results(folder)


@pytest.mark.parametrize("key", ["filters", "tables", "runs", "failures", "complete", "seed", "kind"])
def test_a_manifest_without_a_key_is_refused(folder, key):
    change_manifest(folder, key)
    with pytest.raises(
        cs.InputError, match="holds no estimates" if key == "filters" else f"key '{key}': Field required"
    ):
        cs.read_results(folder)


def test_a_log_without_truth_has_runs_of_any_length(written, folder):
    """Of a log nothing but its filters says how long a run is."""
    tables = ["estimates", "failures", "map"]
    change_manifest(folder, scenario=None, scenario_hash=None, log="drive", tables=tables)
    for name in ("truth", "landmarks", "rejections"):
        (folder / f"{name}.parquet").unlink()
    change(folder, "estimates", only("run != 1 or step < 6"))
    assert cs.read_results(folder).truth is None
    change(folder, "estimates", only("run != 1 or step < 5 or filter == 'one'"))
    with pytest.raises(cs.InputError, match=r"run 1 of 'two' has 4 steps, not 5"):
        cs.read_results(folder)
