"""Pictures and masks of glass as a dataset: cameras, an opaque room, and a stand-in for each object of glass."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import numpy as np
from jaxtyping import Float, UInt8

from datagen.data.cameras import Cameras, Lens, with_depth_range
from datagen.data.config import SPLITS, Imported, Resolution, Split
from datagen.data.images import mask_pixels, png_bytes
from datagen.data.meshes import Mesh
from datagen.disk.errors import HyalineError
from datagen.machine.processes import allow_triangles
from datagen.scene.description import SceneObject
from datagen.scene.finding import ImportChoices
from datagen.scene.materials import Dielectric, Diffuse
from datagen.scene.modelling import ball, moved, transformed
from datagen.terminal.command import say
from hyaline_import.confined_import import save_answer, scene_from
from hyaline_import.datasets.import_dataset import Plan, digest_of, imported_config, split_views, unlit_scene
from hyaline_import.datasets.layouts import ForeignView, on_background, opened
from hyaline_import.foreign import z_up_from
from hyaline_import.importing import Made, unique_names
from hyaline_import.importing import World as Placed
from hyaline_import.mapping import Mapper
from hyaline_import.remarks import Remarks
from hyaline_import.source import scene_name
from hyaline_photos.capture.folder import Folder, Shot, read_capture
from hyaline_photos.capture.lenses import redrawn, redrawn_mask, shared_lens
from hyaline_photos.capture.planes import LEAST_POINTS, find_up
from hyaline_photos.capture.room import Outline, find_outline, find_panes, fit_room, is_shown
from hyaline_photos.capture.stereo import find_depths
from hyaline_photos.commands import CaptureChoices
from hyaline_photos.fit.shapes import perpendicular

IOR = 1.5
"""Of the glass, until `model fit` finds it."""
DISTANCE = 1.0
"""Metres from the cameras to the glass if the scale is unknown."""
GREY = (0.5, 0.5, 0.5)
"""Colour of the room in scene.json; renderers learn what it looks like."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class World:
    """From the cameras' world to ours: metres, z up."""

    rotation: Float[np.ndarray, "3 3"]
    scale: float = 1.0
    offset: Float[np.ndarray, "3"] = dataclasses.field(default_factory=lambda: np.zeros(3))

    def points(self, points: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point 3"]:
        """Points in our world."""
        return self.scale * points @ self.rotation.T + self.offset

    def cameras(self, shots: Sequence[ForeignView], lens: Lens) -> Cameras:
        """The cameras of shots in our world, with the dataset's lens."""
        poses = np.stack([shot.world_from_camera for shot in shots])
        poses[:, :3, :3] = self.rotation @ poses[:, :3, :3]
        poses[:, :3, 3] = self.points(poses[:, :3, 3])
        return lens.cameras(poses)


def plan_capture(root: Path, choices: CaptureChoices) -> Plan:
    """Plans the dataset of a folder: cameras, scene, splits and remarks, without the pictures' contents."""
    folder = read_capture(root)
    lens, about_lens = shared_lens([shot.lens for shot in folder.shots], choices.longest)
    ids = {shot.picture: _object_ids(shot, lens) for shot in folder.shots}
    folder, ids, about_unseen = _without_unseen(folder, ids)
    world, outlines, about_world = _place(folder, lens, ids, choices)
    shots = folder.shots
    every, seen = world.cameras(shots, lens), [ids[shot.picture] for shot in shots]
    panes = find_panes(outlines, seen, every)
    flat = {pane.name: pane.outline() for pane in panes}
    outlines = tuple(flat.get(outline.name, outline) for outline in outlines)
    views, about_splits = split_views(folder)
    cameras: dict[Split, Cameras] = {split: world.cameras(views[split], lens) for split in SPLITS}
    points, maps = world.points(folder.points), None
    if len(points) >= LEAST_POINTS:
        say(f"comparing {len(shots)} pictures for the depths of opaque surfaces, which takes half a second for each")
        through = [0, *(1 + folder.objects.index(name) for name in flat)]
        is_glass = [~np.isin(picture, through) for picture in seen]
        maps = find_depths([_picture(shot, lens) for shot in shots], is_glass, every, points)
    room = fit_room(points, outlines, every.world_from_camera[:, :3, 3], maps, panes)
    about_world = [*about_world, room.remark]
    if (support := room.support) is not None:
        outlines = tuple(outline.standing_on(support) for outline in outlines)
    for outline in outlines:
        sides = ", ".join(f"{2000 * radius:.0f}" for radius in outline.radii)
        kind = "a pane, which depth maps look through; " if outline.name in flat else ""
        about_world.append(f"{outline.name}: about {sides} mm by its masks; {kind}an ellipsoid until `model fit`")
    name = scene_name(root.resolve())
    scene, about_scene, _ = scene_from(_save_scene, name, outlines, room.parts, cameras, where=name)
    place_of = {item.name: place for place, item in enumerate(scene.objects)}
    object_id = np.array([0, *(1 + place_of[outline.name] for outline in outlines)], np.uint8)
    cameras = with_depth_range(cameras, [item.mesh for item in scene.objects])
    imported = Imported(
        layout=folder.layout,
        source=root.resolve().name,
        source_sha256=digest_of(folder.files, str(choices)),
        has_masks=True,
        has_depth=False,
        has_objects=True,
        remarks=(*folder.remarks, *about_lens, *about_unseen, *about_splits, *about_world, *about_scene),
    )

    def files(split: Split, index: int) -> dict[str, bytes]:
        shot = cast(Shot, views[split][index])
        found = object_id[ids[shot.picture]]
        return {
            ".png": png_bytes(_picture(shot, lens)),
            ".mask.png": png_bytes(np.where(found > 0, 255, 0).astype(np.uint8)),
            ".objects.png": png_bytes(found),
        }

    return Plan(
        files=files,
        cameras=cameras,
        config=imported_config(name, Resolution(width=lens.width, height=lens.height), views),
        scene=scene,
        imported=imported,
        stated_license=folder.license,
    )


def _picture(shot: Shot, lens: Lens) -> UInt8[np.ndarray, "h w 3"]:
    return redrawn(on_background(opened(shot.picture), shot.picture, "white"), shot.lens, lens)


def _object_ids(shot: Shot, lens: Lens) -> UInt8[np.ndarray, "h w"]:
    """1 + the place of the object that each pixel sees; where two claim it, the smaller one, which is in front."""
    found = np.zeros((lens.height, lens.width), np.uint8)
    masks = []
    for path in shot.masks:
        mask = mask_pixels(opened(path, (shot.lens.width, shot.lens.height)))
        masks.append(redrawn_mask(mask, shot.lens, lens))
    for place in sorted(range(len(masks)), key=lambda place: -int(masks[place].sum())):
        found[masks[place]] = 1 + place
    return found


def _without_unseen(
    folder: Folder, ids: Mapping[Path, UInt8[np.ndarray, "h w"]]
) -> tuple[Folder, Mapping[Path, UInt8[np.ndarray, "h w"]], list[str]]:
    """Leaves out objects that too few pictures show to find their places, such as a drink deep in its glass."""
    indices = range(1, len(folder.objects) + 1)
    places = [[int((picture == index).sum()) for picture in ids.values()] for index in indices]
    is_kept = np.array([is_shown(sizes) or not any(sizes) for sizes in places])
    if is_kept.all() or not is_kept.any():
        return folder, ids, []
    renumbered = np.concatenate([[0], np.where(is_kept, is_kept.cumsum(), 0)]).astype(np.uint8)
    kept = tuple(name for name, kept in zip(folder.objects, is_kept) if kept)
    lines = [f"{name}: left out; too few pictures show it" for name in folder.objects if name not in kept]
    return dataclasses.replace(folder, objects=kept), {path: renumbered[each] for path, each in ids.items()}, lines


# The world


def _place(
    folder: Folder, lens: Lens, ids: Mapping[Path, UInt8[np.ndarray, "h w"]], choices: CaptureChoices
) -> tuple[World, tuple[Outline, ...], list[str]]:
    """Turns, scales and moves the cameras' world; the outlines of the glass in ours."""
    shots = folder.shots
    if choices.up != "auto" or folder.has_unit:
        rotation = z_up_from("z" if choices.up == "auto" else choices.up)
    else:
        up = find_up(folder.points, np.stack([shot.world_from_camera for shot in shots]))
        rotation = np.stack([*-perpendicular(up), up])
    turned, seen = World(rotation=rotation), [ids[shot.picture] for shot in shots]
    cameras = turned.cameras(shots, lens)
    outlines = [
        find_outline(name, place, seen, cameras, where=f"{folder.root}: masks/{name}")
        for place, name in enumerate(folder.objects, start=1)
    ]
    middle = np.mean([outline.center for outline in outlines], axis=0)
    bottom = min(outline.center[2] - outline.radii[2] for outline in outlines)
    lines = []
    if choices.diameter is not None:
        name, metres = choices.known_diameter()
        radii = {outline.name: outline.radii for outline in outlines}
        if name not in radii:
            raise HyalineError(f"--diameter: {name} is not an object; expected one of {', '.join(radii)}")
        scale = metres / (radii[name][0] + radii[name][1])
    elif folder.has_unit:
        scale = 1.0
    else:
        places = cameras.world_from_camera[:, :3, 3]
        scale = DISTANCE / float(np.median(np.linalg.norm(places - middle, axis=1)))
        lines = [f"scale: is unknown; the cameras were put {DISTANCE:g} m away from the glass, --diameter sets it"]
    # A transforms file's world keeps its origin; otherwise it is below the glass.
    offset = np.zeros(3) if folder.has_unit else -scale * np.array([middle[0], middle[1], bottom])
    world = World(rotation=rotation, scale=scale, offset=offset)
    return world, tuple(outline.moved(scale, offset) for outline in outlines), lines


# The scene


def _save_scene(
    folder: Path,
    name: str,
    outlines: tuple[Outline, ...],
    parts: dict[str, Mesh],
    cameras: dict[Split, Cameras],
) -> None:
    remarks = Remarks()
    glass = [
        SceneObject(
            name=outline.name,
            mesh=moved(transformed(ball(1.0, subdivisions=3), np.diag(outline.radii), (0, 0, 0)), outline.center),
            material=Dielectric(ior=IOR),
        )
        for outline in outlines
    ]
    taken, matt = {item.name for item in glass}, Diffuse(color=GREY)
    opaque = [
        SceneObject(name=f"room_{part}" if part in taken else part, mesh=mesh, material=matt)
        for part, mesh in parts.items()
    ]
    allow_triangles(sum(len(item.mesh.faces) for item in (*glass, *opaque)))
    names = unique_names([item.name for item in (*glass, *opaque)])
    objects = [dataclasses.replace(item, name=new) for item, new in zip((*glass, *opaque), names, strict=True)]
    mapper = Mapper(metres=1.0, remarks=remarks)
    placed = Placed(linear=np.eye(3), offset=np.zeros(3), mapper=mapper, choices=ImportChoices())
    scene = unlit_scene(name, Made(objects=objects, without_uv=set(names)), placed, cameras, how="Captured")
    save_answer(folder, scene, [f"{line.where}: {line.what}" for line in remarks.lines])
