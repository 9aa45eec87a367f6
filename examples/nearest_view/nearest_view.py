"""The method `nearest-view`: training pictures, blended by how near their cameras are. It learns how sharply."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from datagen.data.cameras import Cameras
from model.batches.rays import ViewBatch, Views, load_views_of, views_of
from model.methods.protocol import Inputs, MethodConfig
from model.methods.renderer import Renderer
from model.settings import Optimisation


class NearestView(Renderer[Views]):
    """Cameras in; each picture is a mean of the training pictures, weighted by the distance of their cameras."""

    def __init__(self, sharpness: float, training: Views) -> None:
        super().__init__()
        self.sharpness = nn.Parameter(torch.tensor(sharpness))
        self.register_buffer("pictures", training.rgb.view(training.num_views, -1, 3))
        self.register_buffer("centers", torch.from_numpy(training.cameras.world_from_camera[:, :3, 3]).float())

    def forward(self, views: ViewBatch, *, rng: np.random.Generator | None = None) -> Tensor:
        centers = torch.from_numpy(np.stack([camera.world_from_camera[:3, 3] for camera in views.cameras]))
        distance = torch.cdist(centers.to(self.sharpness), self.get_buffer("centers"))
        if rng is not None:  # While training, a view must not be its own nearest.
            distance = distance.masked_fill(distance < 1e-4, 1e3)
        weight = torch.softmax(-self.sharpness * distance, dim=1)
        return torch.einsum("vt,tpc->vpc", weight, self.get_buffer("pictures") / 255).flatten(0, 1)

    def loss(self, training: Views, batch: int, rng: np.random.Generator, **_: object) -> Tensor:
        views = rng.integers(training.num_views, size=batch).tolist()
        drawn = self(ViewBatch(cameras=tuple(training.cameras[view] for view in views)), rng=rng)
        true = torch.cat([training.image(view).flatten(2)[0].T for view in views])
        return (drawn - true.to(drawn)).abs().mean()


@dataclass(frozen=True, kw_only=True)
class NearestViewConfig(MethodConfig):
    """The training pictures with the nearest cameras, blended."""

    uses_geometry: ClassVar[bool] = False
    knowledge: ClassVar[str] = "cameras only"
    sharpness: float = 5.0
    """Where learning starts: a camera farther by 1 / sharpness metres counts e times less."""

    def optimisation(self) -> Optimisation:
        return Optimisation(steps=100, batch=2, lr=0.1)

    def build(self, inputs: Inputs) -> NearestView:
        views = range(inputs.dataset.config.train.views)
        return NearestView(self.sharpness, load_views_of(views_of, inputs.dataset, "train", views, with_images=True))

    def load_cameras(self, inputs: Inputs, cameras: Cameras) -> Views:
        return views_of(cameras)
