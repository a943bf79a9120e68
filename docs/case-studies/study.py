"""What the case studies share: draw, judge beside a control, argue a second time, and keep the verdicts.

A script defines a :class:`Case` and calls its ``main``; ``python docs/case-studies/SCRIPT.py`` prints the verdicts.
docs/case-studies.md says what is judged and why.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import consistency as cs
from consistency import Verdict

SEED, LARGEST_ARCHIVE = 20070, 100_000  # bytes
SETTINGS = {"false_alarm": 0.01, "detect": 1.5, "power": 0.95}
Rows = dict[str, tuple[Any, Any]]  # name -> errors (runs, [steps,] n), their covariances or deviations


@dataclass(frozen=True)
class Argument:
    """A second reason for what a verdict says of ``row``: what was worked out, and what it has to be.

    Without ``expected`` it is a ratio of true to stated covariance, of the whole or of one axis, to be compared with
    the measured one.
    """

    row: str
    text: str
    found: Any
    expected: Any = None
    rtol: float = 1e-4  # of the largest entry
    axis: str | None = None

    def told(self, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
        what = {"row": self.row, "text": self.text, "axis": self.axis}
        if self.expected is None:
            (row,) = (each for each in rows if each["row"] == self.row)
            value, low, high = row["axes"][self.axis] if self.axis else row["ratio"]
            beyond = 1.7 * np.log(high / low) / 2  # 99.9 % in place of 95 %
            return {**what, "agrees": bool(abs(np.log(self.found / value)) <= beyond), "found": brief(self.found)}
        found, expected = np.asarray(self.found, float), np.asarray(self.expected, float)
        difference = float(np.abs(found - expected).max() / np.abs(expected).max())
        numbers = {} if found.ndim else {"found": brief(found), "expected": brief(expected)}
        difference = {"agrees": difference <= self.rtol, "difference": float(f"{difference:.2g}"), "allowed": self.rtol}
        return {**what, **difference, **numbers}


@dataclass(frozen=True)
class Case:
    """A library and a question: ``simulate`` draws from the model that ``judged`` and ``control`` are told."""

    library: str  # a distribution, whose version is kept
    axes: Sequence[str]
    runs: int  # as many as `consistency plan` asks for, or more
    simulate: Callable[[np.random.Generator, int], Any]
    judged: Callable[[Any], Rows]
    control: Callable[[Any], Rows]
    second: Callable[[], list[Argument]] = list

    def main(self) -> None:
        """Print verdicts and second arguments; with --out keep them, with --rates count what the controls are told."""
        parser = argparse.ArgumentParser()
        parser.add_argument("--out", type=Path, help="JSON file for the verdicts")
        parser.add_argument("--archives", type=Path, help="folder for the draws of this version")
        parser.add_argument("--rates", type=int, help="draws of the controls, whose faults are counted")
        asked = parser.parse_args()
        found = self.rates(asked.rates) if asked.rates else self.study(asked.archives)
        if asked.out:
            asked.out.write_text(json.dumps(found), "utf-8")
        else:
            print(*self.lines(found), sep="\n")

    def study(self, archives: Path | None = None) -> dict[str, Any]:
        began = time.process_time()
        data = self.simulate(np.random.default_rng(SEED), self.runs)
        spent, rows = [time.process_time() - began], []
        for role, draw in (("judged", self.judged), ("control", self.control)):
            for name, arrays in draw(data).items():
                errors, stated, axes = self.rounded(*arrays)
                rows.append({"row": name, "role": role, **told(verdict(name, errors, stated, axes))})
                if archives:
                    keep(archives, archive(Path(sys.argv[0]).stem, self.version, name), errors, stated, axes)
            spent.append(time.process_time() - began)
        arguments = [each.told(rows) for each in self.second()]
        return {
            "library": self.library, "version": self.version, "python": platform.python_version(), "rows": rows,
            "arguments": arguments, "seconds": round(time.process_time() - began, 1),
            "control_seconds": round(spent[0] + spent[2] - spent[1], 2),
        }  # fmt: skip

    def rates(self, draws: int) -> dict[str, Any]:
        """Draws of each control in which a fault was found; cases that share a control draw other random numbers."""
        faults: dict[str, int] = {}
        began = time.process_time()
        own = f"{Path(sys.argv[0]).stem} {self.version}".encode()
        for seed in np.random.SeedSequence((SEED + 1, *own)).spawn(draws):
            rng = np.random.default_rng(seed)
            for name, arrays in self.control(self.simulate(rng, self.runs)).items():
                found = verdict(name, *self.rounded(*arrays))
                fault = found.status not in ("consistent", "undecided")
                faults[name] = faults.get(name, 0) + fault
        return {
            "version": self.version, "draws": draws, "faults": faults,
            "seconds": round((time.process_time() - began) / draws, 2),
        }  # fmt: skip

    def rounded(self, errors: Any, stated: Any) -> tuple[Any, Any, Sequence[str]]:
        """Errors, covariances or deviations as (runs, steps, ...), rounded as in an archive; names of the axes."""
        e, stated = np.float32(errors), np.float32(stated)
        if e.ndim == 2:
            e, stated = e[:, None], stated[:, None]
        n = e.shape[-1]
        return e, stated, tuple(self.axes) if len(self.axes) == n else tuple(f"axis {k}" for k in range(n))

    @property
    def version(self) -> str:
        return version(self.library)

    @staticmethod
    def lines(found: dict[str, Any]) -> Iterator[str]:
        yield " ".join(str(found[key]) for key in ("library", "version") if key in found)
        for each in found.get("rows", ()):
            numbers = {each["row"]: each["ratio"], **each["axes"]}
            ratios = "; ".join(f"{name} {v:.3g} [{low:.3g}, {high:.3g}]" for name, (v, low, high) in numbers.items())
            yield f"  {each['role']}: true / stated of {ratios}: {each['sentence']}"
        for each in found.get("arguments", ()):
            number = each["found"] if "found" in each else f"difference {each['difference']}"
            says = f"{'yes' if each['agrees'] else 'no'}, {number}"
            yield f"  second argument, {each['row']}: {each['text']}: {says}"
        for row, count in found.get("faults", {}).items():
            yield f"  {row}: {count} of {found['draws']} draws found at fault"


def verdict(name: str, errors: Any, stated: Any, axes: Sequence[str]) -> Verdict:
    """The verdict on errors (runs, steps, n) with covariances (runs, steps, n, n) or deviations (runs, steps, n).

    A run with an impossible value fails from there on.
    """
    stated = np.asarray(stated, float)
    alone = stated.ndim == 3  # no cross terms: each component by itself
    given = {"deviations": stated} if alone else {"covariances": 0.5 * (stated + np.swapaxes(stated, -1, -2))}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return cs.judge(errors, **given, axes=axes, name=name, **SETTINGS)


def told(found: Verdict) -> dict[str, Any]:
    """What is kept of a verdict."""
    axes = {} if found.axes is None else {name: brief(interval) for name, interval in found.axes.inflation.items()}
    dof = 0 if found.scale is None else found.scale.dof
    return {
        "runs": found.runs, "steps": found.steps, "failed": len(found.failures), "status": found.status,
        "dof": dof // (len(found.parts) or 1), "parts": len(found.parts) or 1,
        "ratio": brief([found.inflation, *found.inflation_interval]), "axes": axes, "sentence": found.reasons[0],
    }  # fmt: skip


def brief(values: Any) -> Any:
    """Numbers with six digits, for JSON; nested lists as they are."""
    array = np.asarray(values, float)
    return [brief(each) for each in array] if array.ndim else float(f"{array:.6g}")


def archive(case: str, version: str, row: str) -> str:
    """File name of the draws of a row."""
    return f"{case}-{version}-{row}.npz".replace(" ", "-").replace(":", "").replace(",", "")


def keep(folder: Path, name: str, errors: Any, stated: Any, axes: Sequence[str]) -> None:
    folder.mkdir(exist_ok=True)
    path = folder / name
    key = "covariances" if stated.ndim == 4 else "deviations"
    np.savez_compressed(path, errors=errors, **{key: stated}, axes=list(axes))
    if path.stat().st_size > LARGEST_ARCHIVE:
        raise SystemExit(f"{path}: has {path.stat().st_size} bytes, {LARGEST_ARCHIVE} are allowed; judge fewer steps")
