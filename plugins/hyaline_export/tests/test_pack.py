"""Tests that a packed dataset is the same bytes wherever it is packed, and that only whole datasets are unpacked."""

import gzip
import io
import os
import random
import re
import shutil
import subprocess
import tarfile
from collections.abc import Callable
from pathlib import Path

import pytest
from support.builds import tree
from support.commands import call, run
from support.disk import failing_from
from support.synthetic import write_synthetic_dataset

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


def test_an_unpacked_dataset_is_the_packed_one(here: Path) -> None:
    answer = call("datagen unpack 'my scene.tar' --out 'data/a copy'")
    assert answer.status == 0 and answer.out == "data/a copy\n"
    assert tree(Path("data/a copy")) == tree(Path("data/my scene"))
    assert {path.stat().st_mode & 0o777 for path in Path("data/a copy").rglob("*.png")} == {0o666 & ~umask()}
    run("datagen pack 'a copy' --out again.tar")
    assert Path("again.tar").read_bytes() == Path("my scene.tar").read_bytes()
    run("datagen verify 'a copy'")
    subprocess.run(["tar", "-xf", "my scene.tar"], check=True)
    assert tree(Path("synthetic")) == tree(Path("data/my scene")), "any tar program unpacks it"
    Path("my scene.tar").rename("my scene-demo.tar")
    run("datagen unpack 'my scene-demo.tar'")
    assert Path("data/my scene-demo/dataset.json").is_file(), "a folder of its own name"


def umask() -> int:
    before = os.umask(0)
    os.umask(before)
    return before


def test_a_dataset_with_variants_proxies_and_edit_masks_comes_back_whole(here: Path) -> None:
    write_synthetic_dataset(Path("data/whole"), scene_name="synthetic")
    run("proxies make whole --kind box")
    run("datagen add whole --edit remove:pane")
    run("datagen pack whole --out whole.tar")
    run("datagen unpack whole.tar --out again")
    assert tree(Path("again")) == tree(Path("data/whole"))
    names = {path.split("/")[0] for path in tree(Path("again"))}
    assert names >= {"variants", "proxies", "layers"}
    assert any("edit-masks" in path for path in tree(Path("again")))


def test_an_empty_folder_is_filled_and_one_with_other_files_is_left_alone(here: Path) -> None:
    Path("empty").mkdir()
    run("datagen unpack 'my scene.tar' --out empty")
    assert tree(Path("empty")) == tree(Path("data/my scene"))
    Path("theirs").mkdir()
    Path("theirs/thesis.tar").write_text("precious")
    before = tree(here)
    for line, said in (
        ("datagen unpack 'my scene.tar' --out empty", "empty: is not empty, or not a folder; "),
        ("datagen unpack 'my scene.tar' --out theirs/thesis.tar", "theirs/thesis.tar: is not empty, or not a folder; "),
        ("datagen pack empty --out theirs/thesis.tex", "expected .tar"),
        ("datagen pack empty --out theirs/thesis.tar", "is there already; pass --overwrite"),
    ):
        answer = call(line)
        assert answer.status in (1, 2) and said in answer.error
    assert tree(here) == before


@pytest.mark.parametrize("file", ["records/train/0000.json", "images/train/0001.png", HEAD])
def test_unfinished_and_damaged_datasets_are_refused_with_the_way_to_repair_them(here: Path, file: str) -> None:
    (here / "data/my scene" / file).unlink()
    answer = call("datagen pack 'data/my scene' --out new.tar")
    assert answer.status == 1 and answer.err.count("error: ") == 1 and "my scene" in answer.error
    assert (
        "is lost; restore it" in answer.error if file == HEAD else "run the command that made it again" in answer.error
    )
    assert not Path("new.tar").exists()


def archive_of(files: dict[str, bytes], change: Callable[[tarfile.TarInfo], object] = lambda entry: None) -> bytes:
    """An archive of these files as tarfile writes it, metadata first, with changes of its members' headers."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.PAX_FORMAT) as archive:
        for path, content in sorted(files.items(), key=lambda item: (item[0] != HEAD, item[0])):
            entry = tarfile.TarInfo(f"synthetic/{path}")
            entry.size = len(content)
            change(entry)
            archive.addfile(entry, io.BytesIO(content))
    return buffer.getvalue()


def only(path: str, **changes: object) -> Callable[[tarfile.TarInfo], None]:
    """Changes the header of one member."""

    def change(entry: tarfile.TarInfo) -> None:
        for name, value in changes.items() if entry.name.endswith(path) else ():
            setattr(entry, name, value)

    return change


def resized(data: bytes, path: str, size: int) -> bytes:
    """An archive in which a member claims another size."""
    place = data.index(f"synthetic/{path}".encode())
    entry = tarfile.TarInfo(f"synthetic/{path}")
    entry.size = size
    return data[:place] + entry.tobuf(tarfile.GNU_FORMAT) + data[place + 512 :]


def flipped(data: bytes, place: int) -> bytes:
    return data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]


PICTURE = "images/train/0001.png"
DAMAGED = "is damaged, or no tar archive"
NOT_PLAIN = "expected plain files, dataset.json first"
UNFINISHED = "holds no finished dataset"

Change = tuple[Callable[[dict[str, bytes], bytes], bytes], str]


def with_file(path: str, data: bytes = b"x", reason: str = UNFINISHED) -> Change:
    """An archive in which a file was added or replaced."""
    return lambda files, _: archive_of(files | {path: data}), reason


def without(part: str, reason: str) -> Change:
    return lambda files, _: archive_of({path: data for path, data in files.items() if part not in path}), reason


def as_member(path: str = PICTURE, **header: object) -> Change:
    """An archive in which a member's header was changed."""
    return lambda files, _: archive_of(files, only(path, **header)), NOT_PLAIN


HOSTILE: dict[str, Change] = {
    "truncated": (lambda _, data: data[: len(data) // 2], f"{DAMAGED}|{UNFINISHED}"),
    "empty": (lambda *_: b"", DAMAGED),
    "compressed": (lambda _, data: gzip.compress(data), DAMAGED),
    "another tar": without(HEAD, f"holds 'synthetic/images/.*'; {NOT_PLAIN}"),
    "edited metadata": (
        lambda files, _: archive_of(files | {HEAD: files[HEAD].replace(b"synthetic", b"authentic")}),
        rf"{UNFINISHED} \(dataset.json: does not match its own checksum",
    ),
    "a way up": with_file("../../up.json", reason=r"\.\./\.\./up\.json"),
    "a view too many": with_file("images/train/9999.png"),
    "a variant of another dataset": (
        lambda files, _: archive_of(files | {"variants/x2/dataset.json": files[HEAD]}),
        UNFINISHED,
    ),
    "a bomb": (lambda _, data: resized(data, PICTURE, 1 << 50), DAMAGED),
    "a sparse bomb": as_member(type=tarfile.GNUTYPE_SPARSE),
    "a link": as_member(type=tarfile.SYMTYPE, linkname="/etc/passwd", size=0),
    "an empty file": with_file(PICTURE, b"", NOT_PLAIN),
    "layers that no record names": with_file("proxies/x/meshes/a.ply", b"x", rf"{UNFINISHED} \(.*proxies"),
    "an unfinished dataset": without("records/train", f"{UNFINISHED}.*unfinished"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_archive_is_one_line_and_leaves_nothing(here: Path, name: str) -> None:
    make, reason = HOSTILE[name]
    files, data = tree(Path("data/my scene")), Path("my scene.tar").read_bytes()
    assert archive_of(files) == data, "what is changed here is an archive"
    Path("hostile.tar").write_bytes(make(files, data))
    before = tree(here)
    answer = call("datagen unpack hostile.tar --out out")
    assert answer.status == 1 and answer.err.count("error: ") == 1 and "error: hostile.tar: " in answer.error
    assert re.search(reason, answer.error) and "hyaline-tmp" not in answer.error, answer.error
    assert tree(here) == before
    assert sorted(path.name for path in here.iterdir()) == ["data", "hostile.tar", "my scene.tar"]


@pytest.mark.promise("R4")
def test_a_flipped_bit_changes_nothing_or_is_noticed(here: Path, is_full: bool) -> None:
    data, whole = Path("my scene.tar").read_bytes(), tree(Path("data/my scene"))
    rng = random.Random(0)
    places = [0, 512, len(data) - 1, *(rng.randrange(len(data)) for _ in range(300 if is_full else 10))]
    noticed = 0
    for place in places:
        Path("flipped.tar").write_bytes(flipped(data, place))
        answer = call("datagen unpack flipped.tar --out out")
        if answer.status == 0:  # In the zeros between files, or in a header's unused bytes.
            assert tree(Path("out")) == whole, f"byte {place}"
            shutil.rmtree("out")
        else:
            assert answer.status == 1 and "flipped.tar: " in answer.error, f"byte {place}: {answer.err}"
            assert not Path("out").exists()
            noticed += 1
    assert noticed > len(places) / 4


def test_a_full_disk_leaves_no_archive_and_no_folder(here: Path) -> None:
    for line in ("datagen pack 'my scene' --out new.tar", "datagen unpack 'my scene.tar' --out out"):
        before = tree(here)
        with failing_from(here, 9, "ENOSPC") as refused:
            answer = call(line)
        assert refused and answer.status == 1 and "no space left" in answer.error
        assert tree(here) == before and not list(here.glob("*hyaline-tmp"))
