"""The one error type that means: the user can fix this."""


class BadInput(Exception):  # noqa: N818 - it is the user's input, not an error of ours
    """What the user gave cannot be used. The message is one line: what is wrong and what to do.

    The command line prints it and exits with code 2; every other exception is a bug and keeps its traceback.
    """
