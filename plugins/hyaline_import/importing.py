"""From a foreign file to a scene: read, mend, map, stage, check."""

import dataclasses
import itertools
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from datagen.data.config import Resolution, unknown_license
from datagen.data.meshes import Mesh, check_numbers, open_edges
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json
from datagen.disk.storage import read_regular, sha256
from datagen.scene.description import (
    MAX_OBJECTS,
    OBJECT_NAME,
    Environment,
    RectangleLight,
    Scene,
    SceneObject,
)
from datagen.scene.finding import DEFAULT_RESOLUTION, ImportChoices
from datagen.scene.materials import Material, ThinDielectric
from datagen.scene.mending import mend_scene
from datagen.scene.rig import LIGHT, rig_around
from datagen.scene.shading_normals import with_new_normals
from datagen.scene.soundness import check_scene
from hyaline_import.foreign import (
    PLAIN,
    Axis,
    ForeignMap,
    ForeignMaterial,
    ForeignObject,
    elementwise,
    merged_by_material,
    with_cavities,
    z_up_from,
)
from hyaline_import.mapping import Mapper
from hyaline_import.overlaps import apart, nested, parted
from hyaline_import.pictures import veiled
from hyaline_import.remarks import Remark, Remarks
from hyaline_import.source import chosen_materials, read_scene, scene_name
from hyaline_import.staging import (
    LEAST_GLOW,
    even_sky,
    find_scale,
    glowing,
    has_ground,
    make_ground,
    open_arc,
    placed_light,
    placed_map,
)
from hyaline_import.surfaces import (
    closed,
    made_sound,
    mend_surface,
    mesh_of,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Imported:
    """A scene made from a foreign file, and the content of its import.json."""

    scene: Scene
    record: Mapping[str, Json]
    remarks: tuple[Remark, ...]

    def told(self) -> list[str]:
        """The lines to report: approximations, notes, and the number of objects."""
        wheres: dict[str, list[str]] = {}
        for line in self.remarks:
            wheres.setdefault(line.what, []).append(line.where)
        lines = [
            f"{places[0]}{f' and {len(places) - 1} more' if len(places) > 1 else ''}: {what}"
            for what, places in wheres.items()
        ]
        glass = sum(item.material.is_glass for item in self.scene.objects)
        what = f"{glass or 'none'} of them glass"
        advice = "" if glass else "; mark it with --material glass, or --material 'OBJECT=glass'"
        return [*lines, f"scene {self.scene.name}: {len(self.scene.objects)} objects, {what}{advice}"]


@dataclass(frozen=True, kw_only=True, eq=False)
class World:
    """How surfaces of a file become objects of ours."""

    linear: Float[np.ndarray, "3 3"]
    """With `offset`, from the file's world to ours."""
    offset: Float[np.ndarray, "3"]
    mapper: Mapper
    choices: ImportChoices

    @property
    def remarks(self) -> Remarks:
        return self.mapper.remarks

    def mesh(self, name: str, part: ForeignObject) -> Mesh:
        """The mesh of a surface in our world."""
        normals = None if part.normals is None else elementwise(part.normals, self.linear, np.zeros(3))
        positions = elementwise(part.positions, self.linear, self.offset)
        return mesh_of(positions, part.faces, normals, part.uv, crease_deg=part.crease_deg, where=name)


@dataclass(frozen=True, kw_only=True, eq=False)
class Made:
    """The objects so far, and what is to be done to them when all are there."""

    objects: list[SceneObject] = field(default_factory=list)
    without_uv: set[str] = field(default_factory=set)

    def add(self, name: str, part: ForeignObject, world: World, chosen: Material | None) -> None:
        """Adds the objects of a surface: one, or one for each of its parts that overlap."""
        has_uv = part.uv is not None and bool(part.uv.any())  # Exporters write zeros where a mesh has none.
        if item := scene_object(name, part, world, chosen, has_uv=has_uv):
            self.objects.extend(parted(item, world.remarks))
        if not has_uv:
            self.without_uv.add(name)

    def placed(self, remarks: Remarks, *, where: str) -> list[SceneObject]:
        """The objects, without surfaces that coincide, and with what each does where it overlaps another."""
        if not self.objects:
            raise HyalineError(f"{where}: nothing in it is drawn; expected a surface that is seen")
        return nested(apart(self.objects, remarks), remarks)

    def finished(self, scene: Scene, world: World) -> Scene:
        """The scene of these objects with its images, mended and checked."""
        objects = []
        for item in scene.objects:
            is_solid = item.material.medium is not None
            mesh = mend_surface(item.mesh, world.remarks, is_solid=is_solid, where=item.name)
            objects.append(dataclasses.replace(item, mesh=mesh))
        used = {image.path for item in objects for image in item.material.images().values()}
        baked = {image: data for image, data in world.mapper.images.items() if image in used}
        scene = dataclasses.replace(scene, objects=tuple(objects), baked={**baked, **scene.baked})
        scene = mend_scene(scene, without_uv=self.without_uv & {item.name for item in objects})
        check_scene(scene)
        return scene


def import_scene(path: Path, choices: ImportChoices, *, resolution: Resolution = DEFAULT_RESOLUTION) -> Imported:
    """The scene in a foreign file, with an atlas for each object, checked.

    Args:
        resolution: of the pictures, which the ground's pattern is made for.
    """
    if not path.exists():
        start = "" if path.is_absolute() else f", which is relative to {Path.cwd()}"
        raise HyalineError(f"{path}: no such file; check the path{start}")
    remarks = Remarks()
    foreign = read_scene(path, remarks)
    up: Axis = foreign.up if choices.up == "auto" else choices.up
    parts = with_cavities(foreign.objects, remarks)
    if len(parts) > MAX_OBJECTS - 1:  # The ground is one more.
        parts = merged_by_material(parts, remarks, where=path.name)
    names = unique_names([part.name for part in parts])
    materials = chosen_materials(choices.material, names)
    points = np.concatenate([part.positions[np.unique(part.faces)] for part in parts])
    low, high = points.min(axis=0), points.max(axis=0)
    size = float((high - low).max())
    if not 1e-30 < size < 1e30:
        raise HyalineError(f"{path.name}: is {size:g} units large; expected a scene that has a size")
    scale = choices.scale or foreign.metres
    if choices.scale is None and not foreign.is_complete:
        scale = find_scale(size, metres=foreign.metres, remarks=remarks, where=path.name)
    linear = scale * z_up_from(up)
    # The scene's box is put on z = 0, over the origin.
    low, high = np.sort(elementwise(np.stack([low, high]), linear, np.zeros(3)), axis=0)
    offset = np.zeros(3) if foreign.is_complete else -np.array([*(low + high)[:2] / 2, low[2]])
    mapper = Mapper(metres=scale, remarks=remarks)
    world = World(linear=linear, offset=offset, mapper=mapper, choices=choices)
    made = Made()
    unmended: dict[str, HyalineError] = {}
    lights = [placed_light(light, linear, offset) for light in foreign.lights]
    for name, part in zip(names, parts, strict=True):
        chosen = materials.get(name)
        shining = _lamps(name, part, world) if chosen is None else ()
        lights += shining
        try:
            if not shining:
                made.add(name, part, world, chosen)
        except HyalineError as error:
            if not choices.repair:
                raise
            unmended[name] = error
    for name, error in unmended.items():
        if not any(item.material.is_glass for item in made.objects):
            raise error
        remarks.approximate(name, f"left out, since it cannot be mended: {str(error).removeprefix(f'{name}: ')}")
    objects = made.placed(remarks, where=path.name)
    rig = rig_around(objects, azimuth_deg=open_arc(objects, remarks))
    wants_ground = choices.ground == "auto" and not foreign.is_complete and not has_ground(objects)
    if choices.ground == "always" or wants_ground:
        ground = make_ground(objects, resolution=resolution, remarks=remarks)
        made.without_uv.add(ground.name)
        objects.append(ground)
    environment: Environment = LIGHT
    baked: dict[str, bytes] = {}
    if isinstance(foreign.sky, ForeignMap):
        environment = placed_map(foreign.sky, linear, remarks)
        baked[environment.path] = foreign.sky.data
    elif foreign.sky is not None:
        environment = even_sky(foreign.sky)
    scene = Scene(
        name=scene_name(path),
        description=f"Imported from {path.name}"[:200],
        license=foreign.license or unknown_license(path.name),
        objects=tuple(objects),
        environment=environment,
        lights=tuple(lights),
        cameras=rig,
        baked=baked,
    )
    scene = made.finished(scene, world)
    record: dict[str, Json] = {
        "source": path.name,
        "source_sha256": sha256(read_regular(path)),
        "scale": scale,
        "up": up,
        "materials": list(choices.material),
        **remarks.to_json(),
    }
    return Imported(scene=scene, record=record, remarks=tuple(remarks.lines))


def scene_object(
    name: str, part: ForeignObject, world: World, chosen: Material | None, *, has_uv: bool
) -> SceneObject | None:
    """One object in metres, z up, with a material that suits its mesh; None if its opacity cuts it away."""
    remarks, choices = world.remarks, world.choices
    mesh = made_sound(world.mesh(name, part), remarks, where=name)
    mesh = mend_surface(mesh, remarks, is_solid=True, where=name)
    check_numbers(mesh, where=name)
    material = chosen or part.material
    if material is PLAIN:
        remarks.note(name, "has no material in the file; rendered grey and matt; set another with --material")
    if isinstance(material, ForeignMaterial):
        material = world.mapper.averaged(material, mesh, has_uv=has_uv, where=name)
        if (material := veiled(material, mesh, remarks, has_uv=has_uv, where=name)) is None:
            remarks.approximate(name, "is cut away by its opacity, or most of it; left out")
            return None
        is_solid = material.is_glass and not material.is_thin
    else:
        is_solid = material.medium is not None
    if choices.repair and is_solid:
        mesh = made_sound(closed(mesh, remarks, where=name), remarks, where=name)
    if not isinstance(material, Material):
        is_closed = open_edges(mesh) == 0
        material = world.mapper.material(material, is_closed=is_closed, has_uv=has_uv, where=name)
    if material.medium is not None and (count := open_edges(mesh)):
        remarks.approximate(name, f"has {count} open edges; drawn as thin glass, close it by `datagen import --repair`")
        material = ThinDielectric(ior=material.surface().ior)
    if choices.crease is not None:
        mesh = with_new_normals(mesh, crease_deg=choices.crease)
    return SceneObject(name=name, mesh=mesh, material=material)


def _lamps(name: str, part: ForeignObject, world: World) -> tuple[RectangleLight, ...]:
    """The lights of a surface that emits light; none if it is not bright."""
    emission = part.material.emission if isinstance(part.material, ForeignMaterial) else (0.0, 0.0, 0.0)
    if max(emission) < LEAST_GLOW:
        if max(emission) > 0:
            world.remarks.approximate(name, "glows a little, which is ignored")
        return ()
    world.remarks.approximate(name, "emits light; drawn as the sides of a box around it, which shine as much in all")
    return glowing(world.mesh(name, part), emission)


def unique_names(names: list[str]) -> list[str]:
    """Names that a scene may have, each once: others are numbered."""
    fit = [re.sub(r"[^A-Za-z0-9_-]", "_", name).lstrip("-")[:60] or "object" for name in names]
    assert all(re.fullmatch(OBJECT_NAME, name) for name in fit)
    counts, numbers = Counter(fit), {name: itertools.count() for name in fit}
    taken = {name for name, count in counts.items() if count == 1}
    unique = []
    for name in fit:
        numbered = (f"{name}_{number}" for number in numbers[name])
        unique.append(name if counts[name] == 1 else next(other for other in numbered if other not in taken))
        taken.add(unique[-1])
    return unique
