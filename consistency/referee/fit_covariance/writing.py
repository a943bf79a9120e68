"""A fitted model as a folder: noise.toml, motions with covariances, snippets, and a page with pictures."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from consistency.referee.fit_covariance.fit_folder import toml, write_fit
from consistency.referee.fit_covariance.model_text import correction, data_of_model
from consistency.referee.fit_covariance.motion_windows import PIECES, ways
from consistency.referee.fit_covariance.motions import write_motions
from consistency.referee.fit_covariance.noise_model import NoiseModel
from consistency.referee.fit_covariance.page import noise_page
from consistency.referee.types import Array


def write_model(model: NoiseModel, folder: Path, overwrite: bool = False) -> list[Path]:
    """Write the folder of a noise model; its files."""
    motions = partial(write_motions, model.stretches)
    return write_fit(folder, ("noise", model.name), snippets(model), noise_page(model), motions, overwrite)


PLACES = {3: (0, 1, 5), 6: (0, 1, 2, 3, 4, 5)}  # of the axes in messages of ROS: x, y, z, roll, pitch, yaw
HEAD = """\
Cov Log(D^-1 M) = factor * (sum over steps of A diag(variance_per_m |way| + variance_per_rad |turn|) A'
+ diag(floor)); D is the estimated motion after the correction of [mean], M the true one, and A
carries a step's error to the end of the motion. Shown for motions over the span, and for no others."""


def robot_localization(model: NoiseModel) -> str:
    """A function of the covariance of a twist message, whose integration has the covariance of the model."""
    noise = model.noise
    places = PLACES[len(noise.axes)]
    at_rest = noise.floor / seconds(model)
    numbers = noise.factor * np.column_stack([noise.per_m, noise.per_rad, at_rest])
    rows = []
    for axis, place, (per_m, per_rad, rest) in zip(noise.axes, places, numbers.tolist(), strict=True):
        variance = f"{per_m:.17g} * abs(v) + {per_rad:.17g} * abs(w) + {rest:.17g}"
        rows.append(f"    covariance[{7 * place}] = ({variance}) / dt  # {axis}")
    if len(places) < 6:
        rows.append("    # z, roll, pitch: set two_d_mode")
    assignments = "\n".join(rows)
    return f'''"""robot_localization: fuse the twist of the odometry, not its pose. {_origin(model)}

In differential mode two poses are turned into a twist with the sum of their covariances, which is not that
of a motion; a twist is integrated as it is. Set odom0_config to the velocities alone.
"""


def twist_covariance(v: float, w: float, dt: float) -> list[float]:
    """36 numbers of a TwistWithCovariance: v in m/s, w in rad/s, dt in s since the message before."""
    covariance = [0.0] * 36
{assignments}
    return covariance
'''


def seconds(model: NoiseModel) -> float:
    """Median time that a motion over the span takes, s, over which the floor is spread; 1 without a clock."""
    windows = model.windows
    took = []
    for i, first, last in zip(windows.drive, windows.first, windows.last, strict=True):
        took.append(np.ptp(windows.drives[i].t[[first, last]]))
    median = float(np.median(took))
    return median if np.isfinite(median) and median > 0 else 1.0


def gtsam(model: NoiseModel) -> str:
    """A function of the noise model of a BetweenFactor."""
    noise = model.noise
    n = len(noise.axes)
    # Pose3 has the rotation first, Pose2 the position
    order, turn, kind = [0, 1, 2], "[2:]", "Pose2"
    if n == 6:
        order, turn, kind = [3, 4, 5, 0, 1, 2], "[:3]", "Pose3"
    return f'''"""GTSAM: noise of a BetweenFactor{kind}. {_origin(model)}"""

import gtsam
import numpy as np

# {", ".join(noise.axes[i] for i in order)}: the order of gtsam.{kind}
PER_M = np.array([{_numbers(noise.factor * noise.per_m[order])}])
PER_RAD = np.array([{_numbers(noise.factor * noise.per_rad[order])}])
FLOOR = np.array([{_numbers(noise.factor * noise.floor[order])}])
PIECES = {PIECES}


def covariance(delta: gtsam.{kind}) -> np.ndarray:
    """Of the error Log(delta^-1 true) of a corrected motion over the span, taken as even."""
    xi = gtsam.{kind}.Logmap(delta) / PIECES
    way, turn = np.linalg.norm(np.asarray(gtsam.{kind}.Expmap(xi).translation())), np.linalg.norm(xi{turn})
    Q, S = np.diag(PER_M * way + PER_RAD * turn), np.zeros(({n}, {n}))
    for k in range(PIECES + 1):
        A = gtsam.{kind}.Expmap(-k * xi).AdjointMap()
        S += (0.5 if k in (0, PIECES) else 1.0) * A @ Q @ A.T
    return S + np.diag(FLOOR)


def noise(delta: gtsam.{kind}) -> gtsam.noiseModel.Gaussian:
    """Noise model of gtsam.BetweenFactor{kind}(i, j, delta, noise(delta))."""
    return gtsam.noiseModel.Gaussian.Covariance(covariance(delta))
'''


def ceres(model: NoiseModel) -> str:
    """A header with the square root of the information of a straight motion over the span."""
    root = np.linalg.cholesky(np.linalg.inv(straight(model))).T
    rows = ",\n".join(f"    {_numbers(row)}" for row in root)
    return f"""// Ceres: residual = kSqrtInformation * Log(D^-1 M), with {", ".join(model.noise.axes)} in this order.
// {_origin(model)}
// Of a straight motion over the span; for others take the inverse square root of the covariance in motions.csv.
#pragma once

constexpr int kErrorSize = {len(root)};
constexpr double kSqrtInformation[{root.size}] = {{
{rows}}};
"""


def straight(model: NoiseModel) -> Array:
    """Covariance (n, n) of a straight motion as long as the median one of the windows."""
    corrected = model.noise.mean.corrected(model.windows.pieces)
    way = float(np.median(ways(corrected).sum(axis=1)))
    if model.windows.d == 2:
        return model.covariance([way, 0.0, 0.0])
    return model.covariance([way, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


def _origin(model: NoiseModel) -> str:
    """Span and correction, for the head of a file."""
    return f"Shown for motions over {model.span} alone; {correction(model) or 'nothing is corrected'}."


def _numbers(values: Array) -> str:
    return ", ".join(f"{value:.17g}" for value in values)


def snippets(model: NoiseModel) -> dict[str, str]:
    """Files of the model for other programs, by name."""
    return {
        "noise.toml": toml(HEAD, data_of_model(model)),
        "robot_localization_noise.py": robot_localization(model),
        "gtsam_noise.py": gtsam(model),
        "ceres_noise.h": ceres(model),
    }
