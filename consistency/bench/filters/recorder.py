"""What a filter says in a run, written down as it goes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from consistency.bench.types import Estimates, Map
from consistency.referee.geometry.conventions import ADDITIVE
from consistency.referee.types import Array, Failure, Indices


@dataclass(frozen=True)
class RunRecord:
    """What a filter has said so far in a run, written as it goes; the arrays may lie where another process reads them.

    Rows are of steps 1..T. Those of the step in which the filter is may be half written.
    """

    at: Indices  # (1,), the step in which it is, 0 before the start
    pose: Array  # (T, 3)
    covariance: Array  # (T, 3, 3)
    own: Array  # (T, 3, 3), of its own error; of no meaning where that is the additive one
    nis: Array  # (T,)
    dof: Array  # (T,)
    log_det: Array  # (T,)
    rejected: Array  # (M,), bool

    @classmethod
    def empty(cls, steps: int, observations: int) -> RunRecord:
        """Room for one run."""
        at, rejected = np.zeros(1, np.int64), np.zeros(observations, bool)
        pose, covariance, own = (np.empty((steps, *shape)) for shape in ((3,), (3, 3), (3, 3)))
        nis, dof, log_det = (np.empty(steps) for _ in range(3))
        return cls(at, pose, covariance, own, nis, dof, log_det, rejected).begun()

    def begun(self) -> RunRecord:
        """The same arrays, as they are before the first step."""
        self.at[:], self.dof[:], self.rejected[:] = 0, 0, False
        for array in (self.pose, self.covariance, self.own, self.nis, self.log_det):
            array[:] = np.nan
        return self

    def estimates(
        self, name: str, run: int, error: str = ADDITIVE, *, reason: str = "", map_: Map | None = None,
        guarded: bool = False,
    ) -> Estimates:  # fmt: skip
        """Copies of what was said; with a ``reason`` the run has failed in the step in which it is."""
        step = max(int(self.at[0]), 1)
        failure = Failure(name, run, step, reason) if reason else None
        said = (self.pose, self.covariance, self.own, self.nis, self.dof, self.log_det)
        pose, covariance, own, nis, dof, log_det = (array.copy() for array in said)
        if failure is not None:
            for array in (pose, covariance, own, nis, log_det):
                array[step - 1 :] = np.nan
            dof[step - 1 :] = 0
        return Estimates(
            name, run, pose, covariance, nis, dof.astype(np.int64), failure, error, None if error == ADDITIVE else own,
            map_ if failure is None else None, self.rejected.copy() if guarded else None, log_det,
        )  # fmt: skip
