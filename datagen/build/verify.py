"""The search for damage: every byte of a dataset against what its sealed records promise, and what mends it.

Damage is a file of the dataset that is missing, does not hold what was promised, or is no file (a link is never
followed, a pipe never opened); each line ends with the command that mends it. What is no part of a dataset is a remark.
"""

import shlex
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from datagen.build.survey import Survey
from datagen.data.dataset import Dataset, head_files, open_dataset
from datagen.data.geometries import geometry_hash, list_geometries, read_assignment, read_proxy_records
from datagen.data.layer_store import record_path_of_layers
from datagen.data.paths import TRUTH, geometry_root, layers_root, record_path
from datagen.data.variants import EDIT_MASKS_FOLDER as EDIT_MASKS
from datagen.data.variants import edit_mask_files
from datagen.disk.errors import HyalineError
from datagen.disk.heads import list_heads, true_head
from datagen.disk.homes import HEADS, home_of
from datagen.disk.ownership import LAYERS
from datagen.disk.reading import load_json, parse_json
from datagen.disk.storage import sha256_file

NAMED = 3
"""Of many files that say the same, so many are named."""


class Findings(NamedTuple):
    """What a search found."""

    verified: int
    """How many files verify."""
    problems: list[str]
    """A line for each damage, with the command that mends it."""
    remarks: list[str]
    """What is no damage."""
    commands: list[str]
    """Those that the problems name, in the order in which to run them."""


def verify_dataset(root: Path) -> Findings:
    """Reads every file of a dataset, with its layers, proxies and variants; of a variant, that one's.

    Raises:
        HyalineError: no dataset there, or its head is lost together with its copy.
    """
    home = home_of(root)
    check_is_there(home)
    return _search(home, root).findings()


def check_is_there(home: Path) -> None:
    """Refuses a folder that is no dataset by its head, nor by the copy of that.

    Raises:
        HyalineError: with what to do about it.
    """
    if true_head(home, "dataset.json") is not None:
        return
    if (home / "records").is_dir():
        raise HyalineError(
            f"{home}: dataset.json and its copy {HEADS}/dataset.json are lost; build it again with the command and "
            "the flags that it was built with, which keeps all views that are whole"
        )
    open_dataset(home)  # Says what is wrong with it.


def _search(home: Path, root: Path) -> "_Search":
    search = _Search(home, "" if home == root else f"{root.relative_to(home).as_posix()}/")
    search.check_heads()
    search.check_dataset("")
    for head in search.heads:
        if head.startswith("variants/") and head.endswith("/dataset.json"):
            search.check_dataset(head.removesuffix("dataset.json"))
    return search


def list_obstacles(home: Path) -> list[Path]:
    """What stands where files of a dataset belong, or folders of them, and is none.

    Raises:
        HyalineError: a link leads to a folder with such files, which somebody has moved there.
    """
    search = _search(home, home)
    found = [home / place for place in search.lines if place in search.obstacles]
    for path in found:
        if path.is_symlink() and any((home / file).is_file() for file in search.known if path in (home / file).parents):
            raise HyalineError(
                f"{path}: is a link to a folder with files of the dataset, which nothing is written through; "
                "move that folder back here, or remove the link to have them made again"
            )
    return found


def is_good(path: Path, promised: str) -> bool:
    """True when a regular file of these bytes stands there."""
    return path.is_file() and not path.is_symlink() and sha256_file(path) == promised


class _Search:
    """The state of one search: what stands there, what was expected, what was found."""

    def __init__(self, home: Path, within: str) -> None:
        self.home, self.within = home, within
        self.survey = Survey(home)
        self.known: set[str] = set()
        self.good: set[str] = set()
        self.lines: dict[str, tuple[str, str]] = {}
        """What is wrong and what mends it, by place."""
        self.obstacles: set[str] = set()
        """Places where something else stands."""
        self.unmade: list[str] = []
        """Views that are not there, in words, for each folder of records."""
        self.remarks: list[str] = []
        self.heads = list_heads(home)
        self.mend = f"datagen mend {shlex.quote(str(home))}"
        self.finish = self.mend
        """What makes views that are not there."""

    def wrong(self, place: str, what: str, command: str | None = None) -> None:
        if f"{place}/".startswith(self.within):
            self.lines.setdefault(place, (what, command or self.mend))

    def check(self, relative: str, promised: str | None, command: str | None = None) -> bool:
        """Expects a file of these bytes (or of any) at a path; tells where it is not so."""
        self.known.add(relative)
        obstacle = self.survey.obstacle(relative)
        if obstacle is None and promised is not None and sha256_file(self.home / relative) != promised:
            obstacle = relative, "damaged (checksum differs)"
        if obstacle is None:
            self.good.add(relative)
            return True
        self.wrong(*obstacle, command)
        place = obstacle[0]
        if self.survey.kinds.get(place) not in (None, "file") or (place != relative and place in self.survey.kinds):
            self.obstacles.add(place)
        return False

    def check_all(self, prefix: str, files: Mapping[str, str], command: str | None = None) -> None:
        for file, promised in files.items():
            self.check(prefix + file, promised, command)

    # Heads

    def check_heads(self) -> None:
        """Every head and its copy: both whole, and the same."""
        has_copies = self.survey.kinds.get(HEADS) is not None
        if not has_copies:
            self.remarks.append(
                f"{self.home / HEADS}: there are no second copies of the heads, by which a lost one is found and made "
                f"again; `{self.mend}` writes them"
            )
        for head in self.heads:
            data = true_head(self.home, head)
            for path in (head, f"{HEADS}/{head}") if has_copies else (head,):
                command = self._remake_command(head) if data is None else None
                if self.check(path, None, command) and (data is None or (self.home / path).read_bytes() != data):
                    self.good.discard(path)
                    self.wrong(path, "damaged (it does not match its checksum, or is that of another place)", command)

    def _remake_command(self, head: str) -> str | None:
        """What makes a head again that is lost together with its copy, as far as what is left tells."""
        parts = head.split("/")
        geometry = parts[1] if parts[0] == "proxies" else TRUTH
        if parts[-1] == "proxies.json":
            return shlex.join(["proxies", "make", "--dataset", str(self.home), "--kind", geometry, "--overwrite"])
        if parts[0] not in ("layers", "proxies"):
            return None
        words = ["datagen", "peel", "--dataset", str(self.home), "--geometry", geometry]
        array = (self.home / head).parent / "peels.zarr" / "interpolating" / "object_id" / "zarr.json"
        try:
            shape = load_json(array).get("shape")
        except HyalineError:
            shape = None
        if isinstance(shape, list) and len(shape) >= 4:
            words += ["--num-layers", str(shape[-3])]
        return shlex.join(words)

    # A dataset or variant

    def check_dataset(self, prefix: str) -> None:
        """What the head in a folder promises; nothing where it is damaged."""
        if f"{prefix}dataset.json" not in self.good:
            return
        root = self.home / prefix
        try:
            dataset = open_dataset(root)
        except HyalineError as error:
            self.wrong(f"{prefix}dataset.json", _reason(error, root / "dataset.json"))
            return
        for file, promised in head_files(root).items():
            self.check(prefix + file, promised, self._scene_command(dataset, file))
        if dataset.imported is not None:
            self.finish = import_command(dataset)
        self._check_views(dataset, prefix)
        for geometry in list_geometries(dataset):
            self._check_geometry(dataset, prefix, geometry)
        if dataset.edit is not None:
            index = f"{prefix}{EDIT_MASKS}/{EDIT_MASKS}.json"
            if self.check(index, None):
                try:
                    self.check_all(prefix, edit_mask_files(dataset))
                except HyalineError as error:
                    self.wrong(index, _reason(error, self.home / index))

    def _scene_command(self, dataset: Dataset, file: str) -> str | None:
        from datagen.scene.finding import is_made_by_code

        if dataset.imported is not None:
            return import_command(dataset)
        if not file.startswith("scene/") or dataset.edit is not None or is_made_by_code(dataset.config.scene):
            return None
        return f"{self.mend} --scene FOLDER"

    def _check_views(self, dataset: Dataset, prefix: str) -> None:
        unmade, total = [], 0
        command = None if dataset.imported is None else import_command(dataset)
        for split in dataset.splits:
            for view in range(dataset.config.split(split).views):
                total += 1
                path = record_path(dataset.root, split, view)
                relative = prefix + path.relative_to(dataset.root).as_posix()
                self.known.add(relative)
                pictures = [f"{prefix}images/{split}/{path.stem}{ending}" for ending in dataset.endings]
                self.known.update(pictures)
                if self._is_absent(relative):
                    unmade.append(relative)
                    for picture in pictures:
                        if not self._is_absent(picture):
                            self.check(picture, None, command)
                            self.good.discard(picture)
                elif self.check(relative, None, command):
                    try:
                        self.check_all(prefix, dataset.view(split, view).record.files, command)
                    except HyalineError as error:
                        self.good.discard(relative)
                        self.wrong(relative, _reason(error, path), command)
        self._tell_unmade(unmade, total, f" of {prefix.rstrip('/')}" if prefix else "")

    def _is_absent(self, relative: str) -> bool:
        """True when nothing stands at a path, nor what is no folder on its way."""
        obstacle = self.survey.obstacle(relative)
        return obstacle is not None and self.survey.kinds.get(obstacle[0]) is None

    def _tell_unmade(self, unmade: list[str], total: int, of: str) -> None:
        if unmade and unmade[0].startswith(self.within):
            self.unmade.append(f"{len(unmade)} of {total} views{of} ({_some(unmade)})")

    # Geometries

    def _check_geometry(self, dataset: Dataset, prefix: str, geometry: str) -> None:
        place = f"{prefix}proxies/{geometry}/" if geometry != TRUTH else prefix
        if geometry != TRUTH and dataset.home is dataset:
            if f"{place}proxies.json" not in self.good:
                return
            try:
                records = read_proxy_records(dataset, geometry)
            except HyalineError as error:
                self.wrong(f"{place}proxies.json", _reason(error, geometry_root(dataset.root, geometry)))
                return
            command = None if dataset.edit is not None else make_command(dataset, geometry)
            self.check_all(place, {record.file: record.sha256 for record in records}, command)
        if f"{place}layers/straight/layers.json" in self.good:
            self._check_layers(dataset, f"{place}layers/straight/", geometry)

    def _check_layers(self, dataset: Dataset, prefix: str, geometry: str) -> None:
        root = layers_root(dataset.root, geometry)
        try:
            head = dataset.layer_store(geometry).head
        except HyalineError as error:
            self.wrong(f"{prefix}layers.json", _reason(error, root / "layers.json"))
            return
        try:
            if head.geometry != geometry_hash(dataset, geometry):
                self.wrong(f"{prefix}layers.json", "was made of other meshes than stand there now")
        except HyalineError:
            pass  # The meshes have lines of their own.
        self.check_all(prefix, head.files)
        unmade, total = [], 0
        for split in dataset.splits:
            for view in range(dataset.config.split(split).views):
                total += 1
                path = record_path_of_layers(root, split, view)
                relative = prefix + path.relative_to(root).as_posix()
                self.known.add(relative)
                if self._is_absent(relative):
                    unmade.append(relative)
                elif self.check(relative, None):
                    try:
                        self.check_all(prefix, dataset.layer_store(geometry).record(split, view).files)
                    except HyalineError as error:
                        self.good.discard(relative)
                        self.wrong(relative, _reason(error, path))
        self._tell_unmade(unmade, total, f" of {prefix.rstrip('/')}")

    # The end

    def findings(self) -> Findings:
        if any(command.endswith("--scene FOLDER") for _, command in self.lines.values()):
            # One command for all that this program mends: without the scene it would stop there.
            with_scene = f"{self.mend} --scene FOLDER"
            self.lines = {
                place: (what, with_scene if command == self.mend else command)
                for place, (what, command) in self.lines.items()
            }
        lines = [
            f"{self.home / place}: {what}; mend it with `{command}`" for place, (what, command) in self.lines.items()
        ]
        commands = [command for _, command in self.lines.values()]
        if self.unmade:
            lines.append(
                f"{self.home}: unfinished: without records are {', '.join(self.unmade)}; finish it with `{self.finish}`"
            )
            commands.append(self.finish)
        # Proxies first, from which layers are made; but before them what they are made from.
        is_first = any(place == "dataset.json" or place.startswith("scene/") for place in self.lines)
        order = sorted(set(commands), key=lambda command: (command.startswith("datagen") != is_first, command))
        return Findings(
            verified=len([path for path in self.good if path.startswith(self.within)]),
            problems=lines,
            remarks=[*self.remarks, *self._foreign()],
            commands=order,
        )

    def _foreign(self) -> list[str]:
        """What is no part of the dataset, where nothing of it could lie."""
        unread = tuple(place.rsplit("/", 1)[0] + "/" for place in self.lines if place.endswith(("ts.json", "rs.json")))
        foreign = [
            path
            for path, kind in self.survey.kinds.items()
            if kind != "folder"
            and path not in self.known
            and path.startswith(self.within)
            and not path.startswith(unread)
        ]
        foreign = [path for path in foreign if path not in self.lines]
        if not foreign or "dataset.json" in self.lines:
            return []
        return [
            f"{self.home}: {len(foreign)} files are no part of the dataset and were not looked at: {_some(foreign)}"
        ]


def make_command(dataset: Dataset, geometry: str) -> str:
    """The command that makes a dataset's proxies, and their layers, as they were made."""
    words = ["proxies", "make", "--dataset", str(dataset.root)]
    assignment = read_assignment(dataset, geometry)
    if assignment is not None:
        words += ["--name", geometry]
        for item, kind in zip(dataset.objects, assignment, strict=True):
            words += ["--assign", f"{item.name}={kind}"]
    else:
        kind, _, amount = geometry.partition("-")
        words += ["--kind", kind, *(["--amount", amount] if amount else [])]
    place = layers_root(dataset.root, geometry).relative_to(dataset.root) / LAYERS.head
    head = true_head(dataset.root, place.as_posix())  # Its copy knows how many there were where it is lost.
    if head is not None:
        words += ["--num-layers", str(parse_json(head, where=str(place))["num_layers"])]
    return shlex.join(words)


def import_command(dataset: Dataset) -> str:
    """The command that brings back what is lost of an imported dataset."""
    return f"datagen import-dataset FOLDER --out {shlex.quote(str(dataset.root))}"


def _some(paths: Iterable[str]) -> str:
    named = list(paths)
    more = len(named) - NAMED
    return ", ".join(named[:NAMED]) + (f" and {more} more" if more > 0 else "")


def _reason(error: HyalineError, path: Path) -> str:
    """What an error says of a file, without its name and its way out."""
    return str(error).removeprefix(f"{path}: ").split("; ")[0]
