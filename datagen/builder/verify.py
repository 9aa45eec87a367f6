"""The search for damage: every byte of a dataset against what its records promise.

Damage is a file of the dataset that is missing, does not hold what was promised, or is not a file (a link is never
followed, a pipe never opened). The commands that made the dataset mend it; files of others are not looked at.
"""

import contextlib
import os
import stat
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from datagen.data.config import Split
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.geometries import geometry_hash, read_proxy_records
from datagen.data.layers import LayerStore, record_path_of_layers
from datagen.data.paths import TRUTH, geometry_root, layers_root
from datagen.data.variants import EDIT_MASKS_FOLDER, VARIANTS_FOLDER, edit_mask_files
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import DATASET, EDIT_MASKS, LAYERS, PROXIES
from datagen.disk.storage import is_name, read_regular, sha256

NAMED = 3
"""Number of files that are named if more have the same problem."""


class Findings(NamedTuple):
    """What a search found."""

    files: dict[str, str]
    """SHA-256 of the files that verify, by path relative to the dataset."""
    problems: list[str]
    """A line for each damage."""
    remarks: list[str]
    """What is not damage."""


def verify_dataset(root: Path) -> Findings:
    """Reads every file of a dataset, with its layers, proxies and variants; of a variant, that one's."""
    dataset, search = open_dataset(root), _Search(root)
    search.add_record(root / DATASET.head, root, lambda: search.add_dataset(dataset))
    for name in _names(root / VARIANTS_FOLDER, DATASET.head, "records"):
        path = root / VARIANTS_FOLDER / name
        search.add_record(path / DATASET.head, path, lambda path=path: search.add_dataset(open_dataset(path)))
    return search.findings(withheld=sum(dataset.num_views[split] for split in dataset.withheld))


class _Search:
    """What a dataset promises, and what is wrong with it."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.promised: dict[Path, str | None] = {}
        """SHA-256 of each file; None for records, which hold their own."""
        self.problems: dict[Path, str] = {}

    def add_record(self, path: Path, root: Path, read: Callable[[], Mapping[str, str]]) -> None:
        """Adds a record, and the files below `root` that it promises."""
        self.promised[path] = None
        if _obstacle(self.root, path) is None:
            try:
                self.promised |= {root / file: sha256 for file, sha256 in read().items()}
            except HyalineError as error:
                self.problems.setdefault(path, str(error).removeprefix(f"{path}: ").split("; ")[0])

    def add_views(self, root: Path, records: Mapping[Path, Callable[[], Mapping[str, str]]]) -> None:
        """Adds the records of views and their files; views without a record are one problem."""
        unmade = [path for path in records if not os.path.lexists((_obstacle(self.root, path) or [path])[0])]
        for path, read in records.items():
            if path not in unmade:
                self.add_record(path, root, read)
        if unmade:
            what = f"{len(unmade)} of {len(records)} views have no record ({_some(self.root, unmade)})"
            self.problems[root] = f"unfinished: {what}"

    def add_dataset(self, dataset: Dataset) -> dict[str, str]:
        """A dataset or a variant: views, edit masks and geometries; the files of its head."""
        root = dataset.root
        views = [view for split in dataset.splits if split not in dataset.withheld for view in dataset.views(split)]
        self.add_views(root, {view.record_path: lambda view=view: view.record.files for view in views})
        if dataset.edit is not None:
            masks = root / EDIT_MASKS_FOLDER
            self.add_record(masks / EDIT_MASKS.head, masks, lambda: edit_mask_files(masks))
        self.add_layers(dataset, TRUTH, is_due=dataset.imported is None)
        around = set() if dataset.parent is None else {*dataset.parent.root.glob(f"proxies/*/layers/*/{LAYERS.head}")}
        peeled = {path.parts[-4] for path in around}
        for geometry in sorted({*_names(root / "proxies", PROXIES.head, "meshes", "layers"), *peeled}):
            if dataset.home is dataset:
                place = geometry_root(root, geometry)
                self.add_record(
                    place / PROXIES.head,
                    place,
                    lambda name=geometry: {item.file: item.sha256 for item in read_proxy_records(dataset, name)},
                )
            self.add_layers(dataset, geometry, is_due=geometry in peeled)
        return {**dataset.files}

    def add_layers(self, dataset: Dataset, geometry: str, *, is_due: bool) -> None:
        """The layers of a geometry, if they were ever made."""
        root = layers_root(dataset.root, geometry)
        if is_due or os.path.lexists(root):
            self.add_record(root / LAYERS.head, root, lambda: self.add_store(dataset, dataset.layer_store(geometry)))

    def add_store(self, dataset: Dataset, store: LayerStore) -> dict[str, str]:
        with contextlib.suppress(HyalineError):  # Damaged meshes have lines of their own.
            if store.head.geometry != geometry_hash(dataset, store.geometry):
                self.problems.setdefault(store.root / LAYERS.head, "was made of other meshes than are there now")
        views: list[tuple[Split, int]] = [
            (view.split, view.index) for split in dataset.splits for view in dataset.views(split)
        ]
        reads = {record_path_of_layers(store.root, *view): lambda at=view: store.record(*at).files for view in views}
        self.add_views(store.root, reads)
        return {}

    def findings(self, *, withheld: int) -> Findings:
        files: dict[str, str] = {}
        for path, promised in sorted(self.promised.items()):
            if obstacle := _obstacle(self.root, path):
                self.problems.setdefault(*obstacle)
            elif path not in self.problems:
                digest = sha256(read_regular(path))
                if promised in (None, digest):
                    files[path.relative_to(self.root).as_posix()] = digest
                else:
                    self.problems[path] = "damaged or edited (checksum differs)"
        remarks = [f"{self.root}: a verifier keeps the pictures of its {withheld} test views"] if withheld else []
        problems = [f"{path}: {what}" for path, what in self.problems.items()]
        return Findings(files=files, problems=problems, remarks=remarks)


def _obstacle(root: Path, path: Path) -> tuple[Path, str] | None:
    """What keeps a path from being a regular file: the place, and what is wrong there; None if it is one."""
    parts = path.relative_to(root).parts
    for count in range(1, len(parts) + 1):
        place = root.joinpath(*parts[:count])
        what, is_right = ("file", stat.S_ISREG) if place == path else ("folder", stat.S_ISDIR)
        try:
            mode = place.lstat().st_mode
        except FileNotFoundError:
            return place, f"the {what} is missing"
        if not is_right(mode):
            return place, f"is {'a link' if stat.S_ISLNK(mode) else 'in the way'}; expected a {what}"
        if not os.access(place, os.R_OK):
            return place, f"permission to read the {what} is denied"
    return None


def _names(above: Path, *parts: str) -> list[str]:
    """Names of the folders there that hold one of these parts."""
    found = sorted(path.name for path in above.glob("*") if is_name(path.name))
    return [name for name in found if any(os.path.lexists(above / name / part) for part in parts)]


def _some(root: Path, paths: Iterable[Path]) -> str:
    named = [path.relative_to(root).as_posix() for path in paths]
    more = len(named) - NAMED
    return ", ".join(named[:NAMED]) + (f" and {more} more" if more > 0 else "")
