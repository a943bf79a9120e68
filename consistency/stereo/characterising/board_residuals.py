"""Residuals of corners about the plane of their board, and the sensor that they make."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import optimize
from scipy.spatial.transform import Rotation

from consistency.bench.models import stereo
from consistency.bench.scenario import PicturedSensor
from consistency.referee.errors import InputError
from consistency.referee.types import Array
from consistency.stereo.characterising.board_images import MODELS, Calibrated, Corners, Size, calibrate, find_corners
from consistency.stereo.characterising.characterise import Characterisation, characterise
from consistency.stereo.characterising.residuals import MAD, Residuals

POSE = 6  # parameters of the pose of a board
ROUNDS = 3  # of weights and poses in turns
NO_TIME = (
    "Each corner is seen once in each pose of the board: correlation in time and offsets of tracks cannot be told.",
    "The poses of the board are fitted, so that a bias that a turned or shifted board would show is not in the map.",
)


def characterise_board(folder: Path, board: Size, square: float, model: str, grid: Size) -> Characterisation:
    """The noise of corners with one distortion model, the others beside it in the notes.

    Raises
    ------
    InputError
        As :func:`consistency.stereo.characterising.board_images.find_corners`, or an unknown model.
    """
    if model not in MODELS:
        raise InputError(f"--distortion {model}: must be one of {', '.join(MODELS)}")
    corners = find_corners(folder, board, square)
    results = {name: of_model(corners, name, str(folder), grid) for name in MODELS}
    chosen = results[model]
    pairs, names = len(corners.names) + len(corners.missed), ", ".join(corners.missed)
    found = f"The board was not found in {len(corners.missed)} of {pairs} pairs ({names}); the others are used."
    beside = tuple(_line(name, of) for name, of in results.items())
    return replace(chosen, notes=((found,) if corners.missed else ()) + beside + NO_TIME)


def of_model(corners: Corners, model: str, source: str, grid: Size) -> Characterisation:
    """What is known of the corners with one distortion model."""
    calibrated = calibrate(corners, model)
    data = residuals_about_boards(calibrated, corners.board)
    sensor = PicturedSensor(
        model="uvd", sigma=(1.0, 1.0, 1.0), f=calibrated.f, B=calibrated.B, image=corners.image,
        principal_point=calibrated.centre,
    )  # fmt: skip
    # the nodes of the map lie where corners are: boards do not reach the edges of the image
    where = sensor.model_copy(update={"image": None, "principal_point": None})
    of = characterise(data, where, f"{source}, distortion model '{model}'", grid=grid, alone=True)
    rows = calibrated.rows
    spread = MAD * float(np.median(np.abs(rows - np.median(rows))))
    rms = ", ".join(f"{value:.2f}" for value in calibrated.rms)
    text = f"calibration rms {rms} px; v_left - v_right robust sd {spread:.2f} px"
    return replace(of, sensor=sensor, notes=(text,))


def _line(model: str, of: Characterisation) -> str:
    """One model in a line."""
    sigma = " ".join(f"{c.name} {c.sigma.value:.3f}" for c in of.coordinates)
    assert of.bias is not None
    known = of.bias.believed[:, of.bias.grid.known]
    widest = " ".join(f"{c.name} {np.abs(b).max():.2f}" for c, b in zip(of.coordinates, known, strict=True))
    pooled = " ".join(f"{c.name} {c.pooled:.3f}" for c in of.coordinates)
    return (
        f"Distortion model '{model}': noise {sigma} px, largest bias shown {widest} px, both together {pooled} px; "
        f"{of.notes[0]}."
    )


def residuals_about_boards(calibrated: Calibrated, board: Array) -> Residuals:
    """Residuals of corners about a board whose pose is fitted in each pair.

    The six parameters of each pose, and those of the calibration, are paid for: residuals are as large as they would
    be about the truth, on average.
    """
    z, sigma = calibrated.z, np.ones(3)
    n, count = z.shape[:2]
    poses = [_first_pose(pair, board, calibrated) for pair in z]
    ideal = np.empty_like(z)
    for _ in range(ROUNDS):
        for k, pair in enumerate(z):
            poses[k], ideal[k] = _fitted(pair, board, calibrated, poses[k], sigma)
        sigma = np.maximum(np.sqrt(np.mean((z - ideal) ** 2, axis=(0, 1))), 1e-6)
    paid = 1.0 - (POSE * n + calibrated.fitted) / (3.0 * n * count)
    r = (z - ideal) / np.sqrt(paid)
    track = np.repeat(np.arange(n), count)
    step = np.tile(np.arange(count), n)
    return Residuals(r.reshape(-1, 3), ideal.reshape(-1, 3), track, step, np.zeros(n * count, bool))


def _project(pose: Array, board: Array, calibrated: Calibrated) -> Array:
    """Ideal (u, v, d) (c, 3) of a board; the pose is a rotation vector and a place in m, sensor axes."""
    points = Rotation.from_rotvec(pose[:3]).apply(board) + pose[3:]
    x, y, w = points.T
    return np.stack(stereo.project(x, y, w, calibrated.f, calibrated.B), axis=-1)


def _first_pose(z: Array, board: Array, calibrated: Calibrated) -> Array:
    """The pose that lays the board best on the triangulated corners, Arun et al. (1987)."""
    u, v, d = z.T
    seen = np.stack(stereo.triangulate(u, v, d, calibrated.f, calibrated.B), axis=-1)
    turn, _ = Rotation.align_vectors(seen - seen.mean(axis=0), board - board.mean(axis=0))
    return np.concatenate([turn.as_rotvec(), seen.mean(axis=0) - turn.apply(board.mean(axis=0))])


def _fitted(z: Array, board: Array, calibrated: Calibrated, start: Array, sigma: Array) -> tuple[Array, Array]:
    """Pose (6,) of the board by weighted least squares, and the ideal corners (c, 3)."""

    def misfit(pose: Array) -> Array:
        return np.asarray(((z - _project(pose, board, calibrated)) / sigma).ravel())

    best = optimize.least_squares(misfit, start, x_scale="jac")
    return best.x, _project(best.x, board, calibrated)
