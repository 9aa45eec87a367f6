"""Owns the making of an edited dataset: the truth of a changed scene at the test cameras of a dataset that is there."""

import dataclasses

from datagen.build.build import open_or_start, peel_dataset, render_dataset
from datagen.build.find_edit_masks import write_footprints
from datagen.data.cameras import Cameras
from datagen.data.config import SPLITS, Split
from datagen.data.dataset import Dataset, DatasetEdit, read_cameras
from datagen.data.edited import edit_root
from datagen.data.geometries import list_geometries, read_assignment, read_meshes, read_proxy_records, write_proxies
from datagen.data.layer_store import LayersHead, LightPathsHead, read_layers_head
from datagen.data.meshes import Mesh, is_there, no_mesh, write_ply
from datagen.data.paths import LAYER_KINDS, TRUTH, geometry_root, layers_root
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import DATASET, PROXIES, holding
from datagen.disk.storage import sha256
from datagen.scene.edits import Edit, EditedScene, describe_edit, edit_scene, edits_name, moved_mesh
from datagen.scene.folder import load_scene
from datagen.terminal.command import say


def build_edit(base: Dataset, edits: tuple[Edit, ...], *, workers: int, overwrite: bool) -> Dataset:
    """Renders and peels what is missing of the edited scene, with the settings of the base.

    The same seeds give both truths the same noise where the edit changes nothing. Layers are made of each kind and
    each geometry that the base has; proxies are changed as their objects are.

    Raises:
        HyalineError: the edit is impossible, the base has no straight layers, or is an edit itself.
    """
    if base.edit is not None:
        raise HyalineError(f"{base.root}: is an edit itself; give all edits of one scene in one command")
    read_layers_head(base, TRUTH, "straight")
    # Verifies that the meshes are those that the dataset was rendered with.
    read_meshes(base, TRUTH)
    before = load_scene(base.root / "scene", is_sealed=True)
    edited = edit_scene(before, edits)
    record = DatasetEdit(
        base=base.seal,
        edits=tuple(map(describe_edit, edits)),
        changed=edited.changed(before),
        copies=edited.copies,
    )
    train = dataclasses.replace(base.config.train, views=0)
    config = dataclasses.replace(base.config, train=train)
    cameras: dict[Split, Cameras] = {split: read_cameras(base, split) for split in SPLITS}
    nowhere = cameras["train"].world_from_camera[:0]
    cameras["train"] = dataclasses.replace(cameras["train"], world_from_camera=nowhere)
    root = edit_root(base, edits_name(edits))
    with holding(root, DATASET, within=base.root):
        dataset = open_or_start(edited.scene, root, config, cameras, overwrite=overwrite, edit=record)
        render_dataset(dataset, workers=workers)
    for geometry in list_geometries(base):
        if geometry != TRUTH:
            with holding(geometry_root(dataset.root, geometry), PROXIES, within=dataset.root):
                _write_proxies(base, dataset, edited, geometry)
        peel_like(base, dataset, geometry, workers=workers)
    say(f"{root}: finds where the edit shows")
    write_footprints(base, dataset)
    return dataset


def peel_like(base: Dataset, dataset: Dataset, geometry: str, *, workers: int) -> None:
    """Peels what is missing of a geometry, each kind of layers that the base has of it, with the base's settings."""
    for kind in LAYER_KINDS:
        if not (layers_root(base.root, geometry, kind) / "layers.json").is_file():
            continue
        head, _ = read_layers_head(base, geometry, kind)
        match head:
            case LayersHead():
                num_layers, rays = head.num_layers, 4
            case LightPathsHead():
                num_layers, rays = head.max_vertices, head.samples
        peel_dataset(
            dataset, geometry, kinds=(kind,), num_layers=num_layers, rays=rays, overwrite=False, workers=workers
        )


def _write_proxies(base: Dataset, dataset: Dataset, edited: EditedScene, geometry: str) -> None:
    """Proxies stand where their objects stand; a copy has that of its original."""
    meshes = {item.name: mesh for item, mesh in zip(base.objects, read_meshes(base, geometry), strict=True)}
    records = {record.object: record for record in read_proxy_records(base, geometry)}
    there = {item.name for item in edited.scene.objects if is_there(item.mesh)}

    def mesh_of(name: str) -> Mesh:
        if name not in there:
            return no_mesh()
        mesh = meshes[edited.copies.get(name, name)]
        return moved_mesh(mesh, edited.offsets[name]) if name in edited.offsets else mesh

    names = [item.name for item in dataset.objects]
    wanted = tuple(map(mesh_of, names))
    try:
        found = read_meshes(dataset, geometry)
    except HyalineError:
        found = None  # Not made yet, or damaged.
    if found is not None and _hashes(found) == _hashes(wanted):
        return
    statistics = tuple(records[edited.copies.get(name, name)].statistics for name in names)
    assignment = read_assignment(base, geometry)
    if assignment is not None:
        kinds = {item.name: kind for item, kind in zip(base.objects, assignment, strict=True)}
        assignment = tuple(kinds[edited.copies.get(name, name)] for name in names)
    write_proxies(dataset, geometry, wanted, statistics, assignment)


def _hashes(meshes: tuple[Mesh, ...]) -> list[str]:
    return [sha256(write_ply(mesh)) if is_there(mesh) else "" for mesh in meshes]
