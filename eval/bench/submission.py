"""Submissions: one method's predictions of the benchmark's scenes with their records, as one verified file.

    NAME/hyaline-submission.json      sealed: version, preset, name, track, code version, digest of each dataset, size
                                      and SHA-256 of every file
    NAME/SCENE/NAME/run.json          the run's record, and costs.json if training was counted
    NAME/SCENE/NAME/predictions/...   its pictures; variants/angles/ and the edits that it predicted

A reader takes only the files that the protocol asks for, and only the bytes that the index names (export/archive.py).
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO, cast

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset
from datagen.data.paths import view_name
from datagen.data.variants import ANGLES, has_variant, open_variant, variant_command, variant_root
from datagen.disk.errors import HyalineError, UsageError
from datagen.disk.names import check_name
from datagen.disk.ownership import refuse_file
from datagen.disk.records import Json, open_regular, read_regular, to_json
from datagen.disk.storage import seal_bytes, sha256
from datagen.export.archive import (
    Member,
    PackedFile,
    check_packed,
    holds,
    list_members,
    packed_json,
    read_index,
    unpack_members,
    write_archive,
)
from datagen.machine.doctor import code_version
from datagen.terminal.command import choose, say
from datagen.terminal.signals import replacing_at_the_end
from eval.analyses.variants import run_of_variant
from eval.bench.protocol import Protocol, choose_track, has_usual_name, is_of_preset, left_out, load_protocol
from eval.score.runs import Run, has_predictions, has_split, list_run_folders, open_run, read_prediction

INDEX = "hyaline-submission.json"
MAX_WORDS = 200
"""Characters of a submission's texts that scores repeat."""
MAX_PICTURE_BYTES = 16 << 20
"""Bytes of a predicted picture; 512 x 512 pixels of noise take 0.8 MB."""


@dataclass(frozen=True, kw_only=True)
class Submission:
    """The index of a submission."""

    version: int
    """Version of the protocol."""
    preset: str
    name: str
    """The method's name: that of its runs' folders."""
    track: str
    code: str
    """Version of the code that packed it."""
    datasets: dict[str, str]
    """The digest of each scene's dataset, by the scene's name."""
    files: dict[str, PackedFile]
    """By path relative to the submission's folder."""

    def __post_init__(self) -> None:
        check_name(self.name, where="name")
        if len(self.code) > MAX_WORDS:
            raise HyalineError(f"code: has {len(self.code):,} characters; expected at most {MAX_WORDS}")
        check_packed(self.files)
        if not self.datasets:
            raise HyalineError("datasets: is empty; expected at least one scene")
        protocol = load_protocol()
        choose("track", self.track, protocol.tracks)
        for scene in self.datasets:
            choose("scene", scene, protocol.all_scenes(self.preset))
        for path, file in self.files.items():
            if not any(re.fullmatch(_paths_of(scene, self.name, protocol), path) for scene in self.datasets):
                raise HyalineError(f"files: names {path}; expected only records and predictions of the protocol")
            if file.size > MAX_PICTURE_BYTES:
                raise HyalineError(f"files: {path} has {file.size:,} bytes; expected at most {MAX_PICTURE_BYTES:,}")


def _paths_of(scene: str, name: str, protocol: Protocol) -> str:
    """A regular expression of the files that a submission may have of a scene."""
    home, picture = re.escape(f"{scene}/{name}/"), r"[0-9]{4,5}\.png"
    variants = {f"variants/{name}/": splits for name, splits in protocol.variant_splits(scene).items()}
    pictures = "|".join(
        rf"{re.escape(folder)}predictions(\.json|/({'|'.join(splits)})/{picture})"
        for folder, splits in {"": TEST_SPLITS, **variants}.items()
    )
    return rf"{home}(run\.json|costs\.json|{pictures})"


# Packing


def find_runs(root: Path, data_root: Path, preset: str, protocol: Protocol) -> dict[str, dict[str, Run]]:
    """The runs on datasets of a preset, by their name and scene.

    A run that cannot be opened, or whose dataset has another size, is named and left out; so is a second run on a
    scene beside that on the dataset SCENE-PRESET.
    """
    runs: list[Run] = []
    for folder in list_run_folders(root, besides=root / "report"):
        with left_out():
            if has_predictions(folder) and is_of_preset((run := open_run(folder, data_root)).dataset, preset, protocol):
                runs.append(run)
    found: dict[str, dict[str, Run]] = {}
    for run in sorted(runs, key=lambda run: not has_usual_name(run.dataset)):
        scene = run.dataset.config.scene
        first = found.setdefault(run.name, {}).setdefault(scene, run)
        if first is not run:
            double = f"{run.folder}: is a second run of {run.name} on {scene}, beside {first.folder}"
            if not has_usual_name(first.dataset):
                raise HyalineError(double)
            say(f"left out: {double}")
    return found


def list_predictions(run: Run, protocol: Protocol) -> list[tuple[Run, list[Split]]]:
    """A run and its predictions of variants, each with the splits that it has.

    Raises:
        HyalineError: a split that the protocol asks for is missing.
    """
    listed: list[tuple[Run, list[Split]]] = [(run, list(TEST_SPLITS))]
    for name, splits in protocol.variant_splits(run.dataset.config.scene).items():
        if not has_variant(run.dataset, name):
            if name == ANGLES:
                raise HyalineError(
                    f"{run.dataset.root}: has no {name}; make them with `{variant_command(run.dataset, name)}`"
                )
            continue
        found = run_of_variant(run, open_variant(run.dataset, name))
        if found is not None:
            listed.append((found, list(splits)))
        elif name == ANGLES:
            folder = variant_root(run.folder, name) / "predictions"
            raise HyalineError(f"{folder}: missing; the protocol asks for {', '.join(splits)}")
    for part, splits in listed:
        for split in splits:
            if not has_split(part, split):
                raise HyalineError(
                    f"{part.folder / 'predictions' / split}: missing; the protocol asks for all its views"
                )
    return listed


@replacing_at_the_end()
def submit(
    runs: Mapping[str, Run], *, preset: str, track: str | None, out: Path, protocol: Protocol, overwrite: bool
) -> Path:
    """Packs a method's runs; every picture is read and checked.

    Args:
        runs: by scene, all of one name.
        track: None: the first track that allows what the method was told, by its record.
    """
    if out.suffix != ".tar":
        raise UsageError(f"--out {out}: ends in {out.suffix!r}; expected .tar")
    name = next(iter(runs.values())).name
    tracks = [choose_track(run, track, protocol.tracks) for run in runs.values()]
    sources: dict[str, Path] = {}
    for scene, run in runs.items():
        home = f"{scene}/{name}"
        parts = list_predictions(run, protocol)
        records = [run.folder / "run.json", run.folder / "costs.json"]
        for part, splits in parts:
            records.append(part.folder / "predictions.json")
            for split in splits:
                for view in range(part.dataset.config.split(split).views):
                    read_prediction(part, split, view)
                    path = part.folder / "predictions" / split / f"{view_name(view)}.png"
                    sources[f"{home}/{path.relative_to(run.folder).as_posix()}"] = path
        sources |= {f"{home}/{p.relative_to(run.folder).as_posix()}": p for p in records if p.is_file()}
    files = {}
    for path, source in sources.items():
        data = read_regular(source, at_most=MAX_PICTURE_BYTES)
        files[path] = PackedFile(size=len(data), sha256=sha256(data))
    index = Submission(
        version=protocol.version,
        preset=preset,
        name=name,
        track=max(tracks, key=list(protocol.tracks).index),
        code=code_version(),
        datasets={scene: run.dataset.seal for scene, run in runs.items()},
        files=files,
    )
    data, members = _members(index)
    if out.is_file() and not overwrite and holds(out, members):
        say(f"{out}: is finished")
        return out
    refuse_file(out, overwrite=overwrite)
    write_archive(out, data, members, sources)
    total = len(protocol.all_scenes(preset))
    say(f"{out}: track {index.track}, {len(runs)} of {total} scenes, {len(files):,} files")
    return out


def _members(index: Submission) -> tuple[bytes, list[Member]]:
    data = seal_bytes(cast(dict[str, Json], to_json(index)) | {"files": packed_json(index.files)})
    return data, list_members(data, INDEX, index.name, index.files)


# Unpacking


def read_submission(path: Path) -> Submission:
    """The verified index of a submission; its files are not read."""
    with open_regular(path) as archive:
        return _read_index(archive, path)[0]


@contextmanager
def opened_submission(path: Path, truths: Mapping[str, Dataset]) -> Iterator[tuple[Submission, dict[str, Run]]]:
    """A submission with its runs by scene, unpacked for as long as the block lasts.

    Args:
        truths: the datasets that have the truth, by their digest.

    Raises:
        HyalineError: it is damaged, hostile or incomplete, or there is no truth of one of its scenes.
    """
    with open_regular(path) as archive, TemporaryDirectory(prefix="hyaline-bench-") as folder:
        index, members = _read_index(archive, path)
        for scene, seal in index.datasets.items():
            if seal not in truths or truths[seal].config.scene != scene:
                raise HyalineError(
                    f"{path}: predicts {scene} of dataset {seal[:12]}, which is not there; build it, or set --data to "
                    "the folder that contains it"
                )
        root = Path(folder)
        unpack_members(archive, path, members, root)
        try:
            yield index, _open_runs(index, root, truths)
        except HyalineError as error:
            raise HyalineError(str(error).replace(str(root), str(path))) from None


def _open_runs(index: Submission, root: Path, truths: Mapping[str, Dataset]) -> dict[str, Run]:
    runs = {}
    for scene, seal in index.datasets.items():
        folder = root / scene / index.name
        folder.mkdir(parents=True, exist_ok=True)  # Without any file, its predictions are missing below.
        # A record that names another dataset must not choose the truth.
        runs[scene] = run = open_run(folder, root, truths[seal], is_trusted=False)
        choose_track(run, index.track, load_protocol().tracks)
    return runs


def _read_index(archive: BinaryIO, path: Path) -> tuple[Submission, list[Member]]:
    version = load_protocol().version
    return read_index(archive, path, Submission, _members, name=INDEX, version=version, maker="hyaline-bench submit")
