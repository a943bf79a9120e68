"""The one error that a user can correct: unusable input."""

import re
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")
COMMAND = r"'?consistency [a-z-]+[^;,:)']*'?"  # a command line, which keeps its flags
# how what follows a flag begins, if it is its value
WORDS = "repeats|auto|estimate|columns|half|optimal|posyaw|se3|origin|additive|left|right|so3"
VALUE = rf"[\w,]+ for |[-\d'\"./A-Z]|[\w.+-]+[:,=]|(?:{WORDS})\b"
SUBJECT = r":| must| needs| is| goes"  # what follows a flag that is the subject of a sentence
FLAG = re.compile(rf"({COMMAND})|(?<![\w-])--([a-z][a-z-]*)(?:(?={SUBJECT})|( (?={VALUE})|))")


class InputError(ValueError):
    """Unusable input; the message names the file or argument, the key, and the allowed values.

    The command line prints it as one line and ends with exit status 2.
    """


def naming_arguments(function: Callable[P, R]) -> Callable[P, R]:
    """The function for use in Python, whose errors say ``max_dt=`` where the command line has ``--max-dt``."""

    @wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return function(*args, **kwargs)
        except InputError as error:
            error.args = (FLAG.sub(_as_argument, str(error)), *error.args[1:])
            raise

    return called


def _as_argument(found: re.Match[str]) -> str:
    return found[1] or found[2].replace("-", "_") + ("" if found[3] is None else "=")
