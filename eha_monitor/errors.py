"""The one exception that a user is meant to see."""


class InputError(Exception):
    """Bad input: the message is one line that names what is wrong and what was expected.

    The command line prints it without a traceback and exits with status 2.
    """
