"""Runs the case studies with the versions that they are about: ``make case-studies [ONLY="NAME ..."]``.

Makes an environment for each set of versions that fit together, .env-new and .env-old at the top of the checkout, and
keeps verdicts and versions in reports/reference/case-studies.json, from which page.py writes the page.
``--rates`` counts the faults that the controls are told of over many draws.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parents[1]
KEPT = ROOT / "reports/reference/case-studies.json"
TIMEOUT, SLOW = {False: 900, True: 4 * 3600}, 2.0  # s, of a case and of its rates; slower controls have fewer draws
OFTEN, SELDOM = 200, 40  # draws for the rates
SETS = {
    "new": ["pycolmap==4.2.1", "stonesoup==1.9.1", "filterpy==2.0.0", "gtsam==4.3.0", "pykalman==0.11.2", "ahrs==0.4.0",
            "opencv-python-headless==5.0.0.93", "scikit-learn==1.9.1", "statsmodels==0.15.0", "lmfit==1.3.4",
            "simdkalman==1.0.4", "dynamax==1.0.3", "pytransform3d==3.17.0"],
    "old": ["pycolmap==3.11.1", "numpy<2", "filterpy==1.4.5", "gtsam==4.2.1", "pykalman==0.10.1", "ahrs==0.3.1",
            "opencv-python-headless==4.6.0.66"],
}  # fmt: skip
OLD = (
    "pycolmap_pose",
    "filterpy_linear",
    "gtsam_combined",
    "gtsam_imu",
    "pykalman_varying",
    "ahrs_ekf",
    "opencv_calibration",
)
ARCHIVED = (  # of libraries that are not in [dev]
    "ahrs_ekf", "gpr_new_target", "least_squares_scaling", "pycolmap_centre", "pycolmap_pose", "pykalman_varying",
    "stonesoup_cubature",
)  # fmt: skip
ARCHIVED_OLD = ("filterpy_linear", "opencv_calibration")  # in [dev] in other versions


def cases() -> list[str]:
    return sorted(path.stem for path in FOLDER.glob("*.py") if "\nCASE = " in path.read_text("utf-8"))


def python() -> str:
    """A Python of 3.10 to 3.12, for which all versions have wheels."""
    pyenv = (Path.home() / ".pyenv/versions").glob("3.1[012].*/bin/python")
    named = [found for name in ("python3.11", "python3.12", "python3.10") if (found := shutil.which(name))]
    ask = "import ensurepip, sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 12))"
    for each in [sys.executable, *named, *map(str, sorted(pyenv, reverse=True))]:
        if subprocess.run([each, "-c", ask], capture_output=True, check=False).returncode == 0:
            return each
    print("the case studies need Python 3.10, 3.11 or 3.12 with venv, and none is found: install one", file=sys.stderr)
    raise SystemExit(2)


def environment(name: str) -> Path:
    """The Python of an environment with the core and a set of versions; made again if the set has changed."""
    where, done = ROOT / f".env-{name}", ROOT / f".env-{name}/versions"
    there = where / "bin/python"
    if not done.exists() or done.read_text() != str(SETS[name]):
        print(f"case studies: making .env-{name}, a minute or two", file=sys.stderr, flush=True)
        subprocess.run([python(), "-m", "venv", "--clear", where], check=True)
        # filterpy 1.4.5 has no wheel; it is Python alone
        install = (
            "-m pip install --quiet --disable-pip-version-check --no-compile --only-binary :all: --no-binary filterpy"
        )
        subprocess.run([there, *install.split(), "-e", ROOT, *SETS[name]], check=True)
        done.write_text(str(SETS[name]))
    return there


def study(case: str, name: str, options: list[str], scratch: Path, timeout: int) -> dict[str, Any]:
    """What a script keeps; or how it ended, which is a result as well."""
    out = scratch / f"{case}-{name}.json"
    threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
    command = [environment(name), FOLDER / f"{case}.py", "--out", out, *options]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=timeout, check=False, env=os.environ | threads
        )
    except subprocess.TimeoutExpired:
        return {"failed": f"took over {timeout} s"}
    if done.returncode or not out.exists():
        return {"failed": (done.stderr.strip().splitlines() or [f"status {done.returncode}"])[-1]}
    return json.loads(out.read_text("utf-8"))


def options_of(case: str, name: str, rates: bool, kept: dict[str, Any]) -> list[str]:
    if rates:
        seconds = kept["studies"].get(f"{case} {name}", {}).get("control_seconds", 0.0)
        return ["--rates", str(SELDOM if seconds > SLOW else OFTEN)]
    archived = case in ARCHIVED or (name == "old" and case in ARCHIVED_OLD)
    return ["--archives", str(FOLDER / "draws")] if archived else []


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("only", nargs="*", help=f"of {', '.join(cases())}")
    parser.add_argument("--rates", action="store_true")
    asked = parser.parse_args()
    unknown = set(asked.only) - set(cases())
    if unknown:
        print(f"no case study {', '.join(sorted(unknown))}; there are {', '.join(cases())}", file=sys.stderr)
        raise SystemExit(2)
    if Path(sys.prefix) != ROOT / ".env-new":  # which has the core, for the progress bar
        names = [environment(name) for name in SETS]
        raise SystemExit(subprocess.run([names[0], __file__, *sys.argv[1:]], check=False).returncode)
    from consistency.referee.system import progress, write_whole

    kept = json.loads(KEPT.read_text("utf-8")) if KEPT.exists() else {"studies": {}, "rates": {}}
    work = [(case, name) for case in asked.only or cases() for name in SETS if name == "new" or case in OLD]
    part = kept["rates" if asked.rates else "studies"]
    if not asked.only:
        part.clear()
    failed = []
    with (
        tempfile.TemporaryDirectory() as scratch,
        ThreadPoolExecutor(os.cpu_count()) as pool,
        progress("case studies", len(work), "cases") as advance,
    ):
        begun = {}
        for case, name in work:
            options = options_of(case, name, asked.rates, kept)
            begun[pool.submit(study, case, name, options, Path(scratch), TIMEOUT[asked.rates])] = case, name
        for done in as_completed(begun):
            case, name = begun[done]
            part[f"{case} {name}"] = found = done.result()
            failed += [f"{case} in .env-{name}: {found['failed']}"] if "failed" in found else []
            advance(1)
    kept |= {"studies" if not asked.rates else "rates": dict(sorted(part.items()))}
    kept["date"] = time.strftime("%Y-%m-%d")
    write_whole(KEPT, (json.dumps(kept, indent=1) + "\n").encode(), 0o644)
    print(*failed, sep="\n", end="\n" if failed else "", file=sys.stderr)
    raise SystemExit(1 if failed else 0)


if __name__ == "__main__":
    main()
