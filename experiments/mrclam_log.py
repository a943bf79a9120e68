"""One robot of UTIAS MRCLAM as a planar log; why each step is there: docs/reference/recorded.md.

Leung, Halpern, Barfoot & Liu (2011), "The UTIAS multi-robot cooperative localization and mapping dataset",
IJRR 30(8). The first part of a recording is for calibration: the ground truth there says how odometry and camera are
wrong. The log is the rest, of which the truth is used for the start, for judging, and to drop wrong barcodes.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from consistency.bench.scenario import Belief, BelievedMotion, BelievedSensor, models
from consistency.bench.types import Trial
from consistency.referee.errors import InputError
from consistency.referee.types import Array, Indices

DT = 0.1  # s, a step: the robots turn by 0.06 rad in it at most
CALIBRATION = 300.0  # s at the beginning of a recording
CAMERA_LAG = 0.05  # s, by which the stamps of measurements are late: least spread of the bearing for each robot
WINDOW = 1.0  # s, over which odometry is compared with the truth
LAGS = np.arange(0.0, 0.45, 0.05)  # s, tried for the lag of the robot behind its odometry
GROSS = (1.0, 0.1)  # m, rad: a measurement farther from the truth is one of a wrong barcode
ROBOTS = 5  # subjects 1 to 5 are robots, the others landmarks


@dataclass(frozen=True)
class Recording:
    """Files of one robot; stamps in s of the same clock."""

    odometry: Array  # (K, 3): stamp, v in m/s, omega in rad/s
    measurements: Array  # (M, 4): stamp, barcode, range in m, bearing in rad
    truth: Array  # (N, 4): stamp, x, y in m, heading in rad, not wrapped
    landmarks: Array  # (L, 2), m
    barcodes: dict[int, int]  # landmark 0..L-1 by barcode

    @property
    def span(self) -> tuple[float, float]:
        """First and last stamp that odometry and truth share."""
        o, g = self.odometry[:, 0], self.truth[:, 0]
        return float(max(o[0], g[0])), float(min(o[-1], g[-1]))

    def pose(self, t: Array) -> Array:
        """True poses (T, 3) at stamps (T,), by interpolation."""
        return np.column_stack([np.interp(t, self.truth[:, 0], column) for column in self.truth[:, 1:].T])

    def travelled(self, t: Array) -> Array:
        """Way along the heading in m and heading in rad by raw odometry at stamps (T,); a value holds to the next."""
        stamp, rates = self.odometry[:, 0], self.odometry[:, 1:]
        total = np.vstack([np.zeros(2), np.cumsum(rates[:-1] * np.diff(stamp)[:, None], axis=0)])
        return np.column_stack([np.interp(t, stamp, column) for column in total.T])


class Calibration(NamedTuple):
    """What the first part of a recording says of odometry and camera."""

    lag: float  # s, of the robot behind its odometry
    scale_v: float  # true speed over that of odometry
    scale_omega: float
    bias_omega: float  # rad/s
    bias: Array  # (2,), of range in m and bearing in rad, measured less true
    motion: BelievedMotion
    sigma: tuple[float, float]  # m, rad


class Dropped(NamedTuple):
    """Measurements of landmarks after the calibration that are not in the log."""

    gross: int  # wrong barcodes
    repeated: int  # a landmark twice in one step
    kept: int


def read_robot(folder: Path, robot: int) -> Recording:
    """Files of one robot in a folder ``MRCLAM_DatasetN``.

    Raises
    ------
    InputError
        A file is missing, damaged, or has other columns.
    """
    odometry, measurements, truth = (
        _read(folder / f"Robot{robot}_{name}.dat", columns)
        for name, columns in (("Odometry", 3), ("Measurement", 4), ("Groundtruth", 4))
    )
    places = _read(folder / "Landmark_Groundtruth.dat", 5)
    number = {int(subject): i for i, subject in enumerate(places[:, 0])}
    pairs = _read(folder / "Barcodes.dat", 2).astype(int)
    barcodes = {int(barcode): number[int(subject)] for subject, barcode in pairs if subject > ROBOTS}
    truth[:, 3] = np.unwrap(truth[:, 3])
    return Recording(odometry, measurements, truth, places[:, 1:3], barcodes)


def _read(path: Path, columns: int) -> Array:
    """Numbers of a file, as the data are distributed or gzipped, with .gz at the end of the name."""
    packed = path.with_name(f"{path.name}.gz")
    if path.is_file() and packed.is_file():
        raise InputError(f"{packed}: stands beside {path.name}; take one of them away")
    path = path if path.is_file() or not packed.is_file() else packed
    try:
        rows = np.loadtxt(path, ndmin=2)
    except (OSError, ValueError, EOFError, zlib.error) as error:
        reason = "is missing" if not path.is_file() else f"cannot be read ({str(error).splitlines()[0]})"
        raise InputError(f"{path}: {reason}; it must be a file of UTIAS MRCLAM") from None
    if rows.shape[1] != columns or len(rows) < 2 or not np.isfinite(rows).all():
        raise InputError(f"{path}: must hold rows of {columns} finite numbers")
    return rows


def sights_of(data: Recording) -> tuple[Array, Indices, Array]:
    """Measurements of landmarks: stamps without the camera's lag (M,), landmarks (M,), range and bearing (M, 2)."""
    landmark = np.array([data.barcodes.get(int(code), -1) for code in data.measurements[:, 1]], np.int64)
    t = data.measurements[:, 0] - CAMERA_LAG
    keep = (landmark >= 0) & (t >= data.span[0]) & (t <= data.span[1])
    return t[keep], landmark[keep], data.measurements[keep, 2:]


def misfit(data: Recording, t: Array, landmark: Indices, z: Array) -> Array:
    """Measured less true range and bearing (M, 2)."""
    x, y, heading = data.pose(t).T
    dx, dy = (data.landmarks[landmark] - np.column_stack([x, y])).T
    distance, direction = models.range_bearing(dx, dy)
    turn = z[:, 1] - (direction - heading)
    return np.column_stack([z[:, 0] - distance, (turn + np.pi) % (2 * np.pi) - np.pi])


def is_gross(misfits: Array) -> Array:
    """Which of the misfits (M, 2) are of a wrong barcode."""
    return np.asarray((np.abs(misfits) > GROSS).any(axis=1))


def calibrate(data: Recording) -> Calibration:
    """Scale, bias, lag and noise of odometry, bias and noise of the camera, from the first part of the recording.

    The lag is that with the least error of the heading over windows; speed has a scale, the turn rate a scale and a
    bias, by least squares. The noise of a step is white and such that it adds up to the error that is left over a
    window: sigma = rms / sqrt(DT WINDOW). That of the camera is the rms of what is left without the bias.
    """
    first = data.span[0]
    ends = np.arange(first + LAGS[-1], first + CALIBRATION, WINDOW)
    way, turn = _true_motion(data, ends).T
    fits = []
    for lag in LAGS:
        v, omega = np.diff(data.travelled(ends - lag), axis=0).T
        A = np.column_stack([omega, np.full(len(omega), WINDOW)])
        (scale, bias), *_ = np.linalg.lstsq(A, turn, rcond=None)
        along = float(v @ way / (v @ v))
        errors = float(np.std(turn - A @ (scale, bias))), float(np.std(way - along * v))
        fits.append((errors, float(lag), along, float(scale), float(bias)))
    (turned, driven), lag, along, scale, bias = min(fits)
    t, landmark, z = sights_of(data)
    early = t < first + CALIBRATION
    misfits = misfit(data, t[early], landmark[early], z[early])
    misfits = misfits[~is_gross(misfits)]
    per_step = np.sqrt(DT * WINDOW)
    motion = BelievedMotion(sigma_v=driven / per_step, sigma_omega=turned / per_step)
    spread = misfits.std(axis=0)
    return Calibration(lag, along, scale, bias, misfits.mean(axis=0), motion, (float(spread[0]), float(spread[1])))


def _true_motion(data: Recording, ends: Array) -> Array:
    """Way along the heading and turn (N - 1, 2) of the truth between stamps (N,)."""
    pieces = round(WINDOW / DT)
    fine = np.linspace(ends[0], ends[-1], pieces * (len(ends) - 1) + 1)
    pose = data.pose(fine)
    dx, dy = np.diff(pose[:, :2], axis=0).T
    along = dx * np.cos(pose[:-1, 2]) + dy * np.sin(pose[:-1, 2])
    return np.column_stack([along.reshape(-1, pieces).sum(axis=1), np.diff(pose[::pieces, 2])])


def log_of(data: Recording) -> tuple[Trial, Belief, Calibration, Dropped]:
    """The recording after its calibration as one trial, and what a filter is to believe.

    A measurement between two steps is moved to the nearer one by odometry, which takes at most half a step.
    """
    found, (first, last) = calibrate(data), data.span
    stamps = np.arange(first + CALIBRATION, last - DT, DT)
    moved = _calibrated(data, found, stamps)
    controls = np.column_stack([np.full(len(stamps) - 1, DT), np.diff(moved, axis=0) / DT])
    t, landmark, z = sights_of(data)
    step = np.rint((t - stamps[0]) / DT).astype(np.int64)
    late = (step >= 1) & (step < len(stamps))
    t, landmark, z, step = t[late], landmark[late], z[late], step[late]
    gross = is_gross(misfit(data, t, landmark, z))
    at_step = _at(z - found.bias, _calibrated(data, found, t) - _calibrated(data, found, stamps[step]))
    rows = pd.DataFrame({"step": step, "landmark": landmark, "off": np.abs(t - stamps[step])})
    rows[["range", "bearing"]] = at_step
    kept = rows[~gross].sort_values("off").drop_duplicates(["step", "landmark"]).sort_values(["step", "landmark"])
    truth = data.pose(stamps)
    trial = Trial(
        run=0,
        start=truth[0],
        controls=controls,
        first=np.searchsorted(kept["step"], np.arange(1, len(stamps) + 1)),
        landmark=kept["landmark"].to_numpy(np.int64),
        z=kept[["range", "bearing"]].to_numpy(float),
        n_landmarks=len(data.landmarks),
        truth=truth,
        landmarks=np.column_stack([data.landmarks, np.zeros(len(data.landmarks))]),
    )
    sensor = BelievedSensor(model="range-bearing", sigma=found.sigma)
    dropped = Dropped(int(gross.sum()), len(rows) - int(gross.sum()) - len(kept), len(kept))
    return trial, Belief(motion=found.motion, sensor=sensor), found, dropped


def _calibrated(data: Recording, found: Calibration, t: Array) -> Array:
    """Way in m and heading in rad by calibrated odometry at stamps (T,)."""
    way, heading = data.travelled(t - found.lag).T
    return np.column_stack([found.scale_v * way, found.scale_omega * heading + found.bias_omega * t])


def _at(z: Array, since: Array) -> Array:
    """Range and bearing (M, 2) as seen ``since`` (M, 2) earlier, a way in m along the heading and a turn in rad."""
    x, y = models.at_range_bearing(z[:, 0], z[:, 1] + since[:, 1])
    return np.column_stack(models.range_bearing(x + since[:, 0], y))
