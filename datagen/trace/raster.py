"""Owns the straight layers by rasterising: every surface along each pixel's ray, in one pass over the triangles.

Much faster than tracing (trace/peel.py) where a whole view is wanted; equal to it on every ray in general position.
Needs neither Mitsuba nor a scene: rotate, rasterise, keep the nearest hits of each pixel.

In camera space, scaled so that the ray through image point (x, y) runs along d = (x, y, 1), a triangle (v0, v1, v2) is
hit where its edge functions e_i = d . (v_j x v_k) all have the sign of det(v0, v1, v2). They are the hit's barycentric
coordinates but for their sum, perspective included, and its z is det / (e_0 + e_1 + e_2). Nothing is divided by a
vertex's z, so triangles that cross the camera's plane need no clipping, and what lies behind it drops out by its sign.
Source: Olano and Greer 1997, "Triangle Scan Conversion using 2D Homogeneous Coordinates".

Watertight: the two triangles at an edge compute e from the same numbers in the same order, so that one gets exactly the
negative of the other (float64 rounding is symmetric, and nothing here may be fused or reordered). Where e is 0 the
top-left rule decides. No vertex is snapped to a grid, which would move silhouettes and uv.
"""

import math
from typing import TYPE_CHECKING

import numba
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, UInt8, UInt16

from datagen.data.cameras import Cameras
from datagen.data.layers import Layers
from datagen.data.meshes import Mesh, is_there
from datagen.data.number_formats import UV_SCALE

if TYPE_CHECKING:
    from builtins import range as prange  # numba's stands for it, and splits the loop among threads.
else:
    from numba import prange

STRIP_ROWS = 32
"""Rows that one thread does at a time: their hits stay in its cache."""

CHUNKS = 32
"""Parts in which triangles are sorted into strips; any number gives the same order."""

WIDE = 8
"""Triangles wider than this many pixels get the ends of each row computed instead of tried out."""

WAITING = 2048
"""Hits that are found before they are sorted into their pixels."""

TINY = 2.2250738585072014e-308
"""The least positive number that no floating-point mode takes for zero."""

MARGIN = 1e-6
"""Pixels by which bounding boxes are larger than they should be, against rounding; e decides, not the box."""


class Rasterizer:
    """A geometry, ready to peel any number of views of pinhole cameras; what `Peeler` does, by other means."""

    def __init__(self, meshes: tuple[Mesh, ...]) -> None:
        there = [(index + 1, mesh) for index, mesh in enumerate(meshes) if is_there(mesh)]
        first_vertex = np.cumsum([0, *(len(mesh.vertices) for _, mesh in there)])
        empty = np.zeros((0, 3), np.float32)
        self._vertices = np.concatenate([empty, *(mesh.vertices for _, mesh in there)])
        self._uv = np.concatenate([empty[:, :2], *(mesh.uv for _, mesh in there)])
        faces = [mesh.faces + first for (_, mesh), first in zip(there, first_vertex, strict=False)]
        self._faces = np.concatenate([np.zeros((0, 3), np.int32), *faces]).astype(np.int32)
        self._object_id = np.repeat(
            np.array([object_id for object_id, _ in there], np.uint8), [len(mesh.faces) for _, mesh in there]
        )

    def peel(self, cameras: Cameras, view: int, num_layers: int) -> tuple[Layers, float]:
        """The layers of one view, and the share of its rays that had more hits than layers."""
        layers, has_more = self.rasterize(cameras, view, num_layers)
        return layers, float(has_more.mean())

    def rasterize(self, cameras: Cameras, view: int, num_layers: int) -> tuple[Layers, Bool[np.ndarray, "h w"]]:
        """The layers of one view, and of each pixel whether its ray had more hits.

        Surfaces at one distance, to the last bit of float32, keep the order of their objects and faces.
        """
        width, height = cameras.width, cameras.height
        focal = 0.5 * width / math.tan(0.5 * cameras.fov_x)
        world_from_camera = cameras.world_from_camera[view]
        # Rays start where those of the tracer do, which are float32.
        origin = world_from_camera[:3, 3].astype(np.float32).astype(np.float64)
        scale = np.array([[focal, 0, -0.5 * width], [0, -focal, -0.5 * height], [0, 0, -1]])
        projected = _project(self._vertices, scale @ world_from_camera[:3, :3].T, origin)
        order, first_of_strip = _sort_into_strips(projected, self._faces, width, height)
        shape = (num_layers, height, width)
        uv, object_id = np.empty((*shape, 2), np.uint16), np.empty(shape, np.uint8)
        depth, has_more = np.empty(shape, np.float32), np.empty((height, width), np.bool_)
        _fill(
            projected,
            self._faces,
            self._uv,
            self._object_id,
            order,
            first_of_strip,
            focal,
            uv,
            object_id,
            depth,
            has_more,
            numba.get_num_threads(),
        )
        return Layers(uv=uv, object_id=object_id, depth=depth), has_more


@numba.njit(parallel=True, cache=True, nogil=True)
def _project(
    vertices: Float32[np.ndarray, "vertex 3"],
    image_from_world: Float64[np.ndarray, "3 3"],
    origin: Float64[np.ndarray, "3"],
) -> Float64[np.ndarray, "vertex 5"]:
    """Of every vertex x, y, z such that its image is at (x / z, y / z) pixels, and that image; z is metres ahead."""
    out = np.empty((len(vertices), 5))
    m = image_from_world
    for index in prange(len(vertices)):
        px, py, pz = (vertices[index, 0] - origin[0], vertices[index, 1] - origin[1], vertices[index, 2] - origin[2])
        x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz
        y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz
        z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz
        out[index, 0], out[index, 1], out[index, 2] = x, y, z
        inverse = 1 / z if z > 0 else 0.0
        out[index, 3], out[index, 4] = x * inverse, y * inverse
    return out


@numba.njit(inline="always")
def _box(projected, a, b, c, width, height):
    """The pixels whose centres a triangle can cover: first and last column and row, last < first where none."""
    za, zb, zc = projected[a, 2], projected[b, 2], projected[c, 2]
    if za > 0 and zb > 0 and zc > 0:
        xa, xb, xc = projected[a, 3], projected[b, 3], projected[c, 3]
        ya, yb, yc = projected[a, 4], projected[b, 4], projected[c, 4]
        # Clipped as floats: far outside of the view they would be no integers.
        x0 = math.ceil(max(min(xa, xb, xc) - 0.5 - MARGIN, 0.0))
        y0 = math.ceil(max(min(ya, yb, yc) - 0.5 - MARGIN, 0.0))
        x1 = math.floor(max(min(max(xa, xb, xc) - 0.5 + MARGIN, width - 1.0), -1.0))
        y1 = math.floor(max(min(max(ya, yb, yc) - 0.5 + MARGIN, height - 1.0), -1.0))
        return x0, x1, y0, y1
    # It crosses the camera's plane, or lies behind. Outside one side of the view, it is not seen.
    xa, xb, xc = projected[a, 0], projected[b, 0], projected[c, 0]
    ya, yb, yc = projected[a, 1], projected[b, 1], projected[c, 1]
    if (
        (za <= 0 and zb <= 0 and zc <= 0)
        or (xa < 0 and xb < 0 and xc < 0)
        or (ya < 0 and yb < 0 and yc < 0)
        or (xa > width * za and xb > width * zb and xc > width * zc)
        or (ya > height * za and yb > height * zb and yc > height * zc)
    ):
        return 0, -1, 0, -1
    return 0, width - 1, 0, height - 1


@numba.njit(parallel=True, cache=True, nogil=True)
def _sort_into_strips(
    projected: Float64[np.ndarray, "vertex 5"], faces: Int32[np.ndarray, "face 3"], width: int, height: int
) -> tuple[Int32[np.ndarray, " entry"], np.ndarray]:
    """The faces that each strip of rows may show, in their order, and where in that list each strip begins."""
    num_strips = (height + STRIP_ROWS - 1) // STRIP_ROWS
    strips = np.empty((len(faces), 2), np.int16)
    place = np.zeros((CHUNKS, num_strips), np.int64)
    for chunk in prange(CHUNKS):
        for face in range(len(faces) * chunk // CHUNKS, len(faces) * (chunk + 1) // CHUNKS):
            x0, x1, y0, y1 = _box(projected, faces[face, 0], faces[face, 1], faces[face, 2], width, height)
            if x1 < x0 or y1 < y0:
                strips[face, 0], strips[face, 1] = 0, -1
                continue
            first, last = y0 // STRIP_ROWS, y1 // STRIP_ROWS
            strips[face, 0], strips[face, 1] = first, last
            for strip in range(first, last + 1):
                place[chunk, strip] += 1
    first_of_strip = np.empty(num_strips + 1, np.int64)
    total = 0
    for strip in range(num_strips):
        first_of_strip[strip] = total
        for chunk in range(CHUNKS):
            count = place[chunk, strip]
            place[chunk, strip] = total
            total += count
    first_of_strip[num_strips] = total
    order = np.empty(total, np.int32)
    for chunk in prange(CHUNKS):
        for face in range(len(faces) * chunk // CHUNKS, len(faces) * (chunk + 1) // CHUNKS):
            for strip in range(strips[face, 0], strips[face, 1] + 1):
                order[place[chunk, strip]] = face
                place[chunk, strip] += 1
    return order, first_of_strip


@numba.njit(parallel=True, cache=True, nogil=True)
def _fill(
    projected: Float64[np.ndarray, "vertex 5"],
    faces: Int32[np.ndarray, "face 3"],
    vertex_uv: Float32[np.ndarray, "vertex 2"],
    face_id: UInt8[np.ndarray, " face"],
    order: Int32[np.ndarray, " entry"],
    first_of_strip: np.ndarray,
    focal: float,
    uv: UInt16[np.ndarray, "layer h w 2"],
    object_id: UInt8[np.ndarray, "layer h w"],
    depth: Float32[np.ndarray, "layer h w"],
    has_more: Bool[np.ndarray, "h w"],
    num_threads: int,
) -> None:
    """Rasterises every strip and writes its layers; threads take every n-th strip, as views are uneven."""
    num_layers, height, width = object_id.shape
    for thread in prange(num_threads):
        # The hits that wait to be sorted into pixels. A triangle fills the strip at most, and one place is for what is
        # written and not kept.
        where = np.empty((WAITING + STRIP_ROWS * width + 1, 2), np.int32)
        edges = np.empty((WAITING + STRIP_ROWS * width + 1, 4), np.float64)
        # The sorted lists of the strip's pixels.
        count = np.empty(STRIP_ROWS * width, np.int32)
        zs = np.empty((STRIP_ROWS * width, num_layers), np.float32)
        codes = np.empty((STRIP_ROWS * width, num_layers), np.uint32)
        ids = np.empty((STRIP_ROWS * width, num_layers), np.uint8)
        for strip in range(thread, len(first_of_strip) - 1, num_threads):
            top, bottom = strip * STRIP_ROWS, min((strip + 1) * STRIP_ROWS, height)
            count[:] = 0
            waiting = 0
            for entry in range(first_of_strip[strip], first_of_strip[strip + 1]):
                face = order[entry]
                waiting = _find_hits(projected, faces, face, top, bottom, width, height, where, edges, waiting)
                if waiting > WAITING:
                    _sort_hits(where, edges, waiting, faces, vertex_uv, face_id, count, zs, codes, ids)
                    waiting = 0
            _sort_hits(where, edges, waiting, faces, vertex_uv, face_id, count, zs, codes, ids)
            _write(count, zs, codes, ids, top, bottom, focal, uv, object_id, depth, has_more)


@numba.njit(inline="always")
def _find_hits(projected, faces, face, top, bottom, width, height, where, edges, waiting):
    """Adds a triangle's hits in rows [top, bottom) to those that wait: (pixel, face) and (e_0, e_1, e_2, det)."""
    a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
    x0, x1, y0, y1 = _box(projected, a, b, c, width, height)
    y0, y1 = max(y0, top), min(y1, bottom - 1)
    # Normals of the planes through the eye and each side; e_i = nx x + ny y + nz.
    xa, ya, za = projected[a, 0], projected[a, 1], projected[a, 2]
    xb, yb, zb = projected[b, 0], projected[b, 1], projected[b, 2]
    xc, yc, zc = projected[c, 0], projected[c, 1], projected[c, 2]
    nx0, ny0, nz0 = yb * zc - zb * yc, zb * xc - xb * zc, xb * yc - yb * xc
    nx1, ny1, nz1 = yc * za - zc * ya, zc * xa - xc * za, xc * ya - yc * xa
    nx2, ny2, nz2 = ya * zb - za * yb, za * xb - xa * zb, xa * yb - ya * xb
    det = xa * nx0 + ya * ny0 + za * nz0
    if det == 0:
        return waiting
    sign = 1.0 if det > 0 else -1.0
    det = sign * det
    nx0, ny0, nz0 = sign * nx0, sign * ny0, sign * nz0
    nx1, ny1, nz1 = sign * nx1, sign * ny1, sign * nz1
    nx2, ny2, nz2 = sign * nx2, sign * ny2, sign * nz2
    # The top-left rule: on an edge counts as inside where a step to the right, or else down, leads inside.
    least0 = 0.0 if (nx0 > 0) | ((nx0 == 0) & (ny0 > 0)) else TINY
    least1 = 0.0 if (nx1 > 0) | ((nx1 == 0) & (ny1 > 0)) else TINY
    least2 = 0.0 if (nx2 > 0) | ((nx2 == 0) & (ny2 > 0)) else TINY
    for row in range(y0, y1 + 1):
        y = row + 0.5
        row0, row1, row2 = ny0 * y + nz0, ny1 * y + nz1, ny2 * y + nz2
        first, last = x0, x1
        if x1 - x0 > WIDE:
            first, last = _narrow(nx0, row0, abs(nz0), first, last)
            first, last = _narrow(nx1, row1, abs(nz1), first, last)
            first, last = _narrow(nx2, row2, abs(nz2), first, last)
        pixel = (row - top) * width
        for column in range(first, last + 1):
            x = column + 0.5
            e0, e1, e2 = nx0 * x + row0, nx1 * x + row1, nx2 * x + row2
            # Written in any case and kept if inside: of a small triangle no branch could be predicted.
            where[waiting, 0], where[waiting, 1] = pixel + column, face
            edges[waiting, 0], edges[waiting, 1], edges[waiting, 2], edges[waiting, 3] = e0, e1, e2, det
            waiting += int((e0 >= least0) & (e1 >= least1) & (e2 >= least2))
    return waiting


@numba.njit(inline="always")
def _sort_hits(where, edges, waiting, faces, vertex_uv, face_id, count, zs, codes, ids):
    """Sorts the hits that wait into the lists of their pixels."""
    num_layers = zs.shape[1]
    for index in range(waiting):
        e0, e1, e2 = edges[index, 0], edges[index, 1], edges[index, 2]
        total = e0 + e1 + e2
        if total <= 0:
            continue
        inverse = 1 / total
        z = np.float32(edges[index, 3] * inverse)
        pixel, face = where[index, 0], where[index, 1]
        place = count[pixel]
        if place >= num_layers:
            count[pixel] = num_layers + 1
            place = num_layers - 1
            if zs[pixel, place] <= z:
                continue
        else:
            count[pixel] = place + 1
        while place > 0 and zs[pixel, place - 1] > z:
            zs[pixel, place] = zs[pixel, place - 1]
            codes[pixel, place] = codes[pixel, place - 1]
            ids[pixel, place] = ids[pixel, place - 1]
            place -= 1
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        b0, b1, b2 = e0 * inverse, e1 * inverse, e2 * inverse
        u = b0 * vertex_uv[a, 0] + b1 * vertex_uv[b, 0] + b2 * vertex_uv[c, 0]
        v = b0 * vertex_uv[a, 1] + b1 * vertex_uv[b, 1] + b2 * vertex_uv[c, 1]
        zs[pixel, place] = z
        codes[pixel, place] = np.uint32(_code(u) << 16 | _code(v))
        ids[pixel, place] = face_id[face]


@numba.njit(inline="always")
def _code(value):
    return int(min(max(value, 0.0), 1.0) * UV_SCALE + 0.5)


@numba.njit(inline="always")
def _write(count, zs, codes, ids, top, bottom, focal, uv, object_id, depth, has_more):
    """Turns the lists of a strip's pixels into layers."""
    num_layers, height, width = object_id.shape
    stretch = np.empty(width, np.float64)
    for row in range(top, bottom):
        down = (row + 0.5 - 0.5 * height) / focal
        for column in range(width):
            across = (column + 0.5 - 0.5 * width) / focal
            stretch[column] = math.sqrt(across * across + down * down + 1)
            has_more[row, column] = count[(row - top) * width + column] > num_layers
        for layer in range(num_layers):
            for column in range(width):
                pixel = (row - top) * width + column
                is_hit = layer < count[pixel]
                code = codes[pixel, layer] if is_hit else np.uint32(0)
                uv[layer, row, column, 0] = code >> np.uint32(16)
                uv[layer, row, column, 1] = code & np.uint32(0xFFFF)
                object_id[layer, row, column] = ids[pixel, layer] if is_hit else np.uint8(0)
                depth[layer, row, column] = zs[pixel, layer] * stretch[column] if is_hit else np.float32(0)


@numba.njit(inline="always")
def _narrow(slope, offset, size, first, last):
    """The columns of [first, last] where slope * x + offset can be positive, one more at each end against rounding."""
    # Where the slope is lost in the rounding of the offset, its zero is nowhere.
    if abs(slope) <= 1e-10 * size:
        return first, last
    zero = -offset / slope - 0.5
    if slope > 0:
        return max(first, int(min(max(zero, first + 1.0), last + 2.0)) - 1), last
    return first, min(last, int(min(max(zero, first - 2.0), last - 1.0)) + 2)
