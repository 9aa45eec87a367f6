"""The search for damage: every byte of a dataset against what its sealed records promise, and how to repair it.

Damage is a file of the dataset that is missing, does not hold what was promised, or is not a file (a link is never
followed, a pipe never opened). Each line ends with the command that makes the file again: the one that made the
dataset, its proxies or a variant, with the choices that their heads record. Foreign files are a remark.
"""

import shlex
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple, TypeVar

from datagen.build.choices import BuildChoices, SizeChoices
from datagen.build.presets import PRESETS
from datagen.build.survey import Survey
from datagen.data.config import Split
from datagen.data.dataset import Dataset, head_files, open_dataset
from datagen.data.geometries import geometry_hash, make_command, read_proxy_records
from datagen.data.layer_writing import find_num_layers
from datagen.data.layers import record_path_of_layers
from datagen.data.paths import DATA_ROOT, TRUTH, layers_root, record_path
from datagen.data.variants import EDIT_MASKS_FOLDER as EDIT_MASKS
from datagen.data.variants import VARIANTS_FOLDER as VARIANTS
from datagen.data.variants import edit_mask_files, variant_command
from datagen.disk.errors import HyalineError
from datagen.disk.names import is_name
from datagen.disk.ownership import LAYERS
from datagen.disk.storage import home_of, sha256_file
from datagen.terminal.command import fail, say_all, tell, tell_json
from datagen.terminal.parsing import flag_words

Value = TypeVar("Value")

NAMED = 3
"""Number of files that are named if more have the same problem."""


class Findings(NamedTuple):
    """What a search found."""

    files: dict[str, str]
    """SHA-256 of the files that verify, by path relative to the dataset."""
    problems: list[str]
    """A line for each damage, with the command that repairs it."""
    remarks: list[str]
    """What is not damage."""
    commands: list[str]
    """The commands that the problems name, in the order to run them."""

    @property
    def verified(self) -> int:
        """How many files verify."""
        return len(self.files)


def verify_dataset(root: Path) -> Findings:
    """Reads every file of a dataset, with its layers, proxies and variants; of a variant, that one's.

    Raises:
        HyalineError: no dataset there, or its head is lost or damaged.
    """
    home = home_of(root)
    dataset = open_dataset(home)
    search = _Search(home, "" if home == root else f"{root.relative_to(home).as_posix()}/")
    search.check_home(dataset)
    return search.findings()


def tell_findings(root: Path, found: Findings, *, as_json: bool) -> None:
    """Prints them as lines or as one JSON object, and exits with status 1 if there are problems."""
    say_all(found.remarks)
    if as_json:
        lists = {"problems": found.problems, "remarks": found.remarks, "commands": found.commands}
        tell_json({"dataset": str(root), "verified": found.verified, **lists})
    else:
        for problem in found.problems:
            tell(problem)
    if found.problems:
        commands = ", then ".join(f"`{command}`" for command in found.commands)
        fail(f"{root}: {len(found.problems)} problems, listed above; repair them with {commands}")
    if not as_json:
        tell(f"{root}: {found.verified} files verified")


class _Search:
    """The state of one search: existing, expected and damaged files."""

    def __init__(self, home: Path, within: str) -> None:
        self.home, self.within = home, within
        self.survey = Survey(home)
        self.known: set[str] = set()
        self.good: set[str] = set()
        self.hashes: dict[str, str] = {}
        self.lines: dict[str, tuple[str, str]] = {}
        """What is wrong and what repairs it, by place."""
        self.unmade: dict[str, list[str]] = {}
        """Views that are not there, in words for each folder of records, by the command that makes them."""
        self.commands: list[str] = []
        """All commands that may be named, in the order to run them."""
        self.withheld = 0
        """Views whose pictures a verifier keeps."""

    def wrong(self, place: str, what: str, command: str) -> None:
        if f"{place}/".startswith(self.within):
            self.lines.setdefault(place, (what, command))

    def check(self, relative: str, promised: str | None, command: str) -> bool:
        """Expects a file of these bytes (or of any) at a path; notes where it is not so."""
        self.known.add(relative)
        place, what = self.survey.obstacle(relative) or (relative, "")
        if not what and promised not in (None, self._sha256(relative)):
            what = "damaged (checksum differs)"
        if not what:
            self.good.add(relative)
            return True
        # A repair may replace a file, a link or a pipe; users move anything else away themselves.
        is_in_the_way = place in self.survey.kinds and (place != relative or self.survey.kinds[place] == "folder")
        self.wrong(place, f"{what}; move it away, then run" if is_in_the_way else f"{what}; repair it with", command)
        return False

    def _sha256(self, relative: str) -> str:
        """The hash of a file; each file is read once."""
        if relative not in self.hashes:
            self.hashes[relative] = sha256_file(self.home / relative)
        return self.hashes[relative]

    def check_all(self, prefix: str, files: Mapping[str, str], command: str) -> None:
        for file, promised in files.items():
            self.check(prefix + file, promised, command)

    def refused(self, relative: str, error: HyalineError, command: str) -> None:
        """Notes a file that cannot be read as what it should be."""
        self.good.discard(relative)
        reason = str(error).removeprefix(f"{self.home / relative}: ").split("; ")[0]
        self.wrong(relative, f"{reason}; repair it with", command)

    # A dataset or variant

    def check_home(self, dataset: Dataset) -> None:
        """The dataset with its proxies, then its variants."""
        if dataset.imported is not None:
            command = import_command(dataset)
        elif dataset.is_hidden:
            command = shlex.join(["hyaline-bench", "hide", "DATASET", "--scene", dataset.config.scene])
        else:
            files = head_files(self.home)
            scene_is_good = all(
                self.survey.has(file) and self._sha256(file) == promised
                for file, promised in files.items()
                if file.startswith("scene/")
            )
            command = build_command(dataset, scene_is_good=scene_is_good)
        proxies = {name: make_command(dataset, name, find_num_layers(dataset, name)) for name in self._proxies()}
        self.commands = [command, *proxies.values()]
        self._check_files(dataset, "", command)
        is_rendered_here = dataset.imported is None and not dataset.is_hidden
        self._check_layers(dataset, "", TRUTH, command if is_rendered_here else peel_command(dataset))
        for name, make in proxies.items():
            self._check_proxies(dataset, "", name, make)
        for name in self._folders(VARIANTS, "dataset.json", "records"):
            prefix = f"{VARIANTS}/{name}/"
            if not self.check(f"{prefix}dataset.json", None, variant_command(dataset, name)):
                continue
            try:
                variant = open_dataset(self.home / prefix)
            except HyalineError as error:
                self.refused(f"{prefix}dataset.json", error, variant_command(dataset, name))
                continue
            command = variant_command(dataset, name, variant)
            self._check_files(variant, prefix, command)
            for geometry in (TRUTH, *proxies):
                if variant.edit is not None and geometry != TRUTH:
                    self._check_proxies(variant, prefix, geometry, command)
                else:
                    self._check_layers(variant, prefix, geometry, command)

    def _proxies(self) -> list[str]:
        return self._folders("proxies", "proxies.json", "meshes", "layers")

    def _folders(self, above: str, *parts: str) -> list[str]:
        """Names of the folders there that hold one of these parts."""
        kinds = self.survey.kinds
        found = sorted({Path(path).parts[1] for path in kinds if path.startswith(f"{above}/")})
        return [name for name in found if is_name(name) and any(f"{above}/{name}/{part}" in kinds for part in parts)]

    def _check_files(self, dataset: Dataset, prefix: str, command: str) -> None:
        """The head of a dataset, what that promises, and the views."""
        self.check(f"{prefix}dataset.json", None, command)
        self.check_all(prefix, head_files(dataset.root), command)
        unmade, total = [], 0
        self.withheld += sum(dataset.num_views[split] for split in dataset.withheld)
        splits: list[Split] = [split for split in dataset.splits if split not in dataset.withheld]
        for view in (view for split in splits for view in dataset.views(split)):
            total += 1
            path = record_path(dataset.root, view.split, view.index)
            relative = prefix + path.relative_to(dataset.root).as_posix()
            pictures = [f"{prefix}images/{view.split}/{path.stem}{ending}" for ending in dataset.endings]
            self.known.update((relative, *pictures))
            if self._is_absent(relative):
                unmade.append(relative)
                for picture in pictures:
                    if not self._is_absent(picture):
                        self.check(picture, None, command)
                        self.good.discard(picture)
            elif self.check(relative, None, command):
                try:
                    self.check_all(prefix, view.record.files, command)
                except HyalineError as error:
                    self.refused(relative, error, command)
        self._note_unmade(unmade, f"{len(unmade)} of {total} views{f' of {prefix[:-1]}' if prefix else ''}", command)
        if dataset.edit is not None:
            index = f"{prefix}{EDIT_MASKS}/{EDIT_MASKS}.json"
            if self.check(index, None, command):
                try:
                    self.check_all(prefix, edit_mask_files(dataset), command)
                except HyalineError as error:
                    self.refused(index, error, command)

    def _is_absent(self, relative: str) -> bool:
        """True if neither the path nor anything else in its way exists."""
        obstacle = self.survey.obstacle(relative)
        return obstacle is not None and obstacle[0] not in self.survey.kinds

    def _note_unmade(self, unmade: list[str], what: str, command: str) -> None:
        if unmade and unmade[0].startswith(self.within):
            self.unmade.setdefault(command, []).append(f"{what} ({_some(unmade)})")

    # Geometries

    def _check_proxies(self, dataset: Dataset, prefix: str, geometry: str, command: str) -> None:
        place = f"{prefix}proxies/{geometry}/"
        if not self.check(f"{place}proxies.json", None, command):
            return
        try:
            records = read_proxy_records(dataset, geometry)
        except HyalineError as error:
            self.refused(f"{place}proxies.json", error, command)
            return
        self.check_all(place, {record.file: record.sha256 for record in records}, command)
        self._check_layers(dataset, prefix, geometry, command)

    def _check_layers(self, dataset: Dataset, prefix: str, geometry: str, command: str) -> None:
        root = layers_root(dataset.root, geometry)
        prefix += f"{root.relative_to(dataset.root).as_posix()}/"
        head = prefix + LAYERS.head
        base = layers_root(self.home, geometry) / LAYERS.head
        is_due = dataset.imported is None if geometry == TRUTH else dataset.parent is not None and base.is_file()
        if not is_due and not any(path.startswith(prefix) for path in self.survey.kinds):
            return  # Nothing says that they were ever made.
        if not self.check(head, None, command):
            return
        try:
            store = dataset.layer_store(geometry)
            is_current = store.head.geometry == geometry_hash(dataset, geometry)
        except HyalineError as error:
            if str(error).startswith(str(root)):
                self.refused(head, error, command)
                return
            store, is_current = dataset.layer_store(geometry), True  # The meshes have lines of their own.
        if not is_current:
            self.wrong(head, "was made of other meshes than are there now; repair it with", command)
        unmade, total = [], 0
        for view in (view for split in dataset.splits for view in dataset.views(split)):
            total += 1
            path = record_path_of_layers(root, view.split, view.index)
            relative = prefix + path.relative_to(root).as_posix()
            self.known.add(relative)
            if self._is_absent(relative):
                unmade.append(relative)
            elif self.check(relative, None, command):
                try:
                    self.check_all(prefix, store.record(view.split, view.index).files, command)
                except HyalineError as error:
                    self.refused(relative, error, command)
        self._note_unmade(unmade, f"{len(unmade)} of {total} views of {prefix[:-1]}", command)

    # The end

    def findings(self) -> Findings:
        lines = [f"{self.home / place}: {what} `{command}`" for place, (what, command) in self.lines.items()]
        lines += [
            f"{self.home}: unfinished: without records are {', '.join(found)}; finish it with `{command}`"
            for command, found in self.unmade.items()
        ]
        named = dict.fromkeys([*(command for _, command in self.lines.values()), *self.unmade])
        known = [command for command in self.commands if command in named]
        return Findings(
            files={path: self.hashes[path] for path in sorted(self.good) if path.startswith(self.within)},
            problems=lines,
            remarks=self._foreign() + self._withheld(),
            commands=list(dict.fromkeys([*known, *named])),
        )

    def _withheld(self) -> list[str]:
        if not self.withheld:
            return []
        return [f"{self.home}: the pictures of its {self.withheld} test views are the verifier's, none is missing"]

    def _foreign(self) -> list[str]:
        """Files that are not part of the dataset, without those that an unread record may name."""
        unread = tuple(place.rsplit("/", 1)[0] + "/" for place in self.lines if place.endswith(("ts.json", "rs.json")))
        foreign = [
            path
            for path, kind in self.survey.kinds.items()
            if kind != "folder"
            and path not in self.known
            and path not in self.lines
            and path.startswith(self.within)
            and not path.startswith(unread)
        ]
        if not foreign:
            return []
        return [
            f"{self.home}: {len(foreign)} files are no part of the dataset and were not looked at: {_some(foreign)}"
        ]


def _some(paths: Iterable[str]) -> str:
    named = list(paths)
    more = len(named) - NAMED
    return ", ".join(named[:NAMED]) + (f" and {more} more" if more > 0 else "")


# Commands


def build_command(dataset: Dataset, *, scene_is_good: bool) -> str:
    """The command that builds a dataset again, with the choices that its head records.

    Args:
        scene_is_good: whether the dataset's own copy of its scene can be built from.
    """
    from datagen.scene.finding import is_made_by_code

    scene = dataset.config.scene
    if not is_made_by_code(scene):
        scene = str(dataset.root / "scene") if scene_is_good else "FOLDER"  # That it was built from.
    out = [] if dataset.root == DATA_ROOT / scene else ["--out", str(dataset.root)]
    return shlex.join(build_words(dataset, scene, *out))


def build_words(dataset: Dataset, scene: str, *more: str) -> list[str]:
    """The words of a command that builds a dataset of this configuration from a scene."""
    config, preset = dataset.config, PRESETS[dataset.config.preset]
    words = ["datagen", "build", "--scene", scene, "--preset", config.preset, *more]
    usual, pixels = SizeChoices(), config.resolution
    width_and_height = str(pixels.width) if pixels.width == pixels.height else f"{pixels.width}x{pixels.height}"
    lists_cameras = config.interpolating.views != config.extrapolating.views
    size = SizeChoices(
        resolution=_unless(preset.resolution, pixels) and width_and_height,
        views=None if lists_cameras else _unless(preset.train.views, config.train.views),
        test_views=None if lists_cameras else _unless(preset.interpolating.views, config.interpolating.views),
        spp=_unless(preset.train.spp, config.train.spp),
        test_spp=_unless(preset.interpolating.spp, config.interpolating.spp),
        ceiling=config.ceiling_db,
        num_layers=find_num_layers(dataset, TRUTH) or usual.num_layers,
        max_depth=config.max_depth,
    )
    seed = flag_words(BuildChoices(seed=config.seed), BuildChoices())
    return [*words, *flag_words(size, usual), *seed]


def _unless(default: Value, value: Value) -> Value | None:
    """None where the preset has the value already."""
    return None if value == default else value


def import_command(dataset: Dataset) -> str:
    """The command that brings back what is lost of an imported dataset."""
    is_captured = dataset.imported is not None and dataset.imported.layout == "capture"
    words = "datagen capture" if is_captured else "datagen import-dataset"
    return f"{words} FOLDER --out {shlex.quote(str(dataset.root))}"


def peel_command(dataset: Dataset) -> str:
    """The command that makes layers of an imported dataset."""
    number = find_num_layers(dataset, TRUTH)
    words = ["datagen", "peel", str(dataset.root)]
    return shlex.join([*words, *([] if number is None else ["--num-layers", str(number)])])
