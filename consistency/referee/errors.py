"""The one error that a user can correct: unusable input."""


class InputError(ValueError):
    """Unusable input; the message names the file or argument, the key, and the allowed values.

    The command line prints it as one line and ends with exit status 2.
    """
