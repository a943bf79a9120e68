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
            help="KITTI's text, .yaml of OpenCV or BoofCV, or folder of EuRoC's; not needed if in IMAGES.",
        ),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(
            "--truth", help="True poses: KITTI, EuRoC .csv, TUM, or a drive of KITTI raw; found if in IMAGES."
        ),
    ] = None,
    format: Annotated[
        str | None, typer.Option("--format", help="kitti, kitti-raw, euroc or opencv (plain) [by the folders].")
    ] = None,
    left: Annotated[str | None, typer.Option("--left", help="Pattern of plain left images, as 'left/*.png'.")] = None,
    right: Annotated[str | None, typer.Option("--right", help="Pattern of plain right images.")] = None,
    rate: Annotated[float | None, typer.Option("--rate", help="Hz, of images without times [10].")] = None,
    estimator: Annotated[str, typer.Option("--estimator", help="reprojection, svd or horn.")] = "reprojection",
    sigma_per_scale: Annotated[
        float | None, typer.Option("--sigma-per-scale", help="Feature noise over SIFT scale [0.15].")
    ] = None,
    max_landmarks: Annotated[
        int | None,
        typer.Option("--max-landmarks", help="Most landmarks in the log; filters are quadratic in them [200]."),
    ] = None,
    lever: Annotated[float, typer.Option("--lever", help="Metres from the robot's point forward to the camera.")] = 0.0,
    planar: Annotated[
        bool, typer.Option("--planar", help="Write the log even where the camera leaves the plane of a robot.")
    ] = False,
    seed: Annotated[int, typer.Option("--seed", help="Seed of RANSAC.")] = 0,
    overwrite: Overwrite = False,
) -> None:
    """Stereo images to a log for filters, and to a trajectory with covariance."""
    from consistency.stereo.frontend import FrontendOptions, write_frontend_log
    from consistency.stereo.visual_odometry.relative_motion import MotionSettings

    settings = MotionSettings(estimator=estimator, **given_options(sigma_per_scale=sigma_per_scale))
    options = FrontendOptions(
        calibration, truth, format, left, right, rate, lever=lever, planar=planar, seed=seed, settings=settings,
        **given_options(max_landmarks=max_landmarks),
    )  # fmt: skip
    for line in write_frontend_log(images, out, options, overwrite).lines(out):
        print(line)
