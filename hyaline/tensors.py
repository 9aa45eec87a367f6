"""Views and rays of a dataset for PyTorch's data loaders."""

import dataclasses

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor
from torch.utils import data

from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.disk.errors import HyalineError
from datagen.disk.records import checked


@checked
@dataclasses.dataclass(frozen=True)
class ViewDataset(data.Dataset):
    """The views of a split, one per item, read when they are accessed.

    An item has `image` (3, h, w), sRGB from 0 to 1; `origin` (3), the camera's centre in metres; `directions`
    (3, h, w), unit vectors through the pixels' centres in the world; `uv` (layer, 2, h, w), atlas coordinates of the
    surfaces along each ray from 0 to 1, nearest first; `object_id` (layer, h, w), 0 where a layer is empty.

    >>> from hyaline import open_dataset
    >>> views = ViewDataset(open_dataset("glass_table"), "train")
    >>> len(views), views[0]["image"].shape, views[0]["object_id"].shape
    (8, torch.Size([3, 32, 32]), torch.Size([4, 32, 32]))
    """

    dataset: Dataset
    split: Split
    geometry: str = "truth"
    """The geometry of the layers: truth, or a kind of proxy such as box."""

    def __post_init__(self) -> None:
        self.dataset.views(self.split)  # Refuses an unknown split.

    def __len__(self) -> int:
        return self.dataset.num_views[self.split]

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        if not 0 <= index < len(self):
            raise IndexError(f"{self.split}: view {index}; expected 0 to {len(self) - 1}")
        view = self.dataset.view(self.split, index)
        origin, directions = view.camera.rays()
        layers = view.layers(self.geometry)
        return {
            "image": _channels_first(view.image.astype(np.float32) / 255),
            "origin": torch.from_numpy(origin),
            "directions": _channels_first(directions),
            "uv": _channels_first(layers.uv.astype(np.float32) / 65535),
            "object_id": torch.from_numpy(layers.object_id),
        }


@checked
class RayDataset(data.Dataset):
    """All pixels of a split with their centre rays, view by view and row by row, in memory (36 bytes a pixel).

    An item has `origin`, `direction` and `color` (sRGB from 0 to 1), three numbers each.

    >>> from hyaline import open_dataset
    >>> rays = RayDataset(open_dataset("glass_table"), "train")
    >>> len(rays) == 8 * 32 * 32, rays[5]["color"].shape
    (True, torch.Size([3]))
    """

    origin: Float32[Tensor, "ray 3"]
    direction: Float32[Tensor, "ray 3"]
    color: Float32[Tensor, "ray 3"]

    def __init__(self, dataset: Dataset, split: Split) -> None:
        views = dataset.views(split)
        if not views:
            raise HyalineError(f"{dataset.root}: has no {split} views")
        rays = [view.camera.rays() for view in views]
        self.direction = torch.cat([torch.from_numpy(ways.reshape(-1, 3)) for _, ways in rays])
        self.color = torch.cat([torch.from_numpy(view.image.reshape(-1, 3).astype(np.float32) / 255) for view in views])
        centres = torch.stack([torch.from_numpy(origin) for origin, _ in rays])
        self.origin = centres.repeat_interleave(len(self.color) // len(centres), dim=0)

    def __len__(self) -> int:
        return len(self.color)

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        return {"origin": self.origin[index], "direction": self.direction[index], "color": self.color[index]}


def _channels_first(values: Float32[np.ndarray, "... h w c"]) -> Float32[Tensor, "... c h w"]:
    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(values, -1, -3)))
