"""Tests that only what a head lists is ever removed, and that nothing is begun where something else stands."""

import os
from pathlib import Path

import pytest
from support.builds import tree
from support.synthetic import write_synthetic_dataset

from datagen.data.writing import clear_dataset
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import DATASET, LAYERS, FolderKind, begin, holding, refuse_file, remove_files
from datagen.disk.records import Json, commit_sealed, load_sealed
from datagen.disk.storage import sha256

KIND = FolderKind(what="thing", head="thing.json", folders=("parts",))
HEAD: dict[str, Json] = {"version": 1}


def put(root: Path, *files: str) -> None:
    for file in files:
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        (root / file).write_text(f"precious {file}")


def test_a_clearing_removes_what_the_heads_list_and_no_other_byte(tmp_path: Path) -> None:
    root = tmp_path / "data"
    write_synthetic_dataset(root, resolution=8, train_views=2)
    strangers = (
        "points3d.ply", "images/train/0002.png", "images/train/0000.png.tmp", "images/thesis.tex",
        "records/train/0000.json.12ab34cd.tmp", "layers/straight/arrays/train/notes.npy.blosc",
        "layers/own/layers.json", "variants/mine/notes", "proxies/box/meshes/pane.ply", "variants/x2/dataset.json",
        "scene/meshes/cat.ply", "images/train/0001.png.0123456789abcdef.hyaline-tmp.txt",
    )  # fmt: skip
    put(root, *strangers)
    with holding(root, DATASET):
        clear_dataset(root)
    assert tree(root).keys() == {*strangers, "dataset.json"}
    assert all((root / file).read_text() == f"precious {file}" for file in strangers)


def test_temporaries_go_only_where_the_head_verifies(tmp_path: Path) -> None:
    root = tmp_path / "data"
    dataset = write_synthetic_dataset(root, resolution=8, train_views=1)
    ours = "images/train/0000.png.0123456789abcdef.hyaline-tmp"
    inner = "layers/straight/arrays/train/0000.uv.npy.blosc.0123456789abcdef.hyaline-tmp"
    put(root, ours, inner, "images/train/0.partial")
    with holding(root, DATASET):
        assert not (root / ours).exists() and (root / inner).exists()
    with holding(dataset.root / "layers/straight", LAYERS, within=root):
        assert not (root / inner).exists()
    assert (root / "images/train/0.partial").exists()
    other = tmp_path / "other"
    put(other, "a.0123456789abcdef.hyaline-tmp", "thesis.tex")
    with holding(other, KIND):
        assert (other / "a.0123456789abcdef.hyaline-tmp").exists()


def test_a_folder_is_begun_only_where_nothing_else_stands(tmp_path: Path) -> None:
    put(tmp_path, "parts/a.partial")
    before = tree(tmp_path)
    with pytest.raises(HyalineError, match=r"is not empty \(parts/a\.partial\) and no thing; choose another --out"):
        begin(tmp_path, KIND, HEAD)
    assert tree(tmp_path) == before
    put(tmp_path, "thing.json")
    with pytest.raises(HyalineError, match=r"thing\.json: is damaged, or of another program; restore it"):
        begin(tmp_path, KIND, HEAD)
    put(tmp_path / "new", "a.0123456789abcdef.hyaline-tmp")
    begin(tmp_path / "new", KIND, HEAD)
    assert load_sealed(tmp_path / "new/thing.json") == HEAD


def test_nothing_is_removed_or_written_through_a_link(tmp_path: Path) -> None:
    root, other = tmp_path / "data", tmp_path / "other"
    write_synthetic_dataset(root, resolution=8, train_views=1)
    (root / "images").rename(other)
    (root / "images").symlink_to(other)
    before = {path: sha256(data) for path, data in tree(other).items()}
    with pytest.raises(HyalineError, match="images: is a symbolic link"), holding(root, DATASET):
        pass
    with pytest.raises(HyalineError, match="images: is a symbolic link"):
        remove_files(root, ["images/train/0000.png"])
    assert {path: sha256(data) for path, data in tree(other).items()} == before


def test_overwrite_replaces_files_and_nothing_else(tmp_path: Path) -> None:
    put(tmp_path, "page.html", "folder/a")
    os.mkfifo(tmp_path / "pipe.html")
    (tmp_path / "device.html").symlink_to("/dev/null")
    for name in ("folder", "pipe.html", "device.html"):
        for overwrite in (False, True):
            with pytest.raises(HyalineError, match=f"{name}: is a folder, a device or a pipe; choose another --out"):
                refuse_file(tmp_path / name, overwrite=overwrite)
    refuse_file(tmp_path / "page.html", overwrite=True)
    with pytest.raises(HyalineError, match=r"page\.html: already exists; use --overwrite"):
        refuse_file(tmp_path / "page.html")


def test_a_sealed_head_that_names_files_outside_harms_nothing(tmp_path: Path) -> None:
    root = tmp_path / "data"
    write_synthetic_dataset(root, resolution=8, train_views=1)
    put(tmp_path, "thesis.tex")
    head = load_sealed(root / "dataset.json")
    commit_sealed(root / "dataset.json", {**head, "files": {"../thesis.tex": "0"}})
    with pytest.raises(HyalineError, match=r"files: names '\.\./thesis\.tex'"):
        clear_dataset(root)
    assert (tmp_path / "thesis.tex").is_file()
