"""A program of a few lines of shell as an estimator under test, and tables that it writes by the number of its run."""

import numpy as np

STEPS = 4


def write_tables(folder, runs, scale=1.0, name="tables"):
    """``name``/0.csv, 1.csv, ...: estimates of a, b, c whose errors have ``scale`` times the stated variance."""
    draws = np.random.default_rng(3)
    (folder / name).mkdir()
    for run in range(runs):
        truth = draws.normal(size=(STEPS, 3)).cumsum(axis=0)
        estimate = truth - np.sqrt(0.25 * scale) * draws.normal(size=(STEPS, 3))
        lines = ["step,a,b,c,true_a,true_b,true_c,P_a_a,P_a_b,P_a_c,P_b_b,P_b_c,P_c_c"]
        for step in range(STEPS):
            numbers = [*estimate[step], *truth[step], 0.25, 0, 0, 0.25, 0, 0.25]
            lines.append(",".join(map(str, [step + 1, *numbers])))
        (folder / name / f"{run}.csv").write_text("\n".join(lines) + "\n")


def script(folder, text, name="filter"):
    """An executable shell script."""
    path = folder / name
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


COPY = 'cp "$CONSISTENCY_HERE/tables/$1.csv" estimates.csv'
