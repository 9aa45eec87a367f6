"""Training by several processes (`torchrun`): who they are, each one's share of a batch, sums over all of them.

Each process draws the whole batch, takes its share, and adds its part of the loss and of every gradient to those of the
others; batch norm sees all shares. So the processes together take the steps that one alone would, but for rounding.
"""

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor, distributed, nn
from torch.autograd.function import FunctionCtx

from datagen.disk.errors import HyalineError

PATIENCE = timedelta(days=1)
"""How long one waits for the others, the first of whom may be scoring or laying out a cache. `torchrun` ends all as
soon as one has failed."""


@dataclass(frozen=True, kw_only=True)
class Team:
    """The processes that train together, as one of them sees it; one alone unless told."""

    rank: int = 0
    size: int = 1

    @property
    def size_here(self) -> int:
        """Processes on this machine."""
        return min(self.size, int(os.environ.get("LOCAL_WORLD_SIZE", "1")))

    @property
    def is_first(self) -> bool:
        """True for the one that writes files and speaks."""
        return self.rank == 0

    def share(self, batch: int) -> range:
        """The places in a batch that are this process's."""
        return range(batch * self.rank // self.size, batch * (self.rank + 1) // self.size)

    def generator(self, seed: list[int], batch: int) -> np.random.Generator:
        """The generator of a step: whatever is drawn for each pixel of the batch, this process gets its share of."""
        return np.random.default_rng(seed) if self.size == 1 else SharedGenerator(seed, self.share(batch), batch)

    def weigh(self, loss: Tensor, batch: int) -> Tensor:
        """This process's part of the mean over a batch, from the mean over its share."""
        return loss if self.size == 1 else loss * (len(self.share(batch)) / batch)

    def sum_loss(self, part: Tensor, *, is_stopped: bool) -> tuple[float, bool]:
        """The loss of the whole batch, and whether any process was asked to stop; the same in all processes."""
        if self.size == 1:
            return float(part.item()), is_stopped
        total = torch.stack([part.detach(), part.new_tensor(float(is_stopped))])
        distributed.all_reduce(total)
        loss, stopped = total.tolist()
        return loss, stopped > 0

    def sum_gradients(self, renderer: nn.Module) -> None:
        """Adds up every gradient over all processes; those of textures are whole tables, too."""
        if self.size == 1:
            return
        waiting = []
        for parameter in renderer.parameters():
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
            waiting.append(distributed.all_reduce(parameter.grad, async_op=True))
        for work in waiting:
            cast(distributed.Work, work).wait()

    def share_norms(self, renderer: nn.Module) -> None:
        """Makes every batch norm one of all processes; names and values of parameters stay."""
        if self.size == 1:
            return
        for parent in list(renderer.modules()):
            for name, child in list(parent.named_children()):
                if type(child) is nn.BatchNorm1d:
                    shared = SharedBatchNorm(child.num_features, eps=child.eps, momentum=child.momentum)
                    shared.load_state_dict(child.state_dict())
                    setattr(parent, name, shared)

    def agree(self, is_needed: bool = False) -> bool:
        """What the first process says; what the others say does not count.

        Raises:
            HyalineError: the first process has ended.
        """
        if self.size == 1:
            return is_needed
        said = torch.tensor([is_needed], dtype=torch.uint8)
        try:
            distributed.broadcast(said, 0)
        except RuntimeError as error:
            raise HyalineError("the first process has ended; its own line says why") from error
        return bool(said.item())

    @contextlib.contextmanager
    def in_turn(self) -> Iterator[None]:
        """The first process passes before all others, who find what it has made."""
        if not self.is_first:
            self.agree()
        yield
        if self.is_first:
            self.agree()


ALONE = Team()


def is_one_of_several() -> bool:
    """True in a process that `torchrun` has started beside others."""
    return int(os.environ.get("WORLD_SIZE", "1")) > 1


def own_device(device: torch.device) -> torch.device:
    """The GPU of this process, where several share a machine; other devices as they are.

    Raises:
        HyalineError: the machine has fewer GPUs than processes.
    """
    if device.type != "cuda" or not is_one_of_several():
        return device
    index = int(os.environ["LOCAL_RANK"])
    if index >= torch.cuda.device_count():
        raise HyalineError(
            f"device: process {index + 1} of this machine finds {torch.cuda.device_count()} GPUs; expected one each, "
            "so give torchrun a lower --nproc-per-node, or train with --device cpu"
        )
    return torch.device("cuda", index)


@contextlib.contextmanager
def join(device: torch.device) -> Iterator[Team]:
    """The team that `torchrun` has started, or this process alone."""
    if not is_one_of_several():
        yield ALONE
        return
    if device.type == "cuda":
        torch.cuda.set_device(device)
    # Tensors on the CPU travel by gloo, whatever is trained on.
    backend = "cpu:gloo,cuda:nccl" if device.type == "cuda" else "gloo"
    distributed.init_process_group(backend, timeout=PATIENCE)
    try:
        yield Team(rank=distributed.get_rank(), size=distributed.get_world_size())
    finally:
        distributed.destroy_process_group()


class SharedGenerator(np.random.Generator):
    """Draws for all pixels of a batch, as `np.random.default_rng(seed)` would, and hands out the rows of a share.

    Rows are the first axis; several rays of a pixel are consecutive rows. What is drawn alone is the same for all.
    """

    def __init__(self, seed: list[int], share: range, batch: int) -> None:
        super().__init__(np.random.PCG64(seed))
        self.share, self.batch = share, batch

    def random(self, size: Any = None, dtype: Any = np.float64) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """As of the base class; rows of the share."""
        return super().random(dtype=dtype) if size is None else self._own(super().random(self._whole(size), dtype))

    def integers(self, low: Any, high: Any = None, size: Any = None) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """As of the base class; rows of the share."""
        if size is None:
            return super().integers(low, high)
        return self._own(super().integers(low, high, self._whole(size)))

    def _whole(self, size: int | tuple[int, ...]) -> tuple[int, ...]:
        """The shape for the whole batch, from that for the share."""
        rows, *rest = (size,) if isinstance(size, int) else size
        assert rows % len(self.share) == 0, "drawn for each pixel of the share"
        return (rows // len(self.share) * self.batch, *rest)

    def _own(self, drawn: np.ndarray) -> np.ndarray:
        per_pixel = len(drawn) // self.batch
        return drawn[self.share.start * per_pixel : self.share.stop * per_pixel]


class SharedBatchNorm(nn.BatchNorm1d):
    """Batch norm whose mean and variance, while training, are those of the rows of all processes.

    Two passes, as on one process: a sum of squares would cancel. (torch's SyncBatchNorm runs on GPUs alone.)
    """

    def forward(self, input: Float32[Tensor, "ray c"]) -> Float32[Tensor, "ray c"]:  # noqa: A002
        """Normalised by the batch while training, by the running statistics otherwise."""
        if not self.training:
            return super().forward(input)
        sums = _sum_over_all(torch.cat([input.sum(dim=0), input.new_full((1,), len(input))]))
        count = sums[-1].detach()
        mean = sums[:-1] / count
        centred = input - mean
        variance = _sum_over_all(centred.square().sum(dim=0)) / count
        with torch.no_grad():
            assert self.running_mean is not None and self.running_var is not None and self.momentum is not None
            assert self.num_batches_tracked is not None
            self.running_mean.lerp_(mean, self.momentum)
            self.running_var.lerp_(variance * (count / (count - 1)), self.momentum)
            self.num_batches_tracked.add_(1)
        return centred * (self.weight * torch.rsqrt(variance + self.eps)) + self.bias


class _SumOverAll(torch.autograd.Function):
    """The sum over all processes of a tensor; each one's gradient is the sum over all, who all use it."""

    @staticmethod
    def forward(ctx: FunctionCtx, part: Tensor) -> Tensor:  # noqa: ARG004
        total = part.clone()
        distributed.all_reduce(total)
        return total

    @staticmethod
    def backward(ctx: FunctionCtx, *upstream: Tensor) -> Tensor:  # noqa: ARG004
        total = upstream[0].contiguous().clone()
        distributed.all_reduce(total)
        return total


def _sum_over_all(part: Tensor) -> Tensor:
    return cast(Tensor, _SumOverAll.apply(part))
