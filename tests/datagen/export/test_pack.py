"""Tests that a packed dataset is the same bytes wherever it is packed, and that nothing else is ever unpacked."""

import io
import os
import random
import re
import shutil
import subprocess
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.builds import tree
from support.commands import call, run
from support.disk import Change, watch
from support.synthetic import write_synthetic_dataset

from datagen.data.dataset import open_dataset
from datagen.disk.storage import seal_bytes, sha256
from datagen.export import archive, pack

HEAD = "dataset.json"


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a dataset and its archive."""
    folder = tmp_path_factory.mktemp("packed")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        write_synthetic_dataset(Path("data/my scene"))
        run("datagen pack 'my scene' --out 'my scene.tar'")
    return folder


@pytest.fixture
def here(packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of that folder, as the working directory."""
    folder = tmp_path / "here"
    shutil.copytree(packed, folder)
    monkeypatch.chdir(folder)
    return folder


def test_the_same_dataset_gives_the_same_bytes_wherever_it_lies_and_whoever_has_it(here: Path) -> None:
    shutil.copytree("data/my scene", "other")
    for place, path in enumerate(sorted(Path("other").rglob("*"), reverse=True)):
        os.utime(path, (place, place))
        path.chmod(0o700 if path.is_dir() else 0o400 + place % 2)
    Path("other/mine.txt").write_text("precious")
    before = os.umask(0o077)
    try:
        answer = call("datagen pack other --out archives/there.tar")
    finally:
        os.umask(before)
    assert answer.status == 0 and answer.out == "archives/there.tar\n"
    assert "1 files are no part of the dataset and were not looked at: mine.txt" in answer.err
    assert Path("archives/there.tar").read_bytes() == Path("my scene.tar").read_bytes()


def test_any_tar_program_unpacks_every_file_of_the_dataset(here: Path) -> None:
    subprocess.run(["tar", "-xf", "my scene.tar"], check=True)
    (folder,) = (path for path in here.iterdir() if path.name not in ("data", "my scene.tar"))
    (folder / pack.INDEX).unlink()
    assert tree(folder) == tree(Path("data/my scene"))


def test_an_unpacked_dataset_is_the_packed_one_and_is_not_unpacked_twice(here: Path) -> None:
    answer = call("datagen unpack 'my scene.tar' --out 'data/a copy'")
    assert answer.status == 0 and answer.out == "data/a copy\n"
    assert tree(Path("data/a copy")) == tree(Path("data/my scene"))
    with watch(here, refuse):
        again = call("datagen unpack 'my scene.tar' --out 'data/a copy'")
        packed_again = call("datagen pack 'a copy' --out 'my scene.tar'")
    assert again.status == 0 and "data/a copy: holds this dataset already" in again.err
    assert packed_again.status == 0 and "my scene.tar: is finished" in packed_again.err


def test_an_archive_is_unpacked_into_a_folder_of_its_own_name(here: Path) -> None:
    Path("my scene.tar").rename("my scene-demo.tar")
    run("datagen unpack 'my scene-demo.tar'")
    assert tree(Path("data/my scene-demo")) == tree(Path("data/my scene"))


def refuse(change: Change) -> None:
    raise AssertionError(f"changes {change}")


def test_packing_changes_nothing_in_the_dataset(here: Path) -> None:
    with watch(here / "data", refuse):
        run("datagen pack 'my scene' --out 'new.tar'")


def test_an_empty_folder_is_filled_and_one_with_other_files_is_left_alone(here: Path) -> None:
    Path("empty").mkdir()
    run("datagen unpack 'my scene.tar' --out empty")
    assert tree(Path("empty")) == tree(Path("data/my scene"))
    view = next(Path("data/my scene/images").rglob("*.png"))
    view.write_bytes(view.read_bytes() + b"!")
    Path("theirs").mkdir()
    Path("theirs/thesis.tex").write_text("precious")
    Path("file").write_text("precious")
    before = tree(here)
    for place, named in (("data/my scene", view.name), ("theirs", "images/"), ("file", "images/")):
        answer = call(f"datagen unpack 'my scene.tar' --out '{place}'")
        assert answer.status == 1 and f"{place}: is taken, and " in answer.error and named in answer.error
    answer = call("datagen pack 'empty' --out theirs/thesis.tex")
    assert answer.status == 2 and "expected .tar" in answer.error
    Path("theirs/thesis.tex").rename("theirs/thesis.tar")
    answer = call("datagen pack 'empty' --out theirs/thesis.tar")
    assert answer.status == 1 and "is there already; pass --overwrite" in answer.error
    Path("theirs/thesis.tar").rename("theirs/thesis.tex")
    assert tree(here) == before


@pytest.mark.parametrize("file", ["records/train/0000.json", "images/train/0001.png", HEAD])
def test_unfinished_and_damaged_datasets_are_refused_with_the_command_that_repairs_them(here: Path, file: str) -> None:
    (here / "data/my scene" / file).unlink()
    answer = call("datagen pack 'data/my scene' --out new.tar")
    assert answer.status == 1 and answer.err.count("error: ") == 1 and "my scene" in answer.error
    assert "`datagen build" in answer.error or "run it again" in answer.error
    assert not Path("new.tar").exists()


def archive_of(
    files: dict[str, bytes],
    change_index: Callable[[dict[str, Any]], object] = lambda index: None,
    change_entry: Callable[[tarfile.TarInfo], object] = lambda entry: None,
) -> bytes:
    """An archive as tarfile writes it, of these files, with changes of its index and of its members' headers."""
    described = {path: {"size": len(data), "sha256": sha256(data)} for path, data in files.items()}
    dataset = open_dataset(Path("data/my scene"))
    terms = "unknown; ask the author of dataset synthetic"
    index = {"version": 1, "scene": "synthetic", "license": terms, "dataset": dataset.seal}
    index["files"] = described
    change_index(index)
    data = seal_bytes(index)
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.PAX_FORMAT) as archive:
        for path, content in [
            ("hyaline-pack.json", data),
            *sorted(files.items(), key=lambda item: (item[0] == HEAD, item[0])),
        ]:
            entry = tarfile.TarInfo(f"synthetic/{path}")
            entry.size = len(content)
            change_entry(entry)
            archive.addfile(entry, io.BytesIO(content))
        length = archive.offset + 1024
    return buffer.getvalue()[:length]


def rename(index: dict[str, Any], new: str) -> None:
    index["files"][new] = index["files"].pop(HEAD)


def only(path: str, **changes: object) -> Callable[[tarfile.TarInfo], None]:
    """Changes the header of one member."""

    def change(entry: tarfile.TarInfo) -> None:
        for name, value in changes.items() if entry.name.endswith(path) else ():
            setattr(entry, name, value)

    return change


def flipped(data: bytes, place: int) -> bytes:
    return data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]


MORE = {"plugins/sphere.so": b"code"}
HOSTILE: dict[str, tuple[Callable[[dict[str, bytes], bytes], bytes], str]] = {
    "truncated": (lambda _, data: data[: len(data) // 2], r"has [\d,]+ bytes; expected [\d,]+; get the archive again"),
    "cut in its index": (lambda _, data: data[:700], "not a JSON file"),
    "longer": (lambda _, data: data + bytes(512), r"has [\d,]+ bytes; expected [\d,]+; get"),
    "empty": (lambda *_: b"", "is no archive of `datagen pack`"),
    "another format": (lambda _, data: b"PK\3\4" + data, "is no archive of `datagen pack`"),
    "another tar": (lambda files, _: archive_of(files, lambda index: index.clear()), "version is None; expected 1"),
    "a way up": (
        lambda files, _: archive_of(files, lambda index: rename(index, "../up.json")),
        "names '../up.json'; expected a file inside",
    ),
    "an absolute path": (
        lambda files, _: archive_of(files, lambda index: rename(index, "/tmp/up.json")),
        "names '/tmp/up.json'; expected a file inside",
    ),
    "a file in a file": (
        lambda files, _: archive_of(files, lambda index: rename(index, "transforms_train.json/x")),
        "lies in another file",
    ),
    "a bomb": (
        lambda files, _: archive_of(files, lambda index: index["files"][HEAD].update(size=1 << 50)),
        r"has [\d,]+ bytes; expected 1,125,8",
    ),
    "a negative size": (
        lambda files, _: archive_of(files, lambda index: index["files"][HEAD].update(size=-512)),
        "has -512 bytes",
    ),
    "a link": (
        lambda files, _: archive_of(files, change_entry=only(HEAD, type=tarfile.SYMTYPE, linkname="/etc/passwd")),
        r"has [\d,]+ bytes; expected|dataset.json is damaged",
    ),
    "a device": (
        lambda files, _: archive_of(files, change_entry=only(HEAD, type=tarfile.CHRTYPE)),
        "dataset.json is damaged; get the archive again",
    ),
    "another mode": (
        lambda files, _: archive_of(files, change_entry=only("train/0001.png", mode=0o4755)),
        "images/train/0001.png is damaged; get the archive again",
    ),
    "a later version": (
        lambda files, _: archive_of(files, lambda index: index.update(version=2)),
        "version is 2; expected 1; update hyaline",
    ),
    "an unknown key": (
        lambda files, _: archive_of(files, lambda index: index.update(command="rm")),
        "unknown key 'command'",
    ),
    "a scene with a path": (
        lambda files, _: archive_of(files, lambda index: index.update(scene="../up")),
        "scene: is '../up'",
    ),
    "files of no dataset": (
        lambda files, _: archive_of(files | MORE),
        r"holds no finished dataset \(.*1 files are no part of the dataset.*plugins/sphere.so\)",
    ),
    "an unfinished dataset": (
        lambda files, _: archive_of({path: data for path, data in files.items() if "records/train" not in path}),
        r"holds no finished dataset \(.*unfinished",
    ),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_archive_is_one_line_and_leaves_nothing(here: Path, name: str) -> None:
    make, reason = HOSTILE[name]
    files, data = tree(Path("data/my scene")), Path("my scene.tar").read_bytes()
    assert archive_of(files) == data, "what is changed here is an archive"
    Path("hostile.tar").write_bytes(make(files, data))
    before = tree(here)
    answer = call("datagen unpack hostile.tar --out out")
    assert answer.status == 1 and answer.err.count("error: ") == 1 and "hostile.tar: " in answer.error
    assert re.search(reason, answer.error), answer.error
    assert tree(here) == before
    assert sorted(path.name for path in here.iterdir()) == ["data", "hostile.tar", "my scene.tar"]


@pytest.mark.promise("R4")
def test_a_flipped_bit_anywhere_is_noticed(here: Path, is_full: bool, cases: Callable[[int, str], None]) -> None:
    data = Path("my scene.tar").read_bytes()
    rng = random.Random(0)
    places = [0, 512, len(data) - 1, *(rng.randrange(len(data)) for _ in range(300 if is_full else 30))]
    for place in places:
        Path("flipped.tar").write_bytes(flipped(data, place))
        answer = call("datagen unpack flipped.tar --out out")
        assert answer.status == 1 and "flipped.tar: " in answer.error, f"byte {place}: {answer.err}"
        assert not Path("out").exists()
    cases(len(places), "flipped bits")


@pytest.mark.parametrize(
    ("before", "share"),
    [
        (lambda whole: whole[: len(whole) // 2], 0.5),
        (lambda whole: whole[:-1], 0.0),
        (lambda whole: whole + b"!", 0.0),
        (lambda whole: flipped(whole, 600), 1.0),
        (lambda whole: b"of another dataset", 1.0),
    ],
    ids=["half", "all but the end", "longer", "damaged", "another"],
)
def test_packing_goes_on_after_whatever_an_earlier_call_wrote(
    before: Callable[[bytes], bytes], share: float, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, copied, copy = Path("my scene.tar").read_bytes(), [], archive._copy

    def watched(source: Any, member: Any, target: Any) -> bool:
        copied.extend([member.size] if target is not None else [])
        return copy(source, member, target)

    monkeypatch.setattr(archive, "_copy", watched)
    with archive._held_file(Path("new.tar"), pack.INDEX) as (file, part):
        file.write(before(whole))
        file.flush()
        assert "new.tar: another process is writing it" in call("datagen pack 'my scene' --out new.tar").error
    run("datagen pack 'my scene' --out new.tar")
    assert Path("new.tar").read_bytes() == whole and not part.exists()
    assert sum(copied) / len(whole) == pytest.approx(share, abs=0.2) and (share > 0 or not copied)
