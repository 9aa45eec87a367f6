"""Owns batches that are traced ahead: a thread traces the next step's rays while the current step is learned."""

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Int, UInt8
from torch import Tensor

from model.batches import PixelSource, draw_index


@dataclass(frozen=True, kw_only=True, eq=False)
class Taken:
    """What `take` gave for random pixels, and the generator's states around it."""

    index: Tensor
    before: object
    batch: Any
    after: Any


class TakenAhead:
    """A source of pixels that takes random batches in a thread, as soon as they are expected.

    Equal to its source bit by bit: a batch is handed out only to who asks for the same pixels with a generator in the
    same state, which is then left as the source would have left it. What nobody expected is taken when it is asked for.
    """

    def __init__(self, source: PixelSource) -> None:
        self._source = source
        self._worker = ThreadPoolExecutor(1)
        self._expected: deque[Future[Taken]] = deque()

    @property
    def rgb(self) -> UInt8[Tensor, "pixel 3"]:
        return self._source.rgb

    @property
    def pixels_per_view(self) -> int:
        return self._source.pixels_per_view

    @property
    def chunk(self) -> int:
        return self._source.chunk

    def to(self, device: torch.device) -> "TakenAhead":
        return TakenAhead(self._source.to(device))

    def expect(self, batch: int, rng: np.random.Generator) -> None:
        """Begins to take the batch that a step with this generator, which it gets for itself, will draw."""
        self._expected.append(self._worker.submit(self._draw, batch, rng))

    def take(self, index: Int[Tensor, "*pixel"], rng: np.random.Generator | None) -> Any:
        if rng is None or not self._expected:
            return self._source.take(index, rng)
        taken = self._expected.popleft().result()
        if not torch.equal(taken.index, index) or taken.before != rng.bit_generator.state:
            return self._source.take(index, rng)
        rng.bit_generator.state = taken.after
        return taken.batch

    def _draw(self, batch: int, rng: np.random.Generator) -> Taken:
        index = draw_index(self._source, batch, rng)
        before = rng.bit_generator.state
        taken = self._source.take(index, rng)
        return Taken(index=index, before=before, batch=taken, after=rng.bit_generator.state)
