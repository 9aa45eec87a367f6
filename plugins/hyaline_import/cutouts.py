"""Surfaces cut out by an image, such as leaves on cards: transparent parts are removed from the mesh.

The mesh itself is cut, along the line where the image's opacity, interpolated bilinearly between texel centres, reaches
the cutoff. So path tracer, layers, light paths, proxies and every program that reads the mesh agree.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64

from datagen.data.meshes import MIN_AREA, Mesh, no_mesh
from datagen.disk.errors import HyalineError
from datagen.scene.description import Scene
from datagen.scene.images import opened_image

if TYPE_CHECKING:
    import manifold3d

Opacity = Float32[np.ndarray, "tex_h tex_w"]
CornerUv = Float32[np.ndarray, "face 3 2"]

MAX_POINTS = 40_000
"""Points of an image's outlines; a finer image is halved until its outlines have no more."""
MAX_NEW_FACES = 100_000
"""Faces that cutting may add to an object before the image is halved."""
MIN_SIDE = 32
"""Texels per side below which an image is not halved."""
MAX_SIDE = 2048
"""Texels per side of an image for outlines; larger images are halved first."""
MAX_TILES = 4096
"""Largest number of repeats of the image on one face."""
DEVIATION = 0.1
"""Largest deviation of a simplified outline in texels."""
SNAP = 1e-6
"""Barycentric tolerance within which a point snaps to a corner or side."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cut:
    """A cut to be made once the object has its atlas; the image lies in the mesh's original uv."""

    opacity: Opacity
    """Opacity with row 0 on top, as in the image."""
    cutoff: float
    corner_uv: CornerUv
    """uv of the faces' corners, v up."""


def opacity_of(data: bytes, *, where: str) -> Opacity:
    """The opacity in an image file: its alpha, or its brightness if it has no alpha."""
    with opened_image(data, where=where) as image:
        has_alpha = image.has_transparency_data
        values = np.asarray(image.convert("RGBA").getchannel("A") if has_alpha else image.convert("L"))
    return values.astype(np.float32) / 255


def corner_uv_of(mesh: Mesh) -> CornerUv:
    """uv of each corner of each face."""
    return mesh.uv[mesh.faces]


def with_cuts(scene: Scene, cuts: Mapping[str, Cut]) -> Scene:
    """The scene with the objects of these names cut; an object without a remaining face has no mesh."""
    objects = []
    for item in scene.objects:
        if (cut := cuts.get(item.name)) is not None:
            where = f"scene {scene.name}: object {item.name}"
            if item.material.medium is not None:
                raise HyalineError(f"{where}: is solid, and a cutout would open it; expected a material for surfaces")
            objects.append(dataclasses.replace(item, mesh=cut_out(item.mesh, cut, where=where)))
        else:
            objects.append(item)
    return dataclasses.replace(scene, objects=tuple(objects))


def cut_out(mesh: Mesh, cut: Cut, *, where: str) -> Mesh:
    """The mesh without the parts that the image removes, or no mesh if that is everything.

    Opaque faces stay as they are; faces at outlines are split in their planes, with interpolated normals and uv.
    """
    assert len(cut.corner_uv) == len(mesh.faces), "an atlas keeps the faces in their order"
    opacity = cut.opacity
    repeats = bool(cut.corner_uv.min() < 0 or cut.corner_uv.max() > 1)
    while max(opacity.shape) > MAX_SIDE:
        opacity = _halved(opacity)
    while True:
        is_coarsest = min(opacity.shape) < 2 * MIN_SIDE
        stencil = Stencil(opacity, cut.cutoff, repeats=repeats)
        if is_coarsest or stencil.num_points <= MAX_POINTS:
            pieces = _Pieces(mesh, stencil, cut.corner_uv, where=where)
            if pieces.cut_all(at_most=None if is_coarsest else len(mesh.faces) + MAX_NEW_FACES):
                return pieces.mesh()
        opacity = _halved(opacity)


def _halved(opacity: Opacity) -> Opacity:
    """Means of two by two texels; a last odd row or column is dropped."""
    height, width = (size // 2 * 2 for size in opacity.shape)
    quarters = opacity[:height, :width].reshape(height // 2, 2, width // 2, 2)
    return quarters.mean(axis=(1, 3), dtype=np.float64).astype(np.float32)


class Stencil:
    """The opaque part of an image as polygons in uv: (0, 0) is the lower left corner, (1, 1) the upper right one.

    A tree of tiles, each cut from one twice as large, gives a face only the polygons around it.
    """

    def __init__(self, opacity: Opacity, cutoff: float, *, repeats: bool) -> None:
        upright = np.flipud(opacity).astype(np.float64)
        # Half a texel lies outside the outermost centres; everything beyond is cut away.
        around = np.pad(upright, 1, mode="wrap" if repeats else "edge")
        self._values = np.pad(around, 1, constant_values=cutoff - 1)
        self._cutoff = cutoff
        self._size = np.array(opacity.shape[::-1], np.float64)
        self.repeats = repeats
        self.num_points = count_crossings(around, cutoff)
        self._tiles: dict[tuple[int, int, int], manifold3d.CrossSection] = {}

    @cached_property
    def whole(self) -> "manifold3d.CrossSection":
        import manifold3d

        loops = outlines(self._values, self._cutoff)
        # The padding shifts by two texels, and the first centre is half a texel from the border.
        texels = manifold3d.CrossSection([loop - 1.5 for loop in loops], manifold3d.FillRule.EvenOdd)
        image = manifold3d.CrossSection.square(tuple(self._size))
        return (texels.simplify(DEVIATION) ^ image).scale(tuple(1 / self._size))

    def around(self, low: np.ndarray, high: np.ndarray) -> "manifold3d.CrossSection":
        """A part of the stencil that contains everything between two corners."""
        size = max(float((high - low).max()), 2.0**-12)
        level = int(np.floor(-np.log2(size)))
        if level <= 0:
            return self.whole
        column, row = (int(np.floor(value * 2**level)) for value in low)
        return self._tile(level, column, row)

    def _tile(self, level: int, column: int, row: int) -> "manifold3d.CrossSection":
        """Two by two tiles with sides of 2**-level, so that anything up to one tile in size fits into some of them."""
        import manifold3d

        if level == 0:
            return self.whole
        if (key := (level, column, row)) not in self._tiles:
            side = 2.0**-level
            square = manifold3d.CrossSection.square((2 * side, 2 * side)).translate((column * side, row * side))
            self._tiles[key] = self._tile(level - 1, column // 2, row // 2) ^ square
        return self._tiles[key]


@dataclass(kw_only=False)
class _Pieces:
    """Collects the remaining pieces of a mesh's faces."""

    source: Mesh
    stencil: Stencil
    corner_uv: CornerUv
    _: dataclasses.KW_ONLY
    where: str
    kept: list[int] = field(default_factory=list)
    """Faces that stay whole."""
    face: list[Int64[np.ndarray, " point"]] = field(default_factory=list)
    """The face of each new point."""
    shares: list[Float[np.ndarray, "point 3"]] = field(default_factory=list)
    """Barycentric coordinates of each new point on its face."""
    triangles: list[Int64[np.ndarray, "triangle 3"]] = field(default_factory=list)
    """Indices of new points."""
    num_points: int = 0

    def cut_all(self, *, at_most: int | None) -> bool:
        """Cuts every face; stops and returns False if there would be more than `at_most` faces."""
        num_faces = 0
        for index, corners in enumerate(self.corner_uv.astype(np.float64)):
            num_faces += self._cut(index, corners)
            if at_most is not None and num_faces > at_most:
                return False
        return True

    def _cut(self, index: int, corners: Float[np.ndarray, "3 2"]) -> int:
        """Cuts one face and returns the number of faces left of it."""
        import manifold3d

        if not np.isfinite(corners).all():
            raise HyalineError(f"{self.where}: some of its uv are not finite; a cutout needs uv, export the mesh again")
        turn = np.linalg.det([corners[1] - corners[0], corners[2] - corners[0]])
        if is_line := bool(turn == 0):  # All uv on a line or point of the image: its middle decides.
            middle = corners.mean(axis=0) if self.stencil.repeats else np.clip(corners.mean(axis=0), 1e-5, 1 - 1e-5)
            corners, turn = middle + 1e-6 * np.array([[-1, -1], [1, -1], [0, 1]]), 1.0
        loop = corners if turn > 0 else corners[::-1]
        area, polygons = 0.0, []
        for offset in self._tiles(loop):
            moved = loop - offset
            face = manifold3d.CrossSection([moved])
            left = self.stencil.around(moved.min(axis=0), moved.max(axis=0)) ^ face
            area += left.area() / max(face.area(), 1e-300)
            polygons.append([polygon + offset for polygon in left.to_polygons()])
        if area > (0.5 if is_line else 1 - SNAP):
            self.kept.append(index)
            return 1
        if area < SNAP or is_line:
            return 0
        return sum(self._add(index, corners, parts, is_turned=turn < 0) for parts in polygons if parts)

    def _tiles(self, loop: Float[np.ndarray, "3 2"]) -> Iterator[Float[np.ndarray, "2"]]:
        """Lower left corners of the repeats of the image that a face lies on."""
        if not self.stencil.repeats:
            yield np.zeros(2)
            return
        first, last = np.floor(loop.min(axis=0)), np.ceil(loop.max(axis=0))
        columns, rows = np.maximum(last - first, 1)
        if columns * rows > MAX_TILES:
            raise HyalineError(
                f"{self.where}: its cutout repeats {columns * rows:.3g} times on a face; expected at most {MAX_TILES}"
            )
        for row in range(int(rows)):
            for column in range(int(columns)):
                yield first + np.array([column, row])

    def _add(self, index: int, corners: np.ndarray, polygons: list[np.ndarray], *, is_turned: bool) -> int:
        """Adds the triangles of polygons on a face."""
        import manifold3d

        triangles = np.asarray(manifold3d.triangulate(polygons), np.int64).reshape(-1, 3)
        shares = _barycentric(np.concatenate(polygons), corners)
        flat = shares @ self.source.vertices[self.source.faces[index]].astype(np.float64)
        a, b, c = np.moveaxis(flat.astype(np.float32)[triangles].astype(np.float64), 1, 0)
        has_area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1) > 10 * MIN_AREA
        triangles = triangles[has_area]
        if is_turned:
            triangles = triangles[:, ::-1]
        self.face.append(np.full(len(shares), index))
        self.shares.append(shares)
        self.triangles.append(triangles + self.num_points)
        self.num_points += len(shares)
        return len(triangles)

    def mesh(self) -> Mesh:
        """The faces that stayed whole, then the pieces of the others, without unused vertices."""
        source = self.source
        faces = [source.faces[self.kept].astype(np.int64).reshape(-1, 3)]
        arrays = {name: [getattr(source, name)] for name in ("vertices", "normals", "uv")}
        if self.num_points:
            corners = source.faces[np.concatenate(self.face)]
            shares = np.concatenate(self.shares)
            for name, parts in arrays.items():
                parts.append(np.einsum("pk,pkc->pc", shares, getattr(source, name)[corners].astype(np.float64)))
            lengths = np.linalg.norm(arrays["normals"][1], axis=-1, keepdims=True)
            arrays["normals"][1] = arrays["normals"][1] / np.maximum(lengths, 1e-30)
            faces.append(np.concatenate(self.triangles) + len(source.vertices))
        used, faces = np.unique(np.concatenate(faces), return_inverse=True)
        if not len(used):
            return no_mesh()
        joined = {name: np.concatenate(parts)[used].astype(np.float32) for name, parts in arrays.items()}
        return Mesh(faces=faces.reshape(-1, 3).astype(np.int32), **joined)


def _barycentric(points: Float[np.ndarray, "point 2"], corners: Float[np.ndarray, "3 2"]) -> Float[np.ndarray, "p 3"]:
    """Shares of a triangle's corners in points on it; exactly 1 at a corner, exactly 0 on a side."""
    edges = np.stack([corners[1] - corners[0], corners[2] - corners[0]], axis=-1)
    second, third = np.linalg.solve(edges, (points - corners[0]).T)
    shares = np.stack([1 - second - third, second, third], axis=-1)
    shares[shares < SNAP] = 0
    return shares / shares.sum(axis=-1, keepdims=True)


# Outlines of the area where bilinearly interpolated values reach a level; texel (row r, column c) is centred on (c, r)


Grid = Float[np.ndarray, "row column"]
Loops = list[Float[np.ndarray, "point 2"]]

CORNERS = np.array([[0, 0], [0, 1], [1, 1], [1, 0]])
"""Corners of a cell as (row, column) offsets, in order around it; side i goes from corner i to the next."""


def count_crossings(values: Grid, level: float) -> int:
    """The number of points of the outlines."""
    above = values >= level
    return int((above[1:] != above[:-1]).sum() + (above[:, 1:] != above[:, :-1]).sum())


def outlines(values: Grid, level: float) -> Loops:
    """Closed loops around values of at least `level`, which are on their left; x is the column, y the row.

    The grid's border must be below the level, so that every loop closes. Between two texels on either side of the
    level, a loop passes where their interpolation reaches it; within a cell of four texels it is straight.
    """
    start, end = _segments(values, level)
    if not len(start):
        return []
    order = np.argsort(start)
    following = order[np.searchsorted(start, end, sorter=order)]  # Each crossing ends one segment and starts one.
    places = _places(values, level, start)
    loops, is_left = [], np.ones(len(start), bool)
    for first in range(len(start)):
        if not is_left[first]:
            continue
        walk, at = [], first
        while is_left[at]:
            is_left[at] = False
            walk.append(at)
            at = following[at]
        loops.append(places[walk])
    return loops


def _segments(values: Grid, level: float) -> tuple[Int64[np.ndarray, " segment"], Int64[np.ndarray, " segment"]]:
    """The crossings at which the segments of all cells start and end, as numbers of the grid's sides."""
    height, width = values.shape
    heights, widths = height - 1, width - 1
    corners = [values[r : r + heights, c : c + widths] - level for r, c in CORNERS]
    above = [corner >= 0 for corner in corners]
    joined = _is_joined(corners)
    row, column = np.mgrid[:heights, :widths]
    # Sides along rows come first, then those along columns.
    along = row * width + column
    across = height * width + along
    sides = [along, across + 1, along + width, across]
    starts, ends = [], []
    for side in range(4):
        leaves = above[side] & ~above[(side + 1) % 4]
        for steps in (1, 2, 3):
            other = (side + steps) % 4
            enters = ~above[other] & above[(other + 1) % 4]
            # In saddle cells, segments around joined corners lead to the next side, others to the previous one.
            is_chosen = leaves & enters & _is_chosen(above, steps, joined)
            starts.append(sides[side][is_chosen])
            ends.append(sides[other][is_chosen])
    return np.concatenate(starts), np.concatenate(ends)


def _is_joined(corners: list[Grid]) -> Bool[np.ndarray, "cell_row cell_column"]:
    """Where opposite corners are above the level and connected through the middle of the cell."""
    a, b, c, d = corners
    # The value at the saddle of the bilinear surface; its sign is that of the numerator times the denominator's.
    return (a * c - b * d) * (a + c - b - d) > 0


def _is_chosen(above: list[np.ndarray], steps: int, joined: np.ndarray) -> np.ndarray:
    is_saddle = (above[0] == above[2]) & (above[1] == above[3]) & (above[0] != above[1])
    if steps == 2:
        return ~is_saddle
    return ~is_saddle | (joined if steps == 1 else ~joined)


def _places(values: Grid, level: float, crossing: Int64[np.ndarray, " crossing"]) -> Float[np.ndarray, "crossing 2"]:
    """Positions of the crossings on their sides."""
    height, width = values.shape
    is_across = crossing >= height * width
    row, column = np.divmod(crossing - is_across * height * width, width)
    from_level = values[row, column] - level
    other = values[row + is_across, column + ~is_across] - level
    share = from_level / (from_level - other)
    return np.stack([column + share * ~is_across, row + share * is_across], axis=-1)
