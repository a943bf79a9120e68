"""A recorded log without what leaves the common motion of its landmarks, for ``consistency run --log --screen``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd

from consistency.bench.store.log import Log
from consistency.referee.errors import InputError
from consistency.referee.types import Array
from consistency.stereo.visual_odometry.common_motion import screened


def screened_log(log: Log, gate: str | Array) -> Log:
    """A log in which landmarks begin anew where they leave the common motion; ``screening`` says how often.

    Parameters
    ----------
    gate : (s,) or text, greatest misfit of each value of an observation, in units of z

    Raises
    ------
    InputError
        ``gate`` is not one positive number for each value; the sensor is linear.
    """
    values = _numbers(gate) if isinstance(gate, str) else gate
    size = log.belief.sensor.size
    if values.shape != (size,) or not (np.isfinite(values) & (values > 0)).all():
        example = ",".join(["2", "2", "1"][:size])
        raise InputError(
            f"--screen {gate}: must be {size} positive numbers for a sensor '{log.belief.sensor.model}', as {example}"
        )
    found = screened(log.trials, log.belief, values)
    counts = {"offered": found.offered, "judged": found.judged, "broken": found.broken}
    screening = {"gate": values.tolist(), "scale": found.scale.tolist()} | counts
    landmarks, first = log.landmarks, found.trials[0]
    if landmarks is not None and first.landmarks is not None and first.labels is not None:
        places = dict(zip("xyz", first.landmarks.T, strict=True))
        seen = pd.DataFrame({"landmark": first.labels[: len(first.landmarks)]} | places)
        landmarks = pd.concat([landmarks, seen]).drop_duplicates("landmark", ignore_index=True)
    return replace(log, trials=found.trials, landmarks=landmarks, screening=screening)


def screening_line(log: Log) -> str:
    """What a screening found, for a terminal."""
    found = log.screening or {}
    gate, scale = (", ".join(f"{value:.2g}" for value in found[name]) for name in ("gate", "scale"))
    return (
        f"screen: {found['broken']} of {found['judged']} observations that follow another of their landmark leave the "
        f"common motion by more than {gate}; a landmark begins anew there (standard deviation of the rest: {scale})"
    )


def _numbers(text: str) -> Array:
    try:
        return np.array(text.split(","), float)
    except ValueError:
        return np.zeros(0)
