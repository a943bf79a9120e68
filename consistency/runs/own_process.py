"""A function called in a process of its own, while this one does something else."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Generic, TypeVar, cast

T = TypeVar("T")


class OwnProcess(Generic[T]):
    """A call that runs in a new process from now on.

    Parameters
    ----------
    function : at the top level of a module, for the new process imports it by name
    arguments : of the function; these and its value are sent between the processes, pickled
    """

    def __init__(self, function: Callable[..., T], *arguments: object) -> None:
        context = multiprocessing.get_context("spawn")
        self._receiver, sender = context.Pipe(duplex=False)
        self._process = context.Process(target=_call, args=(sender, function, arguments), daemon=True)
        self._process.start()
        sender.close()

    def result(self) -> T:
        """Wait for the function's value.

        Raises
        ------
        Exception
            That of the function.
        ChildProcessError
            The process ended without an answer.
        """
        try:
            value, error = self._receiver.recv()
        except EOFError:
            self._process.join()
            raise ChildProcessError(f"its process ended with exit status {self._process.exitcode}") from None
        if error is not None:
            raise error
        return cast("T", value)

    def stop(self) -> None:
        """End the process, whatever it is at."""
        self._process.terminate()
        self._process.join()
        self._receiver.close()


def _call(sender: Connection, function: Callable[..., T], arguments: tuple[object, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C is reported by the first process alone
    try:
        sender.send((function(*arguments), None))
    except Exception as error:
        sender.send((None, error))
