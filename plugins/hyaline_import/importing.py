"""From a foreign file to a scene: read, mend, map, stage, check."""

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datagen.data.config import Resolution
from datagen.data.meshes import Mesh, is_there, open_edges
from datagen.data.metadata import unknown_license
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json
from datagen.disk.storage import sha256_file
from datagen.machine.confined import allow_triangles
from datagen.scene.cutouts import Cut, with_cuts
from datagen.scene.description import (
    MAX_OBJECTS,
    OBJECT_NAME,
    CameraList,
    CameraRig,
    Environment,
    EnvironmentMap,
    RectangleLight,
    Scene,
    SceneObject,
)
from datagen.scene.finding import DEFAULT_RESOLUTION
from datagen.scene.import_choices import ImportChoices
from datagen.scene.materials import Material
from datagen.scene.mending import mend_scene, mend_surface
from datagen.scene.remarks import Remark, Remarks
from datagen.scene.shading_normals import edge_tilt_deg, with_new_normals
from datagen.scene.soundness import check_scene
from datagen.scene.staging import LIGHT, even_sky, find_scale, has_ground, make_ground, make_rig, subject_box
from datagen.scene.surfaces import closed, made_sound, mesh_of, shape_of
from hyaline_import.cameras import listed_cameras, read_camera_file
from hyaline_import.foreign import (
    PLAIN,
    Axis,
    ForeignMap,
    ForeignMaterial,
    ForeignObject,
    ForeignScene,
    elementwise,
    merged_by_material,
    with_cavities,
    z_up_from,
)
from hyaline_import.foreign_files import (
    READERS,
    check_ending,
    check_overrides,
    ending_of,
    override,
    parse_overrides,
    scene_name,
)
from hyaline_import.lights import LEAST_GLOW, exposed, glowing, lit, placed_light, placed_map
from hyaline_import.mapping import Mapper, lets_light_through
from hyaline_import.overlaps import apart, nested, parted
from hyaline_import.pictures import cut_of, veiled

MIN_SIDE = 16
"""Pixels of the pictures that a ground can be made for."""

RECORD_VERSION = 1
MAX_TOLD = 40
"""Lines that a command prints; import.json has all of them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Imported:
    """A scene made from a foreign file, and the content of its import.json."""

    scene: Scene
    record: Mapping[str, Json]
    remarks: tuple[Remark, ...]

    def told(self) -> list[str]:
        """The lines to report: approximations, notes, and the number of objects."""
        glass = sum(item.material.is_glass for item in self.scene.objects)
        wheres: dict[str, list[str]] = {}
        for line in self.remarks:
            wheres.setdefault(line.what, []).append(line.where)
        lines = [
            f"{places[0]}{f' and {len(places) - 1} more' if len(places) > 1 else ''}: {what}"
            for what, places in wheres.items()
        ]
        shown = lines if len(lines) <= MAX_TOLD else [*lines[:MAX_TOLD], f"... and {len(lines) - MAX_TOLD} lines more"]
        count = f"scene {self.scene.name}: {len(self.scene.objects)} objects"
        if not glass:
            return [
                *shown,
                f"{count}, none of them glass; mark it with --material glass, or --material 'OBJECT=glass'",
            ]
        return [*shown, f"{count}, {glass} of them glass"]


def import_scene(path: Path, choices: ImportChoices, *, resolution: Resolution = DEFAULT_RESOLUTION) -> Imported:
    """The scene in a foreign file, with an atlas for each object, checked.

    Args:
        resolution: of the pictures, which the ground's pattern is made for.
    """
    _check_asked(path, resolution)
    remarks, overrides = Remarks(is_strict=choices.strict), parse_overrides(choices.material)
    foreign: ForeignScene = READERS.find(ending_of(path))(path, remarks)
    allow_triangles(sum(len(part.faces) for part in foreign.objects))
    up: Axis = foreign.up if choices.up == "auto" else choices.up
    parts = _few_enough(with_cavities(foreign.objects, remarks), choices, remarks, path)
    scale = _find_scale(parts, foreign, choices, remarks, where=path.name)
    names = unique_names([part.name for part in parts])
    check_overrides(overrides, names)
    mapper = Mapper(metres=scale, thin=choices.thin, remarks=remarks)
    linear, offset = _world(parts, scale, up)
    if foreign.is_complete:
        offset = np.zeros(3)
    objects: list[SceneObject] = []
    cuts: dict[str, Cut] = {}
    without_uv: set[str] = set()
    lamps: list[RectangleLight] = []
    unmended: dict[str, HyalineError] = {}
    for name, part in zip(names, parts, strict=True):
        chosen = override(name, overrides)
        if chosen is None and (shining := _lamps(name, part, linear, offset, remarks)):
            lamps += shining
            continue
        try:
            item = scene_object(name, part, linear, offset, mapper, chosen, remarks, choices)
            objects += parted(item, remarks, repairs=choices.repair)
        except HyalineError as error:
            if not choices.repair:
                raise
            unmended[name] = error
            continue
        if not (has_uv := _has_uv(part)):
            without_uv.add(name)
        if isinstance(part.material, ForeignMaterial):
            material = veiled(part.material, item.mesh, has_uv=has_uv)
            is_solid = item.material.medium is not None
            cut = cut_of(material, item.mesh, remarks, has_uv=has_uv, is_solid=is_solid, where=name)
            cuts |= {} if cut is None else {name: cut}
    _leave_out(unmended, objects, remarks)
    objects = nested(apart(objects, remarks), remarks)
    rig = _cameras(foreign, choices, objects, linear, offset, remarks)
    wants_ground = choices.ground == "auto" and not foreign.is_complete and not has_ground(objects)
    if choices.ground == "always" or wants_ground:
        ground = make_ground(objects, resolution=resolution, remarks=remarks)
        without_uv.add(ground.name)
        objects.append(ground)
    used = {image.path for item in objects for image in item.material.images().values()}
    baked = {image: data for image, data in mapper.images.items() if image in used}
    environment, lights = _light(foreign, choices, objects, linear, offset, lamps, remarks)
    if isinstance(environment, EnvironmentMap) and isinstance(foreign.sky, ForeignMap):
        baked[environment.path] = foreign.sky.data
    scene = Scene(
        name=scene_name(path),
        description=f"Imported from {path.name}"[:200],
        license=foreign.license or unknown_license(path.name),
        objects=tuple(objects),
        environment=environment,
        lights=lights,
        cameras=rig,
        baked=baked,
    )
    scene = mend_scene(scene, without_uv={item.name for item in objects if item.name in without_uv})
    scene = _without_gone(with_cuts(scene, cuts), remarks, where=path.name)
    check_scene(scene)
    record: dict[str, Json] = {
        "version": RECORD_VERSION,
        "source": path.name,
        "source_sha256": sha256_file(path),
        "scale": scale,
        "up": up,
        "materials": list(choices.material),
        **remarks.to_json(),
    }
    return Imported(scene=scene, record=record, remarks=tuple(remarks.lines))


def _check_asked(path: Path, resolution: Resolution) -> None:
    check_ending(path)
    if not path.exists():
        start = "" if path.is_absolute() else f", which is relative to {Path.cwd()}"
        raise HyalineError(f"{path}: no such file; check the path{start}")
    if resolution.mean_side < MIN_SIDE:
        raise HyalineError(f"--resolution: is {resolution}; expected at least {MIN_SIDE} x {MIN_SIDE} pixels")


def _leave_out(unmended: Mapping[str, HyalineError], objects: list[SceneObject], remarks: Remarks) -> None:
    """A line for each object that could not be mended; if no glass is left without them, its error."""
    for name, error in unmended.items():
        if not any(item.material.is_glass for item in objects):
            raise error
        remarks.approximate(name, f"left out, since it cannot be mended: {str(error).removeprefix(f'{name}: ')}")


def _few_enough(
    parts: tuple[ForeignObject, ...], choices: ImportChoices, remarks: Remarks, path: Path
) -> tuple[ForeignObject, ...]:
    """The objects of a file, made fewer where that is asked for and needed."""
    if len(parts) <= MAX_OBJECTS - 1:
        return parts
    if not choices.merge:
        raise HyalineError(
            f"{path}: has {len(parts):,} objects, and a scene has at most {MAX_OBJECTS - 1} besides its ground; "
            "pass --merge to make one of those of a material"
        )
    return merged_by_material(parts, remarks, where=path.name)


def _without_gone(scene: Scene, remarks: Remarks, *, where: str) -> Scene:
    """The scene without objects that their opacity removes entirely."""
    there = tuple(item for item in scene.objects if is_there(item.mesh))
    if not there:
        raise HyalineError(f"{where}: all of it is cut away by its opacity; expected a surface that is seen")
    for item in scene.objects:
        if not is_there(item.mesh):
            remarks.note(item.name, "is cut away whole by its opacity; left out")
    return dataclasses.replace(scene, objects=there)


def _cameras(
    foreign: ForeignScene,
    choices: ImportChoices,
    objects: list[SceneObject],
    linear: np.ndarray,
    offset: np.ndarray,
    remarks: Remarks,
) -> CameraRig | CameraList:
    """Cameras all around, or those that are listed."""
    if choices.cameras == "around":
        if foreign.cameras:
            remarks.note("cameras", f"the file brings {len(foreign.cameras)}, which --cameras file takes")
        return make_rig(objects, remarks)
    given = foreign.cameras if choices.cameras == "file" else read_camera_file(Path(choices.cameras), remarks)
    return listed_cameras(given, linear, offset, remarks)


def _light(
    foreign: ForeignScene,
    choices: ImportChoices,
    objects: list[SceneObject],
    linear: np.ndarray,
    offset: np.ndarray,
    lamps: list[RectangleLight],
    remarks: Remarks,
) -> tuple[Environment, tuple[RectangleLight, ...]]:
    """What shines on the scene: from infinitely far, and from near."""
    environment: Environment = LIGHT
    if isinstance(foreign.sky, ForeignMap):
        environment = placed_map(foreign.sky, linear, remarks)
    elif foreign.sky is not None:
        environment = even_sky(foreign.sky)
    lights = tuple(placed_light(light, linear, offset) for light in foreign.lights)
    if choices.lights == "file":
        environment, squares = lit(foreign.lamps, LIGHT, linear, offset, subject_box(objects).mean(axis=0), remarks)
        lights = (*lights, *squares)
    elif foreign.lamps:
        remarks.approximate("lamps", f"{len(foreign.lamps)} are left out for soft light; --lights file takes them")
    return environment, exposed((*lights, *lamps), objects, remarks)


def scene_object(
    name: str,
    part: ForeignObject,
    linear: np.ndarray,
    offset: np.ndarray,
    mapper: Mapper,
    chosen: Material | None,
    remarks: Remarks,
    choices: ImportChoices,
) -> SceneObject:
    """One object in metres, z up, with a material that suits its mesh."""
    mesh = made_sound(_mesh(name, part, linear, offset), remarks, where=name)
    mesh, mended = mend_surface(mesh, is_solid=True)
    for line in mended:
        remarks.note(name, line)
    material = chosen or part.material
    if material is PLAIN:
        remarks.note(name, "has no material in the file; rendered grey and matt; set another with --material")
    if isinstance(material, ForeignMaterial):
        material = mapper.averaged(material, mesh, has_uv=_has_uv(part), where=name)
    if choices.repair and _is_solid(material):
        mesh = made_sound(closed(mesh, remarks, where=name), remarks, where=name)
    if not isinstance(material, Material):
        material = veiled(material, mesh, has_uv=_has_uv(part))
        material = mapper.material(material, shape_of(mesh, has_uv=_has_uv(part)), where=name)
    if material.medium is not None and (count := open_edges(mesh)):
        raise HyalineError(
            f"{name}: has {count} open edges, and glass must be closed; --repair closes holes, and --material "
            f"'{name}=thin-glass' draws it as a thin pane"
        )
    if choices.crease is not None:
        mesh = with_new_normals(mesh, crease_deg=choices.crease)
    elif material.medium is not None and (tilt_deg := edge_tilt_deg(mesh)) > 0:
        remarks.note(
            name,
            f"its normals lie up to {tilt_deg:.0f} degrees off its faces, so that light bends at its edges as in a "
            "lens; --crease 30 shades them as edges",
        )
    return SceneObject(name=name, mesh=mesh, material=material)


def _lamps(
    name: str, part: ForeignObject, linear: np.ndarray, offset: np.ndarray, remarks: Remarks
) -> tuple[RectangleLight, ...]:
    """The lights of a surface that emits light; none if it is not bright."""
    emission = part.material.emission if isinstance(part.material, ForeignMaterial) else (0.0, 0.0, 0.0)
    if max(emission) < LEAST_GLOW:
        if max(emission) > 0:
            remarks.approximate(name, "glows a little, which is ignored")
        return ()
    remarks.approximate(name, "emits light; drawn as the sides of a box around it, which shine as much in all")
    return glowing(_mesh(name, part, linear, offset), emission)


def _mesh(name: str, part: ForeignObject, linear: np.ndarray, offset: np.ndarray) -> Mesh:
    normals = None if part.normals is None else elementwise(part.normals, linear, np.zeros(3))
    positions = elementwise(part.positions, linear, offset)
    return mesh_of(positions, part.faces, normals, part.uv, crease_deg=part.crease_deg, where=name)


def _has_uv(part: ForeignObject) -> bool:
    """Exporters write zeros where a mesh has none."""
    return part.uv is not None and bool(part.uv.any())


def _is_solid(material: Material | ForeignMaterial) -> bool:
    """True for glass that fills its mesh, were that closed."""
    if isinstance(material, ForeignMaterial):
        return lets_light_through(material) and not material.is_thin
    return material.medium is not None


def _find_scale(
    parts: tuple[ForeignObject, ...], foreign: ForeignScene, choices: ImportChoices, remarks: Remarks, *, where: str
) -> float:
    """Metres a unit."""
    low = np.min([part.positions[part.faces].min(axis=(0, 1)) for part in parts], axis=0)
    high = np.max([part.positions[part.faces].max(axis=(0, 1)) for part in parts], axis=0)
    size = float((high - low).max())
    if not 1e-30 < size < 1e30:
        raise HyalineError(f"{where}: is {size:g} units large; expected a scene that has a size")
    if choices.scale is not None or foreign.is_complete:
        return choices.scale or foreign.metres
    return find_scale(size, metres=foreign.metres, remarks=remarks, where=where)


def _world(parts: tuple[ForeignObject, ...], scale: float, up: Axis) -> tuple[np.ndarray, np.ndarray]:
    """From the file's world to ours: linear part and offset. The scene's box is on z = 0, over the origin."""
    linear = scale * z_up_from(up)
    points = [elementwise(part.positions[np.unique(part.faces)], linear, np.zeros(3)) for part in parts]
    low, high = np.min([p.min(axis=0) for p in points], axis=0), np.max([p.max(axis=0) for p in points], axis=0)
    return linear, -np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])


def unique_names(names: list[str]) -> list[str]:
    """Names that a scene may have, each once: others are numbered."""
    fit = [re.sub(r"[^A-Za-z0-9_-]", "_", name).lstrip("-")[:60] or "object" for name in names]
    assert all(re.fullmatch(OBJECT_NAME, name) for name in fit)
    counts = {name: fit.count(name) for name in set(fit)} if len(fit) < 1000 else dict.fromkeys(fit, 2)
    taken: set[str] = {name for name, count in counts.items() if count == 1}
    unique, following = [], dict.fromkeys(fit, 0)
    for name in fit:
        if counts[name] == 1:
            unique.append(name)
            continue
        while (numbered := f"{name}_{following[name]}") in taken:
            following[name] += 1
        taken.add(numbered)
        unique.append(numbered)
    return unique
