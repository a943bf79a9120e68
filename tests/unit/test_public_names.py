"""Public names: each stands in a plain module, all of the documents are among them, and they cross processes."""

import pickle
import pkgutil
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import consistency

ROOT = Path(__file__).parents[2]
NAMES = {  # module -> its public names; also those of CONTRACT.md, of docs/api, of the documents and of the gallery
    "consistency": """
        Alarm BoundCorrection Compared Control Correction Drive Finding Gaussian Info InputError Inspection Log
        Monitor NoiseModel Observation Record Results Scenario Study Trial Tuning Verdict analyse anees anees_interval
        compare correct drive_of filter_names fit_covariance get_filter guarded inspect judge load_scenario
        make_record monte_carlo nees plan read read_drives read_log read_results run_trials scenario_names simulate tune
        verdict_table""",
    "consistency.challenging": "Challenge Plan challenge",
    "consistency.diagnostics": """
        Alarm Answer Band Bound BoundErrors Comparison Design Difference EProcess EarlyEnds Ensemble Equivalence
        Errors Evidence GateShare Hotelling Independence InnovationRecord Interval JointNees Largest Map MapRecord
        MapScore MeanTest Monitor NisTest Normality Origin Outlier PilotPlan Pit RatioTable Record RejectionScore
        Rejections RunSummary Runs Settings Skip Truth TruthFit Verdict Whiteness anees anees_interval answers
        chi2_mean_interval clustered_share compare coverage coverage_interval detectable_ratio e_process early_ends
        equivalence ever follow gate_runs hotelling identity_statistic independence judge largest_direction look
        lost_bound lost_runs make_record map_score mean_shape mean_test nees nis_of nis_test nis_whiteness
        noncredibility normality outliers pilot_plan pit power_of ratio_interval rejection_score required_runs rmse
        sequential_design simultaneous_band speaks sphericity spread_steps standardise summary t_squared whiten
        whiteness""",
    "consistency.errors": "InputError MissingPackageError",
    "consistency.filters": "filter_names filter_summaries get_filter guarded usable_names",
    "consistency.imaging": """
        Biases Camera Chain Growth Lens StereoCamera Stops TrackMeans Tracks bias_map disparity_growth stand
        track_means""",
    "consistency.protocols": "Filter Problem TrialTruth WholeTrial",
    "consistency.runs": """
        Interrupted Study executor_for read_findings reproduce run_log run_trials run_until_decided""",
    "consistency.scenario": """
        Belief BelievedMotion BelievedSensor BiasMap DisparityGrowth Distortion GuardSettings LocalBias Mount Scenario
        SigmaPoints TrueSensor Truth UvdSensor load_scenario scenario_names scenario_text""",
    "consistency.store": "Log Results StoredResults open_results read_log read_results write_log",
    "consistency.sweeps": "CellResult Regime read_regime",
    "consistency.testing": """
        ConsistencyError InsufficientTrials assert_consistent assert_not_worse assert_program_consistent""",
    "consistency.tuning": "Factor Setting Tuning tune",
    "consistency.types": "Control Estimates Failure Finding Gaussian Info Map Observation Ratio Trial",
    "consistency.vision": """
        ConsensusError ConvergenceError DegenerateError GimbalLockError PointError Refined RelativeMotion RelativePose
        SharedError StereoRig compose fit_shared implicit_covariance invert read_image read_sequence refine_reprojection
        register_horn register_ransac register_svd register_weighted registration_covariance relative_motion
        sensitivities trajectory triangulable triangulate triangulation_covariance""",
}
PUBLIC = {f"{module}.{name}" for module, names in NAMES.items() for name in names.split()}


@pytest.mark.parametrize("module", NAMES)
def test_a_module_has_its_names_and_no_others(module):
    found = import_module(module)
    assert sorted(found.__all__) == sorted(NAMES[module].split())
    assert all(getattr(found, name) is not None for name in found.__all__)


def test_stub_and_package_have_the_same_names():
    """``__init__.pyi`` says to type checkers where ``__init__.py`` finds each name."""
    stub = Path(consistency.__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    lines = re.findall(r"^from \.(\S+) import (\w+) as \2$", stub, re.MULTILINE)
    assert {name: module for module, name in lines} == consistency._MODULES
    with pytest.raises(AttributeError, match="consistency attribute nonsense"):
        _ = consistency.nonsense  # type: ignore[attr-defined]


def written_names(text):
    """Names of the package that a document lists in the reference, imports, or takes from ``cs``."""
    names, module = set(), ""
    for line in text.splitlines():
        if found := re.match(r"\.\. (currentmodule|auto(?!module)\w+):: (\S+)", line):
            kind, name = found.groups()
            if kind == "currentmodule":
                module = name
            else:
                names.add(name if name.startswith("consistency") else f"{module}.{name}")
    for module, several, one in re.findall(r"^from (consistency\S*) import (?:\(([^)]*)\)|(.*))", text, re.MULTILINE):
        words = re.sub(r"#.*", "", several or one).split(",")
        names |= {f"{module}.{word.split(' as ')[0].strip()}" for word in words if word.strip()}
    names |= {f"consistency.{name}" for name in re.findall(r"\bcs\.(\w+)", text)}
    return names | set(re.findall(r"`(consistency(?:\.\w+)+)`", text))


def is_inside(name):
    """Whether a name is that of a root's own code, which whoever extends the bench reads."""
    return name.split(".")[1] in {"bench", "commands", "referee", "stereo"}


PLACES = ("README.md", "docs/*.md", "docs/reference/*.md", "docs/api/*.md", "docs/gallery/*.py", "docs/examples/*.py")
PAGES = [path for pattern in PLACES
         for path in sorted(ROOT.glob(pattern))]  # fmt: skip


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_names_in_a_document_are_public(page):
    names = {name for name in written_names(page.read_text(encoding="utf-8")) if not is_inside(name)}
    assert names - PUBLIC - NAMES.keys() == set()


def test_names_in_documents_are_seen():
    text = (
        ".. currentmodule:: consistency.vision\n.. autofunction:: a\n.. autoclass:: consistency.b\n"
        "from consistency.c import (\n    d as e,\n    f,  # why\n)\nfrom consistency.g import h, i  # why\ncs.j(1)\n"
        "`consistency.k.l`\n"
    )
    expected = "vision.a b c.d c.f g.h g.i j k.l"
    assert written_names(text) == {f"consistency.{name}" for name in expected.split()}
    assert len(PAGES) > 50
    assert sum(len(written_names(page.read_text(encoding="utf-8"))) for page in PAGES) > 200


@pytest.mark.parametrize("name", ["recording", "reporting", "simulation", "vision.motion", "diagnostics.records"])
def test_names_of_before_are_not_found(name):
    with pytest.raises(ModuleNotFoundError):
        import_module(f"consistency.{name}")


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_a_public_name_has_one_home(name):
    """A pickle names the module of a class or function, from which another process must get the same object."""
    value = pkgutil.resolve_name(name)
    if callable(value) and not getattr(value, "_is_protocol", False):
        assert pickle.loads(pickle.dumps(value)) is value


def test_a_public_module_without_its_packages_names_the_extra():
    code = (
        "import sys\nsys.modules |= dict.fromkeys(['joblib'])\n"
        "try:\n    import consistency.runs\nexcept ImportError as error:\n    print(type(error).__name__, error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.startswith("MissingPackageError consistency.runs needs joblib: pip install ")
