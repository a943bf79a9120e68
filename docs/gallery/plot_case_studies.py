"""
Libraries and their covariances
===============================

Ratio of true to stated covariance for the cases of :doc:`docs/case-studies.md </case-studies>`, with 95 % intervals:
what was judged (purple; a triangle for the axis that decides), and a control on the same data (blue).
"""

import json
import sys
from pathlib import Path

import matplotlib.pyplot as plt

DOCS = Path.cwd().parent if Path.cwd().name == "gallery" else Path("docs")
sys.path.insert(0, str(DOCS / "case-studies"))
from page import APPROXIMATIONS, decisive  # noqa: E402 - in the folder above

studies = json.loads((DOCS.parent / "reports/reference/case-studies.json").read_text("utf-8"))["studies"]
parts = {"found at fault": [], "approximations": [], "consistent or undecided": []}
for key, study in studies.items():
    library = f"{study['library'].removesuffix('-python-headless')} {study['version']}"
    control = next(row for row in study["rows"] if row["role"] == "control")
    for row in study["rows"]:
        if row["role"] == "judged":
            passes = row["status"] in ("consistent", "undecided")
            part = list(parts)[2 if passes else int(key.split()[0] in APPROXIMATIONS)]
            parts[part].append((f"{library}: {row['row']}".replace("`", ""), row, control))
lines = [line for part, rows in parts.items() for line in ((part, None, None), *rows)]

figure, axes = plt.subplots(figsize=(7.6, 0.2 * len(lines) + 0.9), layout="constrained")
for k, (_, row, control) in enumerate(lines):
    if row is None:
        continue
    axis = decisive(row)
    bars = [(control["ratio"], "C0", "o", 0.15), (row["ratio"], "C1", "o", -0.15)]
    bars += [(row["axes"][axis], "C1", "^", -0.15)] if axis else []
    for (value, low, high), color, marker, aside in bars:
        axes.plot([low, high], [k + aside] * 2, color=color, lw=1.4)
        axes.plot(value, k + aside, marker, color=color, ms=4)
for color, marker, label in (("C1", "o", "judged"), ("C1", "^", "axis that decides"), ("C0", "o", "control")):
    axes.plot([], [], marker, color=color, ms=4, label=label)
figure.legend(loc="outside upper center", ncols=3)
axes.axvline(1.0, color="0.6", lw=0.8, zorder=0)
axes.set(xscale="log", xlim=(3e-4, 300), ylim=(len(lines) - 0.4, -0.6), xlabel="true / stated covariance")
axes.set_yticks(range(len(lines)), labels=[name for name, *_ in lines], fontsize=7)
for label, (_, row, _) in zip(axes.get_yticklabels(), lines, strict=True):
    label.set_fontweight("normal" if row else "bold")
axes.set_xticks([0.001, 0.01, 0.1, 1, 10, 100], labels=["0.001", "0.01", "0.1", "1", "10", "100"])
