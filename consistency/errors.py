"""The one error a user can mend: unusable input."""


class InputError(ValueError):
    """Input that cannot be used: says which file or argument, which key, and what is allowed.

    The command line prints it as one line and ends with exit status 2.
    """
