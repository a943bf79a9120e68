"""The command line: parses, calls, prints.

The table of commands says where each is and which extras it needs; the called one alone is loaded.

A command is a function of Typer in a module of this folder, and a row here.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib import import_module
from typing import Annotated, Any, NoReturn, cast

import typer
from typer.core import TyperCommand, TyperGroup
from typer.models import CommandInfo

from consistency.referee.errors import InputError
from consistency.referee.extras import explained, is_installed, remedy, require

UsageError: Any = typer.BadParameter.__base__  # click's, wherever typer keeps it
Abort: Any = typer.Abort
HELP = ["-h", "--help"]
HELP_ALL = "--help-all"
GROUPS = {  # of the list of commands; a command that stands in none is in the first
    "Judge your own estimator": (),
    "The stereo SLAM test bench": ("list", "simulate", "run", "reproduce", "sweep", "challenge", "tune"),
    "Stereo images": ("frontend", "characterise"),
}
PANELS = {  # of the options of commands that read files
    "Needed first": (
        "truth", "covariance", "error", "state", "align", "relative", "skip", "false_alarm", "report", "fail_on",
        "span", "estimates", "out",
    ),
    "What to read": (
        "topic", "truth_topic", "columns", "truth_columns", "world", "body_axes", "truth_world", "truth_body_axes",
        "filters", "name", "axes", "covariance_order", "body", "truth_covariance", "truth_errors", "truth_shared",
        "split", "motions", "dof", "second", "independent", "members", "ensemble", "level", "gaussian", "ends",
        "alert_limit",
    ),
    "How to align": ("max_dt", "time_offset", "lever_arm", "windows"),
    "What to run": (
        "each", "runs", "until_decided", "max_runs", "seed", "jobs", "timeout", "cwd", "check_seed", "keep", "resume",
    ),
    "What to fit": ("per", "held_out", "keep_mean_error", "no_correct", "by_turn", "cautious", "anyway"),
    "What to ask": (
        "by", "by_file", "bins", "detect", "tolerance", "lost", "innovations", "confidence", "power",
    ),
    "What to write": ("html", "pdf", "junit", "verbose", "as_json", "overwrite", "help"),
}  # fmt: skip
SELDOM = {  # options that --help-all alone shows
    "covariance_order", "body", "truth_covariance", "truth_errors", "truth_shared", "motions", "windows", "dof",
    "lever_arm", "truth_columns", "body_axes", "truth_world", "truth_body_axes", "bins", "by_file", "tolerance", "lost",
    "confidence", "verbose", "max_dt", "members", "ensemble", "ends", "gaussian",
    "alert_limit",
}  # fmt: skip


class CommandGroup(TyperGroup):
    """The commands of the table, one of which is loaded when it is called."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands: Any = Loaded()

    def list_commands(self, ctx: Any) -> list[str]:
        return list(self.commands)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Each command with a line, in its group."""
        others = {name for names in GROUPS.values() for name in names}
        limit = formatter.width - 6 - max(map(len, COMMANDS))
        for group, names in GROUPS.items():
            shown = names or [name for name in COMMANDS if name not in others]
            with formatter.section(group):
                formatter.write_dl([(name, self.commands[name].get_short_help_str(limit)) for name in shown])

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Refuse a command without its packages, before its options are looked at; its help is there."""
        name, command, rest = super().resolve_command(ctx, args)
        if name is not None and not ctx.resilient_parsing and not {*HELP} & {*rest}:
            require(f"'{name}'", *COMMANDS[name].extras)
        return name, command, rest

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """What the marks mean, where there are some."""
        marks = {extra: None for row in ROWS for extra in lacking(row.extras)}
        if marks:
            formatter.write(f"\n  [{','.join(marks)}]: needs {remedy(*marks)}\n")  # on one line, to be copied


app = typer.Typer(
    cls=CommandGroup,
    help="Check whether an estimator's covariance matches its errors: 'consistency analyse FILES --truth TRUTH'.",
    context_settings={"help_option_names": HELP},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


@app.callback(invoke_without_command=True)
def _main(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Show the version and exit.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an unforeseen exception.")] = False,
) -> None:
    if version:
        from importlib.metadata import version as version_of

        print(version_of("filter-consistency"))
    elif context.invoked_subcommand is None:
        print(context.get_help())


def main(arguments: list[str] | None = None) -> Any:
    """Entry point: an exception ends in one line and exit status 2, so that status 1 is a verdict's alone."""
    try:
        return _run(arguments)
    except Exception as error:
        words = sys.argv[1:] if arguments is None else arguments
        if words[:1] == ["--debug"]:
            traceback.print_exc()
        at = traceback.extract_tb(error.__traceback__)[-1]
        what = f"{type(error).__name__} in {at.filename}:{at.lineno}: {error}"
        _end(f"unforeseen {what}; please report it, with what 'consistency --debug COMMAND ...' shows", 2)


def _run(arguments: list[str] | None) -> Any:
    """Unusable input ends in one line and exit status 2, KeyboardInterrupt in exit status 130."""
    _open_closed_streams()
    try:
        status = 0 if _show_help(arguments) else app(arguments, standalone_mode=False)
        sys.stdout.flush()
        sys.exit(status)
    except MemoryError:
        _end("not enough memory; take fewer steps, landmarks or runs", 2)
    except InputError as error:
        _end(str(error), 2)
    except UsageError as error:
        command = getattr(getattr(error, "ctx", None), "command_path", "consistency")
        _end(f"{error.format_message()} See: {command} --help", 2)
    except ModuleNotFoundError as error:
        words = sys.argv[1:] if arguments is None else arguments
        missing = explained(error, f"'{words[0]}' with these arguments")
        if missing is None:
            raise
        _end(str(missing), 2)
    except (BrokenPipeError, SystemExit) as error:  # libraries end with status 1, which is a verdict's here
        if not isinstance(error, BrokenPipeError) and not isinstance(error.__context__, BrokenPipeError):
            raise
        _drop_output()
        sys.exit(141)
    except OSError as error:
        from consistency.referee.system import FULL

        if error.filename is None and error.errno not in FULL:
            raise
        fault = "output cannot be written" if error.filename is None else f"{error.filename}: cannot be used"
        _end(f"{fault} ({error.strerror})", 2)
    except (KeyboardInterrupt, Abort):
        _end("stopped", 130)


def _show_help(arguments: list[str] | None) -> bool:
    """Print the help of a command, where that is all that is asked for.

    Typer does so after it has imported what checks the values of options, which takes longer than all the rest.
    """
    words = sys.argv[1:] if arguments is None else arguments
    is_all = HELP_ALL in words[1:]
    if not is_all and (len(words) != 2 or words[1] not in HELP):
        return False
    root: Any = typer.main.get_command(app)
    top: Any = typer.Context(root, info_name="consistency", help_option_names=HELP)
    command = root.get_command(top, words[0])
    if command is not None:
        command.shows_all = is_all
        print(command.get_help(typer.Context(command, info_name=words[0], parent=top)))
    return command is not None


def _end(sentence: str, status: int) -> NoReturn:
    from consistency.referee.parsing import one_line
    from consistency.referee.system import say

    say(f"consistency: {one_line(sentence, 4000)}")
    try:
        sys.stdout.flush()
    except OSError:
        _drop_output()
    sys.exit(status)


def _drop_output() -> None:
    """What a stream could not take goes nowhere; otherwise Python tries again at its end, and ends with status 120."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _open_closed_streams() -> None:
    """Let output that the shell has closed go nowhere, and not into the next file that is opened."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w", encoding="utf-8"))  # noqa: SIM115


class Row:
    """A command: its function, as ``module:name`` in this folder, extras that it always needs, and examples."""

    def __init__(self, name: str, target: str, extras: str = "", *examples: str) -> None:
        self.name = name
        self.module, _, self.function_name = target.partition(":")
        self.extras = tuple(extras.split())
        self.examples = examples

    def function(self) -> Callable[..., Any]:
        """Import the module of the command, and return its function."""
        module = import_module(f"consistency.commands.{self.module}")
        return cast(Callable[..., Any], getattr(module, self.function_name))


# fmt: off
ROWS = (
    # for any estimator
    Row("analyse", "judging:analyse_command", "",
        "analyse mine.npz --report look",
        "analyse est.txt --truth truth.txt --covariance P.txt --error so3",
        "analyse est --truth truth --align posyaw",
        "analyse results --skip 2s --fail-on inconsistent"),
    Row("inspect", "judging:inspect_command", "", "inspect est.csv", "inspect bags --topic /odometry/filtered"),
    Row("report", "judging:report_command", "report",
        "report est.txt --truth truth.txt --covariance P.txt",
        "report results"),
    Row("compare", "judging:compare_command", "",
        "compare new.csv old.csv --truth truth.csv --fail-on worse",
        "compare results --filter ukf-uvd --filter ekf-uvd"),
    Row("monte-carlo", "programs:monte_carlo_command", "",
        "monte-carlo --truth truth.csv --out runs -- ./build/ekf {seed}",
        "monte-carlo --until-decided --jobs 4 --out runs -- python {here}/ekf.py --seed {seed}",
        "monte-carlo --each 'logs/*' --truth 'truth/{name}.csv' --out runs -- ./ekf {input}"),
    Row("baseline", "judging:baseline_command", "", "baseline results --out baseline.json"),
    Row("plan", "judging:plan_command", "",
        "plan --dof 3 --detect 1.2",
        "plan --like results",
        "plan herath2007-stereo --filter ekf-uvd --detect 1.2"),
    Row("fit-covariance", "fitting:fit_covariance_command", "",
        "fit-covariance wheels --truth truth --span 1m --out noise",
        "fit-covariance odometry.csv --truth truth.csv --span 1s --held-out half"),
    Row("correct", "fitting:correct_command", "",
        "correct est --truth truth --out correction",
        "correct est.csv --truth truth.csv --per axis"),
    Row("monitor", "judging:monitor_command", "",
        "monitor innovations.csv --innovations optimal --plot alarm.png",
        "monitor flight.ulg"),
    # the laboratory
    Row("list", "studies:list_command"),
    Row("simulate", "studies:simulate_command", "bench", "simulate herath2007-stereo --runs 10 --out log"),
    Row("frontend", "stereo:frontend_command", "vision",
        "frontend IMAGES --out drive",
        "frontend IMAGES --calibration stereo.yml --rate 20 --out drive"),
    Row("run", "studies:run_command", "bench",
        "run herath2007-stereo --filter ekf-uvd --filter ukf-uvd --out results",
        "run world.toml --filter ekf-uvd --until-decided --out results",
        "run --log log --filter ekf-uvd --out results",
        "run --log log --screen 2,2,1 --filter ekf-uvd --out results"),
    Row("reproduce", "studies:reproduce_command", "bench report",
        "reproduce --out findings",
        "reproduce --only fig3-chain --runs 20 --out findings"),
    Row("challenge", "studies:challenge_command", "bench", "challenge ukf-uvd --minutes 5 --out worst.toml"),
    Row("characterise", "stereo:characterise_command", "bench",
        "characterise log --out sensor.toml",
        "characterise IMAGES --board 9x6 --square 0.024 --out s.toml"),
    Row("sweep", "studies:sweep_command", "bench report",
        "sweep regime --out regime",
        "sweep grid.toml --filter ekf-uvd --out cells"),
    Row("tune", "studies:tune_command", "bench",
        "tune herath2007-optimistic --filter oc-ekf-xyz",
        "tune --log log --filter ekf-uvd"),
)
# fmt: on
COMMANDS = {row.name: row for row in ROWS}


class MarkedCommand(TyperCommand):
    """A command that says in the list of commands which of its extras are not installed."""

    lacks: tuple[str, ...] = ()
    shows_all: bool = False  # options that few need, too

    def get_short_help_str(self, limit: int = 45) -> str:
        mark = f"[{','.join(self.lacks)}] " if self.lacks else ""
        return mark + super().get_short_help_str(limit - len(mark))

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """The options of a command that reads files in panels, and those of others in one list."""
        names = {parameter.name for parameter in self.get_params(ctx)}
        if "truth_world" not in names:
            super().format_options(ctx, formatter)
            return
        hidden = SELDOM.intersection(names) if not self.shows_all else set()
        records: dict[str, list[tuple[str, str]]] = {"Arguments": [], **{panel: [] for panel in PANELS}}
        for panel, parameter in in_panels(self.get_params(ctx)):
            if parameter.name not in hidden and (record := parameter.get_help_record(ctx)) is not None:
                records[panel].append(record)
        for panel in filter(records.get, records):
            with formatter.section(panel):
                formatter.write_dl(records[panel])
        if hidden:
            formatter.write(f"\n  {len(hidden)} more options, rarely needed: consistency {ctx.info_name} {HELP_ALL}\n")


def in_panels(parameters: Iterable[Any]) -> list[tuple[str, Any]]:
    """Parameters with their panels, in the order that a panel has; arguments and what stands in none keep theirs."""
    order = {name: (panel, place) for panel, names in PANELS.items() for place, name in enumerate(names)}
    *_, last = PANELS
    found = []
    for place, parameter in enumerate(parameters):
        panel, at = order.get(parameter.name, (last, place))
        found.append(("Arguments" if parameter.param_type_name == "argument" else panel, at, parameter))
    return [(panel, parameter) for panel, _, parameter in sorted(found, key=lambda each: each[1])]


class Loaded(Mapping[str, Any]):
    """The commands by name; the module of one is imported when it is asked for."""

    def __getitem__(self, name: str) -> Any:
        row = COMMANDS[name]
        # below the options; the mark keeps the lines as they are
        epilog = "\b\nExamples:\n" + "\n".join(f"  consistency {line}" for line in row.examples)
        info = CommandInfo(
            name,
            cls=MarkedCommand,
            callback=row.function(),
            epilog=epilog if row.examples else None,
        )
        made: Any = typer.main.get_command_from_info(info, pretty_exceptions_short=True, rich_markup_mode=None)
        made.lacks = lacking(row.extras)
        return made

    def __iter__(self) -> Iterator[str]:
        return iter(COMMANDS)

    def __len__(self) -> int:
        return len(COMMANDS)


def lacking(extras: tuple[str, ...]) -> tuple[str, ...]:
    """Those of the extras that are not installed here."""
    return tuple(extra for extra in extras if not is_installed(extra))
