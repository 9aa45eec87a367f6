"""The cameras of every split, placed by a scene's rig."""

import dataclasses
import math

import numpy as np
from jaxtyping import Float

from datagen.data.cameras import Cameras, Lens, direction_of, look_at, with_depth_range
from datagen.data.config import SPLITS, DatasetConfig, Split
from datagen.data.meshes import r2_steps
from datagen.disk.errors import HyalineError
from datagen.scene.description import CameraList, CameraRig, Scene
from datagen.scene.soundness import check_cameras_outside
from datagen.scene.values import Vector


def make_cameras(rig: CameraRig | CameraList, config: DatasetConfig) -> dict[Split, Cameras]:
    """The cameras of all splits; only the training ones of a rig are random, from the dataset's seed.

    Source: paper section 4.5. Training cameras lie on a hemisphere that is cropped at the floor, the interpolating path
    lies on the same hemisphere, the extrapolating walk leaves it: nearer, farther, lower, looking elsewhere.
    """
    if isinstance(rig, CameraList):
        return _listed(rig, config)
    poses = {
        "train": _hemisphere(rig, config.train.views, np.random.default_rng(config.seed)),
        "interpolating": _path_on_hemisphere(rig, config.interpolating.views),
        "extrapolating": _walk(rig, config.extrapolating.views),
    }
    lens = Lens(fov_x=math.radians(rig.fov_deg), width=config.resolution.width, height=config.resolution.height)
    return {split: lens.cameras(poses[split]) for split in SPLITS}


def cameras_within(scene: Scene, cameras: dict[Split, Cameras]) -> dict[Split, Cameras]:
    """Cameras with the range of depth that they see in a scene.

    Raises:
        HyalineError: a camera is inside glass.
    """
    for views in cameras.values():
        check_cameras_outside(scene, views.world_from_camera[:, :3, 3])
    return with_depth_range(cameras, [item.mesh for item in scene.objects])


def with_listed_views(config: DatasetConfig, rig: CameraRig | CameraList) -> DatasetConfig:
    """The configuration with as many views of each split as a scene lists; unchanged where a rig places them."""
    if isinstance(rig, CameraRig):
        return config
    sizes = {split: dataclasses.replace(config.split(split), views=len(rig.of(split))) for split in SPLITS}
    return dataclasses.replace(config, **sizes)


def with_listed_shape(config: DatasetConfig, rig: CameraRig | CameraList) -> DatasetConfig:
    """The configuration with pictures of the shape that the lens of listed cameras has, of about as many pixels."""
    if isinstance(rig, CameraRig) or rig.train.fits_any_shape:
        return config
    return dataclasses.replace(config, resolution=rig.train.shaped(config.resolution.pixels))


def _listed(rig: CameraList, config: DatasetConfig) -> dict[Split, Cameras]:
    for split in SPLITS:
        if config.split(split).views != len(rig.of(split)):
            raise HyalineError(
                f"{split}: {config.split(split).views} views are asked for, and the scene lists "
                f"{len(rig.of(split))} cameras; leave out --views and --test-views, or list others"
            )
    return {split: rig.of(split).fitted(config.resolution) for split in SPLITS}


def _hemisphere(rig: CameraRig, count: int, rng: np.random.Generator) -> Float[np.ndarray, "view 4 4"]:
    """Uniform in solid angle over the allowed elevations and azimuths, by a shifted R2 low-discrepancy sequence."""
    unit = (r2_steps(count) + rng.uniform(size=2)) % 1
    low, high = np.sin(np.radians(rig.elevation_deg))
    elevation = np.arcsin(low + unit[:, 0] * (high - low))
    first, last = np.radians(rig.azimuth_deg)
    azimuth = first + unit[:, 1] * (last - first)
    offset = rng.uniform(-1, 1, size=(count, 3)) * rig.target_jitter * rig.radius
    positions = np.array(rig.target, np.float64) + rig.radius * direction_of(elevation, azimuth)
    return np.stack([look_at(p, np.array(rig.target, np.float64) + o) for p, o in zip(positions, offset, strict=True)])


def _path_on_hemisphere(rig: CameraRig, count: int) -> Float[np.ndarray, "view 4 4"]:
    """A sweep over the middle 90 % of the azimuths while the elevation swings twice."""
    s = (np.arange(count) + 0.5) / count
    first, last = np.radians(rig.azimuth_deg)
    low, high = np.radians(rig.elevation_deg)
    azimuth = first + (0.05 + 0.9 * s) * (last - first)
    elevation = low + (0.5 + 0.4 * np.sin(4 * np.pi * s)) * (high - low)
    positions = np.array(rig.target, np.float64) + rig.radius * direction_of(elevation, azimuth)
    return np.stack([look_at(position, np.array(rig.target, np.float64)) for position in positions])


def _walk(rig: CameraRig, count: int) -> Float[np.ndarray, "view 4 4"]:
    """A smooth curve through the rig's walk points, evenly timed between them."""
    from scipy.interpolate import PchipInterpolator

    def curve(points: list[Vector]) -> np.ndarray:
        # Monotone between key points, so the walk never swings through a wall that the points avoid.
        keys = np.arange(len(points))
        return PchipInterpolator(keys, np.array(points))(np.linspace(0, keys[-1], count))

    positions = curve([point.position for point in rig.walk])
    targets = curve([point.target for point in rig.walk])
    return np.stack([look_at(position, target) for position, target in zip(positions, targets, strict=True)])
