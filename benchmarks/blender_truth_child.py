"""Rebuilds a scene in Blender, and draws it as often as asked. Runs in an environment with `bpy`, without hyaline.

    python blender_truth_child.py JOB.json

Each line of standard input asks for a picture, as JSON: spp, seed, and the file to write. Each answer is a line on
standard error, "drawn in SECONDS": processor time of all threads.
"""

# pyright: reportMissingImports=false

import json
import math
import sys
import time
from pathlib import Path

from blender_child import NOT_INSTALLED, add_camera, add_sky, draw, set_cycles


def main(job: dict) -> None:
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    for item in job["objects"]:
        add_object(bpy, item)
    for lamp in job["lamps"]:
        add_lamp(bpy, lamp)
    add_sky(bpy, job)
    add_camera(bpy, job)
    set_cycles(bpy, job)
    scene = bpy.context.scene
    scene.render.use_persistent_data = True  # Otherwise each picture builds the acceleration structure again.
    for line in sys.stdin:
        asked = json.loads(line)
        scene.cycles.samples, scene.cycles.seed = asked["spp"], asked["seed"]
        before = time.process_time()
        draw(bpy, Path(asked["picture"]))
        print("drawn in", time.process_time() - before, file=sys.stderr, flush=True)


def add_object(bpy, item: dict) -> None:
    import numpy as np

    arrays = np.load(item["mesh"])
    mesh = bpy.data.meshes.new(item["name"])
    mesh.from_pydata(arrays["vertices"].tolist(), [], arrays["faces"].tolist())
    layer = mesh.uv_layers.new()
    layer.data.foreach_set("uv", arrays["uv"][arrays["faces"].ravel()].astype(np.float32).ravel())
    mesh.normals_split_custom_set_from_vertices(arrays["normals"].tolist())
    mesh.materials.append(make_material(bpy, item["name"], item["material"]))
    bpy.context.scene.collection.objects.link(bpy.data.objects.new(item["name"], mesh))


def make_material(bpy, name: str, described: dict):
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    kind, roughness = described["kind"], math.sqrt(described.get("alpha", 0.0))
    output = nodes.new("ShaderNodeOutputMaterial").inputs["Surface"]
    if kind == "Dielectric":
        glass = nodes.new("ShaderNodeBsdfGlass")
        glass.inputs["Roughness"].default_value, glass.inputs["IOR"].default_value = 0.0, described["ior"]
        links.new(glass.outputs["BSDF"], output)
        return material
    gloss = nodes.new("ShaderNodeBsdfAnisotropic")  # Blender's name of the Glossy BSDF.
    gloss.inputs["Roughness"].default_value = roughness
    colored = gloss if kind == "Conductor" else nodes.new("ShaderNodeBsdfDiffuse")
    if "image" in described:
        image = nodes.new("ShaderNodeTexImage")
        image.image = bpy.data.images.load(described["image"])
        links.new(image.outputs["Color"], colored.inputs["Color"])
    else:
        colored.inputs["Color"].default_value = (*described["color"], 1)
    if kind != "Plastic":
        links.new(colored.outputs["BSDF"], output)
        return material
    gloss.inputs["Color"].default_value = (1, 1, 1, 1)
    share, both = nodes.new("ShaderNodeFresnel"), nodes.new("ShaderNodeMixShader")
    share.inputs["IOR"].default_value = described["ior"]
    links.new(share.outputs["Fac"], both.inputs["Fac"])
    links.new(colored.outputs["BSDF"], both.inputs[1])
    links.new(gloss.outputs["BSDF"], both.inputs[2])
    links.new(both.outputs["Shader"], output)
    return material


def add_lamp(bpy, lamp: dict) -> None:
    """A one-sided rectangle of constant radiance, which Blender wants as watts: pi times area times radiance."""
    from mathutils import Matrix, Vector

    u, v = Vector(lamp["u"]), Vector(lamp["v"])
    light = bpy.data.lights.new("lamp", "AREA")
    light.shape, light.size, light.size_y = "RECTANGLE", u.length, v.length
    most = max(lamp["radiance"])
    light.energy, light.color = math.pi * u.length * v.length * most, [value / most for value in lamp["radiance"]]
    item = bpy.data.objects.new("lamp", light)
    # It shines along its own -z.
    z = -u.cross(v).normalized()
    axes = u.normalized(), z.cross(u).normalized(), z
    item.matrix_world = Matrix.Translation(lamp["center"]) @ Matrix(axes).transposed().to_4x4()
    bpy.context.scene.collection.objects.link(item)


if __name__ == "__main__":
    try:
        import bpy  # noqa: F401
    except ImportError as missing:
        print(missing, file=sys.stderr)
        sys.exit(NOT_INSTALLED)
    main(json.loads(Path(sys.argv[1]).read_text()))
