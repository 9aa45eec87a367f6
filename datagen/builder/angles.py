"""The cameras of the splits by angle: rotated out of what training covers, at the training distance."""

import math

import numpy as np
from jaxtyping import Bool, Float

from datagen.data.cameras import Cameras, direction_of, look_at
from datagen.data.config import ANGLE_SPLITS, DatasetConfig, Split
from datagen.data.meshes import Mesh, face_corners
from datagen.data.queries import crossings
from datagen.disk.errors import HyalineError
from datagen.scene.description import CameraRig, Scene

STEP = math.radians(0.25)
"""Between two places where a camera may stand."""
LOWEST = math.radians(5)
"""Elevation below which no camera goes, unless training does: it would see the undersides of things."""
HIGHEST = math.radians(89)
"""Elevation above which none goes: straight down, a level camera has no heading."""
MARGIN = math.radians(3)
"""How much farther than to its place a camera could be rotated without running into something."""

Directions = Float[np.ndarray, "place 3"]


def make_angle_cameras(scene: Scene, config: DatasetConfig) -> dict[Split, Cameras]:
    """The cameras of all splits by angle: as many as `config` has extrapolating views, the same at every call.

    Training covers the elevations and azimuths of the rig, as seen from its target. A camera of `extrapolating-20deg`
    lies exactly 20 degrees outside of them, at the training distance, and looks at the target. They are evenly spread
    over all such places, but for those that are lower than training and than 5 degrees, and those to which a training
    camera cannot be rotated without running into something.

    Raises:
        HyalineError: no such place exists.
    """
    if not isinstance(scene.cameras, CameraRig):
        raise HyalineError(
            f"scene {scene.name}: lists its cameras explicitly, so --angles is not available; give it a CameraRig"
        )
    size, fov_x, count = config.resolution, math.radians(scene.cameras.fov_deg), config.extrapolating.views
    meshes = tuple(item.mesh for item in scene.objects)
    cameras: dict[Split, Cameras] = {}
    for split, degrees in ANGLE_SPLITS.items():
        positions = places_outside(scene.cameras, meshes, math.radians(degrees))
        if not len(positions):
            raise HyalineError(
                f"{split}: scene {scene.name} has no place for a camera {degrees:g} degrees outside of training's "
                f"azimuths {scene.cameras.azimuth_deg} and elevations {scene.cameras.elevation_deg}; "
                "narrow them in its scene.json, or leave out --angles"
            )
        chosen = positions[((np.arange(count) + 0.5) * len(positions) / count).astype(int)]
        poses = np.stack([look_at(position, np.array(scene.cameras.target, np.float64)) for position in chosen])
        cameras[split] = Cameras(world_from_camera=poses, fov_x=fov_x, width=size.width, height=size.height)
    return cameras


def angle_outside(rig: CameraRig, directions: Directions) -> Float[np.ndarray, " place"]:
    """Angle in radians between unit directions from the target and the nearest that training covers; 0 inside."""
    low, high, first, last = _bounds(rig)
    elevation = np.arcsin(np.clip(directions[:, 2], -1, 1))
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    is_beside = (azimuth - first) % (2 * np.pi) > last - first
    from_edges = [_angle_to_meridian(azimuth - edge, elevation, low, high) for edge in (first, last)]
    return np.where(is_beside, np.minimum(*from_edges), np.abs(elevation - np.clip(elevation, low, high)))


def places_outside(rig: CameraRig, meshes: tuple[Mesh, ...], angle: float) -> Directions:
    """Every place, in even steps, where a camera lies so far outside of what training covers; metres."""
    start, out = _border(rig, angle)
    directions = math.cos(angle) * start + math.sin(angle) * out
    is_fit = angle_outside(rig, directions) > angle - 1e-6
    is_fit &= directions[:, 2] > math.sin(min(LOWEST, _bounds(rig)[0])) - 1e-9
    is_fit &= directions[:, 2] < math.sin(HIGHEST)
    start, out = start[is_fit], out[is_fit]
    return np.array(rig.target) + rig.radius * directions[is_fit][~_runs_into(rig, meshes, start, out, angle)]


def _bounds(rig: CameraRig) -> tuple[float, float, float, float]:
    """Lowest and highest elevation, first and last azimuth, in radians; once around at most."""
    low, high = np.radians(rig.elevation_deg)
    first, last = np.radians(rig.azimuth_deg)
    return float(low), float(high), float(first), float(min(last, first + 2 * np.pi))


def _border(rig: CameraRig, angle: float) -> tuple[Directions, Directions]:
    """Directions along the region's border, and the tangents that lead away from it; fans at its corners.

    They are spaced so that places `angle` away, along the tangents, are about a step apart.
    """
    low, high, first, last = _bounds(rig)
    rows: list[np.ndarray] = []

    def add(elevation: tuple[float, float], azimuth: tuple[float, float], turn: tuple[float, float], length: float):
        # turn: direction of the tangent, from east (0) over north (pi / 2) to west.
        count = math.ceil(length / STEP) + 1
        rows.append(np.linspace((elevation[0], azimuth[0], turn[0]), (elevation[1], azimuth[1], turn[1]), count)[:-1])

    west, south, fan = math.pi, 1.5 * math.pi, 0.5 * math.pi * math.sin(angle)
    is_open = last - first < 2 * math.pi - 1e-9
    if is_open:
        add((low, high), (last, last), (0, 0), (high - low) * math.cos(angle))
        add((high, high), (last, last), (0, 0.5 * math.pi), fan)
    add((high, high), (last, first), (0.5 * math.pi, 0.5 * math.pi), (last - first) * abs(math.cos(high + angle)))
    if is_open:
        add((high, high), (first, first), (0.5 * math.pi, west), fan)
        add((high, low), (first, first), (west, west), (high - low) * math.cos(angle))
        add((low, low), (first, first), (west, south), fan)
    add((low, low), (first, last), (south, south), (last - first) * abs(math.cos(low - angle)))
    if is_open:
        add((low, low), (last, last), (south, 2 * math.pi), fan)
    elevation, azimuth, turn = np.concatenate(rows).T
    start = direction_of(elevation, azimuth)
    east = direction_of(np.zeros_like(azimuth), azimuth + 0.5 * math.pi)
    north = direction_of(elevation + 0.5 * math.pi, azimuth)
    return start, np.cos(turn)[:, None] * east + np.sin(turn)[:, None] * north


def _angle_to_meridian(
    azimuth: Float[np.ndarray, " place"], elevation: Float[np.ndarray, " place"], low: float, high: float
) -> Float[np.ndarray, " place"]:
    """Angle to the arc from `low` to `high` of the meridian from which `azimuth` is counted."""
    x = np.cos(elevation) * np.cos(azimuth)
    nearest = np.arctan2(np.sin(elevation), x)  # On the great circle, where it may be beyond a pole.
    # Where it is not on the arc, one of the arc's ends is nearest.
    candidates = np.stack([np.clip(nearest, low, high), np.full_like(x, low), np.full_like(x, high)])
    cosine = np.cos(candidates) * x + np.sin(candidates) * np.sin(elevation)
    return np.arccos(np.clip(cosine.max(axis=0), -1, 1))


def _runs_into(
    rig: CameraRig, meshes: tuple[Mesh, ...], start: Directions, out: Directions, angle: float
) -> Bool[np.ndarray, " place"]:
    """True where a mesh is in the way from the border to a place, or right behind it, at the rig's radius."""
    corners = np.concatenate([face_corners(mesh) for mesh in meshes]).astype(np.float64) - np.array(rig.target)
    knots = np.linspace(0, angle + MARGIN, math.ceil((angle + MARGIN) / math.radians(4)) + 1)
    points = rig.radius * (np.cos(knots)[:, None, None] * start + np.sin(knots)[:, None, None] * out)
    origins, spans = points[:-1].reshape(-1, 3), np.diff(points, axis=0).reshape(-1, 3)
    # Only triangles that may cross the sphere on which cameras stand count: walls, and few others.
    center = corners.mean(axis=1, keepdims=True)
    size = np.linalg.norm(corners - center, axis=2).max(axis=1)
    farthest = np.linalg.norm(corners, axis=2).max(axis=1)
    is_near = np.linalg.norm(center[:, 0], axis=1) - size < rig.radius
    # A chord of 4 degrees is 0.06 % nearer than the sphere.
    hits = np.zeros(len(origins), bool)
    for segment, _, share in crossings(corners[is_near & (farthest > 0.999 * rig.radius)], origins, spans):
        hits[segment[(share >= 0) & (share <= 1)]] = True
    return np.logical_or.reduce(hits.reshape(len(knots) - 1, -1))
