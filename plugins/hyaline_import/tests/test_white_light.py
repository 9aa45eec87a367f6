"""Tests that imported surfaces show as much of white light as they do in Cycles."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.foreign import add, taken
from support.gltf import GltfBuilder
from support.meshes import mesh_of
from support.scenes import scene_of

from datagen.data.cameras import Cameras, look_at
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.render.truth import Renderer, render_view

BALL = mesh_of(trimesh.creation.icosphere(3, 0.5))
CAMERAS = Cameras(
    world_from_camera=look_at(np.array((0.3, -3.0, 0.4)), np.zeros(3))[None], fov_x=0.4, width=12, height=12
)
CYCLES = {
    0.0: {0.2: 0.063, 0.4: 0.058, 0.5: 0.052, 0.8: 0.031},
    0.2: {0.2: 0.251, 0.4: 0.246, 0.5: 0.241, 0.8: 0.224},
    0.5: {0.2: 0.532, 0.4: 0.529, 0.5: 0.525, 0.8: 0.515},
    0.8: {0.2: 0.813, 0.4: 0.811, 0.5: 0.810, 0.8: 0.806},
}
"""What a ball shows of white light from everywhere, by base colour and roughness: Blender 4.5's Cycles, Principled BSDF
of index 1.5, orthographic camera, 32 x 32 pixels of 64 samples, mean over the ball."""


@pytest.mark.parametrize("color", CYCLES)
def test_an_imported_surface_shows_as_much_of_white_light_as_in_cycles(color: float, tmp_path: Path) -> None:
    use_mitsuba()
    ball = dataclasses.replace(BALL, normals=2 * BALL.vertices)
    for roughness, expected in CYCLES[color].items():
        pbr = {"metallicFactor": 0, "roughnessFactor": roughness, "baseColorFactor": [color, color, color, 1]}
        path = add(GltfBuilder(), "ball", ball, {"pbrMetallicRoughness": pbr}).written(tmp_path)
        item = dataclasses.replace(taken(path, "--ground never")["ball"], mesh=ball)  # Where the camera looks.
        renderer = Renderer(scene_of(item), max_depth=8)
        truth = render_view(renderer, CAMERAS, 0, spp=256, view_seed=0, ceiling_db=None).radiance
        y, x = np.mgrid[:12, :12] - 5.5
        assert truth[np.hypot(x, y) < 4].mean() == pytest.approx(expected, abs=0.02, rel=0.05)
