"""A table of the intervals of one model of a forecast hub, from the example data of scoringutils.

    python forecast_intervals.py example_quantile.rda hub.csv

The file is data/example_quantile.rda of github.com/epiforecasts/scoringutils; reading it takes pyreadr. A run is a week
in a place, and its steps are what was forecast of it: cases and deaths, one to three weeks ahead. Counts are taken as
logarithms, so that intervals grow about the median by a factor.
"""

import sys

import numpy as np
import pyreadr

QUANTILES = {0.25: "low50", 0.75: "high50", 0.05: "low90", 0.95: "high90", 0.5: "x"}


def main(source: str, target: str, model: str = "EuroCOVIDhub-baseline") -> None:
    (table,) = pyreadr.read_r(source).values()
    table = table[table.model == model].dropna(subset=["predicted", "observed"])
    one = ["location", "target_end_date", "target_type", "horizon", "observed"]
    table = table.astype(dict.fromkeys(one[:3], str))
    wide = table.pivot_table(index=one, columns="quantile_level", values="predicted", observed=True)
    wide = wide[list(QUANTILES)].rename(columns=QUANTILES).reset_index()
    wide["true_x"] = wide.pop("observed")
    numbers = ["true_x", *QUANTILES.values()]
    wide[numbers] = np.log1p(wide[numbers].astype(float).clip(lower=0.0))
    wide["run"] = wide.groupby(["location", "target_end_date"]).ngroup()
    wide["step"] = wide.groupby("run").cumcount() + 1
    wide.to_csv(target, index=False)


if __name__ == "__main__":
    main(*sys.argv[1:])
