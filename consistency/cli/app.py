"""The command line: parses, calls, prints."""

from __future__ import annotations

import errno
import json
import os
import sys
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from consistency.cli.files import FileOptions, reads_files, tell_notes
from consistency.errors import InputError

UsageError: Any = typer.BadParameter.__base__  # click's, wherever typer keeps it
Abort: Any = typer.Abort

HELP = ["-h", "--help"]
app = typer.Typer(
    help="Does your estimator tell the truth about its own uncertainty?",
    context_settings={"help_option_names": HELP},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

Out = Annotated[Path, typer.Option("--out", help="Folder to write; must not exist.")]
Runs = Annotated[int, typer.Option("--runs", help="Number of Monte Carlo runs.")]
Seed = Annotated[int, typer.Option("--seed", help="Seed of the noise.")]
Jobs = Annotated[int, typer.Option("--jobs", help="Workers; -1 is one a core. The result does not depend on it.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an output folder of this bench.")]
ESTIMATES = ".csv, .parquet, .npz, TUM, ROS bags"
Judged = Annotated[Path, typer.Argument(metavar="PATH", help=f"Folder written by 'run', or estimates: {ESTIMATES}.")]
Power = Annotated[float, typer.Option("--power", help="Chance to find that ratio.")]
FalseAlarm = Annotated[float, typer.Option("--false-alarm", help="Chance to find a fault in a filter that has none.")]
BackendName = Annotated[
    str, typer.Option("--backend", help="Where runs are done: local; dask or slurm (docs/cluster.md).")
]
Scheduler = Annotated[
    str | None,
    typer.Option("--scheduler", help="For dask: tcp://HOST:PORT, tls://HOST:PORT or a scheduler file [this machine]."),
]
SchedulerWait = Annotated[
    float | None, typer.Option("--scheduler-wait", help="For dask: seconds to wait for the scheduler [60].")
]
SlurmOptions = Annotated[
    list[str] | None,
    typer.Option(
        "--slurm", metavar="KEY=VALUE", help="For slurm: partition=short, time=60 (minutes); may be repeated."
    ),
]
LOST_HELP = "share of lost runs that must be excluded"
Skip = Annotated[
    str | None,
    typer.Option("--skip", metavar="N|Ns", help="Leave the first N steps, or seconds (2s), of each run out."),
]
DETECT_HELP = "ratio of true to stated covariance that must be found"
FULL = {errno.ENOSPC, errno.EFBIG, errno.EIO, getattr(errno, "EDQUOT", errno.ENOSPC)}  # a disk, a quota, a limit
SCENARIO = "Built-in name (see 'list') or path of a .toml file."


@app.callback(invoke_without_command=True)
def _main(
    context: typer.Context, version: Annotated[bool, typer.Option("--version", help="Show it and exit.")] = False
) -> None:
    if version:
        from importlib.metadata import version as version_of

        print(version_of("filter-consistency"))
    elif context.invoked_subcommand is None:
        print(context.get_help())


@app.command("list")
def list_(as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False) -> None:
    """Scenarios, filters, experiments and sweeps."""
    from consistency.filters import BOUNDS, SMOOTHERS, filter_summaries
    from consistency.filters.guard.settings import KINDS
    from consistency.runs.findings import experiment_summaries
    from consistency.scenario import load_scenario, scenario_names
    from consistency.sweeps.plan import sweep_summaries

    scenarios = {name: load_scenario(name).summary for name in scenario_names()}
    experiments, sweeps, filters = experiment_summaries(), sweep_summaries(), filter_summaries()
    if as_json:
        listed = {"scenarios": scenarios, "filters": list(filters), "experiments": experiments, "sweeps": sweeps}
        print(json.dumps(listed | {"filter_summaries": filters, "guards": KINDS}, indent=2))
        return
    marks = dict.fromkeys(BOUNDS, " (not realisable)") | dict.fromkeys(SMOOTHERS, " (all data at once)")
    marked = {name: text + marks.get(name, "") for name, text in filters.items()}
    guards = {f"FILTER+{kind}": text for kind, text in KINDS.items()}
    named = {
        "Scenarios": scenarios, "Experiments": experiments, "Sweeps": sweeps, "Filters": marked,
        "Guards, before any filter but smoothers": guards,
    }  # fmt: skip
    for title, entries in named.items():
        print(title)
        width = max((len(name) for name in entries), default=0)
        for name, summary in entries.items():
            print(f"  {name:<{width}}  {summary}")
        print()


@app.command()
def simulate(
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help=SCENARIO)],
    out: Out,
    runs: Runs = 1,
    seed: Seed = 0,
    form: Annotated[str, typer.Option("--format", help="Of the tables: parquet or csv; both are read.")] = "parquet",
    overwrite: Overwrite = False,
) -> None:
    """Write truth, controls and observations of a scenario: a log for any filter, ours or not."""
    from consistency.runs.montecarlo import simulate_log
    from consistency.scenario import load_scenario

    simulate_log(load_scenario(scenario), runs, seed, out, overwrite, form)
    count = f"{runs} run{'s' * (runs != 1)}"
    print(f"{count} of {scenario} in {out}; filter them with: consistency run --log {out} --filter F")


@app.command()
def frontend(
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
    from consistency.frontend import Options, write_frontend_log
    from consistency.vision.motion import Settings

    settings = Settings(estimator=estimator, **_options(sigma_per_scale=sigma_per_scale))
    options = Options(
        calibration, truth, format, left, right, rate, lever=lever, planar=planar, seed=seed, settings=settings,
        **_options(max_landmarks=max_landmarks),
    )  # fmt: skip
    for line in write_frontend_log(images, out, options, overwrite).lines(out):
        print(line)


def _options(**options: Any) -> dict[str, Any]:
    """Options that were given; the others keep the defaults of what they are handed to."""
    return {name: value for name, value in options.items() if value is not None}


@app.command()
def run(
    out: Out,
    filters: Annotated[
        list[str], typer.Option("--filter", metavar="NAME", help="Filter name, or FILTER+gate; again for more.")
    ],
    scenario: Annotated[str | None, typer.Argument(metavar="SCENARIO", help=SCENARIO)] = None,
    log: Annotated[Path | None, typer.Option("--log", help="Recorded log folder instead of a scenario.")] = None,
    screen: Annotated[
        str | None,
        typer.Option(
            "--screen",
            metavar="U,V,D",
            help="Landmarks of a log begin anew that leave the common motion by more, in px.",
        ),
    ] = None,
    runs: Annotated[int | None, typer.Option("--runs", help="Number of Monte Carlo runs [default: 50].")] = None,
    until_decided: Annotated[
        bool, typer.Option("--until-decided", help="As many runs as the verdict takes, instead of --runs.")
    ] = False,
    max_runs: Annotated[int | None, typer.Option("--max-runs", help="Most runs of --until-decided.")] = None,
    detect: Annotated[float | None, typer.Option("--detect", help=f"For --until-decided: {DETECT_HELP} [1.5]")] = None,
    false_alarm: Annotated[
        float | None, typer.Option("--false-alarm", help="For --until-decided: chance to fail a right filter [0.05].")
    ] = None,
    lost: Annotated[float | None, typer.Option("--lost", help=f"For --until-decided: {LOST_HELP}.")] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of the noise [default: 0].")] = None,
    jobs: Jobs = -1,
    timeout: Annotated[
        float | None,
        typer.Option("--timeout", help="Seconds a run, after which it is killed; filters that are not compiled only."),
    ] = None,
    memory: Annotated[
        float | None, typer.Option("--memory", metavar="GIB", help="GiB that such a filter may allocate in a run.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with an interrupted run in --out.")] = False,
    overwrite: Overwrite = False,
    backend: BackendName = "local",
    scheduler: Scheduler = None,
    scheduler_wait: SchedulerWait = None,
    slurm: SlurmOptions = None,
) -> None:
    """Put simulated trials, or a recorded log, through filters."""
    from consistency.runs.backends.choosing import backend_for, require_scheduler
    from consistency.runs.montecarlo import Interrupted, resolve_filters, run_log, run_trials
    from consistency.runs.sequential import run_until_decided
    from consistency.scenario import load_scenario
    from consistency.store.log import read_log
    from consistency.store.results import Results, StoredResults
    from consistency.terminal.progress import say
    from consistency.terminal.table import print_verdicts
    from consistency.verdicts.judge import analyse

    if (scenario is None) == (log is None):
        raise InputError("give either a SCENARIO or --log DIR")
    if screen is not None and log is None:
        raise InputError("--screen goes with --log: a scenario says which of its observations are spurious")
    planned = _options(max_runs=max_runs, detect=detect, false_alarm=false_alarm, lost=lost)
    if planned and not until_decided:
        raise InputError(f"--{next(iter(planned)).replace('_', '-')} goes with --until-decided")
    if until_decided and runs is not None:
        raise InputError("--until-decided finds the number of runs; give --max-runs instead of --runs")
    results: Results | StoredResults
    verdicts = None
    if resume and overwrite:
        raise InputError("--resume goes on with what --overwrite would replace; give one of them")
    place = backend_for(backend, jobs, scheduler, slurm or (), scheduler_wait, out)
    if until_decided:
        require_scheduler(backend, scheduler, "--until-decided")
    try:
        if log is not None:
            if runs is not None or seed is not None or until_decided:
                raise InputError("--runs, --seed and --until-decided do not go with --log: a log has the runs it has")
            recorded = read_log(log)
            if screen is not None:
                from consistency.frontend.screening import screened_log, screening_line

                recorded = screened_log(recorded, screen)
                say(screening_line(recorded))
            resolve_filters(filters, recorded.belief, recorded.name)
            if out.resolve() == log.resolve() or log.resolve() in out.resolve().parents:
                raise InputError(f"--out {out}: lies in the log; choose another folder")
            results = run_log(
                recorded, filters, jobs, timeout, memory, place, out=out, resume=resume, overwrite=overwrite
            )  # fmt: skip
        else:
            world = load_scenario(str(scenario))
            runs, seed = 50 if runs is None else runs, 0 if seed is None else seed
            resolve_filters(filters, world.belief)
            if until_decided:
                results, verdicts = run_until_decided(
                    world, filters, seed=seed, jobs=jobs, timeout=timeout, memory=memory, backend=place,
                    out=out, resume=resume, overwrite=overwrite, **planned,
                )  # fmt: skip
            else:
                results = run_trials(
                    world, filters, runs, seed, jobs, timeout,
                    out=out, overwrite=overwrite, resume=resume, memory=memory, backend=place,
                )  # fmt: skip
    except Interrupted as stop:
        done = stop.results.manifest["finished_runs"]
        kept = f"{done} finished runs are in {out}; add --resume to the same command to go on"
        say(f"stopped: {kept}" if done else "stopped before a run was finished; nothing written")
        sys.exit(stop.status)
    print_verdicts(verdicts or analyse(results))
    print(f"results in {out}; next: consistency report {out}")


@app.command()
@reads_files
def analyse(
    path: Judged,
    files: FileOptions,
    filters: Annotated[
        list[str] | None, typer.Option("--filter", metavar="NAME", help="Only this filter; may be repeated.")
    ] = None,
    false_alarm: Annotated[
        float | None, typer.Option("--false-alarm", help="Chance to find a fault in a filter that has none [0.05].")
    ] = None,
    detect: Annotated[
        float | None,
        typer.Option("--detect", help="Consistent is a covariance ratio shown inside [1/R, R] [1.5].", metavar="R"),
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option("--tolerance", help="A covariance ratio shown inside [1/R, R] is no fault.", metavar="R"),
    ] = None,
    lost: Annotated[
        float | None,
        typer.Option("--lost", help="Consistent is also a share of lost runs shown to be this at most.", metavar="P"),
    ] = None,
    innovations: Annotated[
        str | None,
        typer.Option("--innovations", help="'optimal': of an optimal gain without a gate, so that they are judged."),
    ] = None,
    confidence: Annotated[
        float | None, typer.Option("--confidence", help="1 less the --false-alarm, in its place.")
    ] = None,
    skip: Skip = None,
    report: Annotated[
        Path | None, typer.Option("--report", help="Folder for an HTML and a PDF page on files of another estimator.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
    fail_on: Annotated[str | None, typer.Option("--fail-on", help="'inconsistent': exit 1 if any filter is.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace what exists of --report.")] = False,
) -> None:
    """Judge results, or files of another estimator: consistent, overconfident, conservative, undecided ..., and why."""
    from consistency.terminal.table import print_verdicts, verdicts_json
    from consistency.verdicts.files import analyse_recordings
    from consistency.verdicts.options import settings_of, skip_asked

    if fail_on not in (None, "inconsistent"):
        raise InputError(f"--fail-on must be 'inconsistent', got '{fail_on}'")
    if innovations not in (None, "optimal"):
        raise InputError(f"--innovations must be 'optimal', got '{innovations}'")
    changes = _options(confidence=confidence, false_alarm=false_alarm, detect=detect, tolerance=tolerance, lost=lost)
    settings, first = settings_of(**changes) if changes else None, skip_asked(skip)
    written: list[Path] = []
    refused: InputError | None = None  # of a report, said below the verdict
    if overwrite and report is None:
        raise InputError("--overwrite goes with --report: nothing else is written")
    if files.are(path):
        recordings = [recording.without_first(first) for recording in files.read(path)]
        verdicts = analyse_recordings(recordings, filters, settings, optimal_gain=innovations is not None)
        tell_notes(recordings)
        if report is not None:
            from consistency.reporting import write_file_reports
            from consistency.store.storage import require_free

            try:
                require_free(report, overwrite, "verdict", "--report")
                data = verdicts_json(verdicts)
                written = write_file_reports(recordings, verdicts, report, path.name, data, overwrite)
            except InputError as error:
                refused = error
    else:
        from consistency.store.results import open_results
        from consistency.verdicts.judge import analyse as judge_results

        results = open_results(path)
        if report is not None:
            raise InputError(f"--report: is for files of another estimator; for {path} use 'consistency report {path}'")
        if innovations is not None:
            raise InputError(
                "--innovations is for files of another estimator; filters of the bench declare it themselves"
            )
        verdicts = judge_results(results, filters, settings=settings, skip=first)
        if not results.manifest["complete"]:
            done, total = results.manifest["finished_runs"], results.manifest["runs"]
            text = f"{path}: only {done} of {total} runs are there; the same 'consistency run' with --resume goes on"
            if fail_on:
                raise InputError(f"--fail-on: {text}")
            print(f"consistency: {text}", file=sys.stderr)
    if as_json:
        print(verdicts_json(verdicts))
    else:
        print_verdicts(verdicts, reasons=True)
        for file in written:
            print(file)
    is_failed = fail_on is not None and not all(verdict.consistent for verdict in verdicts.values())
    if refused is not None and not is_failed:
        raise refused
    if refused is not None:
        print(f"consistency: {refused}", file=sys.stderr)
    if is_failed:
        raise typer.Exit(1)


@app.command()
def plan(
    scenario: Annotated[
        str | None, typer.Argument(metavar="[SCENARIO]", help="Run a short pilot of it to learn how steps depend.")
    ] = None,
    filters: Annotated[
        list[str] | None, typer.Option("--filter", metavar="NAME", help="Filter of the pilot; may be repeated.")
    ] = None,
    like: Annotated[
        Path | None, typer.Option("--like", metavar="RESULTS", help="Results to learn from, in place of a pilot.")
    ] = None,
    pilot_runs: Annotated[int, typer.Option("--pilot-runs", help="Runs of the pilot.")] = 40,
    seed: Seed = 0,
    detect: Annotated[float, typer.Option("--detect", help=f"{DETECT_HELP.capitalize()}.")] = 1.5,
    dof: Annotated[int, typer.Option("--dof", help="Dimension of the error; 3 for a planar pose.")] = 3,
    false_alarm: FalseAlarm = 0.05,
    power: Power = 0.95,
    allow: Annotated[
        str | None, typer.Option("--allow", help="'conservative': a covariance too large is no fault.")
    ] = None,
    lost: Annotated[float | None, typer.Option("--lost", help=f"{LOST_HELP.capitalize()}.", metavar="P")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
) -> None:
    """How many runs a verdict takes: however steps depend on each other, or as they do in a pilot."""
    from consistency.terminal.table import print_plan
    from consistency.verdicts.options import plan as plan_runs

    if scenario is not None and like is not None:
        raise InputError("give either a SCENARIO for a pilot or --like RESULTS")
    if filters and scenario is None and like is None:
        raise InputError("--filter goes with a SCENARIO or --like RESULTS")
    if scenario is not None and not filters:
        raise InputError(f"--filter: name the filter to plan for in {scenario}")
    pilots = None
    if like is not None:
        from consistency.store.results import open_results
        from consistency.verdicts.judge import pilots_of

        pilots = pilots_of(open_results(like), filters)
    elif scenario is not None:
        from consistency.runs.montecarlo import run_trials
        from consistency.scenario import load_scenario
        from consistency.verdicts.judge import pilots_of

        plan_runs(dof, detect, false_alarm, power, allow, lost=lost)  # refuse before the work
        pilots = pilots_of(run_trials(load_scenario(scenario), filters or [], pilot_runs, seed), filters)
    planned = plan_runs(dof, detect, false_alarm, power, allow, pilots, lost)
    if as_json:
        print(json.dumps(planned, indent=2))
    else:
        print_plan(planned)


@app.command()
@reads_files
def compare(
    path: Judged,
    files: FileOptions,
    other: Annotated[
        Path | None, typer.Argument(metavar="[OTHER]", help="Earlier ones in the same form, or a file of 'baseline'.")
    ] = None,
    filters: Annotated[
        list[str] | None,
        typer.Option(
            "--filter", metavar="NAME", help="Without OTHER: the first against the rest. With it: this filter in both."
        ),
    ] = None,
    false_alarm: FalseAlarm = 0.05,
    skip: Skip = None,
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
    fail_on: Annotated[str | None, typer.Option("--fail-on", help="'worse': exit 1 if the first is.")] = None,
) -> None:
    """Is a filter less consistent than another, or than it was? Run by run on the same trials."""
    from consistency.terminal.table import comparisons_json, print_comparisons
    from consistency.verdicts.baselines import baseline_of_files, is_baseline, read_baseline
    from consistency.verdicts.comparison import compare_filters, compare_with
    from consistency.verdicts.options import skip_asked

    if fail_on not in (None, "worse"):
        raise InputError(f"--fail-on must be 'worse', got '{fail_on}'")
    if not 0.0 < false_alarm < 1.0:
        raise InputError(f"--false-alarm must lie between 0 and 1, got {false_alarm}")
    first = skip_asked(skip)
    sides = [each for each in (path, other) if each is not None]
    estimates = [each for each in sides if not is_baseline(each) and files.are(each)]
    if not estimates and (unread := files.given()):
        raise InputError(f"{unread[0]}: is for files of another estimator, and none is named")
    if len(estimates) == 2 and files.covariance is not None:
        raise InputError(
            f"--covariance: would be read with {path} and with {other}; keep one of them with 'consistency baseline'"
        )
    read = {each: files.read(each) for each in estimates}
    new, *old = (
        baseline_of_files(read[each], str(each), files.truth, first) if each in read else read_baseline(each, first)
        for each in sides
    )
    if old:
        compared = compare_with(new, old[0], filters or [], false_alarm)
    else:
        compared = compare_filters(new, filters or [], false_alarm)
    tell_notes(*read.values())
    if as_json:
        print(comparisons_json(compared))
    else:
        print_comparisons(compared)
    if fail_on and any(each.worse for each in compared):
        raise typer.Exit(1)


@app.command()
@reads_files
def baseline(
    path: Judged,
    out: Annotated[Path, typer.Option("--out", help="JSON file to write; small enough for version control.")],
    files: FileOptions,
    skip: Skip = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file if it exists.")] = False,
) -> None:
    """Keep what a later 'compare' needs of results, one row a run."""
    from consistency.verdicts.baselines import baseline_of_files, write_baseline

    if files.are(path):
        recordings = files.read(path)
        write_baseline(baseline_of_files(recordings, str(path), files.truth, skip), out, overwrite)
        tell_notes(recordings)
    else:
        from consistency.store.results import open_results
        from consistency.verdicts.baselines import baseline_of

        write_baseline(baseline_of(open_results(path), str(path), skip), out, overwrite)
    print(f"baseline in {out}; next: consistency compare NEW {out}")


@app.command()
@reads_files
def report(
    path: Annotated[
        Path, typer.Argument(metavar="PATH", help=f"Folder written by 'run' or 'reproduce', or estimates: {ESTIMATES}.")
    ],
    files: FileOptions,
    html: Annotated[
        Path | None,
        typer.Option("--html", help="HTML file [default: PATH/report.html; of estimates PATH-report.html]."),
    ] = None,
    pdf: Annotated[Path | None, typer.Option("--pdf", help="PDF file [beside the default HTML file].")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files that exist.")] = False,
) -> None:
    """Write a report of results as one offline HTML file and a PDF."""
    from consistency.reporting import require_pages, write_file_pages, write_reports
    from consistency.verdicts.files import analyse_recordings

    estimates = files.are(path)
    stem = path.with_name(f"{path.stem}-report") if estimates else path / "report"
    # one of the two named: only that one is written
    targets = (html, pdf) if html or pdf else (stem.with_name(f"{stem.name}.html"), stem.with_name(f"{stem.name}.pdf"))
    if estimates:
        require_pages(*targets, overwrite)
        recordings = files.read(path)
        write_file_pages(recordings, analyse_recordings(recordings), *targets, path.name)
        tell_notes(recordings)
    else:
        write_reports(path, *targets, overwrite)
    for target in targets:
        if target is not None:
            print(target)


@app.command()
def reproduce(
    only: Annotated[
        list[str] | None,
        typer.Option("--only", metavar="NAME", help="Only this finding or experiment; may be repeated."),
    ] = None,
    long: Annotated[bool, typer.Option("--all", help="Also experiments that take from minutes to hours.")] = False,
    runs: Runs = 50,
    seed: Seed = 0,
    jobs: Jobs = -1,
    out: Out = Path("reports/reproduce"),
    overwrite: Overwrite = False,
) -> None:
    """Set each published finding beside what is measured here; exit 1 if a published one is not reproduced."""
    from consistency.reporting import write_reports
    from consistency.runs.findings import reproduce as reproduce_findings
    from consistency.terminal.table import print_findings
    from consistency.types import OURS

    findings = reproduce_findings(only, runs, seed, jobs, out, overwrite, long)
    print_findings(findings)
    for path in (out / "findings.json", *write_reports(out, out / "report.html", out / "report.pdf", overwrite=True)):
        print(path)
    missed = [finding.id for finding in findings if finding.verdict != "reproduced"]
    own = [finding.id for finding in findings if finding.source.startswith(OURS) and finding.id in missed]
    published = [id for id in missed if id not in own]
    for said, names in (("not reproduced", published), ("do not hold", own)):
        if names:
            print(f"{said}: {', '.join(names)}", file=sys.stderr)
    if published:
        raise typer.Exit(1)


@app.command()
def monitor(
    path: Annotated[
        str,
        typer.Argument(
            metavar="FILE",
            help="Innovations of one run: .csv, .parquet, .npz, .ulg of PX4, a folder of 'run', or - for CSV lines.",
        ),
    ],
    innovations: Annotated[
        str | None,
        typer.Option("--innovations", help="'optimal': declares the optimal gain, without which nothing is judged."),
    ] = None,
    false_alarm: Annotated[
        float, typer.Option("--false-alarm", help="Chance that a right filter ever raises an alarm.")
    ] = 1e-3,
    tolerance: Annotated[
        float, typer.Option("--tolerance", help="Scales of the NIS up to this ratio are no fault; 1 is the exact test.")
    ] = 1.2,
    gate: Annotated[
        float | None, typer.Option("--gate", help="Probability of the filter's chi-square gate, such as 0.99.")
    ] = None,
    mission: Annotated[
        int | None, typer.Option("--mission", help="Innovations of the whole mission, if known.")
    ] = None,
    filter_name: Annotated[
        str | None, typer.Option("--filter", help="Which, if FILE holds several; of a .ulg the sensor.")
    ] = None,
    run: Annotated[
        int | None, typer.Option("--run", help="Which, if FILE holds several; of a .ulg the EKF2's instance.")
    ] = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="NIS and evidence as .png, .pdf or .svg.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the plot if it exists.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
    fail_on: Annotated[str | None, typer.Option("--fail-on", help="'alarm': exit 1 if there is one.")] = None,
) -> None:
    """Watch the NIS of a filter in service: an alarm if it is not what the filter states, and since when."""
    from consistency.reading import one_line
    from consistency.reporting import require_plot, write_monitor_plot
    from consistency.terminal.table import print_watched, watched_json
    from consistency.verdicts.monitoring import make_monitor, read_innovations, watch, watch_lines

    if fail_on not in (None, "alarm"):
        raise InputError(f"--fail-on must be 'alarm', got '{fail_on}'")
    watcher = make_monitor(innovations, false_alarm=false_alarm, tolerance=tolerance, gate=gate, mission=mission)
    if path == "-":
        options = _options(filter=filter_name, run=run, plot=plot)
        if options:
            raise InputError(f"--{next(iter(options))}: does not go with lines as they come (-)")
        watched = watch_lines(sys.stdin, "stdin", watcher, lambda alarm: print(alarm, file=sys.stderr, flush=True))
    else:
        log = read_innovations(Path(path), filter_name, run)
        for note in log.notes:
            print(f"consistency: {one_line(note, 4000)}", file=sys.stderr)
        if plot is not None:
            require_plot(plot, overwrite)
        watched = watch(log, watcher)
    if plot is not None:
        write_monitor_plot(plot, watched)
    if as_json:
        print(watched_json(watched))
    else:
        print_watched(watched)
    if fail_on and watched.alarm is not None:
        raise typer.Exit(1)


def main(arguments: list[str] | None = None) -> Any:
    """Entry point: unusable input ends in one line and exit status 2; SIGTERM and SIGHUP are taken as Ctrl-C.

    Without ``arguments``, as a command, in a child of this process, see :mod:`consistency.store.ending`.
    """
    from consistency.store.ending import supervised

    return supervised(_command) if arguments is None else _command(arguments)


def _command(arguments: list[str] | None = None) -> Any:
    from consistency.store.stopping import STOPS, stoppable

    _open_closed_streams()
    with stoppable(also=STOPS) as stop:
        try:
            status = 0 if _show_help(arguments) else app(arguments, standalone_mode=False)
            if stop.number is not None:  # typer has an exit status of its own for KeyboardInterrupt
                raise KeyboardInterrupt
            sys.stdout.flush()
            sys.exit(status)
        except MemoryError:
            _end("not enough memory; take fewer steps, landmarks or runs", 2)
        except InputError as error:
            _end(_line(str(error)), 2)
        except UsageError as error:
            command = getattr(getattr(error, "ctx", None), "command_path", "consistency")
            _end(_line(f"{error.format_message()} See: {command} --help"), 2)
        except (BrokenPipeError, SystemExit) as error:  # libraries end with status 1, which is a verdict's here
            if not isinstance(error, BrokenPipeError) and not isinstance(error.__context__, BrokenPipeError):
                raise
            _drop_output()
            sys.exit(141)
        except OSError as error:
            if error.filename is None and error.errno not in FULL:
                raise
            fault = "output cannot be written" if error.filename is None else f"{error.filename}: cannot be used"
            _end(_line(f"{fault} ({error.strerror})"), 2)
        except (KeyboardInterrupt, Abort):
            _end("stopped", stop.status)
        except Exception:
            if stop.number is None:
                raise
            _end("stopped", stop.status)  # and who was called took it for an error of its own


def _show_help(arguments: list[str] | None) -> bool:
    """Print the help of a command, where that is all that is asked for.

    Typer does so after it has imported what checks the values of options, which takes longer than all the rest.
    """
    words = sys.argv[1:] if arguments is None else arguments
    if len(words) != 2 or words[1] not in HELP:
        return False
    root: Any = typer.main.get_command(app)
    top: Any = typer.Context(root, info_name="consistency", help_option_names=HELP)
    command = root.get_command(top, words[0])
    if command is not None:
        print(command.get_help(typer.Context(command, info_name=words[0], parent=top)))
    return command is not None


def _line(sentence: str) -> str:
    from consistency.reading import one_line

    return one_line(sentence, 4000)


def _end(sentence: str, status: int) -> NoReturn:
    from consistency.terminal.progress import say

    say(f"consistency: {sentence}")
    try:
        sys.stdout.flush()
    except OSError:
        _drop_output()
    sys.exit(status)


def _drop_output() -> None:
    """What standard output could not take goes nowhere; else it would be tried again at the exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _open_closed_streams() -> None:
    """Let output that the shell has closed go nowhere, and not into the next file that is opened."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w", encoding="utf-8"))  # noqa: SIM115


if __name__ == "__main__":
    main()
