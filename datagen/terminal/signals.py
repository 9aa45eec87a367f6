"""Signals that ask a command to stop: SIGINT (Ctrl-C) and SIGTERM (a scheduler, a shutdown).

Everywhere they raise at once, and what was committed stays. Where a block has work in hand that it can save in a
moment, it holds them back and asks between two pieces of work.
"""

import contextlib
import signal
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from types import FrameType


class Stopped(BaseException):
    """A signal asked this process to stop; like KeyboardInterrupt, it passes whatever catches errors."""

    def __init__(self, number: int, message: str | None = None) -> None:
        super().__init__(message or "stopped")
        self.message = message
        """What was saved and how to go on; None: the command has nothing special to say."""
        self.status = 128 + number
        """The exit status, as shells count it: 130 for SIGINT, 143 for SIGTERM."""


def signal_within(error: BaseException) -> Stopped | None:
    """The signal that a library has turned into an error of its own; None: no signal was the cause."""
    cause: BaseException | None = error
    seen: set[int] = set()
    while cause is not None and id(cause) not in seen:  # An error may be its own cause.
        if isinstance(cause, Stopped):
            return cause
        if isinstance(cause, KeyboardInterrupt):
            return Stopped(signal.SIGINT)
        seen.add(id(cause))
        cause = cause.__cause__ or cause.__context__
    return None


@dataclass
class Held:
    """The first signal that arrived while signals were held back."""

    number: int | None = None


@contextlib.contextmanager
def raise_on_sigterm() -> Iterator[None]:
    """Makes SIGTERM raise `Stopped` while the block runs, as SIGINT raises KeyboardInterrupt."""

    def stop(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        raise Stopped(number)

    with _handling((signal.SIGTERM,), stop):
        yield


@contextlib.contextmanager
def hold_signals() -> Iterator[Held]:
    """Holds SIGINT and SIGTERM back while the block runs; what has arrived is raised when it ends."""
    held = Held()

    def note(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        held.number = held.number or number

    with _handling((signal.SIGINT, signal.SIGTERM), note):
        yield held
    if held.number is not None:
        raise Stopped(held.number)


@contextlib.contextmanager
def _handling(numbers: tuple[signal.Signals, ...], handler: "signal._HANDLER") -> Iterator[None]:
    """Handles signals in the block; those that the parent has told this process to ignore stay ignored."""
    if threading.current_thread() is not threading.main_thread():
        yield  # Python handles signals in the main thread alone.
        return
    ignored = (signal.SIG_IGN, None)
    before = {number: old for number in numbers if (old := signal.getsignal(number)) not in ignored}
    for number in before:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)
