"""The making of a variant: a dataset inside another one, of other cameras, another size, or an edited scene."""

from datagen.builder.build import peel_dataset, render_dataset
from datagen.builder.find_edit_masks import write_edit_masks
from datagen.builder.plan_variant import Plan, edited_scene
from datagen.builder.shards import Shard
from datagen.data.config import config_difference
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.geometries import (
    list_geometries,
    read_assignment,
    read_materials,
    read_meshes,
    read_proxy_records,
    write_proxies,
)
from datagen.data.layer_writing import find_num_layers
from datagen.data.meshes import Mesh, is_there, no_mesh
from datagen.data.metadata import SceneEdit, Variant
from datagen.data.paths import TRUTH, geometry_root, layers_root
from datagen.data.ply import write_ply
from datagen.data.variants import list_variants, open_variant, variant_root
from datagen.data.writing import clear_dataset, dataset_files, head_contents, view_files, write_head
from datagen.disk.errors import DamagedError, HyalineError
from datagen.disk.ownership import DATASET, PROXIES, holding, is_ours, refuse_taken
from datagen.disk.storage import load_sealed, sha256
from datagen.scene.edits import moved_mesh
from datagen.scene.folder import open_scene
from datagen.terminal.command import say


def build_variant(
    base: Dataset, plan: Plan, *, workers: int, shard: Shard | None = None, overwrite: bool = False
) -> Dataset:
    """Renders and peels what is missing of a variant, or of one part of its views.

    An edit gets the proxies of the base, changed as their objects are, and its edit masks.

    Raises:
        HyalineError: a variant of other settings stands there, or another process writes there.
    """
    root = variant_root(base.root, plan.name)
    with holding(root, DATASET, within=base.root, shared=shard is not None):
        variant = _open_or_start(base, plan, overwrite=overwrite, is_alone=shard is None)
        render_dataset(variant, workers=workers, shard=shard)
    _peel(base, variant, workers=workers, shard=shard)
    if variant.edit is not None:
        say(f"{root}: finding where the edit shows")
        write_edit_masks(base, variant)
    return variant


def peel_variants(base: Dataset, *, workers: int, shard: Shard | None = None) -> None:
    """Peels what is missing in every variant, of each geometry that has layers in the dataset itself.

    A variant that is damaged, or needs damaged proxies, is left to the commands that make these.
    """
    for name in list_variants(base.root):
        try:
            variant = open_variant(base, name)
            if shard is None or variant.edit is None:  # Edits are made by one machine.
                _peel(base, variant, workers=workers, shard=shard)
        except DamagedError as error:
            say(f"{variant_root(base.root, name)}: is not peeled: {error}")


def _peel(base: Dataset, variant: Dataset, *, workers: int, shard: Shard | None) -> None:
    """Peels as many layers of each geometry as the base has of it."""
    for geometry in list_geometries(base):
        if not (layers_root(base.root, geometry) / "layers.json").is_file():
            continue
        if variant.edit is not None and geometry != TRUTH:
            with holding(geometry_root(variant.root, geometry), PROXIES, within=variant.root):
                _write_proxies(base, variant, variant.edit, geometry)
        num_layers = base.layer_store(geometry).head.num_layers
        is_other = find_num_layers(variant, geometry) not in (None, num_layers)
        peel_dataset(
            variant,
            geometry,
            num_layers=num_layers,
            overwrite=is_other and shard is None,
            workers=workers,
            shard=shard,
        )


def _open_or_start(base: Dataset, plan: Plan, *, overwrite: bool, is_alone: bool) -> Dataset:
    """The variant, when it is this plan's and of this dataset; an empty one where none is, or an outdated one.

    Args:
        overwrite: start over even if files exist.
        is_alone: False: other processes may be doing the same; nothing is deleted.
    """
    root = variant_root(base.root, plan.name)
    record = Variant(of=base.seal, splits=tuple(plan.cameras), edit=plan.edit)
    contents = head_contents(plan.scene, plan.cameras)
    if is_ours(root, DATASET) and not _is_current(base, plan, record, contents, overwrite=overwrite):
        if not is_alone:
            raise HyalineError(f"{root}: holds an outdated variant; build without --shard, which replaces it")
        refuse_taken(root, DATASET, [*view_files(plan.config, record.splits), *contents], dataset_files(root))
        clear_dataset(root)
        return write_head(root, plan.config, plan.objects, plan.cameras, plan.scene, variant=record, replace=True)
    return write_head(root, plan.config, plan.objects, plan.cameras, plan.scene, variant=record)


def _is_current(base: Dataset, plan: Plan, record: Variant, contents: dict[str, bytes], *, overwrite: bool) -> bool:
    """True when the variant that stands there is the planned one.

    Raises:
        HyalineError: it is one of the same dataset with another configuration, and is not to be replaced.
    """
    root = variant_root(base.root, plan.name)
    said = load_sealed(root / DATASET.head).get("variant")
    if overwrite or not (isinstance(said, dict) and said.get("of") == base.seal):
        return False
    variant = open_dataset(root)
    if difference := config_difference(variant.config, plan.config):
        raise HyalineError(f"{root}: holds a variant with another configuration ({difference}); delete the folder")
    wanted = {path: sha256(data) for path, data in contents.items()}
    return variant.variant == record and variant.files == wanted


def _write_proxies(base: Dataset, variant: Dataset, edit: SceneEdit, geometry: str) -> None:
    """The proxies, moved with their objects; a copy has its original's proxy."""
    edited = edited_scene(base, edit)
    meshes = {item.name: mesh for item, mesh in zip(base.objects, read_meshes(base, geometry), strict=True)}
    records = {record.object: record for record in read_proxy_records(base, geometry)}
    there = {item.name for item in edited.scene.objects if is_there(item.mesh)}

    def mesh_of(name: str) -> Mesh:
        if name not in there:
            return no_mesh()
        mesh = meshes[edited.copies.get(name, name)]
        return moved_mesh(mesh, edited.offsets[name]) if name in edited.offsets else mesh

    names = [item.name for item in variant.objects]
    wanted = tuple(map(mesh_of, names))
    try:
        found = read_meshes(variant, geometry)
    except HyalineError:
        found = None  # Not made yet, or damaged.
    if found is not None and _hashes(found) == _hashes(wanted):
        return
    statistics = tuple(records[edited.copies.get(name, name)].statistics for name in names)
    assignment = read_assignment(base, geometry)
    if assignment is not None:
        kinds = {item.name: kind for item, kind in zip(base.objects, assignment, strict=True)}
        assignment = tuple(kinds[edited.copies.get(name, name)] for name in names)
    base_scene = {item.name: item.material for item in open_scene(base).objects}
    found_materials = read_materials(base, geometry)
    materials = {
        item.name: found_materials[original]
        for item in edited.scene.objects
        if (original := edited.copies.get(item.name, item.name)) in found_materials
        and item.material == base_scene[original]  # Else the edit has given it another.
    }
    write_proxies(variant, geometry, wanted, statistics, assignment, materials)


def _hashes(meshes: tuple[Mesh, ...]) -> list[str]:
    return [sha256(write_ply(mesh)) if is_there(mesh) else "" for mesh in meshes]
