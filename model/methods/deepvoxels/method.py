"""How `deepvoxels` is made: what the dataset decides, the network, and the views."""

from collections.abc import Sequence

from datagen.data.cameras import Cameras
from datagen.data.config import Split
from datagen.disk.errors import HyalineError
from model.batches.rays import black
from model.batches.view_batches import Views, load_views
from model.methods.deepvoxels.config import DeepVoxelsConfig
from model.methods.deepvoxels.renderer import DeepVoxels, build_deepvoxels
from model.methods.protocol import Inputs


def complete(config: DeepVoxelsConfig, inputs: Inputs) -> DeepVoxelsConfig:
    return config.sized(inputs.dataset.config.resolution)


def build(config: DeepVoxelsConfig, inputs: Inputs) -> DeepVoxels:
    return build_deepvoxels(config, inputs.dataset)


def load(
    config: DeepVoxelsConfig,  # noqa: ARG001
    inputs: Inputs,
    split: Split,
    views: Sequence[int],
    *,
    with_images: bool,
    mapped: bool,  # noqa: ARG001
) -> Views:
    return load_views(inputs.dataset, split, views, with_images=with_images)


def load_cameras(config: DeepVoxelsConfig, inputs: Inputs, cameras: Cameras) -> Views:  # noqa: ARG001
    size = config.image_size
    if (cameras.width, cameras.height) != (size, size):
        raise HyalineError(
            f"camera: is {cameras.width} x {cameras.height} pixels; deepvoxels draws {size} x {size}, the size that "
            "its networks were made for"
        )
    return Views(rgb=black(cameras), cameras=cameras)
