"""Training batches whose rays are traced by a second thread, a step ahead, while torch computes."""

import dataclasses
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Generic, Self, TypeVar

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from model.batches.rays import PixelSource, draw_rows

Batch = TypeVar("Batch")
Draw = tuple[Int[Tensor, " pixel"], np.random.Generator]
"""Row numbers of a batch's pixels, and the generator of its rays, which has drawn the row numbers."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TracedPixels(PixelSource[Batch]):
    """Pixels whose rays are traced for each batch, several batches at once for less."""

    ahead: "Ahead[Batch] | None" = None
    """Where the next training batch comes from; None if it is traced when it is asked for."""

    def take_all(self, draws: Sequence[Draw], *, beside_torch: bool = False) -> list[Batch]:
        """The batches of several draws, as `take` gives each.

        Args:
            beside_torch: on the calling thread alone, because another one computes with torch.
        """
        raise NotImplementedError

    def taken_from(self, ahead: "Ahead[Batch]") -> Self:
        """The same pixels; `take` with a generator gives the next batch that was made ahead."""
        return dataclasses.replace(self, ahead=ahead)


class Ahead(Generic[Batch]):
    """The batches of a run's steps, in their order: those of a step are made together during the step before.

    Rays do not depend on weights, and each batch has a generator of its own, so a run that is resumed at any step gets
    the same batches.
    """

    def __init__(
        self,
        pixels: TracedPixels[Batch],
        draw: Callable[[int], list[np.random.Generator]],
        *,
        size: int,
    ) -> None:
        """Makes nothing before the first step begins.

        Args:
            pixels: what each step draws from.
            draw: fresh generators of a step's batches, by step.
            size: pixels in each batch.
        """
        self._pixels, self._draw, self._size = pixels, draw, size
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="trace ahead")
        self._made: dict[int, Future[list[tuple[object, Draw, Batch]]]] = {}
        self._ready: deque[tuple[object, Draw, Batch]] = deque()

    def begin(self, step: int, *, is_last: bool) -> None:
        """Waits for a step's batches, and has those of the next one made unless it is the last.

        Raises:
            Exception: what went wrong in the other thread.
        """
        made = self._made.pop(step, None) or self._thread.submit(self._make, step)
        if not is_last:
            self._made[step + 1] = self._thread.submit(self._make, step + 1)
        self._ready = deque(made.result())

    def next(self, rng: np.random.Generator) -> Batch:
        """The step's next batch; `rng` has drawn its pixels, and goes on as if it had drawn the rays, too."""
        before, (_, drawn), batch = self._ready.popleft()
        assert rng.bit_generator.state == before, "the batches made ahead are not those that are asked for"
        rng.bit_generator.state = drawn.bit_generator.state
        return batch

    def close(self) -> None:
        """Ends the thread, after the batches that it is making."""
        self._thread.shutdown(cancel_futures=True)

    def _make(self, step: int) -> list[tuple[object, Draw, Batch]]:
        draws = [(torch.from_numpy(draw_rows(self._pixels, self._size, rng)), rng) for rng in self._draw(step)]
        before = [rng.bit_generator.state for _, rng in draws]
        return list(zip(before, draws, self._pixels.take_all(draws, beside_torch=True), strict=True))
