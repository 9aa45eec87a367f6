"""Variants of a dataset: what each is to be (cameras, size, scene), and its making inside the dataset."""

import contextlib
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, UInt8

from datagen.builder.angles import make_angle_cameras
from datagen.builder.build import peel_dataset, render_dataset, summary
from datagen.data.cameras import Cameras
from datagen.data.config import (
    SPLITS,
    TEST_SPLITS,
    DatasetConfig,
    DatasetObject,
    SceneEdit,
    Split,
    SplitConfig,
    Variant,
    config_difference,
)
from datagen.data.dataset import Dataset, find_num_layers, open_dataset
from datagen.data.geometries import (
    list_geometries,
    read_assignment,
    read_materials,
    read_meshes,
    read_proxy_records,
    write_proxies,
)
from datagen.data.images import png_bytes, srgb_from_linear
from datagen.data.meshes import Mesh, is_there, no_mesh
from datagen.data.paths import TRUTH, geometry_root, layers_root, view_name
from datagen.data.variants import (
    ANGLES,
    EDIT_MASKS_FOLDER,
    ELSEWHERE,
    LIGHT,
    OBJECT,
    edit_mask_files,
    evenly,
    list_variants,
    open_variant,
    variant_root,
)
from datagen.data.writing import clear_dataset, dataset_files, head_contents, view_files, write_head
from datagen.disk.errors import DamagedError, HyalineError
from datagen.disk.ownership import DATASET, EDIT_MASKS, LAYERS, PROXIES, begin, holding, is_ours, refuse_taken
from datagen.disk.records import Json, load_sealed
from datagen.disk.storage import check_files, commit_all, sha256
from datagen.scene.edits import Edit, describe_edit, edit_scene, edits_name, moved_mesh, parse_edit
from datagen.scene.folder import open_scene, scene_files
from datagen.scene.rig import cameras_within
from datagen.terminal.command import say

MAX_SCALE = 8


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """All that the head of a variant is made of."""

    name: str
    config: DatasetConfig
    cameras: dict[Split, Cameras]
    """Cameras of the variant's splits."""
    objects: tuple[DatasetObject, ...]
    edit: SceneEdit | None = None
    scene: Mapping[str, bytes] = field(default_factory=dict)
    """The files of an edited scene's folder; none where the scene is the parent's."""


def plan_angles(base: Dataset) -> Plan:
    """The splits by angle (datagen/builder/angles.py), each of as many views as `extrapolating` has."""
    scene = open_scene(base)
    cameras = cameras_within(scene, make_angle_cameras(scene, base.config))
    return Plan(name=ANGLES, config=base.config, cameras=cameras, objects=base.objects)


def plan_larger(base: Dataset, scale: int, *, views: int | None = None) -> Plan:
    """The test splits, enlarged by an integer factor, with the same samples per pixel.

    Args:
        views: number of views of each split, chosen evenly; None: all.
    """
    if not 2 <= scale <= MAX_SCALE:
        raise HyalineError(f"larger: is {scale}; expected 2 to {MAX_SCALE} times the dataset's size")
    size = base.config.resolution.times(scale)
    sizes: dict[str, SplitConfig] = {}
    cameras: dict[Split, Cameras] = {}
    for split in TEST_SPLITS:
        there = base.config.split(split)
        count = there.views if views is None else views
        if not 1 <= count <= there.views:
            raise HyalineError(f"larger_views: is {count}; expected 1 to {there.views}, as {split} has")
        sizes[split] = dataclasses.replace(there, views=count)
        poses = base.cameras(split)
        chosen = poses.world_from_camera[evenly(count, there.views)]
        cameras[split] = dataclasses.replace(poses.fitted(size), world_from_camera=chosen)
    config = dataclasses.replace(base.config, resolution=size, **sizes)
    return Plan(name=f"x{scale}", config=config, cameras=cameras, objects=base.objects)


def plan_stereo(base: Dataset, baseline: float) -> Plan:
    """The right camera of a rectified pair for every view, `baseline` metres along the camera's x axis.

    Its noise is independent: equal noise at equal pixels would look like a surface at infinity.
    """
    shift = np.eye(4)
    shift[0, 3] = baseline
    right: dict[Split, Cameras] = {split: base.cameras(split) for split in SPLITS}
    for split, left in right.items():
        right[split] = dataclasses.replace(left, world_from_camera=left.world_from_camera @ shift)
    return Plan(
        name=f"stereo-{1000 * baseline:g}mm",
        config=dataclasses.replace(base.config, seed=base.config.seed ^ 1),
        cameras=cameras_within(open_scene(base), right),
        objects=base.objects,
    )


def plan_edit(base: Dataset, edits: tuple[Edit, ...]) -> Plan:
    """The edited scene at the test cameras of the base, with its settings.

    The same seeds give both truths the same noise where the edit changes nothing.
    """
    base.layer_store()
    # Verifies that the meshes are those that the dataset was rendered with.
    read_meshes(base, TRUTH)
    before = open_scene(base)
    edited = edit_scene(before, edits)
    edit = SceneEdit(edits=tuple(map(describe_edit, edits)), changed=edited.changed(before), copies=edited.copies)
    return Plan(
        name=edits_name(edits),
        config=base.config,
        cameras=cameras_within(edited.scene, {split: base.cameras(split) for split in TEST_SPLITS}),
        objects=tuple(DatasetObject(name=item.name, is_glass=item.material.is_glass) for item in edited.scene.objects),
        edit=edit,
        scene=scene_files(edited.scene),
    )


def _check_base(base: Dataset) -> None:
    if base.parent is not None:
        raise HyalineError(
            f"{base.root}: is a variant; name the dataset around it, {base.parent.root}, and give all edits of one "
            "scene in one command"
        )


def build_variant(base: Dataset, plan: Plan, *, workers: int, overwrite: bool = False) -> Dataset:
    """Renders and peels what is missing of a variant.

    An edit gets the proxies of the base, changed as their objects are, and its edit masks.
    """
    _check_base(base)
    root = variant_root(base.root, plan.name)
    with holding(root, DATASET, within=base.root):
        variant = _open_or_start(base, plan, overwrite=overwrite)
        made = render_dataset(variant, workers=workers)
    made += _peel(base, variant, workers=workers)
    say(*(summary(variant, TRUTH) if made else [f"{root}: is built already; nothing to do"]))
    if variant.edit is not None:
        say(f"{root}: finding where the edit shows")
        write_edit_masks(base, variant)
    return variant


def peel_variants(base: Dataset, *, workers: int) -> None:
    """Peels what is missing in every variant, of each geometry that has layers in the dataset itself.

    A variant that is damaged, or needs damaged proxies, is left to the commands that make these.
    """
    for name in list_variants(base.root):
        try:
            _peel(base, open_variant(base, name), workers=workers)
        except DamagedError as error:
            say(f"{variant_root(base.root, name)}: is not peeled: {error}")


def _peel(base: Dataset, variant: Dataset, *, workers: int) -> int:
    """Peels as many layers of each geometry as the base has of it; returns how many views it peeled."""
    made = 0
    for geometry in list_geometries(base):
        if not (layers_root(base.root, geometry) / LAYERS.head).is_file():
            continue
        if variant.edit is not None and geometry != TRUTH:
            with holding(geometry_root(variant.root, geometry), PROXIES, within=variant.root):
                _write_proxies(base, variant, variant.edit, geometry)
        num_layers = base.layer_store(geometry).head.num_layers
        is_other = find_num_layers(variant, geometry) not in (None, num_layers)
        made += peel_dataset(variant, geometry, num_layers=num_layers, overwrite=is_other, workers=workers)
    return made


def _open_or_start(base: Dataset, plan: Plan, *, overwrite: bool) -> Dataset:
    """The variant, when it is this plan's and of this dataset; an empty one where none is, or an outdated one.

    Args:
        overwrite: start over even if files exist.
    """
    root = variant_root(base.root, plan.name)
    record = Variant(of=base.seal, splits=tuple(plan.cameras), edit=plan.edit)
    contents = head_contents(plan.scene, plan.cameras)
    is_outdated = False
    if is_ours(root, DATASET):
        said = load_sealed(root / DATASET.head).get("variant")
        is_outdated = overwrite or not (isinstance(said, dict) and said.get("of") == base.seal)
    if is_ours(root, DATASET) and not is_outdated:
        variant = open_dataset(root)
        if difference := config_difference(variant.config, plan.config):
            raise HyalineError(f"{root}: holds a variant with another configuration ({difference}); delete the folder")
        wanted = {path: sha256(data) for path, data in contents.items()}
        is_outdated = variant.variant != record or variant.files != wanted
    if is_outdated:
        refuse_taken(root, DATASET, [*view_files(plan.config, record.splits), *contents], dataset_files(root))
        clear_dataset(root)
    return write_head(root, plan.config, plan.objects, plan.cameras, plan.scene, variant=record, replace=is_outdated)


def _write_proxies(base: Dataset, variant: Dataset, edit: SceneEdit, geometry: str) -> None:
    """The proxies, moved with their objects; a copy has its original's proxy."""
    edited = edit_scene(open_scene(base), tuple(map(parse_edit, edit.edits)))
    originals = {item.name: edited.copies.get(item.name, item.name) for item in variant.objects}
    there = {item.name for item in edited.scene.objects if is_there(item.mesh)}
    meshes = {item.name: mesh for item, mesh in zip(base.objects, read_meshes(base, geometry), strict=True)}

    def mesh_of(name: str) -> Mesh:
        if name not in there:
            return no_mesh()
        mesh = meshes[originals[name]]
        return moved_mesh(mesh, edited.offsets[name]) if name in edited.offsets else mesh

    statistics = {record.object: record.statistics for record in read_proxy_records(base, geometry)}
    kinds = read_assignment(base, geometry)
    if kinds is not None:
        of_base = {item.name: kind for item, kind in zip(base.objects, kinds, strict=True)}
        kinds = tuple(of_base[original] for original in originals.values())
    before, after = ({item.name: item.material for item in scene.objects} for scene in (open_scene(base), edited.scene))
    materials = read_materials(base, geometry)
    materials = {
        name: materials[original]
        for name, original in originals.items()
        if original in materials and after[name] == before[original]  # Else the edit has given it another.
    }
    of_variant = tuple(statistics[original] for original in originals.values())
    write_proxies(variant, geometry, tuple(map(mesh_of, originals)), of_variant, kinds, materials)


# Edit masks: where an edit shows in the pictures of its dataset, found from both truths, pixel by pixel


SIGMAS = 3.0
"""Least difference that counts, in standard deviations of its noise."""
LEAST = 0.5 / 255
"""And when it is at least half a step of an 8-bit picture."""
WINDOW = 5
"""Pixels a side over which difference and noise are averaged: light spreads, the noise of single pixels does not."""


def write_edit_masks(base: Dataset, edited: Dataset) -> None:
    """Finds and commits the edit masks of all test views, unless they are there; both truths are built and peeled."""
    root = edited.root / EDIT_MASKS_FOLDER
    if is_ours(root, EDIT_MASKS) and load_sealed(root / EDIT_MASKS.head).get("dataset") == edited.seal:
        with contextlib.suppress(HyalineError):  # Missing or damaged masks are made again.
            check_files(root, edit_mask_files(root))
            return
    files: dict[str, bytes] = {}
    for split in TEST_SPLITS:
        for view in range(edited.num_views[split]):
            shown = shows_objects(base, edited, split, view)
            mask = find_edit_mask(shown, _read_halves(base, split, view), _read_halves(edited, split, view))
            files[f"{split}/{view_name(view)}.png"] = png_bytes(np.repeat(mask[..., None], 3, axis=-1))
    promised: dict[str, Json] = {f"{EDIT_MASKS_FOLDER}/{file}": sha256(data) for file, data in files.items()}
    content: dict[str, Json] = {"dataset": edited.seal, "files": promised}
    with holding(root, EDIT_MASKS, within=edited.root):
        begin(root, EDIT_MASKS, content, replace=True)
        commit_all(root, files)


def shows_objects(base: Dataset, edited: Dataset, split: Split, view: int) -> Bool[np.ndarray, "h w"]:
    """Pixels whose centre ray meets a changed object in either scene, before or as its first opaque surface."""
    assert edited.edit is not None
    shape = edited.config.resolution.shape
    shown = np.zeros(shape, bool)
    for dataset in (base, edited):
        is_changed = np.array([False, *(item.name in edited.edit.changed for item in dataset.objects)])
        is_glass = np.array([True, *(item.is_glass for item in dataset.objects)])
        in_view = np.ones(shape, bool)
        for object_id in dataset.view(split, view).layers().object_id:
            shown |= in_view & is_changed[object_id]
            in_view &= is_glass[object_id]
    return shown


def find_edit_mask(
    shown: Bool[np.ndarray, "h w"], before: Float[np.ndarray, "half h w 3"], after: Float[np.ndarray, "half h w 3"]
) -> UInt8[np.ndarray, "h w"]:
    """Where an edit shows.

    Args:
        shown: pixels that show a changed object.
        before: the two independent halves of the truth before the edit, in sRGB.
        after: the same after it. Noise is taken from the difference: truths of the same random numbers share it.
    """
    from scipy.ndimage import uniform_filter

    def mean_around(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        return uniform_filter(np.where(shown, 0, values), WINDOW, mode="constant")

    # Of the pixels around that show no changed object, which would outshine what its light does beside it.
    share = np.maximum(mean_around(np.ones(shown.shape)), WINDOW**-2)
    first, second = after - before
    means = [mean_around(channel) / share for channel in np.moveaxis((first + second) / 2, -1, 0)]
    # The variance of the mean of two halves is the mean square of half their difference.
    variance = mean_around((((first - second) / 2) ** 2).mean(axis=-1)) / share
    # A running sum of squares may end a little below zero.
    deviation = np.sqrt(np.maximum(variance, 0) / (share * WINDOW**2))
    difference = np.sqrt(np.mean(np.square(means), axis=0))
    is_light = difference > np.maximum(SIGMAS * deviation, LEAST)
    return np.where(shown, OBJECT, np.where(is_light, LIGHT, ELSEWHERE)).astype(np.uint8)


def _read_halves(dataset: Dataset, split: Split, view: int) -> Float[np.ndarray, "half h w 3"]:
    """The two independent halves of a view's truth, in sRGB."""
    radiance, half_difference = dataset.view(split, view).radiance_and_noise()
    return srgb_from_linear(np.stack([radiance + half_difference, radiance - half_difference]))
