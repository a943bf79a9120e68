"""What ``bench.py`` measures of the stereo front-end: a covariance against the simulation it replaces, and images."""

from __future__ import annotations

import contextlib
import os
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from bench_trials import SEED, Work, interleaved

from consistency.bench.runs.reproduce_findings import sibling
from consistency.referee.errors import InputError
from consistency.referee.system import data_folder
from consistency.stereo.visual_odometry.odometry import visual_odometry
from consistency.stereo.visual_odometry.relative_pose import rigid_motions
from consistency.stereo.visual_odometry.sequence import StereoSequence, read_sequence
from consistency.vision import register_svd, registration_covariance, triangulate, triangulation_covariance

rigs = sibling(str(data_folder("experiments") / "README.md"), "published_rig")

NOISE, NEAR, FAR = 2.0, 1.5, 3.0  # px, m, m: of e10's fig. 2.3
OFTEN = 20  # covariances in a measurement
PAIRS = 12  # stereo pairs in another
IMAGES = "CONSISTENCY_BENCH_IMAGES"  # environment variable with the folder of a stereo sequence


def covariance_and_simulation(points: int, samples: int, repeats: int) -> dict[str, float]:
    """Seconds of a covariance from the pixels on, and of Monte Carlo sample by sample and of all samples at once."""
    rig, rng = rigs.published_rig(), np.random.default_rng(SEED)
    p1 = rigs.common_points(rng, rig, rigs.MOTION, points, NEAR, FAR)
    uv = [rig.project(p) for p in (p1, rigs.MOTION.inverse().apply(p1))]
    clouds = [triangulate(rig, z) for z in uv]
    pose, S_uv = register_svd(*clouds), NOISE**2 * np.eye(4)

    def propagate() -> None:
        for _ in range(OFTEN):
            S1, S2 = (triangulation_covariance(rig, z, S_uv) for z in uv)
            registration_covariance(clouds[0], clouds[1], S1, S2, pose)

    def simulate() -> None:
        for _ in range(samples):
            register_svd(*(triangulate(rig, z + rng.normal(0.0, NOISE, z.shape)) for z in uv))

    def at_once() -> None:
        noisy = [z + rng.normal(0.0, NOISE, (samples, *z.shape)) for z in uv]
        rigid_motions(*(triangulate(rig, z.reshape(-1, 4)).reshape(samples, points, 3) for z in noisy))

    works: dict[str, Work] = {"propagate": propagate, "simulate": simulate, "at once": at_once}
    seconds = interleaved(works, repeats)
    return seconds | {"propagate": seconds["propagate"] / OFTEN}


def motions_per_second(repeats: int) -> tuple[float, str]:
    """Rate of motions from one pair of a sequence to the next, and what it was; from reading to covariance.

    Raises
    ------
    InputError
        No sequence is named.
    """
    folder = os.environ.get(IMAGES)
    if not folder:
        raise InputError(f"no images; name a stereo sequence in {IMAGES}")
    whole = read_sequence(Path(folder))
    first = replace(whole, left=whole.left[:PAIRS], right=whole.right[:PAIRS], t=whole.t[:PAIRS])
    seconds = interleaved({"motions": partial(_odometry, first)}, repeats)["motions"]
    width, height = whole.rectification.rig.image_size
    return (len(first) - 1) / seconds, f"{len(first) - 1} motions of {whole.folder.name}, {width} x {height}"


def _odometry(sequence: StereoSequence) -> None:
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stderr(nowhere):
        visual_odometry(sequence, rng=np.random.default_rng(SEED))
