"""Folders and files that nobody else can write: where machine code is kept that this program loads.

What is loaded runs with all rights of the user, so a name proves nothing: the folder and the file have to belong to the
user who runs the program, and neither the group nor others may write there.
"""

import os
import secrets
import stat
from pathlib import Path

from datagen.disk.os_errors import naming
from datagen.disk.storage import sha256

HASH_BYTES = 32


def make_private(folder: Path) -> str | None:
    """Makes a folder that only this user enters, or looks at the one that stands there.

    Returns:
        None when nobody else can write in it; otherwise what is wrong with it.
    """
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError as error:
        return f"{folder}: cannot be made ({error.strerror})"
    if not stat.S_ISDIR(found.st_mode):
        return f"{folder}: is not a folder, or a link to one"
    return _strangers(folder, found)


def write_hashed(path: Path, data: bytes) -> None:
    """Publishes a file that this user alone can read or write, whole or not at all; a hash of its content follows.

    Programs that read a library, or an archive, do not mind what follows it.
    """
    temporary = path.with_suffix(f".{secrets.token_hex(4)}.partial")
    try:
        with naming(path):
            with os.fdopen(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
                file.write(data + bytes.fromhex(sha256(data)))
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def is_intact(path: Path) -> bool:
    """True when `write_hashed` of this user has written the file, and every bit of it is as it was."""
    return read_hashed(path) is not None


def read_hashed(path: Path) -> bytes | None:
    """What `write_hashed` of this user has written; None where any bit of it is in doubt."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return None
    with os.fdopen(handle, "rb") as file:
        found = os.fstat(handle)
        if not stat.S_ISREG(found.st_mode) or _strangers(path, found) is not None:
            return None
        data = file.read()
    content, digest = data[:-HASH_BYTES], data[-HASH_BYTES:]
    return content if content and sha256(content) == digest.hex() else None


def _strangers(path: Path, found: os.stat_result) -> str | None:
    """Who else can write there, if anybody."""
    if found.st_uid != os.geteuid():
        return f"{path}: belongs to user {found.st_uid}"
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"{path}: others may write there (mode {stat.S_IMODE(found.st_mode):o}); `chmod go-w` mends it"
    return None
