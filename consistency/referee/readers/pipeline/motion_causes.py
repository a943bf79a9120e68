"""Mix-ups of motions and of poses with cross-covariances, without which the errors of windows fit."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.readers.mix_ups.hints import Change, Pairs, hints
from consistency.referee.readers.pipeline.relative_motions import Stretch, windows_of
from consistency.referee.readers.truth_matching import Poses
from consistency.referee.readers.windows import Relative

SEARCHED = 20_000  # rows with truth, of all runs, in which mix-ups are looked for


def causes_of_motions(
    name: str, stretches: Sequence[Stretch], axes: Sequence[str], judged: Sequence[int], relative: Relative
) -> list[str]:
    """Mix-ups of motions, or of poses with cross-covariances, without which the errors of the windows fit."""
    most = SEARCHED // len(stretches)
    stretches = [replace(s, rows=s.rows[:most], truth=s.truth[:most]) for s in stretches]
    planar = len(axes) == 3
    runs = [
        Poses(
            s.place, s.t, s.estimate, s.covariance, np.ones(len(s.t), bool), s.t[s.rows], s.truth,
            "planar" if planar else "spatial", s.convention, 0.0,
        )
        for s in stretches
    ]  # fmt: skip

    def errors_without(change: Change) -> Pairs:
        found = []
        for s, p in zip(stretches, runs, strict=True):
            with np.errstate(invalid="ignore"), suppress(InputError):  # infinite covariances; no window fits
                q = change(p)
                cross = None if s.cross is None else change(replace(p, covariance=s.cross)).covariance
                s = replace(s, estimate=q.estimate, covariance=q.covariance, cross=cross, convention=q.convention)
                one = windows_of(replace(s, truth=q.truth), relative)
                found.append((one.error, one.covariance))
        return found

    return hints(name, axes, runs, judged=judged, errors_without=errors_without)
