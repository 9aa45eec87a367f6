"""What a dataset stores of a view, as pictures that a person can read: masks, depth, normals, layers, proxies."""

import colorsys

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from datagen.data.dataset import View
from datagen.quantities.view_quantities import quantities

Picture = UInt8[np.ndarray, "h w 3"]

NOTHING = (24, 24, 24)
"""The colour of pixels that show no surface."""


def stored_pictures(view: View, *, has_layers: bool, proxies: tuple[str, ...] = ()) -> dict[str, Picture]:
    """Pictures of a view by what they show, its own first.

    Args:
        has_layers: whether the true geometry's straight layers are stored: all but the picture come from them.
        proxies: geometries whose straight layers are stored; their first layer is laid over the picture.

    Raises:
        HyalineError: the view is not built, not peeled, or damaged.
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
    pictures["normals"] = np.where((layers.object_id[0] > 0)[..., None], normals, np.array(NOTHING, np.uint8))
    for number, ids in enumerate(layers.object_id):
        if ids.any():
            pictures[f"layer {number}"] = colors[ids]
    for geometry in proxies:
        ids = view.object_ids(geometry)[0]
        laid = (0.55 * view.image + 0.45 * colors[ids]).astype(np.uint8)
        pictures[geometry] = np.where(_outline(ids)[..., None], colors[ids], laid)
    return pictures


def _imported_pictures(view: View) -> dict[str, Picture]:
    """What came with an imported picture."""
    found = {}
    if (mask := view.imported_mask) is not None:
        found["glass"] = np.where(mask[..., None], view.image, view.image // 5)
    if (depth := view.imported_depth) is not None:
        found["depth"] = depth_picture(depth, depth > 0)
    return found


def object_colors(count: int) -> UInt8[np.ndarray, "id 3"]:
    """A colour for each object id, neighbours far apart; nothing for 0."""
    hues = [colorsys.hsv_to_rgb((0.61803 * place) % 1, 0.55, 0.95) for place in range(count)]
    return np.concatenate([[NOTHING], 255 * np.array(hues).reshape(-1, 3)]).astype(np.uint8)


def depth_picture(depth: Float32[np.ndarray, "h w"], is_there: Bool[np.ndarray, "h w"]) -> Picture:
    """Near is bright; black where there is nothing. The nearest and the farthest pixel span the scale."""
    picture = np.zeros((*depth.shape, 3), np.uint8)
    if is_there.any():
        near, far = float(depth[is_there].min()), float(depth[is_there].max())
        share = (depth[is_there] - near) / max(far - near, 1e-9)
        picture[is_there] = (255 - 215 * share).astype(np.uint8)[:, None]
    return picture


def _outline(ids: UInt8[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels beside one of another object."""
    edge = np.zeros(ids.shape, bool)
    edge[1:] |= ids[1:] != ids[:-1]
    edge[:, 1:] |= ids[:, 1:] != ids[:, :-1]
    return edge
