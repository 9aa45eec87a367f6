"""The formats in which datasets are exported, and the export of one into a new folder."""

import contextlib
import os
import secrets
import shlex
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from datagen.data.dataset import Dataset
from datagen.disk.errors import HyalineError, naming
from datagen.disk.storage import real_path, sync_folder
from datagen.terminal.command import say
from hyaline_export.commands import FORMATS
from hyaline_export.source import Source


@dataclass(frozen=True, kw_only=True)
class Format:
    """A format: what writes its files, and how its tool opens them."""

    files: Callable[[Source], Iterator[tuple[str, bytes]]]
    """Yields the path of each file in the export, and its bytes."""
    hint: str
    """The command that opens the export, with OUT for the folder."""
    takes_variants: bool = False
    """Whether variants can be exported; most of them have only test views."""


EXPORTS = Path("exports")
"""Where exports go by default."""


def export_dataset(dataset: Dataset, form: str, out: Path | None, *, num_points: int) -> tuple[Path, str]:
    """Exports a dataset into a new folder; returns it, and the command of the tool that opens it."""
    chosen = FORMATS.find(form)
    if dataset.parent is not None and not chosen.takes_variants:
        raise HyalineError(f"{dataset.root}: is a variant; export the dataset around it, {dataset.parent.root}")
    source = Source(dataset=dataset, num_points=num_points)
    out = out or EXPORTS / f"{dataset.name}-{form}"
    if real_path(out).is_relative_to(real_path(dataset.root)):
        raise HyalineError(f"--out: {out} lies in the dataset {dataset.root}; choose a place outside")
    say(f"{out}: exporting {dataset.root} as {form}")
    with new_folder(out) as folder:
        for path, data in chosen.files(source):
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_bytes(data)
        (folder / "LICENSE.txt").write_text(f"The data in this folder: {dataset.license}\n")
    roles = ", ".join(f"{len(source.of_role(role))} {role}" for role in ("train", "val", "test"))
    say(f"{out}: {len(source.views)} views; {roles}; licence: {dataset.license}")
    if dataset.withheld:
        say(f"{out}: the test pictures are grey, since a verifier keeps the true ones; never train on them")
    return out, chosen.hint.replace("OUT", shlex.quote(str(out)))


@contextlib.contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """A fresh folder beside `out`, which becomes `out` when the block ends; an error or a signal deletes it.

    Raises:
        HyalineError: `out` is neither new nor an empty folder.
    """
    place = real_path(out)
    if os.path.lexists(place) and not (place.is_dir() and not any(place.iterdir())):
        raise HyalineError(f"{out}: is not empty, or not a folder; remove it, or choose another --out")
    # Nobody can prepare a folder or a link under a name that is drawn only now.
    temporary = place.with_name(f"{place.name}.{secrets.token_hex(8)}.hyaline-tmp")
    with naming(out):
        place.parent.mkdir(parents=True, exist_ok=True)
        try:
            temporary.mkdir()
            yield temporary
            for path in (*temporary.rglob("*"), temporary):
                sync_folder(path)  # Files, too.
            temporary.replace(place)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)  # The first error says what is wrong.
            raise
        sync_folder(place.parent)
