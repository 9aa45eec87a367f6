"""Imports a file with Blender and draws it with Cycles. Runs in an environment with `bpy`, without hyaline.

    python blender_child.py JOB.json ANSWER.json

The job names the file, the files of sky, ground and the two pictures to write, and holds the camera, the size of the
scene in metres and its place. The file's lamps and cameras are removed; its meshes and materials stay as Blender reads
them, but for absorption.
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


def main(job: dict, answer: Path) -> None:
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    import_file(bpy, Path(job["file"]))
    for item in list(bpy.data.objects):
        if item.type in ("LIGHT", "CAMERA"):
            bpy.data.objects.remove(item)
    size = place(bpy, job)
    set_absorption(bpy, job["scale"])
    add_ground(bpy, job)
    add_sky(bpy, job)
    add_camera(bpy, job)
    set_cycles(bpy, job)
    for seed, picture in enumerate(job["pictures"]):
        bpy.context.scene.cycles.seed = seed
        draw(bpy, Path(picture))
    answer.write_text(json.dumps({"version": bpy.app.version_string, "size": size}))


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
                color, density = node.inputs["Color"], node.inputs["Density"]
                lost = [-math.log(max(value, 1e-4)) for value in color.default_value[:3]]
                most = max(*lost, 1e-9)
                color.default_value = (*(1 - value / most for value in lost), 1)
                density.default_value *= most / scale


def add_ground(bpy, job: dict) -> None:
    if job["ground"] is None:
        return
    mesh = bpy.data.meshes.new("ground")
    mesh.from_pydata(job["ground"]["vertices"], [], job["ground"]["faces"])
    layer = mesh.uv_layers.new()
    for loop, corner in zip(mesh.loops, layer.data):
        corner.uv = job["ground"]["uv"][loop.vertex_index]
    material = bpy.data.materials.new("ground")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    image, diffuse, output = (
        nodes.new(kind) for kind in ("ShaderNodeTexImage", "ShaderNodeBsdfDiffuse", "ShaderNodeOutputMaterial")
    )
    image.image = bpy.data.images.load(job["ground"]["image"])
    links.new(image.outputs["Color"], diffuse.inputs["Color"])
    links.new(diffuse.outputs["BSDF"], output.inputs["Surface"])
    mesh.materials.append(material)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("ground", mesh))


def add_sky(bpy, job: dict) -> None:
    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    texture = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
    texture.image = bpy.data.images.load(job["sky"])
    world.node_tree.links.new(texture.outputs["Color"], world.node_tree.nodes["Background"].inputs["Color"])
    bpy.context.scene.world = world


def add_camera(bpy, job: dict) -> None:
    from mathutils import Matrix

    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit, lens.angle = "HORIZONTAL", job["fov_x"]
    lens.clip_start, lens.clip_end = 1e-3, 1e4
    camera = bpy.data.objects.new("camera", lens)
    camera.matrix_world = Matrix(job["world_from_camera"])
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera


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
