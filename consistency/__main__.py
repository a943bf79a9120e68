"""``python -m consistency`` and the command ``consistency``: the command line, in a process that any signal ends."""

import gc
import os
import signal
import sys
import threading
from contextlib import suppress
from typing import Any, NoReturn

GLANCE = 0.1  # s between looks, for a signal that another thread was given
SHOW_CURSOR = "\x1b[?25h"
GOES_ON = "; finished runs are kept where there are any: the same command continues, 'run' with --resume"
PROGRAMS_GO_ON = "; finished runs are kept: the same command with --resume continues"


class Command(threading.Thread):
    """The command line; ``status`` is what it ends with.

    A thread does it, because Python runs handlers of signals in the main thread, and a compiler or a reader of files
    in C may keep that from it for minutes. Nothing is tidied up: finished runs are on disk, and what a command leaves
    in the way is cleared by the next one that wants the place.
    """

    status: Any = 1

    def run(self) -> None:
        gc.set_threshold(50_000, 20, 100)  # most of what is made lives as long as the modules that are imported
        for stream in (sys.stdout, sys.stderr):
            with suppress(AttributeError, OSError):  # of a stream that is closed, or that nobody reads
                stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]  # of a locale without Unicode
        from consistency.commands import main  # slow to load

        try:
            self.status = main()
        except SystemExit as end:
            self.status = end.code


def main() -> NoReturn:
    """Run the command line until it ends, or until Ctrl-C does; SIGTERM and SIGHUP end the process by themselves.

    Where programs are run, they end them, too; what a report has half written is removed before.
    """
    signals = [signal.SIGINT]
    if sys.argv[1:2] in (["monte-carlo"], ["analyse"], ["report"]):
        signals += [signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]
    for number in signals:
        if signal.getsignal(number) is not signal.SIG_IGN:  # as of nohup, and of & in a script
            signal.signal(number, _stop)
    command = Command()
    command.start()
    while command.is_alive():
        command.join(GLANCE)
    sys.exit(command.status)


def _stop(number: int, _: Any = None) -> NoReturn:
    """Say so in one line and end at once; an exception would be swallowed by serialisers and compilers."""
    for end in getattr(sys.modules.get("consistency.referee.system"), "AT_STOP", ()):
        end()
    if number != signal.SIGINT and sys.argv[1:2] != ["monte-carlo"]:  # as it would have ended by itself
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
    line = "consistency: stopped"
    if sys.argv[1:2] in (["run"], ["sweep"]):
        line += GOES_ON
    elif sys.argv[1:2] == ["monte-carlo"]:
        line += PROGRAMS_GO_ON
    with suppress(OSError, ValueError, AttributeError):  # a stream that is closed
        if sys.stderr.isatty():
            line = f"{SHOW_CURSOR}\n{line}"
        os.write(sys.stderr.fileno(), f"{line}\n".encode())
    os._exit(128 + number)


if __name__ == "__main__":
    main()
