"""The one kind of error that a user can cause and mend."""


class UserError(Exception):
    """A mistake in the input. The message is one line: file or key, expected, found, what to do.

    The command line prints it without a traceback and exits with code 2.
    """


def mistake_behind(error: BaseException | None) -> UserError | None:
    """The :class:`UserError` that an exception was raised from, if any; jsonargparse wraps what a constructor raises."""
    while error is not None and not isinstance(error, UserError):
        error = error.__cause__ or error.__context__
    return error
