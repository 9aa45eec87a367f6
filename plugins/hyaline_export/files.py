"""What several formats share: pictures, depth, masks, points, and the keys of transforms.json as NeRF tools read it."""

import numpy as np
from jaxtyping import Bool, Float32

from datagen.data.cameras import Camera
from datagen.data.images import png_bytes
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json
from hyaline_export.source import Bounds, ExportView, PointCloud, Source

MILLIMETRES = 1000.0
MAX_DEPTH_MM = np.iinfo(np.uint16).max


def rgb_png(item: ExportView) -> bytes:
    """The 8-bit sRGB picture, without alpha."""
    return png_bytes(item.image)


def rgba_png(item: ExportView) -> bytes:
    """The picture with an alpha of 255 everywhere: whatever a tool puts behind it, it shows what the dataset does.

    The sky and what is seen through glass belong to the picture: none of it may be replaced by a background.
    """
    image = item.image
    return png_bytes(np.concatenate([image, np.full_like(image[..., :1], 255)], axis=-1))


def depth_png(depth: Float32[np.ndarray, "h w"]) -> bytes:
    """16-bit PNG in millimetres, rounded; 0 where there is no surface, or one beyond 65.535 m."""
    millimetres = np.rint(depth.astype(np.float64) * MILLIMETRES)
    return png_bytes(np.where(millimetres > MAX_DEPTH_MM, 0, millimetres).astype(np.uint16))


def mask_png(mask: Bool[np.ndarray, "h w"]) -> bytes:
    """8-bit grey PNG: 255 where the mask is True, 0 elsewhere."""
    return png_bytes(np.where(mask, 255, 0).astype(np.uint8))


def ply_points(points: PointCloud) -> bytes:
    """A binary PLY of points with normals and colours, as Gaussian splatting and nerfstudio start from."""
    layout = [("position", "<f4", 3), ("normal", "<f4", 3), ("color", "u1", 3)]
    rows = np.empty(len(points.position), np.dtype(layout))
    rows["position"], rows["normal"], rows["color"] = points.position, points.normal, points.color
    names = [*(f"float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")), "uchar red", "uchar green", "uchar blue"]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines = [*header, *(f"property {name}" for name in names), "end_header", ""]
    return "\n".join(lines).encode() + rows.tobytes()


MAX_SHIFT = 0.05
"""Pixels by which a principal point may miss the picture's middle and still be taken for it."""


def check_centered(camera: Camera, form: str) -> None:
    """Refuses cameras that readers of a format would take for others: they know the angle of the lens alone."""
    column, row = camera.principal_point
    if max(abs(column - camera.width / 2), abs(row - camera.height / 2)) > MAX_SHIFT:
        raise HyalineError(
            f"--format {form}: its readers take the picture's middle for the principal point, which is {column:g}, "
            f"{row:g} here; export as nerfstudio or colmap"
        )


def world_keys(source: Source) -> dict[str, Json]:
    """What a transforms file says of the world that its views show, and its licence."""
    return {"license": source.dataset.license, **bounds_keys(source.bounds)}


def bounds_keys(bounds: Bounds) -> dict[str, Json]:
    """What a tool needs to know to cut nothing off: metres along the ray, and a box in world axes."""
    return {"near": bounds.near, "far": bounds.far, "aabb": [list(bounds.low), list(bounds.high)]}


def frame(item: ExportView, file_path: str, **more: Json) -> dict[str, Json]:
    """One view: its picture and its world_from_camera (OpenGL)."""
    matrix = np.asarray(item.view.camera.world_from_camera, np.float64)
    return {"file_path": file_path, "transform_matrix": matrix.tolist(), **more}
