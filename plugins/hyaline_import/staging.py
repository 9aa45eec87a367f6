"""What a foreign scene lacks to be rendered, and its lamps: size in metres, ground, cameras all around, light."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from datagen.data.config import Resolution
from datagen.data.meshes import Mesh, face_corners, normals_of, open_edges, points_on
from datagen.data.queries import crossings
from datagen.scene.description import EnvironmentMap, RectangleLight, SceneObject, SoftEnvironment
from datagen.scene.materials import Color, Diffuse, SolidTexture, as_vector
from datagen.scene.modelling import merged, sheet
from datagen.scene.rig import ALL_AROUND, FRONT_DEG, rig_around, subject_box, towards
from hyaline_import.foreign import ForeignMap
from hyaline_import.remarks import Remarks

USUAL_SIZE = (0.02, 5.0)
"""Metres: anything smaller or larger was not modelled in metres."""
TABLE_TOP_SIZE = 0.3
"""Size in metres given to a scene of unknown unit."""
TEXELS_A_PERIOD = 4
GROUND_RADII = 3.0
"""Half the ground's side over the radius of the scene."""
MIN_GAP, MAX_GAP = 3e-4, 1e-3
"""Metres between the ground and the scene: coincident faces lose layers."""
MIN_BACKDROP_DEG, MIN_ARC_DEG = 60, 80
"""Degrees around the glass that a backdrop hides, and that are left for cameras."""
WATCHED_POINTS = 16
"""Points of the glass that cameras must see."""
GRAZING_DEG = 25.0
"""Degrees that cameras keep from the edge of a backdrop."""


def find_scale(size: float, *, metres: float, remarks: Remarks, where: str) -> float:
    """Metres per unit for a scene of this size: the file's own, or a guess if that makes no sense."""
    low, high = USUAL_SIZE
    for unit, name in ((metres, ""), (1.0, "a metre"), (0.01, "a centimetre"), (0.001, "a millimetre")):
        if low <= size * unit <= high:
            if name:
                remarks.approximate(
                    where, f"would be {size * metres:.3g} m large, so its unit is taken for {name}; --scale sets it"
                )
            return unit
    remarks.approximate(
        where, f"would be {size * metres:.3g} m large; made {TABLE_TOP_SIZE} m large, --scale sets metres a unit"
    )
    return TABLE_TOP_SIZE / size


def has_ground(objects: Sequence[SceneObject]) -> bool:
    """True where something opaque lies below the glass and around it."""
    low, high = subject_box(objects)
    middle, half = (low + high) / 2, (high - low) / 2
    around = np.array([[1.2, 1.2], [1.2, -1.2], [-1.2, 1.2], [-1.2, -1.2]])
    origins = np.concatenate([middle[:2] + around * half[:2], np.full((4, 1), middle[2])], axis=-1)
    downwards = np.tile([0.0, 0.0, -1.0], (4, 1))
    return int(_meets_opaque(objects, origins, downwards, within=np.inf).sum()) >= 3


def make_ground(objects: Sequence[SceneObject], *, resolution: Resolution, remarks: Remarks) -> SceneObject:
    """A checkered ground just below everything, whose pattern the textures of a method can hold.

    Args:
        resolution: of the pictures; an object's texture is half as wide as square ones.
    """
    vertices = np.concatenate([item.mesh.vertices for item in objects]).astype(np.float64)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    box = subject_box(objects)
    reach = float(np.linalg.norm(box[1] - box[0])) / 2
    middle = (box[0] + box[1])[:2] / 2
    half = max(GROUND_RADII * reach, 1.05 * float(np.abs(np.stack([low[:2], high[:2]]) - middle).max()))
    gap = min(max(0.005 * reach, MIN_GAP), MAX_GAP)
    texels = max(resolution.mean_side // 2, 8)
    period = 2 * half * TEXELS_A_PERIOD / texels
    remarks.note(
        "ground",
        f"added, {2 * half:.3g} m wide (pattern period {period:.3g} m, {TEXELS_A_PERIOD} texels at {resolution})",
    )
    height = float(low[2]) - gap
    name = "ground"
    while name in {item.name for item in objects}:
        name += "_"
    mesh = sheet((middle[0] - half, middle[1] - half, height), (2 * half, 0, 0), (0, 2 * half, 0), cells=(8, 8))
    pattern = SolidTexture(
        pattern="checker",
        colors=((0.62, 0.55, 0.46), (0.22, 0.29, 0.40)),
        scale=period,
        origin=(float(middle[0]) + period / 4, float(middle[1]) + period / 4, height),
    )
    return SceneObject(name=name, mesh=mesh, material=Diffuse(color=pattern))


def open_arc(objects: Sequence[SceneObject], remarks: Remarks) -> tuple[float, float]:
    """First and last azimuth of the widest arc without a backdrop between cameras and glass."""
    low, high = subject_box(objects)
    reach = float(np.linalg.norm(high - low)) / 2
    glass = [item.mesh for item in objects if item.material.is_glass]
    # A backdrop may be close behind a wide row of glass, so rays begin at the glass itself.
    points = points_on(merged(glass), WATCHED_POINTS).position if glass else (low + high)[None] / 2
    begin = (0.02 if glass else 1.05) * reach
    step = 10
    azimuths = FRONT_DEG + np.arange(0, 360, step)
    directions = np.array([towards(a, e) for a in azimuths for e in (8.0, 45.0)])
    origins = (points + begin * directions[:, None]).reshape(-1, 3)
    far = rig_around(objects).radius - begin
    is_hidden = _meets_opaque(objects, origins, directions.repeat(len(points), axis=0), within=far)
    # Some of the points are on the back of the glass, and may be in the wall behind it.
    is_open = is_hidden.reshape(len(azimuths), -1).mean(axis=-1) <= 0.5
    # Things among the glass hide it only here and there.
    if (~is_open).sum() * step < MIN_BACKDROP_DEG:
        return ALL_AROUND
    # The widest run of open azimuths on the circle.
    runs = [int(np.append(np.roll(is_open, -start), False).argmin()) for start in range(len(azimuths))]
    best = int(np.argmax(runs))
    if runs[best] * step < MIN_ARC_DEG:
        remarks.approximate("cameras", "everything is in a closed space; cameras all around see it from outside")
        return ALL_AROUND
    first = float(azimuths[best])
    first -= 360.0 if first > 180 else 0.0
    first, last = first + GRAZING_DEG, first + step * (runs[best] - 1) - GRAZING_DEG
    remarks.note("cameras", f"are at azimuths from {first:.0f} to {last:.0f} degrees, in front of a backdrop")
    return first, last


def _meets_opaque(
    objects: Sequence[SceneObject],
    origins: Float[np.ndarray, "ray 3"],
    directions: Float[np.ndarray, "ray 3"],
    *,
    within: float,
) -> Bool[np.ndarray, " ray"]:
    """Whether each ray meets something opaque within this distance."""
    opaque = [face_corners(item.mesh) for item in objects if not item.material.is_glass]
    found = np.zeros(len(origins), bool)
    for line, _, distance in crossings(np.concatenate([np.zeros((0, 3, 3)), *opaque]), origins, directions):
        found[line[(distance > 0) & (distance <= within)]] = True
    return found


def even_sky(radiance: Color) -> SoftEnvironment:
    """The same light from all around."""
    return SoftEnvironment(zenith=radiance, horizon=radiance, ground=radiance)


DUST = 1e-9
"""Rounding error of a rotation, as a share of an edge's largest coordinate."""
UPRIGHT = 0.9999
"""Cosine of the largest tilt of an environment map that is ignored."""
LEAST_GLOW = 0.5
"""Radiance from which a surface is a lamp; below, it is a surface that glows a little."""
LEAST_SIDE = 0.02
"""Share of a lamp's box below which a side is left out."""


def placed_light(
    light: RectangleLight, linear: Float[np.ndarray, "3 3"], offset: Float[np.ndarray, "3"]
) -> RectangleLight:
    """A light of the file in our world."""
    edges = linear @ np.stack([light.edge_u, light.edge_v], axis=-1)
    # Without rounding errors of a rotation: Mitsuba 3.9 returns NaN for an edge of 2e-16 m.
    edge_u, edge_v = np.where(np.abs(edges) < DUST * np.abs(edges).max(axis=0), 0.0, edges).T
    corner = as_vector(linear @ light.corner + offset)
    return dataclasses.replace(light, corner=corner, edge_u=as_vector(edge_u), edge_v=as_vector(edge_v))


def placed_map(sky: ForeignMap, linear: Float[np.ndarray, "3 3"], remarks: Remarks) -> EnvironmentMap:
    """A map of the environment in our world; a tilted one is drawn upright."""
    middle, up = (linear @ sky.middle, linear @ sky.up)
    if up[2] < UPRIGHT * np.linalg.norm(up):
        remarks.approximate("environment", "is tilted; drawn upright, turned about the vertical alone")
    return EnvironmentMap(
        path=f"textures/environment{sky.ending}",
        scale=sky.scale,
        rotation_deg=math.degrees(math.atan2(middle[1], middle[0])),
    )


def glowing(mesh: Mesh, radiance: Color) -> tuple[RectangleLight, ...]:
    """Rectangles with the power of a surface that emits light: the sides of a box around a closed one, or one in the
    middle of an open one, which shines to where its faces look."""
    across = normals_of(face_corners(mesh)) / 2
    points = mesh.vertices.astype(np.float64)
    frames = (np.eye(3), np.linalg.eigh(across.T @ (across / np.linalg.norm(across, axis=1, keepdims=True)))[1].T)
    frame = min(frames, key=lambda rows: float(np.prod(np.ptp(points @ rows.T, axis=0) + 1e-6)))
    low, high = (points @ frame.T).min(axis=0), (points @ frame.T).max(axis=0)
    middle, size = (low + high) / 2 @ frame, high - low
    sides = [(axis, sign) for axis in range(3) for sign in (-1.0, 1.0)]
    if open_edges(mesh):
        axis = int(size.argmin())
        sides, size[axis] = [(axis, float(np.sign(across.sum(axis=0) @ frame[axis]) or 1.0))], 0.0
    areas = {side: float(np.prod(np.delete(size, side[0]))) for side in sides}
    sides = [side for side in sides if areas[side] > LEAST_SIDE * sum(areas.values())]
    scale = float(np.linalg.norm(across, axis=1).sum()) / sum(areas[side] for side in sides)
    red, green, blue = (scale * c for c in radiance)
    found = []
    for axis, sign in sides:
        u, v = (size[other] * frame[other] for other in np.delete(np.arange(3), axis))
        if np.cross(u, v) @ frame[axis] * sign < 0:
            u, v = v, u
        corner = middle + sign * size[axis] / 2 * frame[axis] - (u + v) / 2
        u, v = as_vector(u), as_vector(v)
        found.append(RectangleLight(corner=as_vector(corner), edge_u=u, edge_v=v, radiance=(red, green, blue)))
    return tuple(found)
