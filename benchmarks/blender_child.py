"""Draws objects of hyaline, and what Blender imports, with Cycles. Runs in an environment with `bpy`, without hyaline.

    python blender_child.py JOB.json ANSWER.json

The job holds the objects, the lens, and of each view its camera, its pictures to write and their seeds. It may name a
file to import, its scale and its place in metres. The file's lamps and cameras are removed; its meshes and materials
stay as Blender reads them, but for absorption.
"""

# pyright: reportMissingImports=false

import json
import math
import sys
from pathlib import Path

NOT_INSTALLED = 3
"""Exit status without bpy."""

UNREADABLE = 4
"""Exit status where Blender cannot import the file."""

RAW_AXES = {"forward_axis": "Y", "up_axis": "Z"}
"""The file's own axes; the job's matrix turns them."""


SURFACES = {
    "Diffuse": "ShaderNodeBsdfDiffuse",
    "Conductor": "ShaderNodeBsdfAnisotropic",
    "Dielectric": "ShaderNodeBsdfGlass",
}
"""Blender's node for a material of hyaline, by its type in scene.json."""


def main(job: dict, answer: Path) -> None:
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    size = read_file(bpy, job) if "file" in job else []
    for item in job["objects"]:
        add_object(bpy, item)
    add_sky(bpy, job)
    camera = add_camera(bpy, job)
    set_cycles(bpy, job)
    for view in job["views"]:
        place_camera(camera, view)
        for seed, picture in zip(view["seeds"], view["pictures"]):
            bpy.context.scene.cycles.seed = seed
            draw(bpy, Path(picture))
    answer.write_text(json.dumps({"version": bpy.app.version_string, "size": size}))


def read_file(bpy, job: dict) -> list[float]:
    """Imports the file, at its place and without its lights; returns its size in metres."""
    import_file(bpy, Path(job["file"]))
    for item in list(bpy.data.objects):
        if item.type in ("LIGHT", "CAMERA"):
            bpy.data.objects.remove(item)
    set_absorption(bpy, job["scale"])
    return place(bpy, job)


def import_file(bpy, file: Path) -> None:
    readers = {
        ".glb": lambda path: bpy.ops.import_scene.gltf(filepath=path),
        ".gltf": lambda path: bpy.ops.import_scene.gltf(filepath=path),
        ".obj": lambda path: bpy.ops.wm.obj_import(filepath=path, **RAW_AXES),
        ".ply": lambda path: bpy.ops.wm.ply_import(filepath=path, **RAW_AXES),
        ".stl": lambda path: bpy.ops.wm.stl_import(filepath=path, **RAW_AXES),
    }
    try:
        readers[file.suffix.lower()](str(file))
    except RuntimeError as error:
        print(str(error).strip().splitlines()[-1], file=sys.stderr)
        sys.exit(UNREADABLE)
    if not any(item.type == "MESH" for item in bpy.data.objects):
        print("Blender found no mesh in it", file=sys.stderr)
        sys.exit(UNREADABLE)


def place(bpy, job: dict) -> list[float]:
    """Turns and scales everything, and moves its box to where hyaline's is; returns the box's size in metres."""
    from mathutils import Matrix, Vector

    root = bpy.data.objects.new("root", None)
    bpy.context.scene.collection.objects.link(root)
    for item in bpy.data.objects:
        if item.parent is None and item is not root:
            item.parent = root
    root.matrix_world = Matrix(job["linear"]).to_4x4()
    bpy.context.view_layer.update()
    points = []
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        if instance.object.type == "MESH":
            mesh = instance.object.to_mesh()
            used = {index for face in mesh.polygons for index in face.vertices}
            points += [instance.matrix_world @ mesh.vertices[index].co for index in used]
            instance.object.to_mesh_clear()
    low, high = ([bound(point[axis] for point in points) for axis in range(3)] for bound in (min, max))
    target = Vector(job["base"])
    base = Vector(((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]))
    root.matrix_world = Matrix.Translation(target - base) @ root.matrix_world
    return [b - a for a, b in zip(low, high)]


def set_absorption(bpy, scale: float) -> None:
    """Absorbs in metres, and by glTF's formula: Blender 5.0 keeps the file's unit, and absorbs (1 - colour) / distance.

    Source: KHR_materials_volume, -ln(colour) / distance.
    """
    for material in bpy.data.materials:
        for node in material.node_tree.nodes if material.use_nodes else ():
            if node.type == "VOLUME_ABSORPTION":
                density = node.inputs["Density"].default_value / scale
                colors = node.inputs["Color"].default_value[:3]
                set_coefficients(node, [-math.log(max(value, 1e-4)) * density for value in colors])


def set_coefficients(node, coefficients: list[float]) -> None:
    """Makes a volume absorb so much of each channel, in 1/m: Blender's own absorb density (1 - colour)."""
    most = max(*coefficients, 1e-9)
    node.inputs["Density"].default_value = most
    node.inputs["Color"].default_value = (*(1 - value / most for value in coefficients), 1)


def add_object(bpy, item: dict) -> None:
    import numpy as np

    arrays = np.load(item["mesh"])
    mesh = bpy.data.meshes.new("mesh")
    mesh.from_pydata(arrays["vertices"].tolist(), [], arrays["faces"].tolist(), shade_flat=False)
    corners = arrays["faces"].ravel()
    mesh.normals_split_custom_set(arrays["normals"][corners].tolist())
    mesh.uv_layers.new().data.foreach_set("uv", arrays["uv"][corners].ravel())
    image = bpy.data.images.load(item["image"]) if "image" in item else None
    mesh.materials.append(make_material(bpy, SURFACES[item["type"]], item["inputs"], image))
    if any(item.get("absorption", ())):
        add_absorption(mesh.materials[0], item["absorption"])
    thing = bpy.data.objects.new("object", mesh)
    thing.cycles.shadow_terminator_geometry_offset = 0.0
    bpy.context.scene.collection.objects.link(thing)


def make_material(bpy, node: str, inputs: dict, image=None):
    """A material of one node for its surface, with these inputs; an image is its colour."""
    material = bpy.data.materials.new("material")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    surface, output = nodes.new(node), nodes.new("ShaderNodeOutputMaterial")
    links.new(surface.outputs[0], output.inputs["Surface"])
    for name, value in inputs.items():
        surface.inputs[name].default_value = value
    if image is not None:
        texture = nodes.new("ShaderNodeTexImage")
        texture.image, texture.extension = image, "EXTEND"
        links.new(texture.outputs["Color"], surface.inputs["Color"])
    return material


def add_absorption(material, coefficients: list[float]) -> None:
    nodes, links = material.node_tree.nodes, material.node_tree.links
    volume = nodes.new("ShaderNodeVolumeAbsorption")
    set_coefficients(volume, coefficients)
    links.new(volume.outputs["Volume"], nodes["Material Output"].inputs["Volume"])


def add_sky(bpy, job: dict) -> None:
    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    texture = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
    texture.image = bpy.data.images.load(job["sky"])
    world.node_tree.links.new(texture.outputs["Color"], world.node_tree.nodes["Background"].inputs["Color"])
    bpy.context.scene.world = world


def add_camera(bpy, job: dict):
    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit, lens.angle = "HORIZONTAL", job["fov_x"]
    lens.clip_start, lens.clip_end = 1e-3, 1e4
    camera = bpy.data.objects.new("camera", lens)
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    return camera


def place_camera(camera, view: dict) -> None:
    from mathutils import Matrix

    camera.matrix_world = Matrix(view["world_from_camera"])


def set_cycles(bpy, job: dict) -> None:
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.render.resolution_x, scene.render.resolution_y = job["width"], job["height"]
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_mode = "RGB"
    scene.render.image_settings.color_depth = "32"
    cycles = scene.cycles
    cycles.samples, cycles.use_adaptive_sampling, cycles.use_denoising = job["spp"], False, False
    cycles.pixel_filter_type, cycles.filter_width = "BOX", 1.0
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.light_sampling_threshold = 0.0
    cycles.blur_glossy, cycles.caustics_reflective, cycles.caustics_refractive = 0.0, True, True
    for kind in ("max", "diffuse", "glossy", "transmission", "transparent_max", "volume"):
        setattr(cycles, f"{kind}_bounces", job["max_depth"])


def draw(bpy, picture: Path) -> None:
    """Writes linear RGB (h, w, 3) as NPY, the upper row first."""
    import numpy as np

    scene, exr = bpy.context.scene, picture.with_suffix(".exr")
    scene.render.filepath = str(exr)
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(str(exr))
    width, height = image.size
    pixels = np.empty(width * height * image.channels, np.float32)
    image.pixels.foreach_get(pixels)
    np.save(picture, pixels.reshape(height, width, image.channels)[::-1, :, :3])


if __name__ == "__main__":
    try:
        import bpy  # noqa: F401
    except ImportError as missing:
        print(missing, file=sys.stderr)
        sys.exit(NOT_INSTALLED)
    main(json.loads(Path(sys.argv[1]).read_text()), Path(sys.argv[2]))
