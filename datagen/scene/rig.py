"""The cameras of a scene: of every split, placed by its rig; of films; and rig and light of objects that bring none."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from datagen.data.cameras import Cameras, Lens, direction_of, look_at, with_depth_range
from datagen.data.config import SPLITS, DatasetConfig, Split
from datagen.data.dataset import Dataset
from datagen.data.meshes import r2_steps
from datagen.disk.errors import HyalineError
from datagen.scene.description import CameraList, CameraRig, Card, Scene, SceneObject, SoftEnvironment, WalkPoint
from datagen.scene.folder import listed_cameras, open_scene
from datagen.scene.materials import Vector, as_vector
from datagen.scene.soundness import check_cameras_outside


def make_cameras(rig: CameraRig | CameraList, config: DatasetConfig) -> dict[Split, Cameras]:
    """The cameras of all splits; only the training ones of a rig are random, from the dataset's seed.

    Source: paper section 4.5. The interpolating path lies on the training cameras' hemisphere, the walk leaves it.
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
    check_cameras_outside(scene, np.concatenate([views.world_from_camera[:, :3, 3] for views in cameras.values()]))
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


# Films


PATHS = ("orbit", "spline")
MAX_FRAMES = 10_000
FULL_TURN_DEG = 359.0
"""Degrees of a circle; a rig whose cameras cover this much leaves room for a whole orbit."""


def make_path(dataset: Dataset, path: str, frames: int, *, width: int | None, height: int | None) -> Cameras:
    """The cameras of a film.

    Args:
        path: `orbit` turns around the scene at its cameras' middle elevation, or swings to and fro where walls leave
            less than a circle, its target in the middle; `spline` runs through the interpolating test views.
        frames: how many cameras; those of an orbit repeat without a jump.
        width: of the pictures, in pixels; the dataset's unless given. The lens's horizontal angle stays.
        height: of the pictures, in pixels; the width's share of the dataset's aspect unless given.
    """
    if not 2 <= frames <= MAX_FRAMES:
        raise HyalineError(f"--frames: is {frames}; expected 2 to {MAX_FRAMES:,}")
    if path not in PATHS:
        raise HyalineError(f"--path: is {path!r}; expected {' or '.join(PATHS)}")
    views = lens = dataset.cameras("interpolating")
    wide = lens.width if width is None else width
    high = round(wide * lens.height / lens.width) if height is None else height
    for name, value in (("--width", wide), ("--height", high)):
        if not 1 <= value <= 8192:
            raise HyalineError(f"{name}: is {value}; expected 1 to 8192 pixels")
    center = lens.center
    if path == "orbit":
        rig = open_scene(dataset).cameras if dataset.objects else listed_cameras(dataset)  # Without meshes, no scene.
        poses, center = _orbit(rig, frames), None
    else:
        poses = _curve(views.world_from_camera, frames)
    if center is not None:
        center = (center[0] / lens.width * wide, center[1] / lens.height * high)
    return Cameras(world_from_camera=poses, fov_x=lens.fov_x, width=wide, height=high, center=center)


def _orbit(rig: CameraRig | CameraList, frames: int) -> Float[np.ndarray, "view 4 4"]:
    first, last = rig.azimuth_deg
    turn = np.arange(frames) / frames
    if last - first >= FULL_TURN_DEG:
        azimuth = np.radians(first + 360 * turn)
    else:
        azimuth = np.radians((first + last) / 2 + 0.45 * (last - first) * np.sin(2 * np.pi * turn))
    elevation = math.radians(sum(rig.elevation_deg) / 2)
    across = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1) * math.cos(elevation)
    places = np.array(rig.target) + rig.radius * np.pad(across, ((0, 0), (0, 1)), constant_values=math.sin(elevation))
    return np.stack([look_at(place, rig.target) for place in places])


def _curve(keys: Float[np.ndarray, "key 4 4"], frames: int) -> Float[np.ndarray, "view 4 4"]:
    """A curve through key cameras, evenly timed between them: places by cubic splines, turns by rotation splines."""
    from scipy.interpolate import PchipInterpolator
    from scipy.spatial.transform import Rotation, RotationSpline

    if len(keys) < 2:
        return np.repeat(keys, frames, axis=0)
    # Monotone between key frames, so that the camera never swings through a wall that they avoid.
    times, at = np.arange(len(keys)), np.linspace(0, len(keys) - 1, frames)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, 3] = PchipInterpolator(times, keys[:, :3, 3])(at)
    poses[:, :3, :3] = RotationSpline(times, Rotation.from_matrix(keys[:, :3, :3]))(at).as_matrix()
    return poses


# For objects that bring neither cameras nor light


FOV_DEG = 40.0
MARGIN = 1.1
"""How much wider a picture is than its content."""
WALK = ((-0.9, 40.0, 1.0), (-0.45, 20.0, 0.72), (0.0, 4.0, 0.85), (0.4, 12.0, 1.4), (0.7, 45.0, 1.9), (0.95, 25.0, 1.2))
"""Turn in half arcs, elevation in degrees and distance in radii of the points of an extrapolating walk."""
FRONT_DEG = -90.0
"""Azimuth from which files are meant to be seen: glTF's +z, ours -y."""
ALL_AROUND = (FRONT_DEG - 180.0, FRONT_DEG + 180.0)
"""First and last azimuth of a full circle."""


def subject_box(objects: Sequence[SceneObject]) -> Float[np.ndarray, "2 3"]:
    """Lowest and highest corner of the glass; of everything if there is no glass."""
    glass = [item for item in objects if item.material.is_glass] or list(objects)
    corners = np.concatenate([item.mesh.vertices for item in glass]).astype(np.float64)
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def rig_around(
    objects: Sequence[SceneObject],
    *,
    target: Vector | None = None,
    radius: float | None = None,
    azimuth_deg: tuple[float, float] = ALL_AROUND,
    fov_deg: float = FOV_DEG,
) -> CameraRig:
    """Cameras around `target`, by default the middle of the glass, as near as shows all of it."""
    low, high = subject_box(objects)
    centre, reach = (low + high) / 2 if target is None else np.array(target), float(np.linalg.norm(high - low)) / 2
    distance = MARGIN * reach / math.sin(math.radians(fov_deg / 2)) if radius is None else radius
    first, last = azimuth_deg
    middle, half = (first + last) / 2, min((last - first) / 2, 100.0)
    places = [centre + radii * distance * np.array(towards(middle + turn * half, up)) for turn, up, radii in WALK]
    return CameraRig(
        target=as_vector(centre),
        radius=distance,
        elevation_deg=(5.0, 65.0),
        azimuth_deg=azimuth_deg,
        fov_deg=fov_deg,
        target_jitter=0.08,
        walk=tuple(WalkPoint(position=as_vector(place), target=as_vector(centre)) for place in places),
    )


def towards(azimuth_deg: float, elevation_deg: float) -> Vector:
    """The unit direction at an azimuth and an elevation."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    across = math.cos(elevation)
    return across * math.cos(azimuth), across * math.sin(azimuth), math.sin(elevation)


LIGHT = SoftEnvironment(
    zenith=(0.34, 0.38, 0.45),
    horizon=(0.50, 0.47, 0.44),
    ground=(0.20, 0.18, 0.17),
    cards=(
        # Low flags between the softboxes draw the dark outline of glass from every direction.
        Card(direction=towards(-55, 12), size_deg=(26.0, 64.0), radiance=(0.06, 0.06, 0.07), softness_deg=10.0),
        Card(direction=towards(65, 12), size_deg=(26.0, 64.0), radiance=(0.06, 0.06, 0.07), softness_deg=10.0),
        Card(direction=towards(185, 12), size_deg=(26.0, 64.0), radiance=(0.06, 0.06, 0.07), softness_deg=10.0),
        # The key, warm; a cool one across, and one behind that looks like a window.
        Card(direction=towards(-20, 42), size_deg=(23.0, 64.0), radiance=(6.0, 5.3, 4.4), softness_deg=3.0),
        Card(direction=towards(-140, 26), size_deg=(26.0, 52.0), radiance=(1.7, 2.1, 2.7), softness_deg=3.0),
        Card(direction=towards(110, 30), size_deg=(40.0, 40.0), radiance=(2.5, 2.5, 2.5), softness_deg=3.0),
        Card(direction=towards(0, 90), size_deg=(50.0, 30.0), radiance=(2.2, 2.2, 2.2), softness_deg=6.0),
    ),
)
"""Softboxes and flags all around, as photographers show glass: bright cards draw highlights on it and caustics below
it, dark ones its outline. All are wide enough to be found by chance, so that pictures need few samples."""
