"""Reading files that anybody may have written: regular files of a bounded size, JSON and TOML without surprises.

Whatever a file holds, reading it ends soon, and either gives plain values or raises one HyalineError that names the
file: no pipe or device is ever opened, numbers are finite and fit into 64 bits, nesting is shallow, and no key stands
twice.
"""

import contextlib
import errno
import json
import math
import os
import stat
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

from datagen.disk.errors import DamagedError, HyalineError
from datagen.disk.os_errors import describe_os_error
from datagen.disk.records import Json, shown

MAX_JSON_BYTES = 16 << 20
"""The largest that is written here holds the cameras of 10,000 views."""
MAX_TOML_BYTES = 1 << 18
MAX_NESTING = 64
MAX_DIGITS = 20
"""Of an integer in JSON; those of 64 bits have at most 19."""

_OUT_OF_RESOURCES = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EINTR)
"""What says nothing about the file: no reason to take it for damaged and to make it again."""


def open_regular(path: Path) -> BinaryIO:
    """A regular file, opened for reading; links are followed.

    Raises:
        HyalineError: there is none, it is a folder, a pipe or a device, or it cannot be read.
        OSError: this process is out of memory or file handles.
    """
    try:
        with _refusing(path):
            # A pipe would wait for its writer, and a device may do anything: they are never opened.
            _check_regular(path, path.stat().st_mode)
            file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
    except ValueError as error:  # A NUL, or half of a surrogate pair.
        raise HyalineError(f"{shown(str(path))}: cannot be the path of a file ({error})") from error
    try:
        _check_regular(path, os.fstat(file.fileno()).st_mode)
    except HyalineError:
        file.close()
        raise
    return file


def read_regular(path: Path, *, at_most: int | None = None) -> bytes:
    """The bytes of a regular file.

    Raises:
        HyalineError: see `open_regular`; or it holds more than `at_most` bytes.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if at_most is not None and size > at_most:
            raise HyalineError(f"{path}: holds {size:,} bytes; expected at most {at_most:,}")
        with _refusing(path):
            return file.read()


def load_json(path: Path) -> dict[str, Json]:
    """A JSON object from a file.

    Raises:
        HyalineError: missing, not UTF-8 JSON, not an object, a key that stands twice in one object, a number that is
            not finite or does not fit into 64 bits, or a string that is no text.
    """
    return parse_json(read_regular(path, at_most=MAX_JSON_BYTES), where=str(path))


def parse_json(text: bytes, *, where: str) -> dict[str, Json]:
    """A JSON object from the bytes of a file; see `load_json`."""
    try:
        data = json.loads(
            text.decode(), parse_int=_integer, parse_float=_number, parse_constant=_number, object_pairs_hook=_object
        )
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise DamagedError(f"{where}: not a JSON file ({error})") from error
    except RecursionError:
        raise DamagedError(f"{where}: nested too deeply; expected at most {MAX_NESTING} levels") from None
    except HyalineError as error:
        raise DamagedError(f"{where}: {error}") from None
    if not isinstance(data, dict):
        raise DamagedError(f"{where}: holds a {type(data).__name__}; expected a JSON object")
    containers = _containers(data, where=where)  # Numbers and keys were checked as they were read.
    if b"\\u" in text:
        _check_texts(containers, where)
    return data


def load_toml(path: Path) -> dict[str, object]:
    """The content of a TOML file; what is said of `load_json` holds for it, too.

    Raises:
        HyalineError: see there.
    """
    text = read_regular(path, at_most=MAX_TOML_BYTES)
    # The time that tomllib takes for a key such as a.a.a grows with the cube of its length. (Numbers have commas.)
    if any(line.count(b".") > MAX_NESTING + line.count(b",") for line in text.splitlines()):
        raise DamagedError(f"{path}: nested too deeply; expected at most {MAX_NESTING} levels")
    try:
        # TOML asks for newlines as they are; `read_text` would have made them all alike.
        data = tomllib.loads(text.decode().replace("\r\n", "\n"))
    except RecursionError:
        raise DamagedError(f"{path}: nested too deeply; expected at most {MAX_NESTING} levels") from None
    except ValueError as error:  # Of tomllib, of UTF-8, or of int(), which takes 4,300 digits.
        raise DamagedError(f"{path}: not TOML ({error})") from error
    containers = _containers(data, where=str(path))
    _check_texts(containers, str(path))
    for container in containers:
        for value in _values(container):
            _check_number(value, str(path))
    return data


def _check_regular(path: Path, mode: int) -> None:
    kinds = {
        stat.S_IFDIR: "a folder",
        stat.S_IFIFO: "a pipe",
        stat.S_IFSOCK: "a socket",
        stat.S_IFCHR: "a device",
        stat.S_IFBLK: "a device",
    }
    if not stat.S_ISREG(mode):
        raise HyalineError(f"{path}: is {kinds.get(stat.S_IFMT(mode), 'no regular file')}; expected a file")


@contextlib.contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """Turns errors of the system into a HyalineError, except those that say nothing about the file."""
    try:
        yield
    except OSError as error:
        if error.errno in _OUT_OF_RESOURCES:
            raise
        if error.errno == errno.ENOENT:
            raise DamagedError(f"{path}: the file is missing") from error
        raise HyalineError(describe_os_error(error, path)) from error


def _integer(digits: str) -> int:
    if len(digits) > MAX_DIGITS or not -(2**63) <= (value := int(digits)) < 2**63:
        raise HyalineError(f"the number {shown(digits)} is too large; expected one of 64 bits")
    return value


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise HyalineError(f"the number {shown(text)} is not finite; expected one that is")
    return value


def _object(pairs: list[tuple[str, Json]]) -> dict[str, Json]:
    content = dict(pairs)
    if len(content) != len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))
        raise HyalineError(f"key {shown(twice)} stands twice in one object; expected each key once")
    return content


def _containers(data: object, *, where: str) -> list[dict | list]:
    """Every dict and list in `data`, itself among them; refuses nesting that recursion might not survive."""
    found: list[dict | list] = []
    level = [data]
    for _ in range(MAX_NESTING + 1):
        level = [value for value in level if type(value) is dict or type(value) is list]
        if not level:
            return found
        found += level
        level = [value for container in level for value in _values(container)]
    raise DamagedError(f"{where}: nested too deeply; expected at most {MAX_NESTING} levels")


def _values(container: dict | list) -> Iterable[object]:
    return container.values() if type(container) is dict else container


def _check_number(value: object, where: str) -> None:
    if isinstance(value, float) and not math.isfinite(value):
        raise DamagedError(f"{where}: holds the number {value}; expected finite ones")
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise DamagedError(f"{where}: holds a number of {value.bit_length()} bits; expected at most 64")


def _check_texts(containers: list[dict | list], where: str) -> None:
    for container in containers:
        for value in (*container, *_values(container)):
            if isinstance(value, str):
                _check_text(value, where)


def _check_text(text: str, where: str) -> None:
    if "\0" in text or any("\ud800" <= char <= "\udfff" for char in text):
        raise DamagedError(f"{where}: the string {shown(text)} holds a NUL or half of a character; expected text")
