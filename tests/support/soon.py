"""What must end: refusals within some CPU seconds on processors of any speed, anything at all within some seconds."""

import gc
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager


class TookTooLong(BaseException):
    """Passes whatever catches errors."""


@contextmanager
def ending_within(seconds: float) -> Iterator[None]:
    """Raises `TookTooLong` in a block that computes for longer, or waits for five times as long.

    Not while a native library keeps the thread.
    """

    def stop(*_: object) -> None:
        raise TookTooLong(f"more than {seconds:g} s")

    timers = (
        (signal.ITIMER_PROF, signal.SIGPROF, seconds),
        (signal.ITIMER_REAL, signal.SIGALRM, 5 * seconds),
    )
    before = {number: signal.signal(number, stop) for _, number, _ in timers}
    for timer, _, limit in timers:
        signal.setitimer(timer, limit)
    try:
        yield
    finally:
        for timer, number, _ in timers:
            signal.setitimer(timer, 0)
            signal.signal(number, before[number])


@contextmanager
def soon(limit_s: float = 2.0) -> Iterator[None]:
    """Fails where the block takes more CPU seconds than four times `limit_s`.

    So the marks hold on slow processors, too: what fails takes many times as long, not a little longer.
    """
    # What earlier tests left in memory is walked by no collection while the block runs. (To count what is frozen, as
    # `gc.get_freeze_count` does, would itself walk all of it.)
    gc.freeze()
    start = _cpu_s()
    yield
    took = _cpu_s() - start
    assert took <= 4 * limit_s, f"took {took:.1f} CPU s; expected {limit_s:.1f}, and at most four times as many"


def _cpu_s() -> float:
    """CPU seconds of this process and of its children that have ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system
