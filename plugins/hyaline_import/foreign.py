"""What a foreign file holds, whatever its format: surfaces in the file's own units and axes, and their materials."""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from datagen.data.meshes import open_edges, volume_within
from datagen.data.queries import windings
from datagen.disk.errors import HyalineError
from datagen.disk.storage import read_regular
from datagen.machine.processes import allow_file, allow_triangles
from datagen.scene.description import RectangleLight
from datagen.scene.materials import Color, Material
from datagen.scene.modelling import CREASE_DEG
from hyaline_import.remarks import Remarks
from hyaline_import.surfaces import mesh_of, seams_joined

Axis = Literal["x", "y", "z"]
Factor = Literal["metallic", "roughness", "transmission"]

MAX_FILE_BYTES = 1 << 29
"""The largest file that is read, whether imported or named by one."""
MAX_TRIANGLES = 4_000_000
"""The most triangles of a scene, each instance counted."""
MAX_SURFACES = 20_000
"""The most instances of surfaces in a file; a scene has at most 255 objects, one a material if there are more."""
MOST_POINTS = 1000
"""Points of a part that must lie inside another; the surfaces of closed parts do not cross."""


@dataclass(frozen=True, kw_only=True)
class ForeignImage:
    """An image file: a PNG, a JPEG or a WebP, as its bytes."""

    name: str
    data: bytes


@dataclass(frozen=True, kw_only=True)
class FactorImage:
    """A channel of an image, as it is stored, that multiplies one of a material's factors."""

    factor: Factor
    image: ForeignImage
    channel: int
    """0 is red, 3 alpha."""
    lies_as_color: bool = True
    """It is looked up in the uv of the surface; else only its mean is known."""


@dataclass(frozen=True, kw_only=True)
class ForeignMaterial:
    """A material in the terms of glTF's metallic-roughness model and its extensions, into which other files translate.

    Source: glTF 2.0 section 3.9, KHR_materials_transmission, _volume, _ior, _dispersion.
    """

    name: str
    base_color: Color = (1.0, 1.0, 1.0)
    """Linear; times the image."""
    image: ForeignImage | None = None
    alpha: float = 1.0
    """Times that of the image."""
    alpha_mode: Literal["opaque", "mask", "blend"] = "opaque"
    alpha_cutoff: float = 0.5
    """In mode mask, the surface is absent where alpha is less."""
    opacity: ForeignImage | None = None
    """An image of alpha, where that is not the alpha of `image`; in the same uv."""
    metallic: float = 0.0
    roughness: float = 0.5
    """Perceptual: the square root of the microfacet alpha."""
    transmission: float = 0.0
    factor_images: tuple[FactorImage, ...] = ()
    """Images that multiply `metallic`, `roughness` and `transmission`."""
    ior: float = 1.5
    """1 for an opaque surface that mirrors nothing."""
    is_base: bool = False
    """The colour is that of a base below a clear coat, as `Plastic` has it; else that which is seen."""
    is_volume: bool = False
    """It fills its mesh; else the file calls it thin-walled."""
    attenuation_color: Color = (1.0, 1.0, 1.0)
    """What white light becomes after `attenuation_distance`."""
    attenuation_distance: float = math.inf
    """In the file's units."""
    absorption: Color = (0.0, 0.0, 0.0)
    """Besides attenuation: 1 over the file's unit, by channel."""
    is_thin: bool = False
    """The file calls it a thin pane, whatever its mesh."""
    dispersion: float = 0.0
    """20 over the Abbe number."""
    emission: Color = (0.0, 0.0, 0.0)
    """Radiance that its surface emits to the outside."""

    @property
    def is_glass(self) -> bool:
        """Metal lets nothing through, whatever its transmission."""
        return self.transmission * (1 - self.metallic) >= 0.5


PLAIN = ForeignMaterial(name="default", base_color=(0.8, 0.8, 0.8), roughness=1.0, ior=1.0)
"""For surfaces without a material: Blender's grey. (glTF's default, rough metal, is never meant.)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class ForeignObject:
    """One surface of one material, placed in the file's world."""

    name: str
    positions: Float[np.ndarray, "vertex 3"]
    faces: Int[np.ndarray, "face 3"]
    """Counter-clockwise seen from outside."""
    normals: Float[np.ndarray, "vertex 3"] | None = None
    uv: Float[np.ndarray, "vertex 2"] | None = None
    """Texture coordinates of the material's image; v points up."""
    material: ForeignMaterial | Material = PLAIN
    crease_deg: float = CREASE_DEG
    """Without normals, faces that meet at more than this angle get a hard edge; 0 makes every face flat."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ForeignMap:
    """Light from infinitely far as an equirectangular picture."""

    data: bytes
    ending: str
    """.exr or .hdr"""
    scale: float
    middle: Float[np.ndarray, "3"]
    """Direction of its middle column's horizon, in the file's axes; further right in it is clockwise around `up`."""
    up: Float[np.ndarray, "3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class ForeignScene:
    """All surfaces of a file."""

    objects: tuple[ForeignObject, ...]
    up: Axis
    """The axis that points up, by the format's rule or custom."""
    metres: float = 1.0
    """Metres a unit, by the format's rule; 1 where it has none."""
    lights: tuple[RectangleLight, ...] = ()
    """In the file's units and axes."""
    sky: Color | ForeignMap | None = None
    """Radiance from all around, or a map of it; None if the file has none."""
    license: str | None = None
    """The licence in the file, in one line; None if it has none."""
    is_complete: bool = False
    """It was made to be rendered as it is: no ground is added, and nothing is moved."""


def read_foreign(path: Path, *, at_most: int = MAX_FILE_BYTES) -> bytes:
    """The bytes of a file that is imported, or that such a file names."""
    data = read_regular(path, at_most=at_most)
    allow_file(len(data))
    return data


def check_surfaces(parts: Sequence[ForeignObject], *, where: str) -> None:
    """Refuses surfaces that are none, too many or not finite; allows this process what a scene of them takes."""
    count = sum(len(part.faces) for part in parts)
    if not 0 < count <= MAX_TRIANGLES or len(parts) > MAX_SURFACES:
        raise HyalineError(
            f"{where}: holds {count:,} triangles in {len(parts):,} surfaces; expected 1 to {MAX_TRIANGLES:,} triangles "
            f"in at most {MAX_SURFACES:,}"
        )
    if not all(np.isfinite(part.positions).all() for part in parts):
        raise HyalineError(f"{where}: holds numbers that are not finite; export it again")
    allow_triangles(count)


def elementwise(points: np.ndarray, linear: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """linear p + offset; equal points stay equal to the last bit, as they may not in a matrix product."""
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    return np.stack([x * row[0] + y * row[1] + z * row[2] + at for row, at in zip(linear, offset)], axis=-1)


def clipped(value: float) -> float:
    """A number in [0, 1]."""
    return min(max(value, 0.0), 1.0)


def clipped_color(color: Iterable[float]) -> Color:
    """Three numbers in [0, 1]."""
    red, green, blue = map(clipped, color)
    return red, green, blue


def merged_by_material(parts: tuple[ForeignObject, ...], remarks: Remarks, *, where: str) -> tuple[ForeignObject, ...]:
    """One object for each material, and for whether it brings normals and uv."""
    groups: dict[tuple[ForeignMaterial | Material, bool, float, bool], list[ForeignObject]] = {}
    for part in parts:
        key = part.material, part.normals is None, part.crease_deg, part.uv is None
        groups.setdefault(key, []).append(part)
    remarks.note(where, f"its {len(parts):,} objects became {len(groups)}, one a material")
    return tuple(joined(group) for group in groups.values())


def with_cavities(parts: tuple[ForeignObject, ...], remarks: Remarks) -> tuple[ForeignObject, ...]:
    """The objects; a closed one that faces inwards, inside another of its material, is the cavity of that one."""
    corners = [part.positions[part.faces].astype(np.float64) for part in parts]
    volumes = [volume_within(each) for each in corners]
    cavities: dict[int, list[int]] = {}
    for inner in (index for index, volume in enumerate(volumes) if volume < 0):
        around = [
            outer
            for outer, volume in enumerate(volumes)
            if volume > -volumes[inner]
            and parts[outer].material == parts[inner].material
            and (windings(corners[outer], parts[inner].positions[:MOST_POINTS]) > 0).all()
        ]
        mesh = mesh_of(parts[inner].positions, parts[inner].faces, None, None, where=parts[inner].name)
        if around and 0 in (open_edges(mesh), open_edges(seams_joined(mesh)[0])):
            cavities.setdefault(min(around, key=lambda outer: volumes[outer]), []).append(inner)
    for outer, inside in cavities.items():
        names = ", ".join(parts[inner].name for inner in inside)
        remarks.note(parts[outer].name, f"is hollow: {names} faces inwards inside it")
    within = {index for inside in cavities.values() for index in inside}
    return tuple(
        dataclasses.replace(joined([part, *(parts[inner] for inner in cavities.get(index, ()))]), name=part.name)
        for index, part in enumerate(parts)
        if index not in within
    )


def joined(group: Sequence[ForeignObject]) -> ForeignObject:
    """Surfaces as one of the first one's material."""
    first = group[0]
    if len(group) == 1:
        return first
    starts = np.cumsum([0, *(len(part.positions) for part in group)])
    normals = [part.normals for part in group if part.normals is not None]
    uv = [part.uv for part in group if part.uv is not None]
    return dataclasses.replace(
        first,
        name=first.material.name if isinstance(first.material, ForeignMaterial) else first.name,
        positions=np.concatenate([part.positions for part in group]),
        faces=np.concatenate([part.faces + start for part, start in zip(group, starts)]),
        normals=np.concatenate(normals) if len(normals) == len(group) else None,
        uv=np.concatenate(uv) if len(uv) == len(group) else None,
    )


def z_up_from(up: Axis) -> Float[np.ndarray, "3 3"]:
    """The rotation that turns an axis upwards."""
    rows = {
        "x": [[0, 1, 0], [0, 0, 1], [1, 0, 0]],
        "y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
        "z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    }
    return np.array(rows[up], np.float64)
