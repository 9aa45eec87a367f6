"""The exceptions that a user can act upon."""


class HyalineError(Exception):
    """What went wrong, in one line: `{where}: {what, with the value}; {the way out}`.

    Commands print it without a traceback and exit with `status`.
    """

    status = 1


class DamagedError(HyalineError):
    """A file is missing, or does not hold what was promised: what can make it may make it again."""


class WorkerKilledError(HyalineError):
    """A worker process ended in the middle of its work, by a signal; what others had finished is kept."""


class NumericsError(HyalineError):
    """A number that has to be finite is not: it came from damaged data or from training that diverged."""

    status = 3
