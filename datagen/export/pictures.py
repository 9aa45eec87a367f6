"""The files of pictures, depth, masks and points that several formats share."""

import numpy as np
from jaxtyping import Bool, Float32

from datagen.data.images import png_bytes
from datagen.export.source import ExportView, PointCloud

MILLIMETRES = 1000.0
MAX_DEPTH_MM = np.iinfo(np.uint16).max


def rgb_png(item: ExportView) -> bytes:
    """The 8-bit sRGB picture, without alpha."""
    return png_bytes(item.view.image)


def rgba_png(item: ExportView) -> bytes:
    """The picture with an alpha of 255 everywhere: whatever a tool puts behind it, it shows what the dataset does.

    The sky and what is seen through glass belong to the picture: none of it may be replaced by a background.
    """
    image = item.view.image
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
