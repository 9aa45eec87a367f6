"""The search for damage: every byte of a dataset against what its records promise.

Damage is a file of the dataset that is missing, does not hold what was promised, or is not a file (a link is never
followed, a pipe never opened). The commands that made the dataset mend it; files of others are a remark.
"""

import os
import stat
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from datagen.data.config import Split
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.geometries import geometry_hash, read_proxy_records
from datagen.data.layers import DTYPES, array_file, record_path_of_layers
from datagen.data.paths import TRUTH, geometry_root, image_path, layers_root, record_path
from datagen.data.variants import EDIT_MASKS_FOLDER, VARIANTS_FOLDER, edit_mask_files
from datagen.disk.errors import HyalineError
from datagen.disk.names import is_name
from datagen.disk.ownership import DATASET, EDIT_MASKS, LAYERS, PROXIES
from datagen.disk.storage import MAKE_AGAIN, sha256_file
from datagen.terminal.command import fail, say_all, tell, tell_json

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

    @property
    def verified(self) -> int:
        """How many files verify."""
        return len(self.files)


def verify_dataset(root: Path) -> Findings:
    """Reads every file of a dataset, with its layers, proxies and variants; of a variant, that one's.

    Raises:
        HyalineError: no dataset there, or its head is lost or damaged.
    """
    dataset = open_dataset(root)
    search = _Search(root)
    search.check_dataset(dataset)
    for name in _names(root / VARIANTS_FOLDER, DATASET.head, "records"):
        path = root / VARIANTS_FOLDER / name
        if search.check(path / DATASET.head):
            try:
                search.check_dataset(open_dataset(path))
            except HyalineError as error:
                search.refuse(path / DATASET.head, error)
    return search.findings(withheld=sum(dataset.num_views[split] for split in dataset.withheld))


def tell_findings(root: Path, found: Findings, *, as_json: bool) -> None:
    """Prints them as lines or as one JSON object, and exits with status 1 if there are problems."""
    say_all(found.remarks)
    if as_json:
        lists = {"problems": found.problems, "remarks": found.remarks}
        tell_json({"dataset": str(root), "verified": found.verified, **lists})
    else:
        for problem in found.problems:
            tell(problem)
    if found.problems:
        fail(f"{root}: {len(found.problems)} problems, listed above; {MAKE_AGAIN}")
    if not as_json:
        tell(f"{root}: {found.verified} files verified")


class _Search:
    """The state of one search."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.known: set[Path] = set()
        self.hashes: dict[Path, str] = {}
        """SHA-256 of the files that verify."""
        self.problems: dict[Path, str] = {}

    def check(self, path: Path, promised: str | None = None) -> bool:
        """Expects a file of these bytes (or of any); notes where it is not so."""
        self.known.add(path)
        place, what = _obstacle(self.root, path) or (path, "")
        if not what:
            self.hashes[path] = sha256_file(path)
            if promised in (None, self.hashes[path]):
                return True
            what = "damaged or edited (checksum differs)"
        self.hashes.pop(path, None)
        self.problems.setdefault(place, what)
        return False

    def refuse(self, path: Path, error: HyalineError) -> None:
        """Notes a file that cannot be read as what it should be."""
        self.hashes.pop(path, None)
        self.problems.setdefault(path, str(error).removeprefix(f"{path}: ").split("; ")[0])

    def check_record(self, path: Path, root: Path, promised: Callable[[], Mapping[str, str]]) -> bool:
        """Checks a record and the files below `root` that it promises; False if it cannot be read."""
        if not self.check(path):
            return False
        try:
            files = promised()
        except HyalineError as error:
            self.refuse(path, error)
            return False
        for file, sha256 in files.items():
            self.check(root / file, sha256)
        return True

    def check_views(self, root: Path, records: Mapping[Path, Callable[[], Mapping[str, str]]]) -> None:
        """Checks the records of views and their files; views without a record are one problem."""
        unmade = []
        for path, promised in records.items():
            self.known.add(path)
            place, _ = _obstacle(self.root, path) or (path, "")
            if os.path.lexists(place):
                self.check_record(path, root, promised)
            else:
                unmade.append(path)
        if unmade:
            self.problems[root] = (
                f"unfinished: {len(unmade)} of {len(records)} views have no record ({_some(self.root, unmade)})"
            )

    def check_dataset(self, dataset: Dataset) -> None:
        """A dataset or a variant: its record, what that promises, views and geometries."""
        root = dataset.root
        self.check_record(root / DATASET.head, root, lambda: dataset.files)
        splits: list[Split] = [split for split in dataset.splits if split not in dataset.withheld]
        views = [view for split in splits for view in dataset.views(split)]
        pictures = [image_path(root, view.split, view.index) for view in views]
        self.known |= {path.with_suffix(ending) for path in pictures for ending in dataset.endings}
        self.check_views(
            root,
            {
                record_path(root, view.split, view.index): lambda view=view: view.record.files  # Opened when called.
                for view in views
            },
        )
        if dataset.edit is not None:
            path = root / EDIT_MASKS_FOLDER / EDIT_MASKS.head
            self.check_record(path, root, lambda: edit_mask_files(dataset))
        self.check_layers(dataset, TRUTH, is_due=dataset.imported is None)
        around = root if dataset.parent is None else dataset.parent.root
        peeled = (
            set() if around == root else {path.parts[-4] for path in around.glob(f"proxies/*/layers/*/{LAYERS.head}")}
        )
        for geometry in sorted({*_names(root / "proxies", PROXIES.head, "meshes", "layers"), *peeled}):
            if dataset.home is dataset:
                place = geometry_root(root, geometry)
                self.check_record(
                    place / PROXIES.head,
                    place,
                    lambda name=geometry: {item.file: item.sha256 for item in read_proxy_records(dataset, name)},
                )
            self.check_layers(dataset, geometry, is_due=geometry in peeled)

    def check_layers(self, dataset: Dataset, geometry: str, *, is_due: bool) -> None:
        """The layers of a geometry, if they were ever made."""
        root = layers_root(dataset.root, geometry)
        head = root / LAYERS.head
        if not (is_due or os.path.lexists(root)) or not self.check(head):
            return
        try:
            store = dataset.layer_store(geometry)
        except HyalineError as error:
            self.refuse(head, error)
            return
        try:
            if store.head.geometry != geometry_hash(dataset, geometry):
                self.problems.setdefault(head, "was made of other meshes than are there now")
        except HyalineError:
            pass  # The meshes have lines of their own.
        views = [view for split in dataset.splits for view in dataset.views(split)]
        self.known |= {root / array_file(view.split, view.index, name) for view in views for name in DTYPES}
        self.check_views(
            root,
            {
                record_path_of_layers(root, view.split, view.index): lambda view=view: (
                    store.record(view.split, view.index).files
                )
                for view in views
            },
        )

    def findings(self, *, withheld: int) -> Findings:
        for path in self.known:  # Also what is in the way of files that are not made yet.
            if (obstacle := _obstacle(self.root, path)) and os.path.lexists(obstacle[0]):
                self.problems.setdefault(*obstacle)
        remarks = []
        walked = ((place, [*folders, *names]) for place, folders, names in os.walk(self.root))
        found = [Path(place) / name for place, names in walked for name in names]
        foreign = {path for path in found if path.is_symlink() or not path.is_dir()} - self.known - {*self.problems}
        if foreign:
            remarks.append(
                f"{self.root}: {len(foreign)} files are no part of the dataset and were not looked at: "
                f"{_some(self.root, sorted(foreign))}"
            )
        if withheld:
            remarks.append(f"{self.root}: a verifier keeps the pictures of its {withheld} test views")
        return Findings(
            files={path.relative_to(self.root).as_posix(): self.hashes[path] for path in sorted(self.hashes)},
            problems=[f"{path}: {what}" for path, what in self.problems.items()],
            remarks=remarks,
        )


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
    return None


def _names(above: Path, *parts: str) -> list[str]:
    """Names of the folders there that hold one of these parts."""
    found = sorted(path.name for path in above.glob("*") if is_name(path.name))
    return [name for name in found if any(os.path.lexists(above / name / part) for part in parts)]


def _some(root: Path, paths: Iterable[Path]) -> str:
    named = [path.relative_to(root).as_posix() for path in paths]
    more = len(named) - NAMED
    return ", ".join(named[:NAMED]) + (f" and {more} more" if more > 0 else "")
