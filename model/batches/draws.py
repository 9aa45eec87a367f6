"""Training pixels drawn by error: where a renderer errs more, pixels are drawn more often."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int
from torch import Tensor

from datagen.data.config import Resolution
from datagen.data.dataset import Dataset
from datagen.data.images import srgb_from_linear
from datagen.disk.errors import HyalineError
from model.batches.distributed import Processes
from model.batches.rays import Drawable, PixelSource
from model.settings.optimisation import DrawKind
from model.settings.state import State

BLOCK = 8
"""Width and height in pixels of the blocks whose errors are known."""

BY_ERROR = 0.5
"""Share of a batch that is drawn by error; the rest is uniform, so that every pixel is seen. Three quarters are better
in short runs of `light-path`, and worse in full ones (docs/notes/speed.md)."""

MOST = 6.0
"""How many times as often as on average a pixel is drawn by error, at most."""

REFRESH = 50
"""Steps between two looks at the errors."""

REMEMBERED = 12.0
"""Visits to an average block that its error is the mean of; older ones fade."""

EXPECTED = 4.0
"""Visits with the mean error of all blocks that every block is taken to have had."""

UNIT = 2.0**-40
"""Squared errors are added as multiples of this: sums of whole numbers do not depend on the order of their terms."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Blocks:
    """The blocks that tile some views, row by row and view by view; those at the far edges may be smaller."""

    num_views: int
    resolution: Resolution

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of blocks in a view."""
        return -(-self.resolution.height // BLOCK), -(-self.resolution.width // BLOCK)

    def __len__(self) -> int:
        rows, columns = self.shape
        return self.num_views * rows * columns

    def of(self, index: Int[Tensor, " pixel"]) -> Int[Tensor, " pixel"]:
        """The blocks of the pixels with these row numbers."""
        (height, width), (rows, columns) = self.resolution.shape, self.shape
        row, column = index // width, index % width
        return (row // height * rows + row % height // BLOCK) * columns + column // BLOCK

    def pixels(
        self, block: Int[np.ndarray, " pixel"], place: Float64[np.ndarray, "pixel 2"]
    ) -> Int[np.ndarray, " pixel"]:
        """Row numbers of the pixels at places, row and column in [0, 1), of blocks."""
        (height, width), (rows, columns) = self.resolution.shape, self.shape
        first = np.stack([block // columns % rows, block % columns], axis=-1) * BLOCK
        size = np.minimum(BLOCK, [height, width] - first)
        row, column = (first + (place * size).astype(np.int64)).T
        return (block // (rows * columns) * height + row) * width + column

    @property
    def areas(self) -> Float64[np.ndarray, " block"]:
        """Pixels in each block."""
        (height, width), (rows, columns) = self.resolution.shape, self.shape
        high = np.minimum(BLOCK, height - BLOCK * np.arange(rows))
        wide = np.minimum(BLOCK, width - BLOCK * np.arange(columns))
        return np.tile(np.outer(high, wide).ravel(), self.num_views).astype(np.float64)


Drawn = tuple[Int[Tensor, " pixel"], Float32[Tensor, "pixel 3"], Float32[Tensor, "pixel 3"] | None]
"""Row numbers of pixels, the differences of a renderer's sRGB from the true one, and their variance if it is known."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Errors:
    """The squared errors of the pixels that a run has drawn, summed over blocks."""

    blocks: Blocks
    noise: Float64[np.ndarray, " block"]
    """Mean variance of the noise of the pictures in each block, in sRGB: the error that no renderer can avoid."""
    sums: Int[Tensor, "2 block"]
    """Visits, and squared errors in sRGB (means over channels, in `UNIT`), of finished steps."""
    recent: list[Drawn] = field(default_factory=list)
    """The pixels of the step that is being taken, in this process alone."""

    def take_in(self, processes: Processes) -> None:
        """Adds the pixels that all processes have drawn since the last call to the sums."""
        if not self.recent:  # A method whose loss is its own draws as it likes.
            return
        index, missed, variance = zip(*self.recent, strict=True)
        self.recent.clear()
        squares = torch.cat(missed).square()
        if variance[0] is not None:  # A prediction above a white truth counts as right, whatever its noise.
            squares = torch.where(squares == 0, 0.0, squares - torch.cat(variance))
        squares = (squares.mean(dim=-1).double() / UNIT).long()
        found = torch.zeros_like(self.sums)
        block = self.blocks.of(torch.cat(index).to(found.device))
        found.index_add_(1, block, torch.stack([torch.ones_like(squares), squares]))
        self.sums.add_(processes.sum(found))

    def shares(self) -> Float64[np.ndarray, " block"]:
        """The share of the pixels drawn by error that each block gets: its area times the root of its mean squared
        error above the noise, limited to `MOST` times the mean; zeros if nothing is known to be wrong."""
        visits, squares = self.sums.cpu().numpy().astype(np.float64)
        squares = squares * UNIT - visits * self.noise
        mean = max(squares.sum() / max(visits.sum(), 1.0), 0.0)
        size = np.sqrt(np.maximum((squares + EXPECTED * mean) / (visits + EXPECTED), 0.0))
        areas = self.blocks.areas
        share = areas * np.minimum(size, MOST * np.average(size, weights=areas))
        return share / (share.sum() or 1.0)

    def fade(self) -> None:
        """Scales the sums down where they remember more than `REMEMBERED` visits to an average block."""
        kept = min(1.0, REMEMBERED * len(self.blocks) / max(float(self.sums[0].sum()), 1.0))
        self.sums.copy_((self.sums.double() * kept).round().long())


@dataclass(frozen=True, kw_only=True, eq=False)
class BlockDraws:
    """Draws of pixels, half of them by the errors of their blocks."""

    errors: Errors
    edges: Float64[np.ndarray, " block"]
    """Cumulative shares of blocks; zeros: every pixel is as likely as any other."""

    def rows(self, number: int, rng: np.random.Generator) -> Int[np.ndarray, " pixel"]:
        """Row numbers of random pixels."""
        blocks = self.errors.blocks
        rows = rng.integers(blocks.num_views * blocks.resolution.pixels, size=number)
        if self.edges[-1] == 0:
            return rows
        by_error = int(number * BY_ERROR)
        block = np.searchsorted(self.edges, rng.random(by_error) * self.edges[-1], side="right")
        rows[:by_error] = blocks.pixels(block, rng.random((by_error, 2)))
        return rows

    def add(
        self,
        index: Int[Tensor, " pixel"],
        missed: Float32[Tensor, "pixel 3"],
        variance: Float32[Tensor, "pixel 3"] | None,
    ) -> None:
        """Keeps differences of pixels from their true sRGB for the end of the step."""
        self.errors.recent.append((index, missed.detach(), None if variance is None else variance.detach()))


@dataclass(kw_only=True)
class DrawSchedule:
    """How each step of a run draws its pixels. The rays of a step are traced during the step before, so the errors that
    a step looks at end a step earlier."""

    pixels: PixelSource
    errors: Errors | None = None
    """None: every pixel is always as likely as any other."""
    edges: dict[int, Float64[np.ndarray, " block"]] = field(default_factory=dict)
    """Cumulative shares of blocks by the number of finished steps that they know; the last two."""

    def at(self, step: int) -> PixelSource:
        """The pixels, drawn as step `step` draws them, from 0 on; known when step `step - 2` has ended."""
        if self.errors is None:
            return self.pixels
        known = max(step - 1, 0) // REFRESH * REFRESH
        edges = self.edges.get(known, np.zeros(len(self.errors.blocks)))
        assert isinstance(self.pixels, Drawable)
        return self.pixels.drawn(BlockDraws(errors=self.errors, edges=edges))

    def end(self, done: int, processes: Processes) -> None:
        """Takes in the errors of the last of `done` steps, of all processes, and looks at them where it is time."""
        if self.errors is None:
            return
        self.errors.take_in(processes)
        if done % REFRESH == 0:
            self.edges = {**dict(list(self.edges.items())[-1:]), done: np.cumsum(self.errors.shares())}
            self.errors.fade()

    def state(self) -> State:
        """For a checkpoint."""
        if self.errors is None:
            return None
        edges = {done: torch.from_numpy(edges) for done, edges in self.edges.items()}
        return {"sums": self.errors.sums, "edges": edges}

    def load_state(self, state: State) -> None:
        """Goes on from `state()`."""
        if self.errors is None:
            return
        saved = cast(dict[str, Any], state)
        self.errors.sums.copy_(saved["sums"])
        self.edges = {done: edges.numpy() for done, edges in saved["edges"].items()}


def make_schedule(pixels: PixelSource, how: DrawKind, dataset: Dataset, views: Sequence[int]) -> DrawSchedule:
    """A fresh schedule for the pixels of some training views.

    Raises:
        HyalineError: pixels that are drawn as whole views cannot be drawn by error.
    """
    if how == "uniform":
        return DrawSchedule(pixels=pixels)
    if pixels.whole_views or not isinstance(pixels, Drawable):
        raise HyalineError("draws: is error, but this network learns from crops or whole pictures; expected uniform")
    blocks = Blocks(num_views=len(views), resolution=pixels.resolution)
    sums = torch.zeros(2, len(blocks), dtype=torch.int64, device=pixels.device)
    noise = noise_of_blocks(blocks, dataset, views)
    return DrawSchedule(pixels=pixels, errors=Errors(blocks=blocks, noise=noise, sums=sums))


def noise_of_blocks(blocks: Blocks, dataset: Dataset, views: Sequence[int]) -> Float64[np.ndarray, " block"]:
    """Mean variance of the noise in sRGB of training pictures; zeros for imported pictures, whose noise is unknown."""
    if dataset.imported is not None:
        return np.zeros(len(blocks))
    squares = []
    for view in views:
        radiance, noise = dataset.view("train", view).radiance_and_noise()
        halves = srgb_from_linear(radiance + noise), srgb_from_linear(radiance - noise)
        squares.append(np.square((halves[0] - halves[1]) / 2).mean(axis=-1).ravel())
    block = blocks.of(torch.arange(blocks.num_views * blocks.resolution.pixels)).numpy()
    return np.bincount(block, weights=np.concatenate(squares), minlength=len(blocks)) / blocks.areas
