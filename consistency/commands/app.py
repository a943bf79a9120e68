"""The command line: parses, calls, prints. Every command imports what it needs when it is called."""

from __future__ import annotations

import os
import sys
import traceback
from typing import Annotated, Any, NoReturn

import typer

from consistency.commands.registry import HELP, CommandGroup
from consistency.referee.errors import InputError
from consistency.referee.extras import explained

UsageError: Any = typer.BadParameter.__base__  # click's, wherever typer keeps it
Abort: Any = typer.Abort

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
        from consistency.referee.system.atomic import FULL

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
    if len(words) != 2 or words[1] not in HELP:
        return False
    root: Any = typer.main.get_command(app)
    top: Any = typer.Context(root, info_name="consistency", help_option_names=HELP)
    command = root.get_command(top, words[0])
    if command is not None:
        print(command.get_help(typer.Context(command, info_name=words[0], parent=top)))
    return command is not None


def _end(sentence: str, status: int) -> NoReturn:
    from consistency.referee.parsing import one_line
    from consistency.referee.system.progress import say

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
