"""The exceptions that a user can act upon."""

MAX_MESSAGE = 900
"""Characters."""


class HyalineError(Exception):
    """What went wrong, in one line: `{where}: {what, with the value}; {the way out}`.

    Commands print it without a traceback and exit with `status`. Where a value that somebody wrote makes it longer than
    a few lines of a terminal, its middle is left out.
    """

    status = 1

    def __init__(self, message: str) -> None:
        super().__init__(message if len(message) <= MAX_MESSAGE else f"{message[:600]} ... {message[-250:]}")


class DamagedError(HyalineError):
    """A file is missing, or does not hold what was promised: what can make it may make it again."""


class WorkerKilledError(HyalineError):
    """A worker process ended in the middle of its work, by a signal; what others had finished is kept."""


class NumericsError(HyalineError):
    """A number that has to be finite is not: it came from damaged data or from training that diverged."""

    status = 3


class UsageError(HyalineError):
    """A command was typed that does not exist."""

    status = 2
