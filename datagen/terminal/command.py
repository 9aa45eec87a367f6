"""How a command starts, reports progress and ends: parse, run one function, errors as one line, signals.

SIGINT (Ctrl-C) and SIGTERM (a scheduler, a shutdown) raise at once, and what was committed stays. Where a block has
work in hand that it can save in a moment, it holds them back and asks between two pieces of work.
"""

import codecs
import contextlib
import io
import os
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import NoReturn, TypeVar

from datagen.disk.errors import HyalineError, as_hyaline_error, naming, printable
from datagen.terminal.parsing import QUIET, Command, CommandGroup, complete, parse
from datagen.terminal.parsing import choose as choose
from datagen.terminal.plugins import VERSION, naming_parts

Item = TypeVar("Item")

REPORT_EVERY_S = 15.0
"""Without a terminal, progress is a line this often."""
REMIND_EVERY_S = 8.0
"""While nothing is known of the progress, a line says this often that there is some."""


def run(program: str, command: Command | CommandGroup, arguments: list[str]) -> None:
    """Parses `arguments`, calls the function they ask for, and exits.

    Results go to stdout, everything else to stderr. Every command takes `--version` and `--quiet`. Exit status: 0 done,
    1 our error in one line, 2 usage, 3 a number that is not finite, 130 and 143 stopped by SIGINT and SIGTERM.
    """
    hush(QUIET in arguments)
    _open_closed()
    if isinstance(sys.stdout, io.TextIOWrapper) and codecs.lookup(sys.stdout.encoding).name != "utf-8":
        sys.stdout.reconfigure(errors="backslashreplace")  # Tables contain arrows, which ASCII lacks.
    try:
        if "--version" in arguments:
            print(f"hyaline {VERSION}", flush=True)
            return
        if arguments[:1] == ["--complete"]:  # The shell, by `complete -C`, with the word that is being typed.
            words = os.environ["COMP_LINE"][: int(os.environ["COMP_POINT"])].split()[1:]
            for word in complete(command, words[: -1 if arguments[2] else None]):
                print(f"{word}\n" * word.startswith(arguments[2]), end="")
            return
        where = " ".join([_program(), *(word for word in arguments[:1] if not word.startswith("-"))])
        with raise_on_sigterm(), _flushed(), naming_parts(where):
            parse(program, command, [word for word in arguments if word != QUIET])()
    except (Exception, KeyboardInterrupt, Stopped) as error:
        _end(error, arguments)


def _open_closed() -> None:
    """Opens the standard streams that the caller has closed (`2>&-`, some daemons), to nowhere.

    Otherwise files of data would get their numbers, to which libraries write, and progress would go to stdout. A result
    that cannot be printed is an error, so stdout is opened for reading alone.
    """
    for number, mode in enumerate((os.O_RDWR, os.O_RDONLY, os.O_RDWR)):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, mode), True)  # The lowest free number, which is this one.
    if sys.stdout is None:
        sys.stdout = io.TextIOWrapper(io.FileIO(1, "w", closefd=False), "utf-8", write_through=True)
    if sys.stderr is None:
        sys.stderr = Path(os.devnull).open("w")  # noqa: SIM115


def _end(error: BaseException, arguments: list[str]) -> None:
    """Ends the process in one line that says what `error` was; one that is a fault of ours is raised again."""
    # A signal that arrives inside of a library may reach us as the cause of its own error: of a RuntimeError while
    # Dr.Jit 1.5 records a loop, of a SystemError or an ImportError while a compiled module is imported.
    if (stopped := signal_within(error)) is not None:
        for number in (signal.SIGINT, signal.SIGTERM):  # Another one would break off Python's own end.
            signal.signal(number, signal.SIG_IGN)
        same = "the same command without --overwrite" if "--overwrite" in arguments else "the same command again"
        fail(stopped.message or f"stopped; run {same} to continue", status=stopped.status)
    if isinstance(error, BrokenPipeError):  # As other tools when their reader has gone (`report | head`).
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 1)  # Else the interpreter would complain when it flushes its output at its end.
        sys.exit(128 + signal.SIGPIPE)
    told = error if isinstance(error, HyalineError) else as_hyaline_error(error)
    if told is None:
        raise error
    fail(str(told), status=told.status)


@contextlib.contextmanager
def _flushed() -> Iterator[None]:
    """Writes out what was printed before the block is left, also by `sys.exit`, so that its errors are ours to tell."""
    try:
        yield
    finally:
        with naming(Path("standard output")):
            print(end="", flush=True)


def fail(message: str, *, status: int = 1) -> NoReturn:
    """Prints one line on stderr and exits."""
    print(f"error: {printable(' '.join(message.split()))}", file=sys.stderr)
    sys.exit(status)


def tell(line: str) -> None:
    """A line of the result, on stdout."""
    print(printable(line))


_is_quiet = False


def hush(is_quiet: bool = True) -> None:
    """Turns progress and remarks off, as --quiet does, or on again."""
    global _is_quiet
    _is_quiet = is_quiet


def say(*messages: str, is_error: bool = False) -> None:
    """Lines for the person who waits, on stderr; --quiet leaves errors."""
    for message in messages if is_error or not _is_quiet else ():
        print(printable(message), file=sys.stderr, flush=True)


def next_command(line: str) -> None:
    """The last line of a command: what to type next."""
    say(f"next: {line}")


def this_command() -> str:
    """The command line that continues the running command: its words without `--overwrite`."""
    return shlex.join([_program(), *(word for word in sys.argv[1:] if word != "--overwrite")])


def _program() -> str:
    """What was typed first: `datagen`, also for `python -m datagen`."""
    program = Path(sys.argv[0])
    return program.parent.name if program.name == "__main__.py" else program.name


def track(
    items: Iterable[Item], *, label: str, total: int, done: int = 0, status: Callable[[], str] = lambda: ""
) -> Iterator[Item]:
    """Yields `items` while stderr shows how far they are and how long the rest will take.

    Args:
        total: how many items there are, those already done included.
        done: how many were done before; they do not count for the estimate.
        status: what else to show, asked for at each update.
    """
    if _is_quiet:
        yield from items
    elif sys.stderr.isatty():
        yield from _track_on_terminal(items, label, total, done, status)
    else:
        yield from _track_in_lines(items, label, total, done, status)


def _track_on_terminal(
    items: Iterable[Item], label: str, total: int, done: int, status: Callable[[], str]
) -> Iterator[Item]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn())
    more = (TimeRemainingColumn(), TextColumn("{task.fields[status]}"))
    with Progress(*columns, *more, console=Console(stderr=True)) as progress:
        task = progress.add_task(printable(label), total=total, completed=done, status="")
        for item in items:
            yield item
            progress.update(task, advance=1, status=status())


def _track_in_lines(
    items: Iterable[Item], label: str, total: int, done: int, status: Callable[[], str]
) -> Iterator[Item]:
    first = last = time.monotonic()
    for count, item in enumerate(items, start=1):
        yield item
        now = time.monotonic()
        if count == 1:
            first = now  # Which also compiles and warms up.
        if now - last >= REPORT_EVERY_S or done + count == total:
            rest = total - done - count
            left = f", about {(now - first) / (count - 1) * rest:.0f} s left" if count > 1 else ""
            say(f"{label}: {done + count}/{total}{left} {status()}".rstrip())
            last = now


@contextlib.contextmanager
def waiting(label: str) -> Iterator[None]:
    """Says what the block does, and every few seconds that it still does it: libraries report nothing."""
    done, start = threading.Event(), time.monotonic()

    def remind() -> None:
        while not done.wait(REMIND_EVERY_S):
            say(f"{label}: {time.monotonic() - start:.0f} s")

    say(f"{label} ...")
    thread = threading.Thread(target=remind, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


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
