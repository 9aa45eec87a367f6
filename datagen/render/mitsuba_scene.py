"""The way from our scene to Mitsuba's: shapes, lights and sensors. Call `use_mitsuba` first."""

from typing import TYPE_CHECKING, cast

import numpy as np
from jaxtyping import Float, Float32

from datagen.data.cameras import Camera
from datagen.data.meshes import Mesh, face_areas
from datagen.render.environment import environment_plugin, mitsuba_transform
from datagen.scene.description import Scene, SceneObject, image_bytes
from datagen.scene.images import linear_pixels
from datagen.scene.materials.optics import Medium, Plugin, rgb
from datagen.scene.textures import ImageTexture, Reflectance, SolidTexture

if TYPE_CHECKING:
    import mitsuba as mi

TEXEL_SIZE = 0.001
"""Metres per texel that a baked solid texture aims at; a floor has to do with MAX_TEXTURE_SIZE texels a side."""

MIN_TEXTURE_SIZE, MAX_TEXTURE_SIZE = 128, 1024


def load_scene_mitsuba(scene: Scene, *, aims_at_sky: bool = True) -> "mi.Scene":
    """The whole scene, ready to render; `shapes()` keeps the order of `scene.objects`, then the lights.

    Args:
        aims_at_sky: the environment is among the emitters that are sampled; so it is where there is no other.
    """
    import mitsuba as mi

    environment = environment_plugin(scene)
    if scene.lights and not aims_at_sky:
        environment["sampling_weight"] = 0.0
    content: dict[str, object] = {"type": "scene", "environment": environment}
    use_media = is_scalar()
    for index, item in enumerate(scene.objects):
        props = mi.Properties()
        props["bsdf"] = mi.load_dict(_bsdf(scene, item))
        medium = item.material.medium
        if use_media and medium is not None and any(medium.absorption):
            props["interior"] = mi.load_dict(_absorbing_medium(medium))
        content[_shape_id(index)] = _load_mesh(item.mesh, props)
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


def is_scalar() -> bool:
    """True when Mitsuba runs ray by ray, without Dr.Jit's arrays."""
    import mitsuba as mi

    return (mi.variant() or "").startswith("scalar")


def load_geometry_mitsuba(meshes: tuple[Mesh, ...]) -> "mi.Scene":
    """Bare meshes, ready to peel: shape i is object i + 1."""
    import mitsuba as mi

    shapes = {_shape_id(index): _load_mesh(mesh, mi.Properties()) for index, mesh in enumerate(meshes)}
    return _load({"type": "scene", **shapes}, len(meshes))


def to_columns(vectors: Float[np.ndarray, "ray axis"]) -> "list[mi.Float]":
    """x, y and (of three) z of vectors, in memory aligned to a cache line.

    Dr.Jit maps NumPy's memory instead of copying it, and code for unaligned memory is another kernel: one that depends
    on where NumPy happened to put an array is compiled again and again.
    """
    import mitsuba as mi

    count, axes = vectors.shape
    width = -(-count // 16) * 16  # Floats; 16 of them fill a line of 64 bytes.
    memory = np.empty(axes * width + 16, np.float32)
    start = -memory.ctypes.data % 64 // 4
    columns = memory[start : start + axes * width].reshape(axes, width)[:, :count]
    columns[:] = vectors.T
    return [mi.Float(column) for column in columns]


def load_sensor(camera: Camera, *, sampler: str = "multijitter") -> "mi.Sensor":
    """A pinhole camera with a box filter, so that a sample counts for its own pixel alone.

    Args:
        sampler: of `mi.render`; our own path tracer has its own (datagen/render/sobol.py).
    """
    import mitsuba as mi

    # Mitsuba's camera looks along +z and has +x on its left.
    to_world = camera.world_from_camera @ np.diag([-1.0, 1.0, -1.0, 1.0])
    shift: dict[str, float] = {}
    if camera.center is not None:
        # Mitsuba adds the offset, a share of the film's sides, to where a sample is before it finds its ray.
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


def _shape_id(index: int) -> str:
    # Names sort like indices, so that shapes keep our order whatever a container does to it.
    return f"object_{index:03d}"


def _load(content: dict[str, object], num_objects: int) -> "mi.Scene":
    import mitsuba as mi

    # parallel=False: concurrent loading deadlocks now and then (drjit 524). optimize=False: merging renumbers shapes.
    loaded = cast("mi.Scene", mi.load_dict({**content, "embree_use_robust_intersections": True}, False, False))
    found = [shape.id() for shape in loaded.shapes()][:num_objects]
    assert found == [_shape_id(index) for index in range(num_objects)], f"Mitsuba reordered the shapes: {found}"
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
    return item.material.bsdf(lambda reflectance: _texture(scene, item.mesh, reflectance))


def _absorbing_medium(medium: Medium) -> Plugin:
    # Only the scalar variant needs it: the vectorised ones attenuate in closed form (render/path_integrator.py).
    # Its colours go up to 1, absorption goes beyond.
    scale = max(medium.absorption)
    share = (medium.absorption[0] / scale, medium.absorption[1] / scale, medium.absorption[2] / scale)
    return {"type": "homogeneous", "albedo": 0.0, "sigma_t": rgb(share), "scale": scale}


def linear_texels(
    scene: Scene, mesh: Mesh, texture: SolidTexture | ImageTexture
) -> Float32[np.ndarray, "tex_h tex_w 3"]:
    """The linear reflectance of a texture in the mesh's uv, as it is rendered; row 0 is on top."""
    if isinstance(texture, ImageTexture):
        return linear_pixels(image_bytes(scene, texture), where=texture.path)
    from datagen.scene.solid_textures import bake_texture

    return bake_texture(texture, mesh, _texture_size(mesh))


def _texture(scene: Scene, mesh: Mesh, color: Reflectance) -> Plugin:
    match color:
        case SolidTexture() | ImageTexture():
            return _bitmap(linear_texels(scene, mesh, color))
        case _:
            return rgb(color)


def _texture_size(mesh: Mesh) -> int:
    """The power of two that gives the mesh's area texels of TEXEL_SIZE, were its atlas full."""
    wanted = float(face_areas(mesh).sum()) ** 0.5 / TEXEL_SIZE
    return int(np.clip(2 ** np.ceil(np.log2(wanted)), MIN_TEXTURE_SIZE, MAX_TEXTURE_SIZE))


def _bitmap(linear: Float32[np.ndarray, "tex_h tex_w 3"]) -> Plugin:
    import mitsuba as mi

    # Mitsuba's bitmap has v = 0 in its first row, our textures have v = 1 there.
    pixels = np.ascontiguousarray(np.flipud(linear), np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True, "wrap_mode": "clamp"}
