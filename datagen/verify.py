"""Owns the search for damage: every byte of a dataset against what its sealed records promise."""

from collections.abc import Callable, Iterator
from pathlib import Path

from datagen.annex import list_annex_folders
from datagen.dataset import Dataset, check_files, head_files, open_dataset, read_record, record_path
from datagen.edited import edit_root, list_edits
from datagen.errors import HyalineError
from datagen.footprints import footprint_files
from datagen.geometry import TRUTH, geometry_root, list_geometries, read_proxy_records
from datagen.layer_store import LAYER_KINDS, layers_root, read_layers_head, read_layers_record, record_path_of_layers


def verify_dataset(root: Path) -> tuple[int, list[str]]:
    """The number of files that verify, and a line for each that is damaged, missing or foreign.

    Raises:
        HyalineError: the head itself is missing or damaged, so nothing can be said of the rest.
    """
    dataset = open_dataset(root)
    known: set[Path] = {root / "dataset.json"}
    problems: list[str] = []

    def check(folder: Path, files: dict[str, str]) -> None:
        for file, promised in files.items():
            known.add(folder / file)
            try:
                check_files(folder, {file: promised})
            except HyalineError as error:
                problems.append(str(error))

    check(root, head_files(root))
    for split in dataset.splits:
        for view in range(dataset.config.split(split).views):
            known.add(record_path(root, split, view))
            try:
                check(root, read_record(dataset, split, view).files)
            except HyalineError as error:
                problems.append(str(error))
    for geometry in list_geometries(dataset):
        _check_geometry(dataset, geometry, known, problems, check)
    if dataset.edit is not None:
        known.add(root / "footprints" / "footprints.json")
        try:
            check(root, footprint_files(dataset))
        except HyalineError as error:
            problems.append(str(error))
    inner = [*list_annex_folders(root), *(edit_root(dataset, name) for name in list_edits(dataset))]
    problems += [
        f"{path}: belongs to no record; delete it"
        for path in _files(root)
        if path not in known and not set(inner) & set(path.parents)
    ]
    damaged = {problem.split(":")[0] for problem in problems}
    count = len([path for path in known if path.is_file() and str(path) not in damaged])
    for folder in inner:
        try:
            more, further = verify_dataset(folder)
        except HyalineError as error:
            more, further = 0, [str(error)]
        count, problems = count + more, problems + further
    return count, problems


def _check_geometry(dataset: Dataset, geometry: str, known: set[Path], problems: list[str],
                    check: Callable[[Path, dict[str, str]], None]) -> None:  # fmt: skip
    if geometry != TRUTH and dataset.parent is None:
        folder = geometry_root(dataset.root, geometry)
        known.add(folder / "proxies.json")
        try:
            check(folder, {record.file: record.sha256 for record in read_proxy_records(dataset, geometry)})
        except HyalineError as error:
            problems.append(str(error))
    for kind in LAYER_KINDS:
        folder = layers_root(dataset.root, geometry, kind)
        if not folder.is_dir():
            continue
        known.add(folder / "layers.json")
        try:
            head, _ = read_layers_head(dataset, geometry, kind)
        except HyalineError as error:
            problems.append(str(error))
            continue
        check(folder, head.files)
        for split in dataset.splits:
            for view in range(dataset.config.split(split).views):
                known.add(record_path_of_layers(folder, split, view))
                try:
                    check(folder, read_layers_record(dataset, geometry, kind, split, view).files)
                except HyalineError as error:
                    problems.append(str(error))


def _files(root: Path) -> Iterator[Path]:
    return (path for path in sorted(root.rglob("*")) if path.is_file())
