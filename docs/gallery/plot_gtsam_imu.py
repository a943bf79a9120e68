"""
A factor before and after a correction
======================================

Twice the error of GTSAM's IMU factor at the truth, in 200 draws of the noise that it was told. Of a factor whose
covariance is right this is chi-square with 9 degrees of freedom (grey). In 4.2.1 it is three times as large;
:doc:`docs/case-studies.md </case-studies>` says why.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy import stats

import consistency as cs

DOCS = Path.cwd().parent if Path.cwd().name == "gallery" else Path("docs")
DOF, VERSIONS = 9, ("4.2.1", "4.3.0")

figure, panels = plt.subplots(1, 2, figsize=(7.2, 2.8), sharex=True, sharey=True, layout="constrained")
bins = np.geomspace(1, 400, 33)
for axes, version, color in zip(panels, VERSIONS, ("C1", "C0"), strict=True):
    record = cs.read(DOCS / f"case-studies/gtsam-{version}.npz")
    verdict = cs.judge(record)
    expected = len(record.run_numbers) * np.diff(stats.chi2.cdf(bins, DOF))
    axes.stairs(expected, bins, fill=True, color="0.85", label="expected")
    axes.hist(record.errors.nees.ravel(), bins, histtype="step", color=color, lw=1.6, label=f"gtsam {version}")
    low, high = verdict.inflation_interval
    axes.set_title(f"{verdict.status}: x{verdict.inflation:.2f} [{low:.2f}, {high:.2f}]", fontsize="medium")
    axes.set(xscale="log", xlim=(bins[0], bins[-1]), xlabel="twice the error of the factor at the truth")
    axes.set_xticks([1, 3, 9, 30, 100, 300], labels=["1", "3", "9", "30", "100", "300"])
    axes.minorticks_off()
    axes.legend(loc="upper right")
panels[0].set_ylabel(f"draws, of {len(record.run_numbers)}")
