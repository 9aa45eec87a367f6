"""Pictures and masks of glass as a dataset: cameras, an opaque room, and a stand-in for each object of glass."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import numpy as np
from jaxtyping import Float, UInt8

from datagen.data.cameras import Cameras, Lens, with_depth_range
from datagen.data.config import SPLITS, Imported, Resolution, Split
from datagen.data.images import png_bytes
from datagen.data.meshes import Mesh, is_there, no_mesh
from datagen.disk.errors import HyalineError
from datagen.scene.description import Scene, SceneObject
from datagen.scene.finding import ImportChoices
from datagen.scene.materials import Dielectric, Diffuse
from datagen.scene.modelling import ball, moved, transformed
from datagen.terminal.command import track, waiting
from hyaline_import.datasets.import_dataset import Plan, digest_of, imported_config, split_views, unlit_scene
from hyaline_import.datasets.layouts import ForeignView, on_background, opened
from hyaline_import.importing import Made, unique_names
from hyaline_import.importing import World as Placed
from hyaline_import.mapping import Mapper
from hyaline_import.remarks import Remarks
from hyaline_import.source import scene_name
from hyaline_photos.capture.exposure import find_exposures
from hyaline_photos.capture.folder import NAMED, Folder, Shot, read_capture, read_mask
from hyaline_photos.capture.lenses import redrawn, redrawn_mask, shared_lens
from hyaline_photos.capture.planes import NEAR, find_up
from hyaline_photos.capture.room import THING, Outline, find_outline, find_panes, fit_room, is_shown, lacking
from hyaline_photos.capture.stereo import DepthMaps, find_depths, with_uv
from hyaline_photos.commands import DRINK, SCALE, CaptureChoices
from hyaline_photos.fit.shapes import WATER, perpendicular

IOR = 1.5
"""Of the glass, until `model fit` finds it."""
DISTANCE = 1.0
"""Metres from the cameras to the glass if the scale is unknown."""
WANTED, LONGEST = 128, (160, 320)
"""Pixels along a glass, and the longer side of the pictures, from which more would not be learned in the same time."""
FULL = 800
"""Longer side of the pictures of which depth maps are made; larger ones are reduced."""
BORDERS = 0.3, 10.0
"""Least and largest depth that is looked for, over the cameras' distance."""
MAX_LACKING = 0.25
"""Share of what a depth map shows that the room may lack before the picture is named."""
MAX_EDGES = 0.9
"""Share of all pictures' edges that the masks of one object may cover: a table top may nearly fill them."""
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
    """Plans the dataset of a folder: cameras, scene, splits and remarks, all from training pictures and their masks."""
    folder = read_capture(root)
    views, about_splits = split_views(folder)
    shots = cast(tuple[Shot, ...], views["train"])
    lenses = [shot.lens for shot in folder.shots]
    lens, about_lens = shared_lens(lenses, choices.longest or _longest(shots))
    seen = [_object_ids(shot, lens) for shot in track(shots, label="masks", total=len(shots))]
    _check_masks(folder, np.stack(seen))
    folder, about_unseen = _without_unseen(folder, seen)
    if about_unseen:
        views, _ = split_views(folder)
        shots = cast(tuple[Shot, ...], views["train"])
        seen = [_object_ids(shot, lens) for shot in shots]
    world, outlines, about_world = _place(folder, shots, lens, seen, choices)
    with waiting("panes among the glass"):
        panes = find_panes(outlines, seen, world.cameras(shots, lens))
    flat = {pane.name: pane.outline() for pane in panes}
    outlines = tuple(flat.get(outline.name, outline) for outline in outlines)
    full, through = shared_lens(lenses, FULL)[0], [0, *(1 + folder.objects.index(name) for name in flat)]
    wide, full_size, is_glass = world.cameras(shots, full), [], []
    for shot in track(shots, label="pictures of full size", total=len(shots)):
        full_size.append(_picture(shot, full))
        is_glass.append(~np.isin(_object_ids(shot, full), through))
    places, middle = wide.world_from_camera[:, :3, 3], np.mean([outline.center for outline in outlines], axis=0)
    radius = float(np.median(np.linalg.norm(places - middle, axis=1)))
    maps = find_depths(full_size, is_glass, wide, middle, (BORDERS[0] * radius, BORDERS[1] * radius))
    mapped = maps.points(NEAR * radius)
    points = np.concatenate([world.points(folder.points), mapped])
    with waiting("surfaces of the room"):
        room = fit_room(points, outlines, places, maps, panes)
        lacks = lacking(room.parts, maps)
    about_world.append(f"{room.remark}; {lacks.mean():.0%} of what depth maps show is missing or elsewhere")
    if doubtful := [place for place in np.argsort(-lacks) if lacks[place] > MAX_LACKING]:
        names = ", ".join(f"{shots[place].picture.name} ({lacks[place]:.0%})" for place in doubtful[:NAMED])
        about_world.append(f"room: lacks more than {MAX_LACKING:.0%} of {len(doubtful)} pictures, most of {names}")
    if (support := room.support) is not None:
        outlines = tuple(outline.standing_on(support) for outline in outlines)
    unit = "mm" if folder.has_unit or choices.diameter else "thousandths of the cameras' distance"
    for outline in outlines:
        sides = ", ".join(f"{2000 * half:.0f}" for half in outline.radii)
        kind = "a pane, which depth maps look through; " if outline.name in flat else ""
        about_world.append(f"{outline.name}: about {sides} {unit} by its masks; {kind}an ellipsoid until `model fit`")
    name = scene_name(root.resolve())
    cameras: dict[Split, Cameras] = {split: world.cameras(views[split], lens) for split in SPLITS}
    pictures, about_exposure = _exposed(views, lens, world, maps, mapped)
    about_world.append(about_exposure)
    with waiting("unwrapping the room"):
        parts = {
            part: with_uv(mesh, where=part) if part.startswith(THING) else mesh for part, mesh in room.parts.items()
        }
    with waiting("the scene"):
        scene, about_scene = _scene(name, outlines, parts, cameras)
    place_of = {item.name: place for place, item in enumerate(scene.objects)}
    object_id = np.array([0, *(1 + place_of[outline.name] for outline in outlines)], np.uint8)
    cameras = with_depth_range(cameras, [item.mesh for item in scene.objects if is_there(item.mesh)])
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
        found = object_id[_object_ids(shot, lens)]
        return {
            ".png": png_bytes(pictures[shot.picture]),
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


def _exposed(
    views: Mapping[Split, Sequence[ForeignView]], lens: Lens, world: World, maps: DepthMaps, points: np.ndarray
) -> tuple[dict[Path, UInt8[np.ndarray, "h w 3"]], str]:
    """All pictures as if equally exposed, by path, and what was corrected in words."""
    shots = cast(list[Shot], [shot for split in SPLITS for shot in views[split]])
    drawn = [_picture(shot, lens) for shot in track(shots, label="exposure", total=len(shots))]
    exposures = find_exposures(drawn, world.cameras(shots, lens), maps, points)
    corrected = {shot.picture: exposures.corrected(drawn[view], view) for view, shot in enumerate(shots)}
    return corrected, exposures.in_words()


def _object_ids(shot: Shot, lens: Lens) -> UInt8[np.ndarray, "h w"]:
    """1 + the place of the object that each pixel sees; where two claim it, the smaller one, which is in front."""
    found = np.zeros((lens.height, lens.width), np.uint8)
    size = shot.lens.width, shot.lens.height
    masks = [redrawn_mask(read_mask(path, size), shot.lens, lens) for path in shot.masks]
    for place in sorted(range(len(masks)), key=lambda place: -int(masks[place].sum())):
        found[masks[place]] = 1 + place
    return found


def _longest(shots: Sequence[Shot]) -> int:
    """Longer side of the pictures in which glass is about `WANTED` pixels long."""
    shares = []
    for shot in shots[:: max(1, len(shots) // 12)]:
        size = shot.lens.width, shot.lens.height
        places = [np.nonzero(read_mask(path, size)) for path in shot.masks]
        shares += [max(np.ptp(rows), np.ptp(columns)) / max(size) for rows, columns in places if len(rows)]
    return int(np.clip(WANTED / max(np.median(shares), 1e-3), *LONGEST)) if shares else LONGEST[1]


def _check_masks(folder: Folder, seen: UInt8[np.ndarray, "view h w"]) -> None:
    """Refuses inverted masks."""
    edges = np.concatenate([seen[:, [0, -1]].reshape(-1), seen[:, :, [0, -1]].reshape(-1)])
    for place, name in enumerate(folder.objects, start=1):
        if (share := float((edges == place).mean())) > MAX_EDGES:
            raise HyalineError(
                f"{folder.root}: masks/{name}: its masks show {share:.0%} of the pictures' edges; expected white where "
                "the object is seen, black around it: invert them, or take pictures from farther away"
            )


def _without_unseen(folder: Folder, seen: Sequence[UInt8[np.ndarray, "h w"]]) -> tuple[Folder, list[str]]:
    """Leaves out objects that too few pictures show to find their places, such as a drink deep in its glass."""
    sizes = [[int((ids == place).sum()) for ids in seen] for place in range(1, len(folder.objects) + 1)]
    kept = [place for place, each in enumerate(sizes) if is_shown(each)]
    if len(kept) in (0, len(sizes)):
        return folder, []
    lines = [f"{name}: left out; too few pictures show it" for i, name in enumerate(folder.objects) if i not in kept]
    views = {
        role: tuple(dataclasses.replace(shot, masks=tuple(cast(Shot, shot).masks[i] for i in kept)) for shot in shots)
        for role, shots in folder.views.items()
    }
    return dataclasses.replace(folder, views=views, objects=tuple(folder.objects[i] for i in kept)), lines


# The world


def _place(
    folder: Folder,
    shots: Sequence[Shot],
    lens: Lens,
    seen: Sequence[UInt8[np.ndarray, "h w"]],
    choices: CaptureChoices,
) -> tuple[World, tuple[Outline, ...], list[str]]:
    """Turns, scales and moves the cameras' world; the outlines of the glass in ours."""
    rotation = np.eye(3)
    if not folder.has_unit:
        up = find_up(folder.points, np.stack([shot.world_from_camera for shot in shots]))
        rotation = np.stack([*-perpendicular(up), up])
    cameras = World(rotation=rotation).cameras(shots, lens)
    outlines = [
        find_outline(name, place, seen, cameras, where=f"{folder.root}: masks/{name}")
        for place, name in enumerate(track(folder.objects, label="places of glass", total=len(folder.objects)), start=1)
    ]
    middle = np.mean([outline.center for outline in outlines], axis=0)
    bottom = min(outline.center[2] - outline.radii[2] for outline in outlines)
    lines = []
    if choices.diameter is not None:
        name, metres = choices.known_diameter()
        radii = {outline.name: outline.radii for outline in outlines}
        name = next(iter(radii)) if name is None and len(radii) == 1 else name
        if name not in radii:
            raise HyalineError(f"--diameter: {name} is not an object; expected one of {', '.join(radii)}")
        scale = metres / (radii[name][0] + radii[name][1])
    elif folder.has_unit:
        scale = 1.0
    else:
        places = cameras.world_from_camera[:, :3, 3]
        scale = DISTANCE / float(np.median(np.linalg.norm(places - middle, axis=1)))
        lines = [
            f"{SCALE}is unknown, so all lengths are relative; the cameras were put {DISTANCE:g} m away from the "
            "glass, --diameter sets it"
        ]
    # A transforms file's world keeps its origin; otherwise it is below the glass.
    offset = np.zeros(3) if folder.has_unit else -scale * np.array([middle[0], middle[1], bottom])
    world = World(rotation=rotation, scale=scale, offset=offset)
    return world, tuple(outline.moved(scale, offset) for outline in outlines), lines


# The scene


def _scene(
    name: str, outlines: Sequence[Outline], parts: Mapping[str, Mesh], cameras: dict[Split, Cameras]
) -> tuple[Scene, list[str]]:
    """The scene of a room and stand-ins for glass, and remarks."""
    remarks = Remarks()
    glass = [
        SceneObject(
            name=outline.name,
            mesh=moved(transformed(ball(1.0, subdivisions=3), np.diag(outline.radii), (0, 0, 0)), outline.center),
            material=Dielectric(ior=IOR),
        )
        for outline in outlines
    ]
    opaque = [SceneObject(name=part, mesh=mesh, material=Diffuse(color=GREY)) for part, mesh in parts.items()]
    names = unique_names([item.name for item in (*glass, *opaque)])
    objects = [dataclasses.replace(item, name=new) for item, new in zip((*glass, *opaque), names, strict=True)]
    mapper = Mapper(metres=1.0, remarks=remarks)
    placed = Placed(linear=np.eye(3), offset=np.zeros(3), mapper=mapper, choices=ImportChoices())
    made = Made(objects=objects, without_uv={name for name in names if not name.startswith(THING)})
    scene = unlit_scene(name, made, placed, cameras, how="Captured")
    # What a glass may hold, which its masks show as one with it, has no mesh until `model fit` finds it.
    drink = Dielectric(ior=WATER, priority=-1)
    free = [f"{name}{DRINK}" for name in names[: len(glass)] if f"{name}{DRINK}" not in names]
    drinks = [SceneObject(name=name, mesh=no_mesh(), material=drink) for name in free]
    scene = dataclasses.replace(scene, objects=(*scene.objects, *drinks))
    return scene, [f"{line.where}: {line.what}" for line in remarks.lines]
