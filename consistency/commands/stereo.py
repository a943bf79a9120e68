"""Stereo images and sensors: ``frontend`` and ``characterise``; they parse, call and print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from consistency.commands.shared_options import AsJson, Out, Overwrite, given_options
from consistency.referee.extras import require


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


def characterise_command(
    source: Annotated[
        Path, typer.Argument(metavar="LOG|IMAGES", help="Log folder with truth, or folder of stereo pairs.")
    ],
    out: Annotated[Path, typer.Option("--out", help="sensor.toml to write, for a belief or a log.")],
    report: Annotated[Path | None, typer.Option("--report", help="Folder for report.html and report.pdf.")] = None,
    grid: Annotated[
        str | None, typer.Option("--grid", metavar="KxL", help="Nodes of the bias map, across and down [5x4].")
    ] = None,
    at_rest: Annotated[
        bool, typer.Option("--at-rest", help="Declare that the sensor stood still all the time.")
    ] = False,
    free_poses: Annotated[
        bool,
        typer.Option("--free-poses", help="Also fit the pose of each step, so that its error does not count as noise."),
    ] = False,
    calibration: Annotated[
        Path | None, typer.Option("--calibration", help="Calibration of images: a file or folder, as for 'frontend'.")
    ] = None,
    truth: Annotated[Path | None, typer.Option("--truth", help="True poses of images, as for 'frontend'.")] = None,
    format: Annotated[
        str | None, typer.Option("--format", help="Layout: kitti, euroc or opencv [by the folders].")
    ] = None,
    left: Annotated[
        str | None, typer.Option("--left", help="Pattern of plain left images, such as 'left/*.png'.")
    ] = None,
    right: Annotated[str | None, typer.Option("--right", help="Pattern of plain right images.")] = None,
    board: Annotated[
        str | None, typer.Option("--board", metavar="KxL", help="Inner corners of a chessboard in leftN, rightN.")
    ] = None,
    square: Annotated[float | None, typer.Option("--square", help="Side of a square of the board, m.")] = None,
    distortion: Annotated[
        str | None, typer.Option("--distortion", help="Lens model for a board: full, poor or none [full].")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of RANSAC, for images without a board [0].")] = None,
    as_json: AsJson = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Overwrite existing files of --out and --report.")
    ] = False,
) -> None:
    """Measure a stereo sensor: noise, growth, bias, tails. Every number has an interval."""
    from consistency.referee.show import terminal
    from consistency.referee.system import require_free
    from consistency.stereo.characterising.sensor_text import as_json as json_of
    from consistency.stereo.characterising.sensor_text import (
        measured_sensor_toml,
        require_free_file,
        sensor_blocks,
        write_sensor,
    )
    from consistency.stereo.characterising.sources import (
        CORNERS,
        NODES,
        SourceOptions,
        characterise_source,
        parse_counts,
    )
    from consistency.stereo.pages import write_sensor_reports

    require_free_file(out, overwrite)
    if report is not None:
        require("--report", "report")
        require_free(report, overwrite, "characterisation", "--report")
    size = None if board is None else parse_counts(board, "--board", CORNERS)
    nodes = None if grid is None else parse_counts(grid, "--grid", NODES)
    options = SourceOptions(
        nodes, at_rest, free_poses, calibration, truth, format, left, right, size, square, distortion, seed
    )
    measured = characterise_source(source, options)
    written = [] if report is None else write_sensor_reports(measured.of, report, json_of(measured.of), overwrite)
    write_sensor(out, measured_sensor_toml(measured.of, measured.others))
    if as_json:
        print(json_of(measured.of))
        return
    terminal.show(*sensor_blocks(measured.of))
    for path in written:
        print(path)
    print(f"sensor in {out}; next: copy it into a log and consistency run --log LOG --filter F")
