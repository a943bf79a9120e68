"""The one loop over a trial that all compiled filters share."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.filters.kernel.covariance import append_landmark
from consistency.filters.kernel.gain import NOT_FINITE, POSE
from consistency.filters.kernel.jit import Kernel, inner
from consistency.filters.kernel.linalg import definiteness_with
from consistency.filters.kernel.local_state import Factors
from consistency.filters.kernel.slam import (
    OBSERVED,
    Data,
    Slam,
    State,
    correct,
    insert_error,
    landmark_width,
    make_local,
    place,
    pose_covariance,
    predict,
    prepare,
    robot_width,
    settle,
)
from consistency.filters.kernel.work import Work, make_work
from consistency.types import Array, Indices


class Outcome(NamedTuple):
    """What a filter said of a trial of T steps; NaN from the step of a failure on."""

    pose: Array  # (T, r)
    covariance: Array  # (T, r, r), of the additive error
    own: Array  # (T, r, r), of the filter's own error
    nis: Array  # (T,)
    nis_dof: Indices  # (T,)
    step: int  # of the failure, or 0
    code: int  # of REASONS, or 0
    state: State  # after the last step


@inner
def _find_known(data: Data, k: int, offset: Indices, work: Work) -> int:
    """Observations of step k + 1 whose landmark is in the state, their offsets, and how many they are."""
    m = 0
    for i in range(data.first[k], data.first[k + 1]):
        label = data.landmark[i]
        if offset[label] >= 0:
            work.known[m], work.label[m], work.at[m] = i, label, offset[label]
            m += 1
    return m


@inner
def _insert_new(slam: Slam, state: State, data: Data, k: int, local: Factors, work: Work) -> State:
    """The state with the landmarks that step k + 1 sees for the first time."""
    r, w = robot_width(slam.motion), landmark_width(slam.landmark)
    x, P, n, base, offset = state.x, state.P, state.n, state.base, state.offset
    for i in range(data.first[k], data.first[k + 1]):
        label = data.landmark[i]
        if offset[label] < 0:
            offset[label] = n
            place(slam.point, slam, State(x, P, n, base, offset), k, label, data.z[i], work)
            insert_error(slam.error, x[:r], x[n : n + w], work.Jp)
            append_landmark(P, n, work.Jp, work.Jz, data.R[i])
            if base > 0:
                _append_factors(label, r, w, n, base, work.Jp, local)
            n += w
    return State(x, P, n, base, offset)


@inner
def _append_factors(label: int, r: int, w: int, n: int, base: int, Jp: Array, local: Factors) -> None:
    """A new landmark at ``n`` of the active part."""
    Phi = local.Phi
    for a in range(w):
        for j in range(base):
            total = 0.0
            for c in range(r):
                total += Jp[a, c] * Phi[c, j]
            Phi[n + a, j] = total
    local.label[(n - r) // w] = label


@inner
def _step(
    slam: Slam, state: State, data: Data, k: int, local: Factors, work: Work
) -> tuple[State, int, int, float]:
    """Step k + 1: predict, update, insert what is new; the state, a code of REASONS or 0, landmarks in the update, NIS."""
    predict(slam.update, slam, state, k, data.controls[k], local.Phi, work)
    m, nis = _find_known(data, k, state.offset, work), np.nan
    if m > 0:
        code, nis = correct(slam.update, slam, state, data, k, m, local, work)
        if code > 0:
            return state, code, 0, nis
    state = _insert_new(slam, state, data, k, local, work)
    return state, 0 if np.isfinite(state.x[: state.n].sum()) else NOT_FINITE, m, nis


@inner
def _most_seen(first: Indices) -> int:
    most = 0
    for k in range(len(first) - 1):
        most = max(most, first[k + 1] - first[k])
    return most


def run_trial(slam: Slam, data: Data, size: int) -> Outcome:
    """Filter a whole trial whose state grows to at most ``size`` variables."""
    T, r, w = len(data.controls), robot_width(slam.motion), landmark_width(slam.landmark)
    pose, covariance, own = np.full((T, r), np.nan), np.full((T, r, r), np.nan), np.full((T, r, r), np.nan)
    nis, nis_dof = np.full(T, np.nan), np.zeros(T, np.int64)
    x, P, offset = np.zeros(size), np.zeros((size, size)), np.full(data.n_landmarks, -1)
    work = make_work(slam, size, _most_seen(data.first))
    local = make_local(slam.covariance, r, w, size)
    x[:r] = data.start
    whole = State(x, P, r, 0, np.full(data.n_landmarks, -1))
    state = State(x, P, r, 0, offset)  # what a step works on: the whole, unless it has a base
    full_rank = False
    for k in range(T):
        labels = data.landmark[data.first[k] : data.first[k + 1]]
        state = prepare(slam.covariance, slam, whole, state, labels, local)
        state, code, m, value = _step(slam, state, data, k, local, work)
        if m > 0:
            nis[k], nis_dof[k] = value, OBSERVED * m
        if code == 0:
            own[k] = state.P[:r, :r]
            pose_covariance(slam.error, state.x[:r], own[k], covariance[k])
            rank = definiteness_with(covariance[k], work.small)
            pose[k] = state.x[:r]
            if rank < 0 or (full_rank and rank == 0):
                code, pose[k], covariance[k], own[k] = POSE, np.nan, np.nan, np.nan
            full_rank = full_rank or rank == 1
        if code > 0:
            return Outcome(pose, covariance, own, nis, nis_dof, k + 1, code, whole)
        n = whole.n
        for label in labels:
            if whole.offset[label] < 0:
                whole.offset[label] = n
                n += w
        whole = State(x, P, n, 0, whole.offset)
    settle(slam.covariance, slam, whole, state, local)
    return Outcome(pose, covariance, own, nis, nis_dof, 0, 0, whole)


trial_kernel = Kernel(run_trial)
