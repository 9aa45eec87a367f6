"""Making a dataset whole again, from what its own heads say: whatever is missing or damaged is made once more.

Nothing that verifies is touched. Heads come back from their copies (disk/heads.py), scene and cameras from the scene
that the dataset was built from, all else from those, by the functions that made it first. Proxies are made by another
program: `datagen verify` names its command.
"""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from datagen.build.build import files_in, peel_dataset, render_dataset
from datagen.build.build_variant import build_variant
from datagen.build.plan_variant import plan_again
from datagen.build.verify import check_is_there, import_command, is_good, list_obstacles
from datagen.data.dataset import Dataset, head_files, open_dataset
from datagen.data.depth_range import with_depth_range
from datagen.data.geometries import list_geometries
from datagen.data.paths import layers_root
from datagen.data.transforms import TRANSFORMS_FILES
from datagen.data.variants import list_variants, open_variant
from datagen.data.writing import head_contents
from datagen.disk.errors import DamagedError, HyalineError
from datagen.disk.heads import list_heads, true_head
from datagen.disk.homes import HEADS, home_of
from datagen.disk.ownership import DATASET, holding
from datagen.disk.storage import commit, commit_same, one_writer, sha256
from datagen.scene.description import Scene
from datagen.scene.folder import load_scene
from datagen.scene.rig import make_cameras
from datagen.terminal.command import say


def mend_dataset(root: Path, *, scene: str | None, workers: int) -> Dataset:
    """Makes all that is missing or damaged of a dataset, its layers and variants; returns it.

    Args:
        scene: the scene's name, or the folder that it was built from; needed where the copy in the dataset is damaged
            and the scene is no built-in one.

    Raises:
        HyalineError: the head is lost together with its copy, or the scene is no longer the one that was rendered.
    """
    home = home_of(root)
    check_is_there(home)  # Before anything is touched.
    with one_writer(home):
        _clear_the_way(home)
        _restore_heads(home)
        # What stands in the way of a folder's files is known when its head is there.
        _clear_the_way(home)
    with holding(home, DATASET):
        dataset = open_dataset(home)
        if dataset.imported is not None:
            _check_imported(dataset)
        else:
            _restore_scene(dataset, scene)
            render_dataset(dataset, workers=workers)
    for geometry in list_geometries(dataset):
        with _passing_over_proxies(f"{home}: layers of {geometry}"):
            _peel(dataset, geometry, workers=workers)
    for name in list_variants(home):
        variant = open_variant(dataset, name)
        with _passing_over_proxies(str(variant.root)):
            build_variant(dataset, plan_again(dataset, variant), workers=workers)
    return dataset


def _check_imported(dataset: Dataset) -> None:
    """Refuses to go on where only the folder that a dataset was imported from has what is lost."""
    lost = [file for file, digest in head_files(dataset.root).items() if not is_good(dataset.root / file, digest)]
    lost += [f"{split} {view.index}" for split in dataset.splits for view in dataset.views(split) if not view.is_built]
    if lost:
        raise HyalineError(
            f"{dataset.root}: {lost[0]} is missing or damaged, and was imported; bring it back with "
            f"`{import_command(dataset)}`"
        )


def _peel(dataset: Dataset, geometry: str, *, workers: int) -> None:
    """Peels what is missing of the layers that a geometry's head promises."""
    if (layers_root(dataset.root, geometry) / "layers.json").is_file():
        num_layers = dataset.layer_store(geometry).head.num_layers
        peel_dataset(dataset, geometry, num_layers=num_layers, overwrite=False, workers=workers)


@contextlib.contextmanager
def _passing_over_proxies(what: str) -> Iterator[None]:
    """Leaves what needs damaged proxies, which are another command's to make, for the next time."""
    try:
        yield
    except DamagedError as error:
        say(f"{what}: not mended yet: {error}")


def _clear_the_way(home: Path) -> None:
    """Removes links and pipes, and moves other things aside, that stand where files of the dataset belong."""
    for path in list_obstacles(home):
        is_folder = path.is_dir() and not path.is_symlink()
        if is_folder and not any(path.iterdir()):
            path.rmdir()
        elif is_folder or (path.is_file() and not path.is_symlink() and path.stat().st_size):
            number = next(number for number in range(1, 1000) if not path.with_name(f"{path.name}.{number}").exists())
            aside = path.rename(path.with_name(f"{path.name}.{number}"))
            say(f"{path}: stood in the way; is now {aside}")
        else:
            path.unlink()


def _restore_heads(home: Path) -> None:
    for head in list_heads(home):
        data = true_head(home, head)
        if data is None:
            continue  # What made it must make it again.
        commit_same(home / head, data)
        commit_same(home / HEADS / head, data)


def _restore_scene(dataset: Dataset, given: str | None) -> None:
    """Writes lost scene files and cameras again."""
    promised = head_files(dataset.root)
    lost = [file for file, digest in promised.items() if not is_good(dataset.root / file, digest)]
    if not lost:
        return
    scene = _find_scene(dataset, given, lost)
    # Datasets of format version 1 have cameras without near and far.
    bare = make_cameras(scene.cameras, dataset.config)
    for cameras in (bare, with_depth_range(bare, [item.mesh for item in scene.objects])):
        contents = head_contents(files_in(dataset, scene), cameras)
        if all(sha256(contents[file]) == promised[file] for file in lost if file in TRANSFORMS_FILES.values()):
            break
    for file in lost:
        if file not in contents or sha256(contents[file]) != promised[file]:
            raise HyalineError(
                f"{dataset.root / file}: cannot be made again: scene {scene.name} is not what it was when the dataset "
                "was built; restore the file from elsewhere, or build the dataset anew with --overwrite"
            )
        commit(dataset.root / file, contents[file])


def _find_scene(dataset: Dataset, given: str | None, lost: list[str]) -> Scene:
    from datagen.scene.finding import find_scene, is_made_by_code

    if not any(file.startswith("scene/") for file in lost):
        return load_scene(dataset.root / "scene")
    if given is None and not is_made_by_code(dataset.config.scene):
        raise HyalineError(
            f"{dataset.root / lost[0]}: is lost or damaged, and comes from a scene of yours; name the folder or file "
            "that the dataset was built from with --scene"
        )
    return find_scene(given or dataset.config.scene, resolution=dataset.config.resolution)
