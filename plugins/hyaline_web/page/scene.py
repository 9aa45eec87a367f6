"""The page's data of a scene: meshes, optics, texels, weights and cameras, as arrays and a manifest.

Arrays are text: in few bits where asked for, sorted by bytes, deflated, base64.
"""

import base64
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, cast

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32, Shaped, UInt16, UInt32
from scipy.ndimage import binary_dilation
from torch import Tensor

from datagen.data.dataset import Dataset
from datagen.data.geometries import read_meshes
from datagen.data.images import srgb_from_linear, to_8bit
from datagen.data.layers import UV_SCALE, quantize_uv, round_mantissa
from datagen.data.meshes import PLASTIC, Mesh, is_there, open_edges
from datagen.data.paths import follows_light
from datagen.disk.records import Json
from datagen.scene.description import CameraRig, Scene
from datagen.scene.edits import CLEAR_GLASS, GREY
from datagen.scene.folder import open_scene
from datagen.scene.materials import Material
from datagen.scene.media import RAY_OFFSET, SKIP_COSINE
from datagen.trace.surface_hits import MIN_COSINE
from datagen.trace.surface_tables import EVENTS, Tints, tints_of
from model.methods.page import MethodPage, fours, package_text
from model.methods.protocol import MethodConfig
from model.methods.renderer import Renderer
from model.nets.pixel_mlp import LEAKY_SLOPE
from model.nets.texture import NeuralTextures, TexturePyramid, level_scales, texel_centers

Quality = Literal["small", "exact"]
"""small: texels, normals and uv in few bits. exact: every number as it is."""

DTYPES = ("uint8", "uint16", "uint32", "float32", "float64")
"""Number types that unpack.js reads."""

MEMORY = 6
"""zlib's memory level: with a low one, few numbers share a code table, which then fits them better."""

POSITION_STEPS = 0xFFFF
"""Steps of a vertex's position along each side of its object's box."""

NORMAL_STEPS = 0xFFFFFE
"""Steps of a coordinate of an octahedral normal in 24 bits: an even number, so that 0 is exact."""

STEPS = 16
"""Steps per standard deviation of texels in a small page: a page of the demo loses 0.4 to 1.4 dB against Python."""

MAX_CODE = 8191
"""Largest code, so that the difference of two fits into 16 bits."""

Places = list[list[list[int]]]
"""For each texture and level: its first texel, its width, the texels from one of its rows to the next."""

TintPlaces = list[list[int] | None]
"""For each object its first texel, and the number of columns and rows; None if it has a single colour."""


@dataclass(kw_only=True)
class Packed:
    """Named arrays in the order in which they are added."""

    entries: list[Json] = field(default_factory=list)
    """The description of each array for unpack.js."""
    parts: list[bytes] = field(default_factory=list)

    def add(self, name: str, values: Shaped[np.ndarray, "*shape"], *, differences: bool = False) -> None:
        """One more array.

        Args:
            differences: store how each row differs from the one before it, of whole numbers that change little.
        """
        assert values.dtype.name in DTYPES
        self.entries.append(
            {"name": name, "dtype": values.dtype.name, "shape": list(values.shape), "differences": differences}
        )
        if differences:
            # In as many bits as the numbers have: a difference that does not fit wraps around, there and back.
            signed = np.dtype(f"i{values.itemsize}")
            steps = np.diff(values, axis=0, prepend=np.zeros_like(values[:1])).view(signed)
            values = ((steps << 1) ^ (steps >> (8 * values.itemsize - 1))).view(values.dtype)
        rows = values.reshape(-1, values.shape[-1] if values.ndim > 1 else 1)
        # Equal bytes of numbers that belong together lie side by side: they deflate well.
        raw = np.ascontiguousarray(rows).view(np.uint8).reshape(len(rows), rows.shape[1], values.itemsize)
        self.parts.append(np.ascontiguousarray(raw.transpose(1, 2, 0)).tobytes())

    def text(self) -> str:
        """All arrays, as unpack.js reads them; equal arrays give equal text."""
        packer = zlib.compressobj(9, zlib.DEFLATED, zlib.MAX_WBITS, MEMORY, zlib.Z_FILTERED)
        return base64.b64encode(packer.compress(b"".join(self.parts)) + packer.flush()).decode()


def fold_normals(normals: Float32[np.ndarray, "vertex 3"]) -> Float32[np.ndarray, "vertex 2"]:
    """Unit vectors as points of an unfolded octahedron, in floats."""
    d = normals.astype(np.float64)
    d /= np.abs(d).sum(axis=1, keepdims=True)
    folded = (1 - np.abs(d[:, [1, 0]])) * np.where(d[:, :2] >= 0, 1, -1)
    return np.where(d[:, 2:] < 0, folded, d[:, :2]).astype(np.float32)


def quantize_normals(normals: Float32[np.ndarray, "vertex 3"]) -> UInt32[np.ndarray, "vertex 2"]:
    """The same in 24 bits each way: in 16, refraction through curved glass would lose 4 dB."""
    return np.rint((fold_normals(normals).astype(np.float64) + 1) / 2 * NORMAL_STEPS).astype(np.uint32)


def quantize_positions(
    vertices: Float32[np.ndarray, "vertex 3"],
) -> tuple[UInt16[np.ndarray, "vertex 3"], list[float], list[float]]:
    """Positions as whole numbers, the corner of their box, and how long a step is; where a side is flat it is 0."""
    if not len(vertices):
        return np.zeros((0, 3), np.uint16), [0.0] * 3, [0.0] * 3
    wide = vertices.astype(np.float64)
    low = wide.min(axis=0)
    step = np.ptp(wide, axis=0) / POSITION_STEPS
    codes = np.rint((wide - low) / np.where(step > 0, step, 1)).astype(np.uint16)
    return codes, low.tolist(), step.tolist()


def residuals(codes: Int32[np.ndarray, "h w c"], counts: Bool[np.ndarray, "h w"]) -> Int32[np.ndarray, "h w c"]:
    """How each number differs from its guess: left plus above less above left, but not beyond left and above.

    Args:
        counts: texels that matter; the others become equal to their prediction, so that their residual is 0.

    Source: the predictor of LOCO-I (Weinberger et al. 2000). floats.js reads it back.
    """
    height, width, _ = codes.shape
    known, left_over = codes.copy(), np.zeros_like(codes)
    # All texels of a diagonal have their neighbours on the two before it.
    for diagonal in range(height + width - 1):
        y = np.arange(max(0, diagonal - width + 1), min(diagonal, height - 1) + 1)
        x = diagonal - y
        has_left, has_above = (x > 0)[:, None], (y > 0)[:, None]
        above = np.where(has_above, known[y - 1, x], 0)
        left = np.where(has_left, known[y, x - 1], above)
        above = np.where(has_above, above, left)
        corner = np.where(has_left & has_above, known[y - 1, x - 1], above)
        guess = np.clip(left + above - corner, np.minimum(left, above), np.maximum(left, above))
        left_over[y, x] = np.where(counts[y, x, None], codes[y, x] - guess, 0)
        known[y, x] = guess + left_over[y, x]
    return left_over


def zigzag(values: Int32[np.ndarray, "*shape"]) -> np.ndarray:
    """0, -1, 1, -2, 2, ... as 0, 1, 2, 3, 4, ...: (*shape,) int32, the high bytes of little numbers are 0."""
    return np.where(values < 0, -2 * values - 1, 2 * values).astype(np.int32)


def add_texels(
    packed: Packed, textures: NeuralTextures | TexturePyramid, quality: Quality, meshes: Sequence[Mesh] | None
) -> Places:
    """Adds the texels of all levels; small: their sum at the finest level's texels.

    Args:
        meshes: the mesh of each texture; only texels that look-ups on it can touch matter. None: all matter.
    """
    levels = textures.levels() if isinstance(textures, TexturePyramid) else [textures]
    layouts = [level.layout for level in levels]
    if quality == "exact":
        finer_counts = textures.finer_counts if isinstance(textures, TexturePyramid) else 1.0
        scales = level_scales(len(levels), finer_counts)
        tables = [_padded(scale * level.table) for scale, level in zip(scales, levels)]
        packed.add("texels", np.concatenate(tables))
        firsts = np.cumsum([0, *(len(table) for table in tables)])
        return [
            [
                [int(first) + layout.bases[texture], layout.sizes[texture], layout.strides[texture]]
                for first, layout in zip(firsts, layouts)
            ]
            for texture in range(len(layouts[0].sizes))
        ]
    sizes = layouts[0].sizes
    sums = []
    for texture, size in enumerate(sizes):  # All levels, at the centres of the finest texels.
        object_id = torch.full((size * size, 1), texture + 1, dtype=torch.uint8)
        sums.append(_padded(textures(texel_centers(size)[:, None], object_id)[:, 0]))
    counts = [np.ones(len(values), bool) for values in sums]
    for texture, mesh in enumerate(meshes or ()):
        counts[texture] = touched_texels(mesh, sizes[texture])
    step = _step(np.concatenate([values[chosen] for values, chosen in zip(sums, counts)]), levels[0].table.shape[1])
    codes = [
        residuals(
            np.rint(values / step).astype(np.int32).reshape(size, size, -1).clip(-MAX_CODE, MAX_CODE),
            chosen.reshape(size, size),
        ).reshape(size * size, -1)
        for values, size, chosen in zip(sums, sizes, counts)
    ]
    packed.add("texels", zigzag(np.concatenate(codes)).astype(np.uint16))
    packed.add("texelStep", np.array([step], np.float32))
    firsts = np.cumsum([0, *(size * size for size in sizes)])
    return [[[int(first), size, size]] for first, size in zip(firsts, sizes)]


def _step(values: Float32[np.ndarray, "texel c"], channels: int) -> float:
    """The quantisation step of texels, from the spread of all channels except padding."""
    spread = float(np.sqrt(values[:, :channels].var(axis=0).mean())) if len(values) else 0.0
    return max(spread / STEPS, float(np.abs(values).max(initial=0)) / MAX_CODE, 1e-9)


def touched_texels(mesh: Mesh, size: int) -> Bool[np.ndarray, " texel"]:
    """The texels that bilinear look-ups on a mesh can touch, row by row; possibly a few more."""
    touched = np.zeros((size + 2, size + 2), bool)
    corners = mesh.uv[mesh.faces].astype(np.float64) * [1, -1] + [0, 1]
    extent = size * np.ptp(corners, axis=1).max(axis=-1, initial=0)
    # Points on each face, no more than half a texel from each other, in as many steps as some power of 2.
    steps = 1 << np.ceil(np.log2(np.maximum(2 * extent, 1))).astype(int)
    for count in np.unique(steps):
        first, second = (share.ravel() / count for share in np.mgrid[: count + 1, : count + 1])
        inside = first + second <= 1
        shares = np.stack([1 - first - second, first, second], axis=1)[inside]
        chosen = corners[steps == count]
        for part in np.array_split(chosen, -(-len(chosen) * len(shares) // 1_000_000)):
            places = np.clip(np.floor(np.einsum("pk,fkc->fpc", shares, part) * size), 0, size - 1).astype(int) + 1
            touched[places[..., 1], places[..., 0]] = True
    return binary_dilation(touched, np.ones((3, 3)))[1:-1, 1:-1].ravel()


def _padded(features: Tensor) -> Float32[np.ndarray, "texel c"]:
    values = features.cpu().numpy().astype(np.float32)
    return np.pad(values, ((0, 0), (0, fours(values.shape[1]) - values.shape[1])))


def add_tints(packed: Packed, tints: Tints, quality: Quality) -> TintPlaces:
    """Adds the texels of all metals that have any, row by row: linear floats; small: 8 bits of sRGB, as images have."""
    places: TintPlaces = []
    count = 0
    for texels in tints:
        places.append(None if texels is None else [count, texels.shape[1], texels.shape[0]])
        count += 0 if texels is None else texels.shape[0] * texels.shape[1]
    if count:
        linear = np.concatenate([texels.reshape(-1, 3) for texels in tints if texels is not None])
        if quality == "small":
            packed.add("tints", to_8bit(srgb_from_linear(linear)), differences=True)
        else:
            packed.add("tints", linear)
    return places


@dataclass(frozen=True, kw_only=True, eq=False)
class WebScene:
    """A trained scene, ready for the page."""

    manifest: dict[str, Json]
    packed: Packed
    shader: str
    """GLSL: the numbers that it shares with Python, then what all pages have, and the method's part in its place."""


def web_scene(renderer: Renderer, config: MethodConfig, dataset: Dataset, geometry: str, quality: Quality) -> WebScene:
    """The page's data for the scene of a trained renderer whose method has a page."""
    scene = open_scene(dataset, geometry)
    meshes = read_meshes(dataset, geometry)
    page = config.draw_page(renderer, scene)
    packed = Packed()
    boxes = _add_meshes(packed, meshes, quality, with_normals=page.has_normals)
    with torch.inference_mode():
        # A learned relief can shift look-ups to any texel.
        charted = None if page.relief else [mesh for mesh in meshes for _ in range(page.shells)]
        places = add_texels(packed, page.textures, quality, charted)
    tints: TintPlaces = [None] * len(meshes)
    if page.follows_light:
        tints = add_tints(packed, tints_of(scene, own_uv=follows_light(geometry)), quality)
    weights = np.concatenate([np.zeros((0, 4), np.float32), *page.weights])
    packed.add("weights", round_mantissa(weights) if quality == "small" else weights)
    views: dict[str, Json] = {}
    for split in dataset.splits:
        cameras = dataset.cameras(split)
        packed.add(f"cameras/{split}", np.ascontiguousarray(cameras.world_from_camera[:, :3].reshape(-1, 12)))
        views[split] = len(cameras)
    target, reach = _orbit(scene, dataset)
    defines = _defines(page, levels=len(places[0]), has_tints=any(tints))
    manifest: dict[str, Json] = {
        "schema": 4,
        "name": dataset.name,
        "quality": quality,
        "samples": page.samples,
        "lens": _lens(dataset),
        "target": target,
        "reach": reach,
        "start": f"{'interpolating' if 'interpolating' in views else dataset.splits[0]}/0",
        "views": views,
        "shells": page.shells,
        "followsLight": page.follows_light,
        "normalSteps": NORMAL_STEPS,
        "uvSteps": UV_SCALE,
        "defines": cast(Json, defines),
        "edits": [{"name": "matt", **_optics(GREY)}, {"name": "clear glass", **_optics(CLEAR_GLASS)}],
        "objects": [
            {**item, **box} for item, box in zip(_objects(scene, meshes, page, places, tints), boxes, strict=True)
        ],
    }
    parts = (
        *(f"#define {name} {value}{'u' * (value > 0x7FFFFFFF)}" for name, value in defines.items()),
        package_text("hyaline_web.page", "rays.glsl", "networks.glsl"),
        page.shader,
        package_text("hyaline_web.page", "picture.glsl"),
    )
    return WebScene(manifest=manifest, packed=packed, shader="\n".join(parts))


def _defines(page: MethodPage, *, levels: int, has_tints: bool) -> dict[str, int | float]:
    """The shader's defines: constants shared with Python, the page's own choices, and the method's."""
    return {
        **{event.upper(): code for event, code in EVENTS.items()},
        "RAY_OFFSET": RAY_OFFSET,
        "SKIP_COSINE": SKIP_COSINE,
        "MIN_COSINE": MIN_COSINE,
        "LEAKY_SLOPE": LEAKY_SLOPE,
        # Steps of the R2 sequence, times 2^32.
        "R2_X": round(2**32 / PLASTIC),
        "R2_Y": round(2**32 / PLASTIC**2),
        "FEATURE_TEXELS": fours(next(page.textures.parameters()).shape[1]) // 4,
        "LEVELS": levels,
        "TINTS": int(has_tints),
        "NORMALS": int(page.has_normals),
        "LIGHT_PATH": int(page.follows_light),
        "RELIEF": int(page.relief is not None),
        **page.defines,
    }


def _lens(dataset: Dataset) -> dict[str, Json]:
    """In focal lengths: half the width and height of the dataset's pictures, and how far right of their middle, and
    below it, the principal point is."""
    cameras = dataset.cameras(dataset.splits[0])
    half = [cameras.width / 2, cameras.height / 2]
    shift = [(at - middle) / cameras.focal for at, middle in zip(cameras.principal_point, half, strict=True)]
    return {"half": [side / cameras.focal for side in half], "shift": cast(Json, shift)}


def _orbit(scene: Scene, dataset: Dataset) -> tuple[list[Json], float]:
    """The point that the page's camera turns about, and half of how far the dataset's cameras are from it, metres."""
    if isinstance(scene.cameras, CameraRig):
        return list(scene.cameras.target), scene.cameras.radius / 2
    vertices = np.concatenate([item.mesh.vertices for item in scene.objects])
    target = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    places = dataset.cameras(dataset.splits[0]).world_from_camera[:, :3, 3]
    return [float(value) for value in target], float(np.linalg.norm(places - target, axis=1).mean() / 2)


def _objects(
    scene: Scene, meshes: tuple[Mesh, ...], page: MethodPage, places: Places, tints: TintPlaces
) -> list[dict[str, Json]]:
    """The manifest's entry of each object, in the order of their ids."""
    listed: list[dict[str, Json]] = []
    first_vertex = first_face = 0
    for index, (item, mesh) in enumerate(zip(scene.objects, meshes, strict=True)):
        shells = slice(index * page.shells, (index + 1) * page.shells)
        listed.append(
            {
                "name": item.name,
                "firstVertex": first_vertex,
                "numVertices": len(mesh.vertices),
                "firstFace": first_face,
                "numFaces": len(mesh.faces),
                "isClosed": is_there(mesh) and open_edges(mesh) == 0,
                **_optics(item.material, tints[index]),
                "texels": cast(Json, places[shells]),
                "relief": None if page.relief is None else cast(Json, page.relief[shells]),
            }
        )
        first_vertex, first_face = first_vertex + len(mesh.vertices), first_face + len(mesh.faces)
    return listed


def _optics(material: Material, tint: list[int] | None = None) -> dict[str, Json]:
    """The manifest's entry of a material."""
    surface, medium = material.surface(), material.medium
    return {
        "event": surface.event,
        "ior": surface.ior,
        "roughness": surface.roughness,
        "color": list(surface.color),
        "tint": cast(Json, tint),
        "priority": None if medium is None else medium.priority,
        "mediumIor": 1.0 if medium is None else medium.ior,
        "spread": [0.0, 0.0, 0.0] if medium is None else [ior - medium.ior for ior in medium.iors],
        "absorption": [0.0, 0.0, 0.0] if medium is None else list(medium.absorption),
    }


def _add_meshes(
    packed: Packed, meshes: tuple[Mesh, ...], quality: Quality, *, with_normals: bool
) -> list[dict[str, Json]]:
    """Adds all meshes, one after the other; returns the quantisation of each mesh's vertices."""

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(mesh, name) for mesh in meshes])

    is_small, boxes = quality == "small", [{} for _ in meshes]
    if is_small:
        codes, lows, steps = zip(*(quantize_positions(mesh.vertices) for mesh in meshes), strict=True)
        packed.add("vertices", np.concatenate(codes), differences=True)
        boxes = [{"low": cast(Json, low), "step": cast(Json, step)} for low, step in zip(lows, steps)]
    else:
        packed.add("vertices", joined("vertices"))
    packed.add("faces", joined("faces").astype(np.uint32), differences=True)
    normals, uv = joined("normals"), joined("uv")
    if with_normals:
        packed.add("normals", quantize_normals(normals) if is_small else fold_normals(normals), differences=is_small)
    packed.add("uv", quantize_uv(uv) if is_small else uv, differences=is_small)
    return boxes
