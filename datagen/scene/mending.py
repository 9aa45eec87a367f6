"""From objects to a checked scene: atlases for meshes without one, with their images baked into them."""

import dataclasses

import numpy as np
from jaxtyping import Float32

from datagen.data.images import png_bytes, srgb_from_linear, to_8bit
from datagen.data.meshes import Mesh, check_areas, check_numbers, is_there
from datagen.disk.errors import HyalineError
from datagen.scene.atlas import bake_corners, coverage, unwrap_all
from datagen.scene.description import EnvironmentMap, Scene, image_bytes
from datagen.scene.images import linear_pixels, look_up, read_map
from datagen.scene.materials import ImageTexture
from datagen.scene.soundness import check_names, check_scene
from datagen.terminal.command import say

COVERAGE_SIZE = 256
"""Texels per side of the raster that is checked for overlapping uv."""
MAX_SHARED = 0.005
"""Share of covered texels that several faces may share; atlases with overlapping charts have many times more."""
MIN_COVERED = 0.005
"""Share of the atlas that a surface must cover; with less, it would have only a few texels or none."""
MIN_SIZE, MAX_SIZE = 128, 2048
"""Texels per side of an image that is baked into new uv."""
MAX_UV = 1e5
"""Repeats of an image beyond which 32-bit floats cannot distinguish its texels."""


def assemble(scene: Scene, *, without_uv: set[str] | None = None) -> Scene:
    """The scene, mended by `mend_scene` (without `without_uv`, all objects get an atlas) and checked."""
    check_names(scene)
    if isinstance(scene.environment, EnvironmentMap):
        read_map(image_bytes(scene, scene.environment), where=f"scene {scene.name}: {scene.environment.path}")
    scene = mend_scene(scene, without_uv={item.name for item in scene.objects} if without_uv is None else without_uv)
    check_scene(scene)
    return scene


def mend_scene(scene: Scene, *, without_uv: set[str]) -> Scene:
    """The scene with an atlas for each object; each repair prints one line.

    Args:
        without_uv: names of objects whose files have no uv: they get an atlas without a message.
    """
    faults = {}
    for item in scene.objects:
        if not is_there(item.mesh):
            continue
        where = f"scene {scene.name}: object {item.name}"
        check_numbers(item.mesh, where=where)
        for image in item.material.images().values():
            linear_pixels(image_bytes(scene, image), where=f"{where}: {image.path}")
            if item.name in without_uv:
                raise HyalineError(f"{where}: has no uv for {image.path}; export its mesh with uv, or give it a color")
        if (fault := "" if item.name in without_uv else atlas_fault(item.mesh)) is not None:
            faults[item.name] = fault
    return _with_atlases(scene, faults)


def _with_atlases(scene: Scene, faults: dict[str, str]) -> Scene:
    """The scene with a new atlas for each object in `faults`, and its image baked into it."""
    wheres = {name: f"scene {scene.name}: object {name}" for name in faults}
    for item in scene.objects:
        if item.name in faults:
            check_areas(item.mesh, where=wheres[item.name])
    meshes = unwrap_all({wheres[item.name]: item.mesh for item in scene.objects if item.name in faults})
    objects, baked = [], dict(scene.baked)
    for item in scene.objects:
        if (fault := faults.get(item.name)) is None:
            objects.append(item)
            continue
        mesh, material, what = meshes[wheres[item.name]], item.material, "unwrapped again"
        for field, image in material.images().items():
            if not item.mesh.uv.any() or not np.abs(item.mesh.uv).max() < MAX_UV:
                raise HyalineError(
                    f"{wheres[item.name]}: {fault}; {image.path} needs uv in or near [0, 1], export its mesh with them"
                )
            path, what = f"baked/{item.name}_{field}.png", f"unwrapped again, and {image.path} baked into its new uv"
            baked[path] = baked_image(linear_pixels(image_bytes(scene, image), where=image.path), item.mesh, mesh)
            material = material.with_fields({field: ImageTexture(path=path)})
        if fault:
            say(f"{wheres[item.name]}: {fault}; it was {what}")
        objects.append(dataclasses.replace(item, mesh=mesh, material=material))
    return dataclasses.replace(scene, objects=tuple(objects), baked=baked)


def baked_image(image: Float32[np.ndarray, "tex_h tex_w 3"], before: Mesh, after: Mesh) -> bytes:
    """The PNG that colours a surface in new uv as the image did in the old uv, where it repeats outside [0, 1].

    Args:
        after: the same faces in the same order, with new uv.
    """
    a, b, c = np.moveaxis(before.uv[before.faces].astype(np.float64), 1, 0)
    # Texels that the surface shows, which are more than the image has where it repeats.
    shown = 0.5 * np.abs(np.linalg.det(np.stack([b - a, c - a], axis=-1))).sum() * image.shape[0] * image.shape[1]
    wanted = 2 ** np.ceil(np.log2(max(*image.shape[:2], shown**0.5)))
    size = int(np.clip(wanted, MIN_SIZE, MAX_SIZE))
    uv = bake_corners(after, before.uv[before.faces].astype(np.float64), size)
    repeats = bool(before.uv.min() < 0 or before.uv.max() > 1)
    return png_bytes(to_8bit(srgb_from_linear(look_up(image, uv, repeats=repeats))))


def atlas_fault(mesh: Mesh) -> str | None:
    """Why a mesh's uv are not an atlas, which gives each surface point its own texels; None if they are one."""
    if not np.isfinite(mesh.uv).all():
        return "some of its uv are not finite"
    if mesh.uv.min() < 0 or mesh.uv.max() > 1:
        return f"its uv span {mesh.uv.min():g} to {mesh.uv.max():g}"
    counts = coverage(mesh, COVERAGE_SIZE)
    covered = int((counts > 0).sum())
    if covered < MIN_COVERED * counts.size:
        return f"its uv cover {100 * covered / counts.size:.2g} % of the atlas"
    if (shared := float((counts > 1).sum()) / covered) > MAX_SHARED:
        return f"its uv overlap on {100 * shared:.1f} % of their texels"
    return None
