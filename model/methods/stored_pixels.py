"""The pixels of methods that look up stored layers."""

from collections.abc import Sequence

from datagen.data.cameras import Cameras
from datagen.data.config import Split
from model.batches.layers import Pixels, load_pixels, peel_cameras
from model.methods.protocol import Inputs


def load_stored(
    inputs: Inputs, split: Split, views: Sequence[int], *, with_images: bool, whole_views: bool = False
) -> Pixels:
    """Pixels with the nearest stored layers, as many as the method looks up.

    Args:
        whole_views: the renderer needs neighbouring pixels.
    """
    return load_pixels(
        inputs.dataset,
        inputs.geometry,
        split,
        views,
        with_images=with_images,
        max_layers=inputs.num_layers,
        whole_views=whole_views,
    )


def peel_as_stored(inputs: Inputs, cameras: Cameras, *, whole_views: bool = False) -> Pixels:
    """The pixels of any cameras as `load_stored` would give them, with layers peeled now."""
    return peel_cameras(inputs.dataset, inputs.geometry, inputs.num_layers, cameras, whole_views=whole_views)
