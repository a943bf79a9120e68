"""``consistency frontend``: parses, calls, prints."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from consistency.commands.shared_options import Out, Overwrite, given_options


def frontend_command(
    images: Annotated[Path, typer.Argument(metavar="IMAGES", help="Folder of stereo pairs: KITTI, EuRoC, or plain.")],
    out: Out,
    calibration: Annotated[
        Path | None,
        typer.Option(
            "--calibration",
            help="Calibration: text of KITTI, .yaml of OpenCV or BoofCV, or folder of EuRoC; not needed if in IMAGES.",
        ),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(
            "--truth", help="True poses: KITTI, EuRoC .csv, TUM, or a drive of KITTI raw; not needed if in IMAGES."
        ),
    ] = None,
    format: Annotated[
        str | None, typer.Option("--format", help="Layout: kitti, kitti-raw, euroc or opencv (plain) [by the folders].")
    ] = None,
    left: Annotated[
        str | None, typer.Option("--left", help="Pattern of plain left images, such as 'left/*.png'.")
    ] = None,
    right: Annotated[str | None, typer.Option("--right", help="Pattern of plain right images.")] = None,
    rate: Annotated[float | None, typer.Option("--rate", help="Rate of images without times, Hz [10].")] = None,
    estimator: Annotated[
        str, typer.Option("--estimator", help="Estimator of a motion: reprojection, svd or horn.")
    ] = "reprojection",
    sigma_per_scale: Annotated[
        float | None, typer.Option("--sigma-per-scale", help="Feature noise over SIFT scale [0.15].")
    ] = None,
    max_landmarks: Annotated[
        int | None,
        typer.Option(
            "--max-landmarks",
            help="Maximum number of landmarks in the log; the time of filters is quadratic in it [200].",
        ),
    ] = None,
    lever: Annotated[
        float, typer.Option("--lever", help="Distance of the camera ahead of the robot's point, m.")
    ] = 0.0,
    planar: Annotated[
        bool, typer.Option("--planar", help="Write the log even if the camera leaves the plane of a robot.")
    ] = False,
    seed: Annotated[int, typer.Option("--seed", help="Seed of RANSAC.")] = 0,
    overwrite: Overwrite = False,
) -> None:
    """Convert stereo images to a log and a trajectory. The trajectory states covariances."""
    from consistency.stereo.frontend import FrontendOptions, write_frontend_log
    from consistency.stereo.visual_odometry.relative_motion import MotionSettings

    settings = MotionSettings(estimator=estimator, **given_options(sigma_per_scale=sigma_per_scale))
    options = FrontendOptions(
        calibration, truth, format, left, right, rate, lever=lever, planar=planar, seed=seed, settings=settings,
        **given_options(max_landmarks=max_landmarks),
    )  # fmt: skip
    for line in write_frontend_log(images, out, options, overwrite).lines(out):
        print(line)
