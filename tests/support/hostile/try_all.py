"""A process that reads hostile files one after the other and records the outcome of each.

A tenth of the files also go through a real command, with a renderer that takes no time.

`python try_all.py OUT STEP` writes a JSON line to OUT before and after every STEP-th case.
Code that must never run would leave its mark in the working folder.
"""

import functools
import json
import os
import shutil
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

# The folder tests/datagen would hide the package, were the package not found first.
sys.path[:0] = [str(Path(__file__).resolve().parents[place]) for place in (3, 2)]

import pytest  # noqa: E402
from support.soon import TookTooLong, ending_within  # noqa: E402

SECONDS = 10
"""A file may take so long."""

TENTH = 10
"""Every file of so many that are read is read by a command, too."""

MARK = "CODE RAN"


def main() -> None:
    out, step = Path(sys.argv[1]), int(sys.argv[2])
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder).resolve()
        secret = base / "secret"
        secret.write_text("secret\n")
        os.environ["HYALINE_SECRET"] = str(secret)
        place = base / "work"
        place.mkdir()
        os.chdir(place)
        (base / "temporary").mkdir()
        tempfile.tempdir = str(base / "temporary")
        with pytest.MonkeyPatch.context() as patch:
            _try(base / "world", place, out, step, patch)


def _try(world: Path, place: Path, out: Path, step: int, patch: pytest.MonkeyPatch) -> None:
    from support import fake_renderer
    from support.disk import read_state
    from support.hostile.corpus import cases_of, write_world
    from support.hostile.readers import COMMANDS, READERS

    write_world(world)
    fake_renderer.install(patch)
    built = world.with_name("built")
    commands = {reader: functools.partial(_end_of, line, world, built) for reader, line in COMMANDS.items()}
    for command in commands.values():
        command()  # What it imports, and which files that opens, is neither timed nor heard.
    opened = _listen(world, place)
    cases = cases_of(world)
    good = read_state(world)
    with out.open("w") as lines:
        for number, case in enumerate(cases[::step]):
            begin = {"begin": number, "name": case.name, "path": case.path, "key": case.key}
            lines.write(json.dumps(begin) + "\n")
            lines.flush()
            _clear(world / case.path)
            case.place(world)
            found = {"outcome": _try_one(functools.partial(READERS[case.reader], world), world, place, opened)}
            if number % TENTH == 0 and case.reader in commands:
                found["ended"] = _try_one(commands[case.reader], world, place, opened)
            _clear(world / case.path)
            (world / case.path).write_bytes(good.files[case.path])
            lines.write(json.dumps({"name": case.name, **found}) + "\n")
        # Not `ru_maxrss`: a process inherits that of the one that started it, from before it became another program.
        status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
        peak = int(status["VmHWM"].split()[0]) * 1024
        lines.write(json.dumps({"peak": peak}) + "\n")


def _clear(path: Path) -> None:
    """Deletes what lies there: a file, a folder, a pipe or a link."""
    shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink(missing_ok=True)


def _try_one(read: Callable[[], str], world: Path, place: Path, opened: list[str]) -> str:
    """What came of reading a file, in one line; or what else was read, or ran."""
    opened.clear()
    outcome = _read(read, world)
    if opened:
        outcome = f"READ OUTSIDE: {opened[0]}"
    if any(place.iterdir()):
        outcome = MARK
        shutil.rmtree(place)
        place.mkdir()
    return outcome


def _end_of(line: str, world: Path, out: Path) -> str:
    """How a command ended that reads the world; what it wrote is deleted.

    Raises:
        HyalineError: it failed, and said why in its last line.
    """
    from support.commands import call

    from datagen.disk.errors import HyalineError

    try:
        answer = call(line.format(world=world, out=out))
    finally:
        shutil.rmtree(out) if out.is_dir() else out.unlink(missing_ok=True)
    if answer.status == 0:
        return "the command ended"
    assert answer.status == 1 and answer.error.startswith("error: "), answer
    raise HyalineError(answer.error)


def _read(read: Callable[[], str], world: Path) -> str:
    """What came of reading a file, in one line that is the same on every machine."""
    from datagen.disk.errors import HyalineError

    try:
        with ending_within(SECONDS):
            return "accepted: " + read()
    except HyalineError as error:
        return "refused: " + _plain(str(error), world)
    except TookTooLong:
        return f"HANG: more than {SECONDS} s"
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        return f"TRACEBACK: {type(error).__name__} in {Path(last.filename).name} {last.name}"


def _plain(text: str, world: Path) -> str:
    """A message without folders of this machine, without what a library said (in brackets), and not too long."""
    text = " ".join(text.replace(f"{world}/", "").replace(str(world), ".").split())
    text = text.encode("ascii", "backslashreplace").decode()
    return text.split(" (")[0][:400].rstrip()


def _listen(world: Path, place: Path) -> list[str]:
    """Hears which files are opened; the list holds those that nothing that reads the world should open."""
    import matplotlib  # noqa: F401  It reads its settings when it is first imported, here and not below.
    import mitsuba
    import torch

    from datagen.disk.storage import user_cache

    roots = [world, place, world.with_name("built"), Path(tempfile.gettempdir()), user_cache("atlases")]
    roots += [Path(sys.prefix), Path(sys.base_prefix), Path(__file__).resolve().parents[3]]
    roots += [Path(module.__file__).resolve().parents[1] for module in (torch, mitsuba)]  # pyright: ignore
    roots += [Path("/proc"), Path("/sys"), Path("/usr"), Path("/etc/localtime"), Path("/dev/null")]
    allowed = tuple(str(root.resolve()) for root in roots)
    opened: list[str] = []

    def hear(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
            path = Path(os.path.realpath(os.fsdecode(arguments[0])))
            if not str(path).startswith(allowed) and path.exists() and not path.is_dir():
                opened.append(str(path))

    sys.addaudithook(hear)
    return opened


if __name__ == "__main__":
    main()
