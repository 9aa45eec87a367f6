"""Converts a scene for Mitsuba: shapes, lights, sky and sensors. Call `use_mitsuba` first."""

import math
from typing import TYPE_CHECKING, cast

import numpy as np
from jaxtyping import Float, Float32, Int32

from datagen.data.cameras import Camera
from datagen.data.meshes import Mesh, face_areas
from datagen.machine.processes import ROOT
from datagen.render.albedo import below_coat
from datagen.scene.atlas import bake_positions, find_arrays, keep_arrays, key_of
from datagen.scene.description import (
    Card,
    Environment,
    EnvironmentMap,
    Scene,
    SceneObject,
    SoftEnvironment,
    image_bytes,
)
from datagen.scene.images import linear_pixels, read_map
from datagen.scene.materials import ImageTexture, Plugin, Reflectance, SolidTexture, Texture, rgb
from datagen.scene.textures import evaluate_texture

if TYPE_CHECKING:
    import mitsuba as mi

TEXEL_SIZE = 0.001
"""Target size of a baked texture's texels in metres; large floors are limited by MAX_TEXTURE_SIZE."""

MIN_TEXTURE_SIZE, MAX_TEXTURE_SIZE = 128, 1024

POINTS_AT_ONCE = 1 << 14
"""Points evaluated together, so that intermediate results stay in the CPU cache: 1 << 20 take three times as long."""


def load_scene_mitsuba(scene: Scene, *, aims_at_sky: bool = True) -> "mi.Scene":
    """The whole scene, ready to render; `shapes()` keeps the order of `scene.objects`, then the lights.

    Args:
        aims_at_sky: sample the environment as an emitter; always so if it is the only one.
    """
    import mitsuba as mi

    environment = environment_plugin(scene)
    if scene.lights and not aims_at_sky:
        environment["sampling_weight"] = 0.0
    content: dict[str, object] = {"type": "scene", "environment": environment}
    for index, item in enumerate(scene.objects):
        props = mi.Properties()
        props["bsdf"] = mi.load_dict(_bsdf(scene, item))
        content[shape_name(index)] = _load_mesh(item.mesh, props)
    for index, light in enumerate(scene.lights):
        to_world = np.eye(4)
        u, v = np.array(light.edge_u), np.array(light.edge_v)
        normal = np.cross(u, v)
        center = np.array(light.corner) + 0.5 * (u + v)
        to_world[:3] = np.stack([u / 2, v / 2, normal / np.linalg.norm(normal), center], axis=1)
        content[f"z_light_{index:03d}"] = {
            "type": "rectangle",
            "to_world": mitsuba_transform(to_world),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(light.radiance)}},
        }
    return _load(content, len(scene.objects))


def load_geometry_mitsuba(meshes: tuple[Mesh, ...]) -> "mi.Scene":
    """Bare meshes, ready to peel: shape i is object i + 1."""
    import mitsuba as mi

    shapes = {shape_name(index): _load_mesh(mesh, mi.Properties()) for index, mesh in enumerate(meshes)}
    return _load({"type": "scene", **shapes}, len(meshes))


def id_of_shape(hit: "mi.PreliminaryIntersection3f") -> "mi.UInt32":
    """Dr.Jit's number of the shape that each ray hits, 0 where it hits none.

    Mitsuba's own `shape_index` is 0 for every shape on CUDA (3.9).
    """
    import drjit as dr
    import mitsuba as mi

    return cast("mi.UInt32", dr.reinterpret_array(mi.UInt32, hit.shape))


def shapes_by_id(scene: "mi.Scene") -> Int32[np.ndarray, " id"]:
    """Index of each shape in its scene by the number that `id_of_shape` gives; -1 for all other numbers."""
    import drjit as dr
    import mitsuba as mi

    ids = np.array(dr.reinterpret_array(mi.UInt32, cast("mi.ShapePtr", scene.shapes_dr())))
    shapes = np.full(ids.max(initial=0) + 1, -1, np.int32)
    shapes[ids] = np.arange(len(ids), dtype=np.int32)
    return shapes


def to_columns(vectors: Float[np.ndarray, "ray axis"]) -> "list[mi.Float]":
    """x, y and (of three) z of vectors, aligned to a cache line: Dr.Jit compiles other kernels for unaligned memory."""
    import mitsuba as mi

    count, axes = vectors.shape
    width = -(-count // 16) * 16  # Floats; 16 of them fill a line of 64 bytes.
    memory = np.empty(axes * width + 16, np.float32)
    start = -memory.ctypes.data % 64 // 4
    columns = memory[start : start + axes * width].reshape(axes, width)[:, :count]
    columns[:] = vectors.T
    return [mi.Float(column) for column in columns]


def load_sensor(camera: Camera, *, sampler: str = "multijitter") -> "mi.Sensor":
    """A pinhole camera with a box filter, so that a sample counts only for its own pixel.

    Args:
        sampler: the sampler for `mi.render`; our own path tracer uses datagen/render/sobol.py.
    """
    import mitsuba as mi

    # Mitsuba's camera looks along +z and has +x on its left.
    to_world = camera.world_from_camera @ np.diag([-1.0, 1.0, -1.0, 1.0])
    shift: dict[str, float] = {}
    if camera.center is not None:
        # Mitsuba adds the offset, a share of the film's sides, to a sample's position before it computes the ray.
        shift["principal_point_offset_x"] = 0.5 - camera.center[0] / camera.width
        shift["principal_point_offset_y"] = 0.5 - camera.center[1] / camera.height
    return cast(
        "mi.Sensor",
        mi.load_dict(
            {
                "type": "perspective",
                "fov": float(np.degrees(camera.fov_x)),
                "fov_axis": "x",
                **shift,
                "near_clip": 1e-3,
                "far_clip": 1e4,
                "to_world": mitsuba_transform(to_world),
                "film": {
                    "type": "hdrfilm",
                    "width": camera.width,
                    "height": camera.height,
                    "pixel_format": "rgb",
                    "component_format": "float32",
                    "rfilter": {"type": "box"},
                },
                "sampler": {"type": sampler},
            }
        ),
    )


def shape_name(index: int) -> str:
    """The id of a scene's shape in Mitsuba."""
    # Names sort like indices, so that shapes keep our order in any container.
    return f"object_{index:03d}"


def _load(content: dict[str, object], num_objects: int) -> "mi.Scene":
    import mitsuba as mi

    # parallel=False: concurrent loading deadlocks now and then (drjit 524). optimize=False: merging renumbers shapes.
    loaded = cast("mi.Scene", mi.load_dict({**content, "embree_use_robust_intersections": True}, False, False))
    found = [shape.id() for shape in loaded.shapes()][:num_objects]
    assert found == [shape_name(index) for index in range(num_objects)], f"Mitsuba reordered the shapes: {found}"
    return loaded


def _load_mesh(mesh: Mesh, props: "mi.Properties") -> "mi.Mesh":
    import mitsuba as mi

    loaded = mi.Mesh(
        "mesh",
        vertex_count=len(mesh.vertices),
        face_count=len(mesh.faces),
        props=props,
        has_vertex_normals=True,
        has_vertex_texcoords=True,
    )
    params = mi.traverse(loaded)
    params["vertex_positions"] = np.ascontiguousarray(mesh.vertices).ravel()
    params["vertex_normals"] = np.ascontiguousarray(mesh.normals).ravel()
    params["vertex_texcoords"] = np.ascontiguousarray(mesh.uv).ravel()
    params["faces"] = np.ascontiguousarray(mesh.faces).ravel().astype(np.uint32)
    params.update()
    return loaded


def _bsdf(scene: Scene, item: SceneObject) -> Plugin:
    return item.material.bsdf(lambda reflectance: _texture(scene, item, reflectance))


def linear_texels(
    scene: Scene, mesh: Mesh, texture: SolidTexture | ImageTexture
) -> Float32[np.ndarray, "tex_h tex_w 3"]:
    """The linear reflectance of a texture in the mesh's uv, as rendered; row 0 is on top."""
    if isinstance(texture, ImageTexture):
        return linear_pixels(image_bytes(scene, texture), where=texture.path)
    size = _texture_size(mesh)
    arrays = {"vertices": mesh.vertices, "faces": mesh.faces, "uv": mesh.uv}
    key = key_of(arrays, _BAKERS, texture, size, np.__version__)
    if kept := find_arrays("textures", [key]):
        return kept[key]["texels"]
    texels = bake_texture(texture, mesh, size)
    keep_arrays("textures", {key: {"texels": texels}})
    return texels


_BAKERS = [ROOT / "datagen" / name for name in ("render/mitsuba_scene.py", "scene/atlas.py", "scene/textures.py")]
"""The code that a baked texture depends on."""


def bake_texture(texture: SolidTexture, mesh: Mesh, size: int) -> Float32[np.ndarray, "tex_h tex_w 3"]:
    """The linear colour of a texture at each texel of the mesh's atlas."""
    positions = bake_positions(mesh, size)
    rows = max(1, POINTS_AT_ONCE // size)
    return np.concatenate(
        [evaluate_texture(texture, positions[first : first + rows]) for first in range(0, size, rows)]
    )


def _texture(scene: Scene, item: SceneObject, color: Reflectance) -> Plugin:
    import mitsuba as mi

    surface = item.material.surface()
    texels = linear_texels(scene, item.mesh, color) if isinstance(color, Texture) else np.array([[color]], np.float32)
    if surface.event == "coated":
        texels = below_coat(texels, surface.ior, surface.roughness)
    elif not isinstance(color, Texture):
        return rgb(color)
    # Mitsuba's bitmap has v = 0 in its first row, our textures have v = 1 there.
    pixels = np.ascontiguousarray(np.flipud(texels), np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True, "wrap_mode": "clamp"}


def _texture_size(mesh: Mesh) -> int:
    """The power of two that gives texels of about TEXEL_SIZE, if the mesh filled its atlas."""
    wanted = float(face_areas(mesh).sum()) ** 0.5 / TEXEL_SIZE
    return int(np.clip(2 ** np.ceil(np.log2(wanted)), MIN_TEXTURE_SIZE, MAX_TEXTURE_SIZE))


# Light from infinitely far


SMALL_LIGHT = 32.0
"""Lobes sharper than this are sampled as lights. Measured on the glass table with sharper lobes of equal power: without
sampling, 45 dB take 0.8, 1.0 and 1.2 times as long at 16, 32 and 64. Built-in scenes have 4 to 8."""

SMALL_CARD_DEG = 24.0
"""Bright cards narrower than this are sampled as lights; a lobe of SMALL_LIGHT is as wide at half height."""

MIN_HEIGHT, MAX_HEIGHT = 256, 2048
"""Rows of a soft sky's latitude-longitude map, which is twice as wide as high. For smooth skies 256 are enough."""
ROWS_PER_LOBE = 4
"""Rows across the width at half height of the sharpest lobe."""
ROWS_PER_EDGE = 2
"""Rows across the edge of the sharpest card."""


def has_small_light(environment: Environment) -> bool:
    """Whether the sky has small bright parts that are worth sampling as lights."""
    if isinstance(environment, EnvironmentMap):
        return True  # Nearly all maps contain the sun, a window or a lamp.
    is_bright = (min(card.size_deg) < SMALL_CARD_DEG and any(card.radiance) for card in environment.cards)
    return any(lobe.sharpness > SMALL_LIGHT for lobe in environment.lobes) or any(is_bright)


def radiance_of_environment(environment: SoftEnvironment, directions: Float[np.ndarray, "... 3"]) -> np.ndarray:
    """Radiance (..., 3) arriving from unit directions (world space, +z up)."""
    up = directions[..., 2:3]
    sky = np.clip(up, 0, 1) ** 0.6
    ground = np.clip(-up, 0, 1) ** 0.6
    zenith, horizon, nadir = (np.array(c) for c in (environment.zenith, environment.horizon, environment.ground))
    radiance = horizon * (1 - sky - ground) + zenith * sky + nadir * ground
    for lobe in environment.lobes:
        axis = np.array(lobe.direction) / np.linalg.norm(lobe.direction)
        falloff = np.exp(lobe.sharpness * (directions @ axis - 1))[..., None]
        radiance = radiance + falloff * np.array(lobe.radiance)
    for card in environment.cards:
        cover = _cover(card, directions)[..., None]
        radiance = (1 - cover) * radiance + cover * np.array(card.radiance)
    return radiance


def _cover(card: Card, directions: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "..."]:
    """Share of the sky that a card hides in each direction, 0 to 1."""
    axis = np.array(card.direction) / np.linalg.norm(card.direction)
    level = np.cross(axis, (0.0, 1.0, 0.0) if abs(axis[2]) > 0.999 else (0.0, 0.0, 1.0))
    level /= np.linalg.norm(level)
    cosine, sine = math.cos(math.radians(card.roll_deg)), math.sin(math.radians(card.roll_deg))
    upright = np.cross(level, axis)
    sides = cosine * level + sine * upright, cosine * upright - sine * level
    ahead, cover = directions @ axis, 1.0
    for side, size_deg in zip(sides, card.size_deg):
        angle_deg = np.degrees(np.abs(np.arctan2(directions @ side, ahead)))
        t = np.clip((size_deg / 2 - angle_deg) / card.softness_deg + 0.5, 0, 1)
        cover = cover * t * t * (3 - 2 * t)
    return np.asarray(cover)


BLACK = 1e-30
"""Radiance of a black sky."""


def environment_plugin(scene: Scene) -> Plugin:
    """Mitsuba's emitter for the light from infinitely far."""
    import mitsuba as mi

    environment = scene.environment
    if isinstance(environment, SoftEnvironment):
        radiance, to_world = painted(environment), _Z_UP
    else:
        radiance = read_map(image_bytes(scene, environment), where=f"scene {scene.name}: {environment.path}")
        radiance, to_world = radiance * np.float32(environment.scale), _about_z(environment.rotation_deg) @ _MIDDLE_TO_X
    if not radiance.any():  # Mitsuba 3.9 divides a map by its sum.
        radiance = np.full_like(radiance, BLACK)
    return {"type": "envmap", "bitmap": mi.Bitmap(radiance), "to_world": mitsuba_transform(to_world)}


def mitsuba_transform(matrix: Float[np.ndarray, "4 4"]) -> "mi.ScalarTransform4f":
    """A matrix as Mitsuba's transform."""
    import mitsuba as mi

    return mi.ScalarTransform4f(matrix.tolist())


# Mitsuba's map has +y up: u follows atan2(x, -z), v follows acos(y).
_Z_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)
"""Rotation about x: the map's y is our z."""
_MIDDLE_TO_X = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)
"""Rotation that turns the map's middle column, towards its +z, to our +x."""


def _about_z(angle_deg: float) -> Float[np.ndarray, "4 4"]:
    turned = np.eye(4)
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    turned[:2, :2] = [[cosine, -sine], [sine, cosine]]
    return turned


def painted(environment: SoftEnvironment) -> Float32[np.ndarray, "h w 3"]:
    """The map of a soft sky, to be turned by `_Z_UP`."""
    height = _painted_height(environment)
    width = 2 * height
    theta = (np.arange(height) + 0.5)[:, None] / height * np.pi
    phi = (np.arange(width) + 0.5)[None, :] / width * 2 * np.pi
    x, y, z = np.broadcast_arrays(np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta))
    return radiance_of_environment(environment, np.stack([x, -z, y], axis=-1)).astype(np.float32)


def _painted_height(environment: SoftEnvironment) -> int:
    """Rows of the map: a power of two that gives the sharpest lobe or card edge a few rows."""
    height = MIN_HEIGHT
    for lobe in environment.lobes:
        width = 2 * math.acos(max(-1.0, 1 - math.log(2) / lobe.sharpness))
        while height < MAX_HEIGHT and height * width < ROWS_PER_LOBE * math.pi:
            height *= 2
    for card in environment.cards:
        while height < MAX_HEIGHT and height * card.softness_deg < ROWS_PER_EDGE * 180:
            height *= 2
    return height
