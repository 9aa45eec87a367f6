"""A scene without glass, a painted cube on a disc: what a method must manage before its failure on glass counts.

`python tests/support/opaque_cube.py FOLDER` writes it for `datagen build --scene FOLDER`.
"""

import sys
from pathlib import Path

from datagen.scene.description import CameraRig, Scene, SceneObject, SoftEnvironment, WalkPoint
from datagen.scene.folder import save_scene
from datagen.scene.materials import Diffuse, SolidTexture
from datagen.scene.mending import assemble
from datagen.scene.modelling import cylinder, moved, rounded_box


def opaque_cube() -> Scene:
    """A cube of one metre with three by three squares of strong contrast a face, on a dark disc under a white sky.

    The mean of the training pictures scores little here: a method must see the cube turn to do better.
    """
    checker = SolidTexture(pattern="checker", colors=((0.90, 0.70, 0.08), (0.03, 0.08, 0.40)), scale=0.8)
    cube = moved(rounded_box((1.0, 1.0, 1.0), bevel=0.02), (0.2, 0.2, 0.561))
    disc = moved(cylinder(0.9, 0.06), (0.2, 0.2, 0.0))
    scene = Scene(
        name="opaque_cube",
        objects=(
            SceneObject(name="disc", mesh=disc, material=Diffuse(color=(0.12, 0.14, 0.12))),
            SceneObject(name="cube", mesh=cube, material=Diffuse(color=checker)),
        ),
        environment=SoftEnvironment(
            zenith=(0.95, 0.95, 0.95),
            horizon=(0.9, 0.9, 0.9),
            ground=(0.85, 0.85, 0.85),
        ),
        cameras=CameraRig(
            target=(0.2, 0.2, 0.5),
            radius=2.8,
            elevation_deg=(10.0, 70.0),
            fov_deg=40.0,
            walk=(
                WalkPoint(position=(2.4, -1.4, 1.2), target=(0.2, 0.2, 0.5)),
                WalkPoint(position=(1.1, -1.3, 1.3), target=(0.2, 0.3, 0.5)),
                WalkPoint(position=(-2.7, -2.7, 0.9), target=(0.3, 0.2, 0.4)),
            ),
        ),
    )
    return assemble(scene)


if __name__ == "__main__":
    save_scene(opaque_cube(), Path(sys.argv[1]))
