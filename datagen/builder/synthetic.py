"""A tiny dataset made without Mitsuba: a glass pane over a textured floor, ray-traced by closed formula."""

import dataclasses
from pathlib import Path

import numpy as np

from datagen.data.cameras import Cameras, direction_of, look_at, with_depth_range
from datagen.data.config import SPLITS, DatasetConfig, DatasetObject, Resolution, SplitConfig, square
from datagen.data.dataset import Dataset
from datagen.data.geometries import geometry_hash
from datagen.data.images import encode_exr, linear_from_srgb, png_bytes
from datagen.data.layers import Layers, quantize_uv, start_layers
from datagen.data.meshes import Mesh
from datagen.data.paths import TRUTH, layers_root
from datagen.data.writing import commit_view, write_head
from datagen.scene.description import CameraRig, Scene, SceneObject, SoftEnvironment, WalkPoint
from datagen.scene.folder import scene_files
from datagen.scene.materials import Diffuse, ThinDielectric

HEIGHTS = (0.5, 0.0)
"""z of the pane (object 1) and of the floor (object 2); both span [-1, 1] in x and y, uv = (x + 1, y + 1) / 2."""


def quad(z: float) -> Mesh:
    """A horizontal square that faces up."""
    xy = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float32)
    return Mesh(
        vertices=np.concatenate([xy, np.full((4, 1), z, np.float32)], axis=1),
        faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        normals=np.tile(np.array([0, 0, 1], np.float32), (4, 1)),
        uv=(xy + 1) / 2,
    )


def synthetic_scene() -> Scene:
    """The pane and the floor as a scene."""
    grey = (0.5, 0.5, 0.5)
    return Scene(
        name="synthetic",
        objects=(
            SceneObject(name="pane", mesh=quad(HEIGHTS[0]), material=ThinDielectric(ior=1.5)),
            SceneObject(name="floor", mesh=quad(HEIGHTS[1]), material=Diffuse(color=grey)),
        ),
        environment=SoftEnvironment(zenith=grey, horizon=grey, ground=grey),
        cameras=CameraRig(
            target=(0, 0, 0),
            radius=3,
            elevation_deg=(30, 80),
            walk=(WalkPoint(position=(2, 0, 2), target=(0, 0, 0)), WalkPoint(position=(0, 2, 1), target=(0, 0, 0))),
        ),
    )


def trace(origin: np.ndarray, directions: np.ndarray, num_layers: int) -> Layers:
    """The straight layers of pane and floor, for cameras above both."""
    h, w = directions.shape[:2]
    uv = np.zeros((num_layers, h, w, 2), np.float32)
    object_id = np.zeros((num_layers, h, w), np.uint8)
    depth = np.zeros((num_layers, h, w), np.float32)
    count = np.zeros((h, w), int)
    for index, z in enumerate(HEIGHTS):
        t = (z - origin[2]) / directions[..., 2]
        p = origin + t[..., None] * directions
        rows, columns = np.nonzero((t > 0) & (np.abs(p[..., :2]) < 1).all(axis=-1))
        layer = count[rows, columns]
        uv[layer, rows, columns] = (p[rows, columns, :2] + 1) / 2
        object_id[layer, rows, columns] = index + 1
        depth[layer, rows, columns] = t[rows, columns]
        count[rows, columns] += 1
    return Layers(uv=quantize_uv(uv), object_id=object_id, depth=depth)


def shade(layers: Layers) -> np.ndarray:
    """The picture (h, w, 3) uint8: a smooth pattern on the floor, dimmed to a bluish 80 % behind the pane."""
    image = np.full((*layers.object_id.shape[1:], 3), 0.9)
    for object_id, uv in zip(layers.object_id[::-1], layers.uv[::-1], strict=True):
        u, v = np.moveaxis(uv / 65535, -1, 0)
        pattern = np.stack([0.5 + 0.4 * np.sin(9 * u), 0.5 + 0.4 * np.sin(7 * v), 0.3 + 0.4 * u * v], axis=-1)
        image = np.where((object_id == 2)[..., None], pattern, image)
        image = np.where((object_id == 1)[..., None], image * [0.7, 0.75, 0.8] + 0.05, image)
    return np.rint(image * 255).astype(np.uint8)


def write_synthetic_dataset(
    root: Path,
    *,
    resolution: int | Resolution = 32,
    num_layers: int = 4,
    train_views: int = 8,
    sees_nothing: bool = False,
    scene_name: str = "synthetic",
) -> Dataset:
    """A complete dataset with its straight layers; 8 training views and 2 of each test split unless told.

    Args:
        resolution: one number for square pictures.
        sees_nothing: the last extrapolating camera looks away from all objects.
        scene_name: what the dataset calls its scene.
    """
    size = resolution if isinstance(resolution, Resolution) else square(resolution)
    config = DatasetConfig.even(scene_name, size, 2)
    config = dataclasses.replace(config, preset="tiny", train=SplitConfig(views=train_views, spp=4))
    scene = synthetic_scene()
    rng = np.random.default_rng(0)
    cameras = {}
    for split in SPLITS:
        poses = []
        for _ in range(config.split(split).views):
            azimuth, elevation = rng.uniform(0, 2 * np.pi), rng.uniform(0.6, 1.3)
            poses.append(look_at(3 * direction_of(np.array(elevation), np.array(azimuth)), np.zeros(3)))
        if sees_nothing and split == "extrapolating":
            away = poses[-1][:3, 3]
            poses[-1] = look_at(away, 2 * away)
        cameras[split] = Cameras(
            world_from_camera=np.stack(poses), fov_x=np.radians(50), width=size.width, height=size.height
        )
    objects = (DatasetObject(name="pane", is_glass=True), DatasetObject(name="floor", is_glass=False))
    cameras = with_depth_range(cameras, [item.mesh for item in scene.objects])
    dataset = write_head(root, config, objects, cameras, scene_files(scene))
    meshes_hash = geometry_hash(dataset, TRUTH)
    start_layers(layers_root(root, TRUTH), size, num_layers=num_layers, geometry_hash=meshes_hash)
    store = dataset.layer_store()
    noise = rng.normal(0, 1e-3, (*size.shape, 3)).astype(np.float32)
    for split in SPLITS:
        stored = dataset.cameras(split)
        for view in range(config.split(split).views):
            layers = trace(*stored[view].rays(), num_layers)
            picture = shade(layers)
            exr = encode_exr(linear_from_srgb(picture / 255).astype(np.float32), noise)
            files = {".png": png_bytes(picture), ".exr": exr}
            commit_view(dataset, split, view, files, seed=0, spp=4, noise_mse=1e-5, variant="none")
            store.write(split, view, layers, overflow_share=0.0)
    return dataset
