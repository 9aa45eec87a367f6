"""Tests that imported surfaces show as much of white light as they do in Cycles."""

import dataclasses
import io
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from support.commands import call
from support.gltf import GltfBuilder
from support.meshes import mesh_of
from support.scenes import scene_of

from datagen.data.cameras import Cameras, look_at
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.render.truth import Renderer, render_view
from datagen.scene.folder import load_scene
from datagen.scene.materials import Conductor, Dielectric, Material, RoughDielectric, ThinDielectric
from datagen.scene.textures import ImageTexture

BALL = mesh_of(trimesh.creation.icosphere(3, 0.5))
WHITE_PNG = io.BytesIO()
Image.new("RGB", (4, 4), (255, 255, 255)).save(WHITE_PNG, format="PNG")
CAMERAS = Cameras(
    world_from_camera=look_at(np.array((0.3, -3.0, 0.4)), np.zeros(3))[None], fov_x=0.4, width=12, height=12
)
MATERIALS: dict[str, tuple[Material, float]] = {
    "an index of 1": (Dielectric(ior=1.0), 0.9999),
    "an index of 1, with dispersion": (Dielectric(ior=1.0, dispersion=1.0), 0.9999),
    "a thin pane of index 1": (ThinDielectric(ior=1.0), 0.9999),
    "a thin pane": (ThinDielectric(ior=1.5), 0.999),
    "a thin pane of white tint": (ThinDielectric(ior=1.9, tint=(1, 1, 1)), 0.998),
    "diamond that parts colours": (Dielectric(ior="diamond", dispersion="measured"), 0.99),
    "frosted flint that parts colours": (RoughDielectric(ior="sf11", dispersion="measured", roughness=0.05), 0.97),
    "a mirror with an image": (Conductor(color=ImageTexture(path="white.png"), roughness=0.0), 0.999),
    "metal with an image": (Conductor(color=ImageTexture(path="white.png"), roughness=0.05), 0.985),
}
"""What it is made of, and the least share of the light that is left."""


CYCLES = {
    0.0: {0.2: 0.063, 0.4: 0.058, 0.5: 0.052, 0.8: 0.031},
    0.2: {0.2: 0.251, 0.4: 0.246, 0.5: 0.241, 0.8: 0.224},
    0.5: {0.2: 0.532, 0.4: 0.529, 0.5: 0.525, 0.8: 0.515},
    0.8: {0.2: 0.813, 0.4: 0.811, 0.5: 0.810, 0.8: 0.806},
}
"""What a ball shows of white light from everywhere, by base colour and roughness: Blender 4.5's Cycles, Principled BSDF
of index 1.5, orthographic camera, 32 x 32 pixels of 64 samples, mean over the ball."""


@pytest.mark.parametrize("color", CYCLES)
def test_an_imported_surface_shows_as_much_of_white_light_as_in_cycles(
    color: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_mitsuba(quiet=True)
    monkeypatch.chdir(tmp_path)
    for roughness, expected in CYCLES[color].items():
        builder = GltfBuilder()
        pbr = {"metallicFactor": 0, "roughnessFactor": roughness, "baseColorFactor": [color, color, color, 1]}
        ball = dataclasses.replace(BALL, normals=2 * BALL.vertices)
        builder.node(mesh=builder.mesh(ball, material=builder.material(pbrMetallicRoughness=pbr)))
        builder.written(tmp_path, "ball.glb")
        assert call("datagen import ball.glb --ground never --overwrite").status == 0
        item = load_scene(tmp_path / "scenes/ball").objects[0]
        item = dataclasses.replace(item, mesh=ball)  # In the middle, where the camera looks.
        renderer = Renderer(scene_of(item), max_depth=8)
        truth = render_view(renderer, CAMERAS, 0, spp=256, view_seed=0, ceiling_db=None).radiance
        y, x = np.mgrid[:12, :12] - 5.5
        # Cycles keeps the light that facets throw onto others; a base below a rough coat loses up to a tenth.
        assert truth[np.hypot(x, y) < 4].mean() == pytest.approx(expected, abs=0.02, rel=0.11 if color == 0.8 else 0.05)
