"""The renderer of `deepvoxels`: a grid of learned features that views are lifted into and drawn from.

Source: Sitzmann et al., DeepVoxels: Learning Persistent 3D Feature Embeddings, CVPR 2019, and the code they released;
in this paper section 5.1. No geometry is known: the method gets images, cameras and how far the scene reaches.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor
from torch.nn import functional

from datagen.data.cameras import Camera, Cameras
from datagen.data.config import Resolution, square
from datagen.data.geometries import read_meshes
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from hyaline_paper.deepvoxels.config import DeepVoxelsConfig
from hyaline_paper.deepvoxels.voxel_grid import VoxelGrid, fit_cube, lift, sample_frustum
from hyaline_paper.deepvoxels.voxel_nets import (
    Critic,
    Integration,
    Occlusion,
    Unet,
    Volume,
    collapse,
    feature_extractor,
    rendering_network,
)
from model.batches.rays import ViewBatch, Views, views_of
from model.methods.protocol import Inputs
from model.methods.renderer import ParameterGroup, PatchTerms, Renderer
from model.settings import Optimisation

BORDER = 5
"""Pixels at each edge of a picture that the loss leaves out, because they are drawn from half-empty feature maps. The
authors also leave them out of their scores; here predictions are whole, like every other method's."""
L1_WEIGHT = 200.0
"""Weight of L1 relative to the critic."""


class DeepVoxels(Renderer[Views]):
    """Views in, their pictures out, drawn from a grid of features that training views were lifted into.

    The grid is a buffer, not a parameter: each training step integrates one more view into it, without a gradient to
    earlier steps, and it persists for the whole run.
    """

    def __init__(self, config: DeepVoxelsConfig, *, origin: Float32[Tensor, "3"], edge: float) -> None:
        """Args:
        origin: of the grid, in world space, metres.
        edge: of the grid, metres.
        """
        super().__init__()
        self.config = config
        features, size = config.voxel_features, config.num_voxels
        num_halvings = int(math.log2(config.image_size // config.plane_size))
        plane = config.plane_size
        self.feature_extractor = feature_extractor(
            width=config.width, num_outputs=features, num_halvings=num_halvings, plane_size=plane
        )
        self.integration = Integration(features, dropout=2 * config.dropout, bounded=config.bounded)
        self.inpainting = Unet(3, features + 3, features, width=features, num_down=2, max_channels=4 * features)
        self.occlusion = Occlusion(features, num_planes=2 * size, plane_size=plane)
        self.rendering = rendering_network(
            width=config.width,
            num_inputs=features,
            num_doublings=num_halvings,
            plane_size=plane,
            dropout=config.dropout,
        )
        self.critic = Critic() if config.adversarial else None
        # Saved with the weights, because later renderings need the grid where it was learned.
        self.register_buffer("origin", origin.clone())
        self.register_buffer("voxel_size", torch.tensor(edge / size, dtype=torch.float32))
        self.register_buffer("volume", torch.zeros(1, features, size, size, size))
        self.register_buffer("coordinates", grid_coordinates(size), persistent=False)

    @property
    def grid(self) -> VoxelGrid:
        """Where the voxels are."""
        origin, voxel_size = self.get_buffer("origin"), self.get_buffer("voxel_size")
        return VoxelGrid(origin=origin, voxel_size=voxel_size, num_voxels=self.config.num_voxels)

    def forward(self, views: ViewBatch, **_: object) -> Float32[Tensor, "pixel 3"]:
        """sRGB colours in [0, 1] of all pixels of the views, drawn from the grid as it is."""
        inpainted = self.inpaint(self.get_buffer("volume"))
        return torch.cat([self.draw(inpainted, camera)[0].flatten(1).T for camera in views.cameras])

    def loss(
        self,
        training: Views,
        batch: int,
        rng: np.random.Generator,
        *,
        softness: float = 0.0,  # noqa: ARG002
        patch_terms: PatchTerms | None = None,  # noqa: ARG002
    ) -> Tensor:
        """Lifts one view into the grid, draws `batch` others from it, and compares.

        The lifted view is one of the four whose axes are nearest to the first target's. The authors go through all
        first targets in epochs; here each step draws its own, so that a resumed run draws the same ones.
        """
        if training.num_views < 2:
            raise HyalineError(f"train: has {training.num_views} view to learn from; deepvoxels needs at least 2")
        targets = rng.choice(training.num_views, size=min(batch, training.num_views), replace=False).tolist()
        source = int(rng.choice(training.neighbours(targets[0])))
        with seeded_torch(rng, training.rgb.device):
            inpainted = self.inpaint(self.observe(training.image(source), training.cameras[source]))
            inside = slice(BORDER, -BORDER)
            losses = []
            for target in targets:
                drawn = self.draw(inpainted, training.cameras[target])[..., inside, inside]
                true = training.image(target)[..., inside, inside]
                loss = (drawn - true).abs().mean()
                if self.critic is not None:
                    loss = L1_WEIGHT * loss + adversarial_loss(self.critic, drawn - 0.5, true - 0.5)
                losses.append(loss)
            return torch.stack(losses).mean()

    def groups(self, optimisation: Optimisation) -> list[ParameterGroup]:
        """One Adam moves the networks and the critic, at the same rate."""
        critic = [] if self.critic is None else list(self.critic.parameters())
        return [
            ParameterGroup(parameters=self.all_but(critic), lr=optimisation.lr, weight_decay=optimisation.weight_decay),
            ParameterGroup(
                parameters=critic, lr=optimisation.lr, weight_decay=optimisation.weight_decay, counts_as="helper"
            ),
        ]

    def observe(self, image: Float32[Tensor, "1 3 h w"], camera: Camera) -> Volume:
        """The grid after integrating one more view; it is stored, too.

        Args:
            image: sRGB in [0, 1].
        """
        lifted = lift(self.feature_extractor(image - 0.5), camera, self.grid)
        volume = self.integration(lifted, self.get_buffer("volume"), self.get_buffer("coordinates"))
        # A new tensor: this step's gradient still needs the old one.
        self.volume = volume.detach()
        return volume

    def inpaint(self, volume: Volume) -> Volume:
        """The grid with unseen voxels filled in from their surroundings."""
        return self.inpainting(torch.cat([volume, self.get_buffer("coordinates")], dim=1))

    def draw(self, inpainted: Volume, camera: Camera) -> Float32[Tensor, "1 3 h w"]:
        """sRGB picture in [0, 1] of one view."""
        frustum = sample_frustum(inpainted, camera, self.grid, self.config.plane_size)
        return 0.5 + 0.5 * self.rendering(collapse(frustum, self.occlusion(frustum)))


def grid_coordinates(size: int) -> Float32[Tensor, "1 3 z y x"]:
    """The place of each voxel along z, y and x, in [-0.5, 0.5)."""
    steps = torch.arange(-(size // 2), size // 2) / size
    return torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"))[None]


def adversarial_loss(critic: Critic, drawn: Float32[Tensor, "1 3 h w"], true: Float32[Tensor, "1 3 h w"]) -> Tensor:
    """The renderer's and the critic's losses in one number.

    The renderer's loss is -log D(drawn), with the critic's parameters held constant; the critic's loss is
    -(log D(true) + log(1 - D(drawn))) / 2, with the picture held constant. No parameter appears in both, and Adam
    updates each parameter independently, so one Adam takes exactly the steps of the authors' two optimisers of equal
    rate, and one checkpoint resumes both.
    """
    fixed = {name: value.detach() for name, value in critic.named_parameters()}
    renderer_side = functional.softplus(-torch.func.functional_call(critic, fixed, (drawn,))).mean()
    on_true, on_drawn = functional.softplus(-critic(true)).mean(), functional.softplus(critic(drawn.detach())).mean()
    return renderer_side + 0.5 * (on_true + on_drawn)


@contextmanager
def seeded_torch(rng: np.random.Generator, device: torch.device) -> Iterator[None]:
    """Seeds torch's own generator, which dropout uses, from a step's generator, and restores it afterwards."""
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(int(rng.integers(2**62)))
        yield


def complete(config: DeepVoxelsConfig, inputs: Inputs) -> DeepVoxelsConfig:
    return config.sized(inputs.dataset.config.resolution)


def build(config: DeepVoxelsConfig, inputs: Inputs) -> DeepVoxels:
    """A fresh network, its grid around the point that the training cameras look at."""
    dataset = inputs.dataset
    if dataset.config.resolution != square(config.image_size):
        raise HyalineError(
            f"image_size: is {config.image_size}, but {dataset.root} has {dataset.config.resolution} pixels; "
            "expected pictures of the size that the networks were made for"
        )
    # Imported pictures may come without meshes: then the grid reaches as far as the cameras allow.
    meshes = read_meshes(dataset, TRUTH) if dataset.objects else ()
    vertices = np.concatenate([np.zeros((0, 3)), *(mesh.vertices.astype(np.float64) for mesh in meshes)])
    origin, edge = fit_cube(dataset.cameras("train"), vertices)
    return DeepVoxels(config, origin=torch.from_numpy(origin).float(), edge=edge)


def _check_size(config: DeepVoxelsConfig, found: Resolution) -> None:
    size = square(config.image_size)
    if found != size:
        raise HyalineError(
            f"camera: is {found} pixels; deepvoxels draws {size}, the size that its networks were made for"
        )


def load_cameras(config: DeepVoxelsConfig, inputs: Inputs, cameras: Cameras) -> Views:  # noqa: ARG001
    _check_size(config, cameras.size)
    return views_of(cameras)
