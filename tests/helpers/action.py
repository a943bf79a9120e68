"""The file of the GitHub Action, and whether steps that use it give inputs that it has."""

import re

import yaml
from documents import ROOT

FOLDER = ROOT / ".github/actions/consistency"
FILE = yaml.safe_load((FOLDER / "action.yml").read_text())
STEPS = FILE["runs"]["steps"]
STEP_KEYS = {"name", "id", "if", "shell", "run", "uses", "with", "env", "working-directory", "continue-on-error"}
ACTION = re.compile(r"(\.|OWNER/filter-consistency)/\.github/actions/consistency(@VERSION)?")


def require_uses(text):
    """The steps of a workflow, or of a part of one, that use the action; there must be one.

    Raises
    ------
    AssertionError
        A key or an input does not exist.
    """
    content = yaml.safe_load(text)
    steps = content
    if isinstance(content, dict):
        at_the_top = {"on" if key is True else key for key in content}  # which is how YAML 1.1 reads the key "on"
        assert {"on", "jobs"} <= at_the_top <= {"name", "on", "jobs", "permissions"}
        assert all("runs-on" in job for job in content["jobs"].values())
        steps = [step for job in content["jobs"].values() for step in job["steps"]]
    for step in steps:
        assert set(step) <= STEP_KEYS
        assert ("run" in step) != ("uses" in step)
    uses = [step for step in steps if ACTION.fullmatch(step.get("uses", ""))]
    assert uses
    for step in uses:
        assert set(step["with"]) <= set(FILE["inputs"])
    return uses
