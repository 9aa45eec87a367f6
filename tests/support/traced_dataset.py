"""A small dataset of solid glass, whose pictures are the colours of its objects: made in half a second."""

import dataclasses
from pathlib import Path

import numpy as np
from support.meshes import box
from support.synthetic import pixel_rays, synthetic_scene

from datagen.data.cameras import Cameras, look_at, with_depth_range
from datagen.data.config import SPLITS, DatasetConfig, DatasetObject, Resolution, Split, SplitConfig, square
from datagen.data.dataset import Dataset
from datagen.data.geometries import geometry_hash
from datagen.data.images import encode_exr, linear_from_srgb, png_bytes
from datagen.data.layers import start_layers
from datagen.data.paths import TRUTH, layers_root
from datagen.data.writing import commit_view, write_head
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.atlas import faces_apart
from datagen.scene.description import Scene, SceneObject
from datagen.scene.folder import scene_files
from datagen.scene.materials import Dielectric, Diffuse, Plastic, SolidTexture, ThinDielectric
from datagen.scene.modelling import ball, moved, rounded_box, sheet

BALL = (np.array([0.0, 0.0, 0.7]), 0.3)
"""Centre and radius of the ball of glass."""

SLAB = (0.45, 0.55)
"""z of the faces of a slab of glass below a part of the floor's view; it spans 0.5 to 1.3 in x and -0.4 to 0.4 in y."""


def glass_scene() -> Scene:
    """A ball, a slab and a thin pane of glass, and a glossy cube, above a floor with a pattern, under a grey sky."""
    pattern = SolidTexture(pattern="stripes", colors=((0.8, 0.2, 0.1), (0.1, 0.2, 0.8)), scale=0.5)
    low, high = SLAB
    things = {
        "floor": (sheet((-2, -2, 0), (4, 0, 0), (0, 4, 0)), Diffuse(color=pattern)),
        "ball": (
            moved(ball(BALL[1], subdivisions=3), BALL[0].tolist()),
            Dielectric(ior=1.5, absorption=(3.0, 1.0, 0.0)),
        ),
        "slab": (moved(box((0.8, 0.8, high - low)), (0.9, 0, (low + high) / 2)), Dielectric(ior=1.6)),
        "pane": (sheet((-1.2, -0.4, 0.5), (0.6, 0, 0), (0, 0.8, 0)), ThinDielectric(ior=1.5)),
        "cube": (moved(rounded_box((0.4, 0.4, 0.4), bevel=0.05), (0, 0.9, 0.25)), Plastic(color=(0.2, 0.6, 0.3))),
    }
    objects = tuple(
        SceneObject(name=name, mesh=faces_apart(mesh), material=material) for name, (mesh, material) in things.items()
    )
    scene = synthetic_scene()
    cameras = dataclasses.replace(scene.cameras, target=(0, 0, 0.3), elevation_deg=(20, 80))
    return dataclasses.replace(scene, name="glasses", objects=objects, cameras=cameras)


def write_traced_dataset(root: Path, *, scene: Scene | None = None, resolution: int | Resolution = 48) -> Dataset:
    """A complete dataset with straight layers: 10 training views and 2 of each test split, in colours by object."""
    scene = scene or glass_scene()
    size = resolution if isinstance(resolution, Resolution) else square(resolution)
    config = dataclasses.replace(DatasetConfig.even(scene.name, size, 2), train=SplitConfig(views=10, spp=4))
    cameras: dict[Split, Cameras] = {split: _cameras(split, config.split(split).views, size) for split in SPLITS}
    objects = tuple(DatasetObject(name=item.name, is_glass=item.material.is_glass) for item in scene.objects)
    cameras = with_depth_range(cameras, [item.mesh for item in scene.objects])
    dataset = write_head(root, config, objects, cameras, scene_files(scene))
    meshes_hash = geometry_hash(dataset, TRUTH)
    start_layers(layers_root(dataset.root, TRUTH), size, num_layers=8, geometry_hash=meshes_hash)
    use_mitsuba()
    from datagen.trace.peel import Peeler

    peeler = Peeler(tuple(item.mesh for item in scene.objects))
    for split in SPLITS:
        for view in range(config.split(split).views):
            layers, _ = peeler.peel(dataset.cameras(split), view, 8)
            picture = _colors(len(objects))[layers.object_id[0]]
            radiance = linear_from_srgb(picture / 255).astype(np.float32)
            exr = encode_exr(radiance, np.zeros_like(radiance))
            png = png_bytes(picture)
            commit_view(dataset, split, view, {".png": png, ".exr": exr}, seed=0, spp=4, noise_mse=1e-5, variant="none")
            dataset.layer_store().write(split, view, layers, overflow_share=0.0)
    return dataset


def _colors(count: int) -> np.ndarray:
    return np.concatenate([[[230, 230, 230]], np.random.default_rng(0).integers(20, 220, (count, 3))]).astype(np.uint8)


def _cameras(split: Split, count: int, size: Resolution) -> Cameras:
    rng = np.random.default_rng(SPLITS.index(split))
    azimuth, elevation = rng.uniform(0, 2 * np.pi, count), rng.uniform(0.3, 1.3, count)
    around = np.stack([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    target = np.array([0.2, 0.1, 0.4])
    poses = [look_at(target + 3 * place, target) for place in around.T]
    return Cameras(world_from_camera=np.stack(poses), fov_x=np.radians(50), width=size.width, height=size.height)


__all__ = ["BALL", "SLAB", "glass_scene", "pixel_rays", "write_traced_dataset"]
