"""Training by several processes (`torchrun`), as PyTorch's DistributedDataParallel does it.

Each process draws its own share of every batch with a seed of its own, and gradients are averaged over all processes.
Batch norm sees the rows of its own process; the first one's running statistics are saved. So two processes train as
well as one, but not to the same numbers. Equal numbers of processes and threads give equal bytes.
"""

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta
from typing import cast

import numpy as np
import torch
from torch import Tensor, distributed, nn

from datagen.disk.errors import HyalineError
from model.settings.runtime import process_number

PATIENCE = timedelta(days=1)
"""How long processes wait for each other; the first may be scoring or writing a cache. `torchrun` ends all of them if
one fails."""


@dataclass(frozen=True, kw_only=True)
class Processes:
    """The processes that train together, from the view of one of them; by default a single one."""

    rank: int = 0
    count: int = 1

    @property
    def count_here(self) -> int:
        """Processes on this machine."""
        return min(self.count, process_number("LOCAL_WORLD_SIZE", 1))

    @property
    def is_first(self) -> bool:
        """True for the one that writes files and messages."""
        return self.rank == 0

    def share(self, batch: int) -> int:
        """How many of a batch's pixels each process draws."""
        return batch // self.count

    def generator(self, seed: int, step: int, update: int) -> np.random.Generator:
        """The random generator of an update in this process; the first one's equals that of a single process."""
        return np.random.default_rng([seed, step, update, self.rank])

    def mean_loss(self, loss: Tensor, *, is_stopped: bool) -> tuple[Tensor, bool]:
        """The mean over all processes, and whether any was asked to stop; all get the same result."""
        if self.count == 1:
            return loss.detach(), is_stopped
        total = torch.stack([loss.detach(), loss.new_tensor(float(is_stopped))])
        distributed.all_reduce(total)
        return total[0] / self.count, bool(total[1] > 0)

    def average_gradients(self, renderer: nn.Module) -> None:
        """Makes every gradient its mean over all processes; those of textures are whole tables, too."""
        if self.count == 1:
            return
        waiting = []
        for parameter in renderer.parameters():
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
            waiting.append((distributed.all_reduce(parameter.grad, async_op=True), parameter.grad))
        for work, gradient in waiting:
            cast(distributed.Work, work).wait()
            gradient /= self.count

    def broadcast(self, is_needed: bool = False) -> bool:
        """The first process's value; the others' are ignored."""
        if self.count == 1:
            return is_needed
        value = torch.tensor([is_needed], dtype=torch.uint8)
        try:
            distributed.broadcast(value, 0)
        except RuntimeError as error:
            raise HyalineError("the first process has ended; its own message gives the reason") from error
        return bool(value.item())

    @contextlib.contextmanager
    def in_turn(self) -> Iterator[None]:
        """Runs the block in the first process before the others, which then find its files."""
        if not self.is_first:
            self.broadcast()
        yield
        if self.is_first:
            self.broadcast()


ALONE = Processes()


def is_one_of_several() -> bool:
    """True in one of several processes started by `torchrun`."""
    return process_number("WORLD_SIZE", 1) > 1


def see_own_gpu() -> None:
    """Hides the GPUs of other `torchrun` processes from this one, so that torch and Dr.Jit both use its own.

    Dr.Jit 1.5 always takes the first GPU that it sees. Call this before anything asks CUDA; machines without a GPU
    stay as they are.
    """
    if not is_one_of_several() or (count := torch.cuda.device_count()) == 0:
        return
    index = process_number("LOCAL_RANK", 0)
    if index >= count:
        raise HyalineError(
            f"device: process {index + 1} of this machine finds {count} GPUs; expected one each, "
            "so give torchrun a lower --nproc-per-node, or train with --device cpu"
        )
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")
    os.environ["CUDA_VISIBLE_DEVICES"] = visible[index] if visible != [""] else str(index)


@contextlib.contextmanager
def join(device: torch.device) -> Iterator[Processes]:
    """The processes that `torchrun` has started, or this one alone."""
    if not is_one_of_several():
        yield ALONE
        return
    # Tensors on the CPU travel by gloo, whatever is trained on.
    backend = "cpu:gloo,cuda:nccl" if device.type == "cuda" else "gloo"
    distributed.init_process_group(backend, timeout=PATIENCE)
    try:
        yield Processes(rank=distributed.get_rank(), count=distributed.get_world_size())
    finally:
        distributed.destroy_process_group()
