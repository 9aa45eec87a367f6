"""The renderer of `deepvoxels`: a grid of learned features that views are lifted into and drawn from.

Source: Sitzmann et al., DeepVoxels: Learning Persistent 3D Feature Embeddings, CVPR 2019, and the code they released;
in this paper section 5.1. No geometry is known: the method gets images, cameras and how far the scene reaches.

Axis words besides the contract's: `z y x` voxels of the grid along the world's axes, `d` planes of a view's frustum,
nearest first, `p q` rows and columns of the small picture plane on which features are lifted and projected.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from torch import Tensor
from torch.nn import functional

from datagen.data.cameras import Camera, Cameras
from datagen.data.config import Resolution, square
from datagen.data.geometries import read_meshes
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from hyaline_paper.methods import DeepVoxelsConfig
from hyaline_paper.voxel_nets import (
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
from model.methods.renderer import PatchTerms, Renderer

CLEARANCE = 0.9
"""Largest radius of the grid's bounding sphere, relative to the distance of the nearest training camera."""


@dataclass(frozen=True, kw_only=True, eq=False)
class VoxelGrid:
    """A cube of voxels, its edges along the world's axes."""

    origin: Float32[Tensor, "3"]
    """World position (m) of voxel (n/2, n/2, n/2): the cube's middle but for half a voxel, as in its authors' code."""
    voxel_size: Float32[Tensor, ""]
    """Metres."""
    num_voxels: int
    """n: along each edge."""

    @property
    def num_planes(self) -> int:
        """Planes of a view's frustum, a voxel apart: more than the cube's diagonal, sqrt(3) n."""
        return 2 * self.num_voxels


def fit_cube(cameras: Cameras, vertices: Float[np.ndarray, "vertex 3"]) -> tuple[Float[np.ndarray, "3"], float]:
    """Origin and edge in metres of the cube that the grid fills, from the training cameras and the scene's extent.

    The origin is the point nearest to all optical axes, in the least-squares sense. The cube is the smallest one around
    it that contains the scene (for an unknown scene, the largest), unless cameras are inside its bounding sphere: then
    the sphere ends before the nearest camera. The method requires this (its cameras look at the grid from outside);
    parts of a room outside the grid must then be drawn from within it.

    Source: DeepVoxels sets origin, scale and near plane by hand for each scene; here they are computed.
    """
    position = cameras.world_from_camera[:, :3, 3]
    forward = -cameras.world_from_camera[:, :3, 2]
    # The square of a point's distance to an axis is |across (point - position)|^2.
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.eigvalsh(total)[0] < 1e-6 * len(position):
        raise HyalineError(f"cameras: all {len(position)} look the same way; deepvoxels needs views from around")
    origin = np.linalg.solve(total, np.einsum("vij,vj->i", across, position))
    nearest = float(np.linalg.norm(position - origin, axis=1).min())
    reach = float(np.abs(vertices - origin).max()) if len(vertices) else math.inf
    edge = min(2 * reach, CLEARANCE * nearest * 2 / math.sqrt(3))
    return origin, edge


def near_plane(camera: Camera, grid: VoxelGrid) -> Float32[Tensor, ""]:
    """Depth in metres of a view's first plane: the near side of the grid's bounding sphere, but in front of the camera.

    DeepVoxels has one near plane for all views. Here each view has its own, which is the same for cameras on a sphere
    around the grid, and also works for a path that comes nearer or goes farther.
    """
    pose = _pose(camera, grid.origin.device)
    depth = -((grid.origin - pose[:3, 3]) @ pose[:3, 2])
    return torch.maximum(depth - 0.5 * math.sqrt(3) * grid.num_voxels * grid.voxel_size, grid.voxel_size)


def _pose(camera: Camera, device: torch.device) -> Float32[Tensor, "4 4"]:
    return torch.as_tensor(camera.world_from_camera, dtype=torch.float32, device=device)


def _middle(camera: Camera) -> tuple[float, float]:
    """Column and row of the principal point, as shares of the picture's width and height."""
    column, row = camera.principal_point
    return column / camera.width, row / camera.height


def voxel_centers(grid: VoxelGrid) -> Float32[Tensor, "voxel 3"]:
    """World positions of all voxels; voxel (x, y, z) is row (z n + y) n + x."""
    steps = torch.arange(grid.num_voxels, device=grid.origin.device) - grid.num_voxels // 2
    z, y, x = torch.meshgrid(steps, steps, steps, indexing="ij")
    return grid.origin + grid.voxel_size * torch.stack([x, y, z], dim=-1).reshape(-1, 3)


def project_points(p_world: Float32[Tensor, "point 3"], camera: Camera, size: int) -> Float32[Tensor, "point 3"]:
    """Column and row on a plane of `size` x `size` pixels, and depth in metres; pixel i has its centre at i + 0.5.

    Column and row mean nothing where the depth is not positive.
    """
    pose = _pose(camera, p_world.device)
    p_camera = (p_world - pose[:3, 3]) @ pose[:3, :3]
    right, up, depth = p_camera[:, 0], p_camera[:, 1], -p_camera[:, 2]
    focal = 0.5 * size / math.tan(0.5 * camera.fov_x)
    column, row = _middle(camera)
    return torch.stack([column * size + focal * right / depth, row * size - focal * up / depth, depth], dim=1)


def frustum_points(camera: Camera, grid: VoxelGrid, size: int) -> Float32[Tensor, "point 3"]:
    """World positions of a view's frustum: plane by plane from the near plane on, row by row, at pixel centres."""
    device = grid.origin.device
    focal = 0.5 * size / math.tan(0.5 * camera.fov_x)
    across, down = ((torch.arange(size, device=device) + 0.5 - share * size) / focal for share in _middle(camera))
    depth = near_plane(camera, grid) + grid.voxel_size * torch.arange(grid.num_planes, device=device)
    z, down, right = torch.meshgrid(depth, down, across, indexing="ij")
    p_camera = torch.stack([right * z, -down * z, -z], dim=-1).reshape(-1, 3)
    pose = _pose(camera, device)
    return pose[:3, 3] + p_camera @ pose[:3, :3].T


def lift(features: Float32[Tensor, "1 c p q"], camera: Camera, grid: VoxelGrid) -> Float32[Tensor, "1 c z y x"]:
    """A view's features at every voxel, bilinear at its projected centre; 0 outside the view.

    The authors' code also drops voxels outside a frustum whose bounds it rounds to whole metres; this does not. Theirs
    assumes pixel centres at whole numbers, half a pixel off.
    """
    size = features.shape[-1]
    column, row, depth = project_points(voxel_centers(grid), camera, size).unbind(1)
    is_seen = (depth > 0) & (column >= 0) & (column < size) & (row >= 0) & (row < size)
    # Within half a pixel of the border, the border's value is used.
    place = torch.stack([row, column], dim=1)[is_seen].sub(0.5).clamp(0, size - 1)
    rows = _gather(features[0].flatten(1).T, place, size)
    return _spread(rows, is_seen).T.reshape(1, -1, *[grid.num_voxels] * 3)


def sample_frustum(
    volume: Float32[Tensor, "1 c z y x"], camera: Camera, grid: VoxelGrid, size: int
) -> Float32[Tensor, "1 c d p q"]:
    """The grid's features on a view's frustum, trilinear between voxel centres; 0 outside the outermost centres."""
    points = frustum_points(camera, grid, size)
    place = (points - grid.origin) / grid.voxel_size + grid.num_voxels // 2
    is_inside = ((place >= 0) & (place <= grid.num_voxels - 1)).all(dim=1)
    rows = _gather(volume[0].flatten(1).T, place[is_inside].flip(1), grid.num_voxels)
    return _spread(rows, is_inside).T.reshape(1, -1, grid.num_planes, size, size)


def _gather(
    table: Float32[Tensor, "cell c"], place: Float32[Tensor, "point axis"], size: int
) -> Float32[Tensor, "point c"]:
    """Rows of a square or cubic table between its cells, linear along each axis; the last axis varies fastest.

    A bag of four or eight rows for each point. `grid_sample` in five dimensions runs on one CPU thread.
    """
    low = place.floor().clamp(max=size - 2)
    share = place - low
    taps = place.new_zeros(len(place), 1, dtype=torch.int64)
    weights = place.new_ones(len(place), 1)
    for axis in range(place.shape[1]):
        first, part = low[:, axis, None].long(), share[:, axis, None]
        taps = torch.cat([size * taps + first, size * taps + first + 1], dim=1)
        weights = torch.cat([weights * (1 - part), weights * part], dim=1)
    return functional.embedding_bag(taps, table.contiguous(), per_sample_weights=weights, mode="sum")


def _spread(rows: Float32[Tensor, "point c"], is_there: Bool[Tensor, " cell"]) -> Float32[Tensor, "cell c"]:
    """Each row in the next place that is there; zeros elsewhere."""
    index: Int[Tensor, " point"] = is_there.nonzero().squeeze(1)
    return rows.new_zeros(len(is_there), rows.shape[1]).index_copy(0, index, rows)


# The renderer


BORDER = 5
"""Pixels at each edge of a picture that the loss leaves out, because they are drawn from half-empty feature maps. The
authors also leave them out of their scores; here predictions are whole, like every other method's."""


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
        self.integration = Integration(features)
        self.inpainting = Unet(3, features + 3, features, width=features, num_down=2, max_channels=4 * features)
        self.occlusion = Occlusion(features, num_planes=2 * size, plane_size=plane)
        self.rendering = rendering_network(
            width=config.width,
            num_inputs=features,
            num_doublings=num_halvings,
            plane_size=plane,
        )
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
        inpainted = self.inpaint(self.observe(training.image(source), training.cameras[source]))
        inside = slice(BORDER, -BORDER)
        losses = []
        for target in targets:
            drawn = self.draw(inpainted, training.cameras[target])[..., inside, inside]
            losses.append((drawn - training.image(target)[..., inside, inside]).abs().mean())
        return torch.stack(losses).mean()

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


def complete(config: DeepVoxelsConfig, inputs: Inputs) -> DeepVoxelsConfig:
    return config.sized(inputs.dataset.config.resolution)


def build(config: DeepVoxelsConfig, inputs: Inputs) -> DeepVoxels:
    """A fresh network, its grid around the point that the training cameras look at."""
    dataset = inputs.dataset
    _check_size(config, dataset.config.resolution)
    # Imported pictures may come without meshes: then the grid reaches as far as the cameras allow.
    meshes = read_meshes(dataset, TRUTH) if dataset.objects else ()
    vertices = np.concatenate([np.zeros((0, 3)), *(mesh.vertices.astype(np.float64) for mesh in meshes)])
    origin, edge = fit_cube(dataset.cameras("train"), vertices)
    return DeepVoxels(config, origin=torch.from_numpy(origin).float(), edge=edge)


def _check_size(config: DeepVoxelsConfig, found: Resolution) -> None:
    size = square(config.image_size)
    if found != size:
        raise HyalineError(f"resolution: is {found}; deepvoxels draws {size}, the size that its networks were made for")


def load_cameras(config: DeepVoxelsConfig, inputs: Inputs, cameras: Cameras) -> Views:  # noqa: ARG001
    _check_size(config, cameras.size)
    return views_of(cameras)
