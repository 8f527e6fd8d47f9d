"""The one error that a user can cause and mend."""


class UserError(Exception):
    """A mistake in the input. The message is one line: file or key, expected, found, what to do.

    The command line prints it without a traceback and exits with code 2.
    """
