"""What a variant of a dataset is to be: which cameras, which size and which scene."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field

from datagen.builder.angles import make_angle_cameras
from datagen.data.cameras import Cameras
from datagen.data.config import TEST_SPLITS, DatasetConfig, Split, SplitConfig
from datagen.data.dataset import Dataset, DatasetObject
from datagen.data.geometries import read_meshes
from datagen.data.metadata import SceneEdit
from datagen.data.paths import TRUTH
from datagen.data.variants import ANGLES, evenly, scale_name
from datagen.disk.errors import HyalineError
from datagen.scene.edits import Edit, EditedScene, describe_edit, edit_scene, edits_name, parse_edit
from datagen.scene.folder import open_scene, scene_files
from datagen.scene.rig import cameras_within

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
    """The splits by angle (datagen/builder/angles.py), each of as many views as `extrapolating` has.

    Raises:
        HyalineError: the scene has no place for such cameras.
    """
    _check_base(base)
    scene = open_scene(base)
    cameras = cameras_within(scene, make_angle_cameras(scene, base.config))
    return Plan(name=ANGLES, config=base.config, cameras=cameras, objects=base.objects)


def plan_larger(base: Dataset, scale: int, *, views: int | None = None) -> Plan:
    """The test splits, enlarged by an integer factor, with the same samples per pixel.

    Args:
        views: number of views of each split, chosen evenly; None: all.

    Raises:
        HyalineError: an unfit scale or number of views.
    """
    _check_base(base)
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
    return Plan(name=scale_name(scale), config=config, cameras=cameras, objects=base.objects)


def plan_edit(base: Dataset, edits: tuple[Edit, ...]) -> Plan:
    """The edited scene at the test cameras of the base, with its settings.

    The same seeds give both truths the same noise where the edit changes nothing.

    Raises:
        HyalineError: the edit is impossible, or the base has no straight layers, by which edit masks are found.
    """
    _check_base(base)
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


def edited_scene(base: Dataset, edit: SceneEdit) -> EditedScene:
    """The scene of a variant, with what the edit did to each object."""
    return edit_scene(open_scene(base), tuple(map(parse_edit, edit.edits)))
