"""Owns a scene without glass, a painted cube on a disc: what a method must manage before its failure on glass counts.

`python tests/opaque_cube.py FOLDER` writes it for `datagen build --scene FOLDER`.
"""

import sys
from pathlib import Path

from datagen.atlas import unwrap_all
from datagen.modelling import cylinder, moved, rounded_box
from datagen.scene import (
    CameraRig,
    Diffuse,
    Lobe,
    Scene,
    SceneObject,
    SoftEnvironment,
    SolidTexture,
    WalkPoint,
    check_scene,
    save_scene,
)


def opaque_cube() -> Scene:
    """A cube of one metre with a checker of quarter metres, on a striped disc under a soft sky."""
    checker = SolidTexture(pattern="checker", colors=((0.75, 0.62, 0.20), (0.10, 0.22, 0.55)), scale=0.5)
    stripes = SolidTexture(pattern="stripes", colors=((0.55, 0.50, 0.45), (0.30, 0.42, 0.32)), scale=0.6)
    # A quarter of a square aside, so that no face lies where two squares meet.
    cube = moved(rounded_box((1.0, 1.0, 1.0), bevel=0.02), (0.06, 0.06, 0.561))
    meshes = {"disc": cylinder(1.1, 0.06), "cube": cube}
    unwrapped = unwrap_all(meshes)
    scene = Scene(
        name="opaque_cube",
        objects=(
            SceneObject(name="disc", mesh=unwrapped["disc"], material=Diffuse(color=stripes)),
            SceneObject(name="cube", mesh=unwrapped["cube"], material=Diffuse(color=checker)),
        ),
        environment=SoftEnvironment(
            zenith=(0.7, 0.75, 0.85),
            horizon=(0.6, 0.6, 0.6),
            ground=(0.3, 0.3, 0.3),
            lobes=(Lobe(direction=(0.8, -0.4, 0.9), radiance=(2.0, 1.8, 1.5), sharpness=6.0),),
        ),
        cameras=CameraRig(
            target=(0.0, 0.0, 0.45),
            radius=3.0,
            elevation_deg=(10.0, 70.0),
            fov_deg=45.0,
            walk=(
                WalkPoint(position=(2.4, -1.8, 1.2), target=(0.0, 0.0, 0.45)),
                WalkPoint(position=(0.9, -1.4, 1.3), target=(0.0, 0.1, 0.5)),
                WalkPoint(position=(-2.9, -2.9, 0.9), target=(0.1, 0.0, 0.4)),
            ),
        ),
    )
    check_scene(scene)
    return scene


if __name__ == "__main__":
    save_scene(opaque_cube(), Path(sys.argv[1]))
