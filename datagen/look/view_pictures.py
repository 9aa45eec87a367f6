"""A view's stored data as pictures for people: masks, depth, normals, layers, proxies."""

import colorsys

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from datagen.data.dataset import View
from datagen.quantities import quantities

Picture = UInt8[np.ndarray, "h w 3"]

NOTHING = (24, 24, 24)
"""The colour of pixels without a surface."""
TONES = ((0.55, 0.95), (0.85, 0.75), (0.35, 0.8))
"""Saturations and values of objects, in turn, so that they differ in more than hue."""
NEAREST, FARTHEST = 255, 40
"""Grey levels of the nearest and the farthest pixel in a depth picture."""


def stored_pictures(view: View, *, has_layers: bool, proxies: tuple[str, ...] = ()) -> dict[str, Picture]:
    """Pictures of a view by name; the view's own picture comes first.

    Args:
        has_layers: whether the true geometry's straight layers are stored; everything but the picture needs them.
        proxies: geometries with stored straight layers; their first layer is laid over the picture.
    """
    pictures = {"picture": view.image}
    if not has_layers:
        return {**pictures, **_imported_pictures(view)}
    layers = view.layers()
    colors = object_colors(len(view.dataset.objects))
    found = quantities(view)
    pictures["glass"] = np.where(found.glass[..., None], view.image, view.image // 5)
    pictures["depth"] = depth_picture(layers.depth[0], layers.object_id[0] > 0)
    normals = (127.5 * (found.normal() + 1)).clip(0, 255).astype(np.uint8)
    is_there = (layers.object_id[0] > 0)[..., None]
    pictures["normals"] = np.where(is_there, normals, np.array(NOTHING, np.uint8))
    for number, ids in enumerate(layers.object_id):
        if ids.any():
            pictures[f"layer {number}"] = colors[ids]
    for geometry in proxies:
        ids = view.object_ids(geometry)[0]
        pictures[geometry] = (0.55 * view.image + 0.45 * colors[ids]).astype(np.uint8)
    return pictures


def _imported_pictures(view: View) -> dict[str, Picture]:
    """The mask and depth that were imported with a picture."""
    found = {}
    if (mask := view.imported_mask) is not None:
        found["glass"] = np.where(mask[..., None], view.image, view.image // 5)
    if (depth := view.imported_depth) is not None:
        found["depth"] = depth_picture(depth, depth > 0)
    return found


def object_colors(count: int) -> UInt8[np.ndarray, "id 3"]:
    """A colour for each object id, with neighbouring ids far apart; `NOTHING` for 0."""
    hues = [colorsys.hsv_to_rgb((0.61803 * place) % 1, *TONES[place % len(TONES)]) for place in range(count)]
    return np.concatenate([[NOTHING], 255 * np.array(hues).reshape(-1, 3)]).astype(np.uint8)


def depth_picture(depth: Float32[np.ndarray, "h w"], is_there: Bool[np.ndarray, "h w"]) -> Picture:
    """Depth as grey: near is bright, black means no surface. The nearest and the farthest pixel span the scale."""
    picture = np.zeros((*depth.shape, 3), np.uint8)
    if not is_there.any():
        return picture
    near, far = float(depth[is_there].min()), float(depth[is_there].max())
    share = (depth[is_there] - near) / max(far - near, 1e-9)
    picture[is_there] = (NEAREST - (NEAREST - FARTHEST) * share).astype(np.uint8)[:, None]
    return picture
