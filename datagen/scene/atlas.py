"""The uv atlas: unwraps a mesh so that every surface point has its own texels, and bakes values into texels.

Texture arrays are (tex_h, tex_w, c), row 0 on top: texel (r, c) is centred on u = (c + 0.5) / size,
v = 1 - (r + 0.5) / size.
"""

import contextlib
import hashlib
import io
import sys
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float32, Int32

from datagen.data.meshes import Mesh, check_numbers, is_there, mesh_from
from datagen.disk.errors import HyalineError
from datagen.disk.storage import commit, private_cache
from datagen.machine.processes import ChildError, arrays_from_child

if TYPE_CHECKING:
    import xatlas

RESOLUTION = 1024
"""Texels per side for which the charts are packed; xatlas may need more."""
PADDING = 5
"""Texels between charts at `RESOLUTION`, which leaves one texel of gutter at 256."""
BOX = 1024.0
"""Longest side given to xatlas, in its units: it treats triangles below 1e-7 square units as degenerate."""
MAX_CHILDREN = 4
"""Processes that unwrap in parallel; each takes half a second to start."""
MAX_KEPT_BYTES = 1 << 30
"""Size limit for each kind of kept arrays."""

Arrays = Mapping[str, np.ndarray]


def unwrap(mesh: Mesh, *, where: str) -> Mesh:
    """The same surface with unique uv for every point, the same bytes every time; faces keep their order.

    Vertices are duplicated along the atlas's seams, with the same position and normal.
    """
    return unwrap_all({where: mesh})[where]


def unwrap_all(meshes: dict[str, Mesh]) -> dict[str, Mesh]:
    """`unwrap` for many meshes, named by their keys in errors; by the user's cache, or in a few child processes: xatlas
    hangs on infinite coordinates and could crash."""
    from datagen.machine.processes import num_cores

    for where, mesh in meshes.items():
        check_numbers(mesh, where=where)
        if not np.isfinite(mesh.normals).all():
            raise HyalineError(f"{where}: normals are not finite; expected finite ones, xatlas hangs on others")
    surfaces = {where: _surface(mesh) for where, mesh in meshes.items()}
    code, version = Path(__file__), metadata.version("xatlas")
    keys = {where: key_of(surface, [code], version) for where, surface in surfaces.items()}
    atlases = find_arrays("atlases", keys.values())
    # Surfaces that differ only in position and size are unwrapped once.
    first = {key: where for where, key in reversed(keys.items()) if key not in atlases}
    shares = _share_out({where: surfaces[where] for where in first.values()}, min(MAX_CHILDREN, num_cores()))
    with ThreadPoolExecutor(max_workers=MAX_CHILDREN) as pool:
        made = {keys[where]: atlas for share in pool.map(_unwrap_in_child, shares) for where, atlas in share.items()}
    done = {where: _with_uv(mesh, {**atlases, **made}[keys[where]], where=where) for where, mesh in meshes.items()}
    keep_arrays("atlases", made)
    return done


def _surface(mesh: Mesh) -> Arrays:
    """The arrays from which an atlas is made, its vertices in a box of `BOX` units."""
    inside = mesh.vertices.astype(np.float64) - mesh.vertices.min(axis=0)
    return {
        "vertices": (inside * (BOX / (float(inside.max()) or 1.0))).astype(np.float32),
        "normals": mesh.normals.astype(np.float32),
        "faces": mesh.faces.astype(np.uint32),
    }


def _share_out(surfaces: dict[str, Arrays], most: int) -> list[dict[str, Arrays]]:
    """Surfaces divided into at most `most` shares of about equal numbers of faces, none of them empty."""
    shares: list[dict[str, Arrays]] = [{} for _ in range(min(most, len(surfaces)))]
    for where, surface in sorted(surfaces.items(), key=lambda item: -len(item[1]["faces"])):
        least = min(shares, key=lambda share: sum(len(other["faces"]) for other in share.values()))
        least[where] = surface
    return shares


def _unwrap_in_child(surfaces: dict[str, Arrays]) -> dict[str, Arrays]:
    arrays: dict[str, np.ndarray] = {}
    for index, surface in enumerate(surfaces.values()):
        arrays |= {f"{index}.{name}": values for name, values in surface.items()}
    cpu_s = 60 + sum(len(surface["faces"]) for surface in surfaces.values()) // 200
    try:
        answers = arrays_from_child("datagen.scene.atlas", arrays, cpu_s=cpu_s)
    except ChildError as error:
        where = ", ".join(surfaces)
        raise HyalineError(
            f"{where}: unwrapping failed ({error}); run the same command again, simplify the mesh, or bring one with uv"
        ) from None
    return {
        where: {name: answers[f"{index}.{name}"] for name in ("vertex_of", "faces", "uv")}
        for index, where in enumerate(surfaces)
    }


def faces_apart(mesh: Mesh) -> Mesh:
    """The mesh with a chart for each face, two in each square of a grid."""
    place = np.arange(len(mesh.faces))
    side = int(np.ceil(np.sqrt((len(place) + 1) // 2)))
    lower = np.array([(0.1, 0.1), (0.8, 0.1), (0.1, 0.8)])
    inside = np.where(place[:, None, None] % 2, 1 - lower, lower)
    uv = (np.stack([place // 2 % side, place // 2 // side], axis=-1)[:, None] + inside) / side
    vertices, normals = (values[mesh.faces].reshape(-1, 3) for values in (mesh.vertices, mesh.normals))
    return mesh_from(vertices, np.arange(3 * len(place)).reshape(-1, 3), normals, uv.reshape(-1, 2))


def bake_positions(mesh: Mesh, size: int) -> Float32[np.ndarray, "tex_h tex_w 3"]:
    """World position of the surface at each texel centre; gutters hold the nearest chart's border.

    Zeros for a mesh without faces. Source: paper section 4.3, Eq. 3.
    """
    return bake_corners(mesh, mesh.vertices[mesh.faces].astype(np.float64), size)


def bake_corners(mesh: Mesh, values: Float[np.ndarray, "face 3 c"], size: int) -> Float32[np.ndarray, "tex_h tex_w c"]:
    """Values at faces' corners, interpolated at each texel centre; gutters hold the nearest chart's border."""
    channels = values.shape[-1]
    baked = np.zeros((size * size, channels), np.float32)
    if not is_there(mesh):
        return baked.reshape(size, size, channels)
    covered = np.zeros(size * size, bool)
    # A chart thinner than a texel may miss every centre, so the texels of its corners are set first.
    uv_texel = np.clip(np.floor(_texel_coordinates(mesh, size) + 0.5).astype(np.int64), 0, size - 1)
    corner = np.argsort(mesh.faces, axis=None, kind="stable")  # The last vertex in a texel counts.
    at_corner = (uv_texel[:, 1] * size + uv_texel[:, 0])[mesh.faces.reshape(-1)[corner]]
    baked[at_corner] = values.reshape(-1, channels)[corner]
    covered[at_corner] = True
    for face, texel, weights in _rasterise(mesh, size):
        inside = weights.min(axis=-1) >= -1e-9
        baked[texel[inside]] = np.einsum("pk,pkc->pc", weights[inside], values[face[inside]])
        covered[texel[inside]] = True
    baked = baked.reshape(size, size, channels)
    if covered.all():
        return baked
    from scipy.ndimage import distance_transform_edt

    nearest = distance_transform_edt(~covered.reshape(size, size), return_distances=False, return_indices=True)
    assert isinstance(nearest, np.ndarray)
    return baked[nearest[0], nearest[1]]


def coverage(mesh: Mesh, size: int) -> Int32[np.ndarray, "tex_h tex_w"]:
    """Number of triangles whose interior contains each texel centre: at most 1 if the atlas does not overlap."""
    counts = np.zeros(size * size, np.int32)
    for _, texel, weights in _rasterise(mesh, size):
        counts += np.bincount(texel[weights.min(axis=-1) > 1e-7], minlength=size * size).astype(np.int32)
    return counts.reshape(size, size)


# Rasterising


_PAIRS_AT_ONCE = 1 << 18
_SLACK = 1e-6
"""Tolerance in texels for centres that rounding moves off a face's edge."""


def _texel_coordinates(mesh: Mesh, size: int) -> np.ndarray:
    """The vertices' uv as (column, row), where texel centres are integers."""
    uv = mesh.uv.astype(np.float64)
    return np.stack([uv[:, 0] * size - 0.5, (1 - uv[:, 1]) * size - 0.5], axis=-1)


def _rasterise(mesh: Mesh, size: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yields (face, texel, barycentric weights) of all texel centres in each face or just next to it, in pieces."""
    corners = _texel_coordinates(mesh, size)[mesh.faces]
    a, b, c = np.moveaxis(corners, 1, 0)
    area = _cross(b - a, c - a)
    low = np.clip(np.ceil(corners[..., 1].min(axis=1) - _SLACK), 0, size).astype(np.int64)
    high = np.clip(np.floor(corners[..., 1].max(axis=1) + _SLACK), -1, size - 1).astype(np.int64)
    kept = np.flatnonzero((high >= low) & (np.abs(area) > 1e-12))
    # One item per row of texels through a face, from its first to its last column.
    heights = (high - low + 1)[kept]
    row_face = np.repeat(kept, heights)
    row = _counted(heights) + low[row_face]
    first, last = _columns(corners[row_face], row)
    first = np.clip(np.ceil(first - _SLACK), 0, size).astype(np.int64)
    last = np.clip(np.floor(last + _SLACK), -1, size - 1).astype(np.int64)
    widths = np.maximum(last - first + 1, 0)
    ends = np.cumsum(widths)
    start = 0
    while start < len(row_face):
        before = ends[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, before + _PAIRS_AT_ONCE, side="right")))
        part = slice(start, stop)
        face, y = np.repeat(row_face[part], widths[part]), np.repeat(row[part], widths[part])
        x = _counted(widths[part]) + np.repeat(first[part], widths[part])
        # Relative to the corner, which is precise enough for slivers far from the origin.
        from_a = np.stack([x, y], axis=-1) - a[face]
        at_b = _cross(from_a, (c - a)[face]) / area[face]
        at_c = _cross((b - a)[face], from_a) / area[face]
        yield face, y * size + x, np.stack([1 - at_b - at_c, at_b, at_c], axis=-1)
        start = stop


def _columns(corners: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest column (n,) where triangles (n, 3, 2) cross a row; near a tip, those of the nearest edge."""
    first, last = np.full(len(row), np.inf), np.full(len(row), -np.inf)
    for start, end in ((0, 1), (1, 2), (2, 0)):
        p, q = corners[:, start], corners[:, end]
        rise = q[:, 1] - p[:, 1]
        is_level = np.abs(rise) < _SLACK
        t = np.where(is_level, 0.0, (row - p[:, 1]) / np.where(is_level, 1.0, rise))
        crosses = (np.minimum(p[:, 1], q[:, 1]) - _SLACK <= row) & (row <= np.maximum(p[:, 1], q[:, 1]) + _SLACK)
        for x in (p[:, 0] + np.clip(t, 0, 1) * (q[:, 0] - p[:, 0]), np.where(is_level, q[:, 0], np.nan)):
            first = np.where(crosses, np.fmin(first, x), first)
            last = np.where(crosses, np.fmax(last, x), last)
    return np.where(first <= last, first, 0.0), np.where(first <= last, last, -1.0)


def _counted(lengths: np.ndarray) -> np.ndarray:
    """0, 1, ..., n - 1 for each n in `lengths`, concatenated."""
    return np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


# Arrays that take long to compute, in the user's cache. Several processes may find and keep the same ones at once


def key_of(arrays: Arrays, makers: Sequence[Path], *facts: object) -> str:
    """A digest of the arrays that others are computed from, the code in `makers`, and anything else that matters."""
    digest = hashlib.sha256(repr(facts).encode())
    for path in makers:
        digest.update(path.read_bytes())
    for name, values in sorted(arrays.items()):
        digest.update(f"{name} {values.dtype.str} {values.shape}".encode())
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def find_arrays(kind: str, keys: Iterable[str]) -> dict[str, Arrays]:
    """The arrays that were kept under each of some keys, unless they are damaged."""
    found: dict[str, Arrays] = {}
    if (cache := private_cache(kind)) is not None:
        for key in keys:
            with (
                contextlib.suppress(ValueError, OSError, EOFError, zipfile.BadZipFile),
                (cache / f"{key}.npz").open("rb") as file,
                np.load(file) as kept,  # With a checksum of each array.
            ):
                found[key] = dict(kept)
    return found


def keep_arrays(kind: str, made: Mapping[str, Arrays]) -> None:
    """Keeps arrays by key if the cache is writable; the oldest of their kind make room."""
    if not made or (cache := private_cache(kind)) is None:
        return
    with contextlib.suppress(OSError):  # A full disk, or another process that deletes the same files.
        for key, arrays in made.items():
            buffer = io.BytesIO()
            np.savez(buffer, allow_pickle=False, **arrays)
            commit(cache / f"{key}.npz", buffer.getvalue())
        kept = sorted(((path.stat(), path) for path in cache.glob("*.npz")), key=lambda item: -item[0].st_mtime)
        for size, (_, path) in zip(np.cumsum([stat.st_size for stat, _ in kept]), kept, strict=True):
            if size > MAX_KEPT_BYTES:
                path.unlink(missing_ok=True)


# xatlas and its child process


def _with_uv(mesh: Mesh, atlas: Arrays, *, where: str) -> Mesh:
    vertex_of, faces, uv = atlas["vertex_of"].astype(np.int64), atlas["faces"].astype(np.int32), atlas["uv"]
    if not ((uv >= 0) & (uv <= 1)).all():  # NaN, too.
        raise HyalineError(f"{where}: xatlas's uv span {uv.min():g} to {uv.max():g}; expected [0, 1]")
    assert np.array_equal(vertex_of[faces], mesh.faces), "xatlas keeps the faces and their order"
    return mesh_from(mesh.vertices[vertex_of], faces, mesh.normals[vertex_of], uv)


def _unwrap_here(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, ...]:
    """Source vertex of each new one, new faces, and uv in [0, 1], by xatlas in this process."""
    atlas = _pack(vertices, faces, normals, PADDING)
    # The atlas may be larger than requested (xatlas 0.0.11); its gutter is then too narrow.
    if (longest := max(atlas.width, atlas.height)) > 1.1 * RESOLUTION:
        atlas = _pack(vertices, faces, normals, -(-PADDING * longest // RESOLUTION))
    vertex_of, new_faces, uv = atlas[0]
    return vertex_of, new_faces, uv


def _pack(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, padding: int) -> "xatlas.Atlas":
    import xatlas

    atlas = xatlas.Atlas()
    atlas.add_mesh(vertices, faces, normals)
    options = xatlas.PackOptions()
    options.resolution = RESOLUTION
    options.padding = padding
    # A closed strip can unroll into a chart four times as long as the atlas (xatlas 0.0.11), which squeezes all others.
    options.max_chart_size = RESOLUTION
    options.bilinear = True
    options.rotate_charts_to_axis = True
    atlas.generate(pack_options=options)
    if atlas.atlas_count != 1:
        raise HyalineError(f"xatlas made {atlas.atlas_count} atlases; expected 1")
    return atlas


def _child(source: Path, target: Path) -> None:
    answers: dict[str, np.ndarray] = {}
    with np.load(source) as arrays:
        for index in range(len(arrays.files) // 3):
            vertices, faces, normals = (arrays[f"{index}.{name}"] for name in ("vertices", "faces", "normals"))
            vertex_of, new_faces, uv = _unwrap_here(vertices, faces, normals)
            answers |= {f"{index}.vertex_of": vertex_of, f"{index}.faces": new_faces, f"{index}.uv": uv}
    np.savez(target, allow_pickle=False, **answers)


if __name__ == "__main__":
    _child(Path(sys.argv[1]), Path(sys.argv[2]))
