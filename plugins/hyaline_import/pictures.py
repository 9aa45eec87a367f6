"""Images of foreign materials: decoded with care, written as PNG, and what their opacity cuts out of a mesh."""

import dataclasses
import functools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int64, UInt8

from datagen.data.images import linear_from_srgb, srgb_from_linear
from datagen.data.meshes import MIN_AREA, Mesh, face_areas, no_mesh
from datagen.disk.errors import HyalineError
from datagen.scene.images import opened_image
from datagen.scene.materials import Color
from hyaline_import.foreign import ForeignImage, ForeignMaterial
from hyaline_import.remarks import Remarks

Opacity = Float32[np.ndarray, "tex_h tex_w"]
CornerUv = Float32[np.ndarray, "face 3 2"]
Piece = tuple[Float[np.ndarray, "point 3"], Int64[np.ndarray, "triangle 3"]]
"""What is left of a face: barycentric coordinates of points on it, and triangles of them."""

MAX_POINTS = 40_000
"""Points of the outlines on one face; a finer image is halved until there are no more."""
MAX_NEW_FACES = 100_000
"""Faces that cutting may add to an object before the image is halved."""
MIN_SIDE = 32
"""Texels per side below which an image is not halved."""
MAX_TILES = 4096
"""Largest number of repeats of the image on one face."""
MAX_TEXELS = 1 << 24
"""Texels on one face, each repeat counted, before the image is halved."""
SNAP = 1e-6
"""Share of a face, or of its sides, that counts as rounding."""
WHOLE: Piece = (np.eye(3), np.array([[0, 1, 2]]))
NOTHING: Piece = (np.zeros((0, 3)), np.zeros((0, 3), np.int64))
MAX_SIDE = 2048
"""Texels a side that are kept."""
INSIDE = (np.ones((3, 3)) + 3 * np.eye(3)) / 6
"""Barycentric coordinates of the points of a face where an image is looked up."""
INVISIBLE = 1 / 512
"""Alpha below which a blended surface is invisible, since it rounds to 0 in 8 bits."""
SOLID_BLEND = 0.9
"""Alpha from which on a blended surface counts as opaque."""
BLEND_CUTOFF = 0.5
"""Opacity from which on a blended surface is drawn."""
PARTLY = (0.1, 0.9)
"""Opacity that is neither nothing nor all."""
MOSTLY = 0.5
"""Share of a surface from which on it is a pane if its image is partly opaque there."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cut:
    """A cut to be made once the object has its atlas; the image lies in the mesh's original uv."""

    opacity: Opacity
    """Opacity with row 0 on top, as in the image."""
    cutoff: float
    corner_uv: CornerUv
    """uv of the faces' corners, v up."""


def cut_out(mesh: Mesh, cut: Cut, *, where: str) -> Mesh:
    """The mesh without the parts that the image removes, or no mesh if that is everything.

    Opaque faces stay whole; faces at outlines are split in their planes, with interpolated normals and uv. Where the
    outlines are too fine, a coarser copy of the image is used.
    """
    uv = cut.corner_uv.astype(np.float64)
    tiles = np.maximum(np.ceil(uv.max(axis=1)) - np.floor(uv.min(axis=1)), 1).prod(axis=-1).max()
    if not tiles <= MAX_TILES:
        raise HyalineError(f"{where}: its cutout repeats {tiles:.3g} times on a face; expected at most {MAX_TILES}")
    opacity = np.flipud(cut.opacity).astype(np.float64)
    while (pieces := _pieces(mesh, opacity, cut.cutoff, uv)) is None:
        height, width = (size // 2 * 2 for size in opacity.shape)
        opacity = opacity[:height, :width].reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3))
    counts = [len(shares) for shares, _ in pieces]
    shares = np.concatenate([shares for shares, _ in pieces])
    starts = np.cumsum([0, *counts])
    triangles = np.concatenate([faces + start for (_, faces), start in zip(pieces, starts)])
    if not len(triangles):
        return no_mesh()
    rows = np.concatenate([mesh.vertices, mesh.normals, mesh.uv], axis=1).astype(np.float64)
    points = np.einsum("pk,pkc->pc", shares, rows[np.repeat(mesh.faces, counts, axis=0)])
    points[:, 3:6] /= np.maximum(np.linalg.norm(points[:, 3:6], axis=1, keepdims=True), 1e-30)
    points, index = np.unique(points[triangles.reshape(-1)].astype(np.float32), axis=0, return_inverse=True)
    vertices, normals, uv = (np.ascontiguousarray(part) for part in np.split(points, [3, 6], axis=1))
    return Mesh(vertices=vertices, faces=index.reshape(-1, 3).astype(np.int32), normals=normals, uv=uv)


def _pieces(
    mesh: Mesh, opacity: Float[np.ndarray, "tex_h tex_w"], cutoff: float, uv: Float[np.ndarray, "face 3 2"]
) -> list[Piece] | None:
    """What is left of each face; None if there is too much of it, and the image can be halved."""
    mode = "wrap" if uv.min() < 0 or uv.max() > 1 else "clip"
    is_coarsest = min(opacity.shape) < 2 * MIN_SIDE
    found, budget = [], len(mesh.faces) + MAX_NEW_FACES
    # The centre of the first texel is (0, 0).
    for corners, flat in zip(uv * opacity.shape[::-1] - 0.5, mesh.vertices[mesh.faces].astype(np.float64), strict=True):
        low, high = np.floor(corners.min(axis=0)).astype(int) - 1, np.ceil(corners.max(axis=0)).astype(int) + 2
        if not is_coarsest and np.prod(high - low) > MAX_TEXELS:
            return None
        columns, rows = (np.arange(*ends) for ends in zip(low, high))
        around = np.take(np.take(opacity, rows, axis=0, mode=mode), columns, axis=1, mode=mode)
        above = around >= cutoff
        if not is_coarsest and sum(np.diff(above, axis=axis).sum() for axis in (0, 1)) > MAX_POINTS:
            return None
        if above.all() or not above.any():
            found.append(WHOLE if above.any() else NOTHING)
        else:
            found.append(_cut(corners - low, flat, around, cutoff))
        budget -= len(found[-1][1])
        if not is_coarsest and budget < 0:
            return None
    return found


def _cut(corners: Float[np.ndarray, "3 2"], flat: Float[np.ndarray, "3 3"], around: np.ndarray, cutoff: float) -> Piece:
    """What is left of one face, by its corners among the texels around it and in space."""
    import manifold3d
    from skimage.measure import find_contours

    turn = np.linalg.det([corners[1] - corners[0], corners[2] - corners[0]])
    if turn == 0:  # All uv on a line or point of the image: its middle decides.
        column, row = np.rint(corners.mean(axis=0)).astype(int)
        return WHOLE if around[row, column] >= cutoff else NOTHING
    # A border below the cutoff closes every outline; what reaches the cutoff just so is inside.
    loops = find_contours(np.pad(around, 1, constant_values=cutoff - 1), cutoff - 1e-9)
    opaque = manifold3d.CrossSection([loop[:-1, ::-1] - 1 for loop in loops], manifold3d.FillRule.EvenOdd)
    left = opaque ^ manifold3d.CrossSection([corners if turn > 0 else corners[::-1]])
    share = 2 * left.area() / abs(turn)
    if share > 1 - SNAP or share < SNAP:
        return WHOLE if share > 0.5 else NOTHING
    polygons = left.to_polygons()
    triangles = np.asarray(manifold3d.triangulate(polygons), np.int64).reshape(-1, 3)
    edges = np.stack([corners[1] - corners[0], corners[2] - corners[0]], axis=-1)
    second, third = np.linalg.solve(edges, (np.concatenate(polygons) - corners[0]).T)
    shares = np.stack([1 - second - third, second, third], axis=-1)
    shares[shares < SNAP] = 0
    shares /= shares.sum(axis=-1, keepdims=True)  # Exactly 1 at a corner, exactly 0 on a side.
    a, b, c = np.moveaxis((shares @ flat).astype(np.float32)[triangles].astype(np.float64), 1, 0)
    triangles = triangles[0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1) > 10 * MIN_AREA]
    return shares, triangles if turn > 0 else triangles[:, ::-1]


def decoded(image: ForeignImage) -> Float32[np.ndarray, "tex_h tex_w 4"]:
    """Linear colour and alpha of an image of at most `MAX_SIDE` texels a side; a larger one is reduced."""
    values = stored(image) / np.float64(255)
    values[..., :3] = linear_from_srgb(values[..., :3])
    return values.astype(np.float32)


@functools.lru_cache(maxsize=4)
def stored(image: ForeignImage) -> UInt8[np.ndarray, "tex_h tex_w 4"]:
    """RGBA as the file holds it, reduced as in `decoded`; read-only."""
    from PIL import Image

    with opened_image(image.data, where=f"image of {image.name}") as picture:
        if max(picture.size) > MAX_SIDE:
            picture.draft("RGB", (MAX_SIDE, MAX_SIDE))
        rgba = picture.convert("RGBA")
    if max(rgba.size) > MAX_SIDE:
        rgba.thumbnail((MAX_SIDE, MAX_SIDE), Image.Resampling.BOX)
    return np.asarray(rgba)


def values_on(
    mesh: Mesh, values: Float[np.ndarray, "tex_h tex_w"]
) -> tuple[Float[np.ndarray, " point"], Float[np.ndarray, " point"]]:
    """An image's values at three points of each face, and the area that each represents."""
    points = np.einsum("pk,fkc->fpc", INSIDE, mesh.uv[mesh.faces].astype(np.float64)).reshape(-1, 2)
    height, width = values.shape
    column, row = (
        np.floor(place % 1 * size).astype(int) for place, size in ((points[:, 0], width), (-points[:, 1], height))
    )
    seen = values[np.minimum(row, height - 1), np.minimum(column, width - 1)].astype(np.float64)
    return seen, np.repeat(face_areas(mesh), len(INSIDE)) + np.finfo(np.float32).tiny  # So that some of them count.


@functools.lru_cache(maxsize=256)
def mean_color(image: ForeignImage) -> Color:
    """The mean linear colour, weighted by alpha."""
    pixels = decoded(image).astype(np.float64)
    weight = pixels[..., 3:] if pixels[..., 3].any() else np.ones_like(pixels[..., 3:])
    red, green, blue = np.clip((pixels[..., :3] * weight).sum(axis=(0, 1)) / weight.sum(), 0, 1).tolist()
    return red, green, blue


# Opacity


def veiled(material: ForeignMaterial, mesh: Mesh, *, has_uv: bool) -> ForeignMaterial:
    """The material as one of a single alpha where its image lets a part of the light through nearly everywhere.

    Many files draw panes in this way: an image of their colour whose alpha is, say, 0.3 everywhere.
    """
    if material.alpha_mode != "blend" or not has_uv or (material.image is None and material.opacity is None):
        return material
    seen, areas = values_on(mesh, _opacity(material))
    partly = areas[(seen > PARTLY[0]) & (seen < PARTLY[1])].sum() / areas.sum()
    if partly < MOSTLY:
        return material
    return dataclasses.replace(material, alpha=float(seen @ areas / areas.sum()), opacity=None)


def cut_of(
    material: ForeignMaterial, mesh: Mesh, remarks: Remarks, *, has_uv: bool, is_solid: bool, where: str
) -> Cut | None:
    """How a surface is to be cut; None where nothing is cut away."""
    is_pane = material.alpha_mode == "blend" and INVISIBLE <= material.alpha < SOLID_BLEND
    if material.alpha_mode == "opaque" or is_pane or (is_solid and material.alpha_mode == "blend"):
        return None
    opacity = _opacity(material)
    cutoff = min(material.alpha_cutoff, 2.0) if material.alpha_mode == "mask" else BLEND_CUTOFF
    if opacity.min() >= cutoff:
        return None
    if is_solid:
        remarks.approximate(where, "is cut out by its opacity, which would open a solid; drawn whole")
        return None
    if not has_uv and opacity.size > 1:
        remarks.approximate(where, "is cut out by an image, and has no uv; drawn whole")
        return None
    remarks.note(where, f"is cut out where its opacity is below {cutoff:.2g}")
    return Cut(opacity=opacity, cutoff=cutoff, corner_uv=mesh.uv[mesh.faces])


def _opacity(material: ForeignMaterial) -> Opacity:
    """Per texel, the factor included; one texel without an image."""
    if material.opacity is not None:
        pixels = decoded(material.opacity)
        has_alpha = pixels[..., 3].min() < 1
        values = pixels[..., 3] if has_alpha else srgb_from_linear(pixels[..., :3].astype(np.float64)).mean(axis=-1)
    elif material.image is not None:
        values = decoded(material.image)[..., 3]
    else:
        values = np.ones((1, 1))
    return (values * material.alpha).astype(np.float32)
