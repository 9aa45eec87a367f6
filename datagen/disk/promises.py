"""Files whose SHA-256 a sealed head or record promises."""

from collections.abc import Mapping
from pathlib import Path

from datagen.disk.errors import DamagedError
from datagen.disk.homes import mend_command, way_out
from datagen.disk.names import find_file
from datagen.disk.reading import read_regular
from datagen.disk.storage import sha256, sha256_file


def check_files(root: Path, files: Mapping[str, str]) -> None:
    """Raises a DamagedError that names the first file whose bytes are not the promised ones."""
    for relative, promised in files.items():
        if sha256_file(find_file(root, relative, where=str(root))) != promised:
            path = root / relative
            raise DamagedError(f"{path}: damaged (checksum differs); mend it with `{mend_command(path)}`")


def read_promised(root: Path, relative: str, promised: str) -> bytes:
    """The bytes of a file below `root`, which are those that were promised.

    Raises:
        DamagedError: missing, or its SHA-256 is another.
    """
    path = find_file(root, relative, where=str(root))
    try:
        data = read_regular(path)
    except DamagedError as error:
        raise DamagedError(f"{error}; {way_out(path)}") from None
    if sha256(data) != promised:
        raise DamagedError(f"{path}: damaged (checksum differs); mend it with `{mend_command(path)}`")
    return data
