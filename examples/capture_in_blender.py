"""Renders a folder for `datagen capture` with Blender's Cycles alone: a tumbler and a ball of glass on a table, or a
curved vessel with water and a solid frustum behind two books.

    python3.11 -m venv blender && blender/bin/pip install bpy==4.4.0 "numpy<2"
    blender/bin/python examples/capture_in_blender.py [--books] FOLDER [VIEWS] [PIXELS] [SAMPLES]

writes images/, masks/OBJECT/, transforms.json with the true cameras, and truth/ with all meshes and transforms.json.
Remove transforms.json, and `datagen capture` has to find the cameras, too. Of hyaline only
`benchmarks/blender_child.py` is used, which sets Cycles up.
"""

# pyright: reportMissingImports=false

import argparse
import json
import math
import sys
from itertools import pairwise
from pathlib import Path

try:
    import bpy
    import numpy as np
    from mathutils import Matrix, Vector

    sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
    from blender_child import add_camera, make_material, set_cycles
except ModuleNotFoundError as error:
    if not {"-h", "--help"} & {*sys.argv}:
        sys.exit(f"error: {error}; run this script in an environment with `pip install bpy`")

TABLE = 0.75
INDEX = {"tumbler": 1.5, "ball": 1.52, "vessel": 1.5, "frustum": 1.52}
WATER = 1.333
"""Indices of refraction."""


def main(root: Path, views: int = 64, pixels: int = 256, samples: int = 96, *, has_books: bool = False) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    make_room()
    glass = make_glass_behind_books() if has_books else make_glass()
    camera = make_camera(pixels)
    frames = []
    for view in range(views):
        camera.matrix_world = world_from_camera(view, views)
        name = f"{view:04d}.png"
        draw(root / "images" / name, samples=samples)
        frames.append({"file_path": f"images/{name}", "transform_matrix": [list(row) for row in camera.matrix_world]})
    write_masks(root, camera, frames, glass)
    focal = 0.5 * pixels / math.tan(0.5 * camera.data.angle)
    lens = {"fl_x": focal, "fl_y": focal, "cx": pixels / 2, "cy": pixels / 2, "w": pixels, "h": pixels}
    (root / "truth").mkdir(exist_ok=True)
    for folder in (root, root / "truth"):
        (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}, indent=1))
    for item in [item for item in bpy.data.objects if item.type == "MESH"]:
        bpy.ops.object.select_all(action="DESELECT")
        item.select_set(True)
        path = str(root / "truth" / f"{item.name}.ply")
        axes = {"forward_axis": "Y", "up_axis": "Z"}
        bpy.ops.wm.ply_export(filepath=path, **axes, export_selected_objects=True, export_triangulated_mesh=True)


# The scene


def make_room() -> None:
    """A floor, three walls and a table with two things on it; its light is an even sky and a large lamp."""
    slab("floor", (4, 4, 0.02), (0, 0, -0.01), seed=1)
    slab("back", (4, 0.02, 2.4), (0, 2, 1.2), seed=2)
    slab("left", (0.02, 4, 2.4), (-2, 0, 1.2), seed=3)
    slab("right", (0.02, 4, 2.4), (2, 0, 1.2), seed=4)
    slab("table", (0.9, 0.7, 0.05), (0, 0, TABLE - 0.025), seed=5)
    slab("book", (0.18, 0.13, 0.05), (-0.22, 0.16, TABLE + 0.025), seed=6, turn=20)
    slab("box", (0.12, 0.10, 0.20), (0.24, 0.20, TABLE + 0.10), seed=7, turn=-15)
    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.55, 0.6, 0.7, 1)
    bpy.context.scene.world = world
    lamp = bpy.data.lights.new("lamp", "AREA")
    lamp.energy, lamp.size = 60, 1.2
    item = bpy.data.objects.new("lamp", lamp)
    item.matrix_world = looking((0.8, -0.6, 2.3), (0, 0, TABLE))
    bpy.context.scene.collection.objects.link(item)


def make_glass() -> dict[str, str]:
    """Makes the glass, and returns the object whose mask shows each mesh."""
    outside = [(0, 0), (0.040, 0), (0.044, 0.004), (0.052, 0.150)]
    inside = [(0.048, 0.150), (0.041, 0.016), (0.037, 0.013), (0, 0.013)]
    lathe("tumbler", [*outside, *inside], (0.02, -0.12, TABLE + 0.0005), INDEX["tumbler"])
    angles = np.linspace(-math.pi / 2, math.pi / 2, 49)
    ball = [(0.05 * math.cos(angle), 0.05 + 0.05 * math.sin(angle)) for angle in angles]
    ball[0], ball[-1] = (0, 0), (0, 0.1)
    lathe("ball", ball, (-0.14, -0.10, TABLE + 0.0005), INDEX["ball"], is_smooth=True)
    return {"tumbler": "tumbler", "ball": "ball"}


def make_glass_behind_books() -> dict[str, str]:
    """A vessel that is half full, and a frustum; returns the object whose mask shows each mesh.

    Each surface of the vessel lies between two media, whose indices it divides: there are no gaps and no overlaps.
    """
    slab("wide_book", (0.17, 0.03, 0.08), (-0.05, -0.17, TABLE + 0.04), seed=8, turn=8)
    slab("tall_book", (0.03, 0.10, 0.12), (0.17, -0.12, TABLE + 0.06), seed=9, turn=-25)
    wall, base, level, height = 0.003, 0.010, 0.072, 0.125

    def radius(z: float) -> float:
        return 0.036 + 0.010 * math.sin(math.pi * (z / height) ** 0.8)

    outside = [(radius(z), z) for z in np.linspace(0, height, 40)]
    inside = [(radius(z) - wall, z) for z in np.linspace(height, level, 18)]
    wet = [(radius(z) - wall, z) for z in np.linspace(base, level, 21)]
    place, index = (-0.07, -0.03, TABLE + 0.0005), INDEX["vessel"]
    lathe("vessel", [(0, 0), *outside, *inside], place, index, is_smooth=True)
    lathe("vessel_to_water", [(0, base), *wet], place, WATER / index, is_smooth=True)
    lathe("water", [wet[-1], (0, level)], place, WATER)
    frustum = [(0, 0), (0.036, 0), (0.021, 0.085), (0, 0.085)]
    lathe("frustum", frustum, (0.09, -0.01, TABLE + 0.0005), INDEX["frustum"], is_smooth=True)
    return {"vessel": "vessel", "vessel_to_water": "vessel", "water": "vessel", "frustum": "frustum"}


def slab(name: str, size: tuple, center: tuple, *, seed: int, turn: float = 0.0) -> None:
    """A box with a picture on each of its faces, in proportion."""
    bpy.ops.mesh.primitive_cube_add(size=1)
    item = bpy.context.object
    item.name = name
    item.matrix_world = (
        Matrix.Translation(center) @ Matrix.Rotation(math.radians(turn), 4, "Z") @ Matrix.Diagonal((*size, 1))
    )
    bpy.ops.object.transform_apply()
    layer = item.data.uv_layers.active
    for face in item.data.polygons:
        axis = max(range(3), key=lambda i: abs(face.normal[i]))
        across = [i for i in range(3) if i != axis]
        for loop in face.loop_indices:
            place = item.data.vertices[item.data.loops[loop].vertex_index].co
            layer.data[loop].uv = [(place[i] - center[i]) / max(size) + 0.5 for i in across]
    item.data.materials.append(make_material(bpy, "ShaderNodeBsdfDiffuse", {}, picture(name, seed)))


def picture(name: str, seed: int, side: int = 512) -> "bpy.types.Image":
    """Overlapping rectangles of many colours and sizes, which features are easily found on."""
    rng = np.random.default_rng(seed)
    pixels = np.ones((side, side, 4), np.float32)
    pixels[..., :3] = rng.uniform(0.3, 0.7, 3)
    for size in (200, 130, 80, 50):
        for _ in range(int(0.9 * (side / size) ** 2)):
            row, column = rng.integers(-size // 2, side, 2)
            height, width = rng.integers(size // 3, size, 2)
            pixels[max(row, 0) : row + height, max(column, 0) : column + width, :3] = rng.uniform(0.06, 0.85, 3)
    image = bpy.data.images.new(name, side, side)
    image.pixels.foreach_set(pixels.ravel())
    image.pack()
    return image


def lathe(
    name: str, profile: list, place: tuple, index: float, *, is_smooth: bool = False, segments: int = 128
) -> None:
    """A surface of revolution between two media, from its profile (radius, height); front sides are on its right.

    Args:
        index: of the medium behind it, relative to that in front.
        is_smooth: with smooth normals, but for edges of more than 30 degrees.
    """
    vertices, rings = [], []
    for radius, height in profile:
        around = 1 if radius == 0 else segments
        rings.append([len(vertices) + i for i in range(around)])
        for i in range(around):
            angle = 2 * math.pi * i / segments
            at = (radius * math.cos(angle), radius * math.sin(angle), height)
            vertices.append([a + b for a, b in zip(at, place)])
    faces = []
    for low, high in pairwise(rings):
        for i in range(segments):
            corners = [low[i % len(low)], low[(i + 1) % len(low)], high[(i + 1) % len(high)], high[i % len(high)]]
            faces.append(list(dict.fromkeys(corners)))
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices, [], faces)
    if is_smooth:
        mesh.shade_smooth()
        mesh.set_sharp_from_angle(angle=math.radians(30))
    mesh.materials.append(make_material(bpy, "ShaderNodeBsdfGlass", {"IOR": index, "Roughness": 0}))
    bpy.context.scene.collection.objects.link(bpy.data.objects.new(name, mesh))


# Cameras and pictures


def looking(place: tuple, target: tuple) -> "Matrix":
    """world_from_camera of a camera or lamp that looks along its -z."""
    rotation = (Vector(target) - Vector(place)).to_track_quat("-Z", "Y").to_matrix().to_4x4()
    return Matrix.Translation(place) @ rotation


def world_from_camera(view: int, views: int) -> "Matrix":
    """Three arcs around the table, which is open towards -y."""
    azimuth = math.radians(-90 + 150 * ((view * 0.618034) % 1 - 0.5))
    elevation = math.radians((15, 32, 50)[view % 3])
    radius = 0.95 + 0.15 * math.sin(view)
    flat = radius * math.cos(elevation)
    place = (flat * math.cos(azimuth), flat * math.sin(azimuth), TABLE + 0.08 + radius * math.sin(elevation))
    return looking(place, (0.03 * math.sin(3 * view), 0.03 * math.cos(5 * view), TABLE + 0.04))


def make_camera(pixels: int) -> "bpy.types.Object":
    scene = bpy.context.scene
    set_cycles(bpy, {"width": pixels, "height": pixels, "spp": 1, "max_depth": 24})
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "PNG", "8"
    scene.view_settings.view_transform = "Standard"
    scene.cycles.sample_clamp_indirect, scene.cycles.blur_glossy = 10.0, 1.0  # As Blender has them, against fireflies.
    scene.render.use_persistent_data = True
    return add_camera(bpy, {"fov_x": math.radians(42)})


def draw(path: Path, *, samples: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    bpy.context.scene.cycles.samples = samples
    bpy.context.scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


def write_masks(root: Path, camera: "bpy.types.Object", frames: list, glass: dict[str, str]) -> None:
    """A picture for each object and view: white where one of its meshes is seen, through nothing else."""
    bpy.context.scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0
    bpy.data.objects["lamp"].hide_render = True
    for name in dict.fromkeys(glass.values()):
        for item in [item for item in bpy.data.objects if item.type == "MESH"]:
            item.data.materials.clear()
            shines = {"Strength": float(glass.get(item.name) == name)}
            item.data.materials.append(make_material(bpy, "ShaderNodeEmission", shines))
        for frame in frames:
            camera.matrix_world = Matrix(frame["transform_matrix"])
            path = root / "masks" / name / Path(frame["file_path"]).name
            draw(path, samples=16)
            image = bpy.data.images.load(str(path))
            pixels = np.array(image.pixels[:]).reshape(-1, 4)
            pixels[:, :3] = pixels[:, :1] > 0.735  # sRGB of one half.
            image.pixels.foreach_set(pixels.ravel().astype(np.float32))
            image.save()
            bpy.data.images.remove(image)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Render a folder for `datagen capture` with Blender's Cycles.")
    parser.add_argument("folder", type=Path, help="folder to write")
    for name, usual in (("views", 64), ("pixels", 256), ("samples", 96)):
        parser.add_argument(name, type=int, nargs="?", default=usual, help="default: %(default)s")
    parser.add_argument("--books", action="store_true", help="the vessel and the frustum behind books")
    given = parser.parse_args()
    main(given.folder, given.views, given.pixels, given.samples, has_books=given.books)
