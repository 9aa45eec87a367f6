"""Adam for large textures on a CPU: each update costs as much as the texels that its rays meet, not as all texels.

In dense Adam every texel keeps moving by its momentum after the update that met it. Here a texel catches up when it is
read next. Its gradient was zero in the k updates since s, so m and v have decayed by b1^k and b2^k, and it has moved by
m / sqrt(v) times the sum of rate_u (b1 / sqrt(b2))^(u - s) over these updates u, which is kept for each s. This is
dense Adam except for rounding, and for the term 1e-8 beside sqrt(v), which stays as it was at s.
"""

# Numba's extensions are untyped.
# pyright: reportCallIssue=false

import math
from typing import cast

import numba
import numpy as np
import torch
from jaxtyping import Float32, Float64, Int32, UInt8
from torch import Tensor

from datagen.disk.errors import HyalineError
from datagen.machine.compiled import compiled
from model.nets.texels import AHEAD, fetch, taps
from model.state import State

BETA2, EPSILON = 0.999, 1e-8

Moved = tuple[
    Float32[np.ndarray, "texel c"],
    Float32[np.ndarray, "texel c"],
    Float32[np.ndarray, "texel c"],
    Int32[np.ndarray, " texel"],
    int,
    Float64[np.ndarray, "update 4"],
]
"""Table, means, squares, and update up to which each texel has been moved; number of updates, and their history."""

LEAST_SHARE = 1e-9
"""Share of a momentum below which it moves a texel no more."""


class LazyAdam:
    """The optimiser's state of one table of texels, the table's gradient, and the texels that this update has read."""

    def __init__(self, table: Float32[Tensor, "texel c"], *, beta1: float) -> None:
        self._table = table
        self.gradient = torch.zeros_like(table, requires_grad=False)
        """Zero except for texels that the current update has read."""
        self.added = 0.0
        """Sum of the upstream gradients that the current update has added to it."""
        self._mean, self._square = torch.zeros_like(self.gradient), torch.zeros_like(self.gradient)
        self._current = torch.zeros(len(table), dtype=torch.int32)
        """Update up to which a texel has been moved, by texel."""
        self._is_read = np.zeros(len(table), np.uint8)
        self._read, self._num_read = np.empty(len(table), np.int32), 0
        self._beta1, self._ratio = beta1, beta1 / math.sqrt(BETA2)
        self._updates = 0
        self._history = np.zeros((0, 4))
        """By update: the sum of rates times powers of `_ratio` since then; and by number of updates, what is left of a
        mean and of a square, and Adam's 1e-8 as it counts after this update."""
        self._lengthen(1024)

    def read(
        self,
        uv: Float32[np.ndarray, "slot 2"],
        object_id: UInt8[np.ndarray, " slot"],
        places: Int32[np.ndarray, "3 object"],
        *,
        is_training: bool,
    ) -> None:
        """Moves the texels around these points to where they are now; in training they will have a gradient."""
        self._num_read = _read_texels(
            uv, object_id, places, self._moved(), self._is_read, self._read, self._num_read, is_training
        )

    def is_finite(self) -> bool:
        """Whether the gradient is; each texel's is a weighted sum of upstream gradients."""
        return math.isfinite(self.added)

    def step(self, rate: float) -> None:
        """Adam's step for the texels that were read, whose gradient is zero afterwards."""
        self._updates += 1
        now = self._updates
        if now >= len(self._history):
            self._lengthen(2 * now)
        first_share, second_share = 1 - self._beta1**now, 1 - BETA2**now
        rate *= math.sqrt(second_share) / first_share
        if self._ratio > 0:
            reach = min(now, math.ceil(math.log(LEAST_SHARE) / math.log(self._ratio)))
            powers = self._ratio ** np.arange(reach, 0, -1)
            self._history[now - reach : now, 0] += rate * powers
        _step_rows(
            self._table.detach().numpy(),
            self.gradient.numpy(),
            self._mean.numpy(),
            self._square.numpy(),
            self._current.numpy(),
            self._is_read,
            self._read[: self._num_read],
            now,
            np.float32(rate),
            np.float32(self._beta1),
            np.float32(self._history[now, 3]),
        )
        self._num_read, self.added = 0, 0.0

    def catch_up(self) -> None:
        """Moves all texels to where they are now."""
        _catch_up_all(self._moved())

    def state(self) -> State:
        """State for a checkpoint; the table is stored as is, with pending updates."""
        return {
            "mean": self._mean,
            "square": self._square,
            "current": self._current,
            "sums": torch.from_numpy(self._history[: self._updates + 1, 0].copy()),
        }

    def load_state(self, state: State) -> None:
        found = cast(dict[str, Tensor], state)
        self._mean.copy_(found["mean"])
        self._square.copy_(found["square"])
        self._current.copy_(found["current"])
        self._updates = len(found["sums"]) - 1
        self._lengthen(self._updates + 1024)
        self._history[:, 0] = 0
        self._history[: self._updates + 1, 0] = found["sums"].numpy()

    def _lengthen(self, length: int) -> None:
        number = np.arange(length)
        sums = np.zeros(length)
        sums[: len(self._history)] = self._history[:length, 0]
        # Without denormal numbers, which are slow.
        left = [np.where(decay**number > LEAST_SHARE**2, decay**number, 0) for decay in (self._beta1, BETA2)]
        self._history = np.stack([sums, *left, EPSILON * np.sqrt(1 - BETA2**number)], axis=1)

    def _moved(self) -> Moved:
        return (
            self._table.detach().numpy(),
            self._mean.numpy(),
            self._square.numpy(),
            self._current.numpy(),
            self._updates,
            self._history,
        )


@numba.njit(error_model="numpy")
def _catch_up(moved, rows):
    """Moves texels by their momentum in the updates since each was current.

    Their moments are rarely in a cache: they are fetched ahead instead of waited for. A call for each texel would take
    six times as long, since it counts references to all arrays.
    """
    table, mean, square, current, updates, history = moved
    for place in range(len(rows)):
        if place + AHEAD < len(rows):
            ahead = rows[place + AHEAD]
            fetch(table, ahead)
            fetch(mean, ahead)
            fetch(square, ahead)
        row = rows[place]
        since = current[row]
        current[row] = updates
        if since in (updates, 0):
            continue
        way, epsilon = np.float32(history[since, 0]), np.float32(history[since, 3])
        kept_mean, kept_square = np.float32(history[updates - since, 1]), np.float32(history[updates - since, 2])
        for c in range(table.shape[1]):
            table[row, c] -= way * mean[row, c] / (np.sqrt(square[row, c]) + epsilon)
            mean[row, c] *= kept_mean
            square[row, c] *= kept_square


@compiled()
def _read_texels(
    uv: Float32[np.ndarray, "slot 2"],
    object_id: UInt8[np.ndarray, " slot"],
    places: Int32[np.ndarray, "3 object"],
    moved: Moved,
    is_read: UInt8[np.ndarray, " texel"],
    read: Int32[np.ndarray, " texel"],
    num_read: int,
    is_training: bool,
) -> int:
    """Lists the texels around points, each once in an update, and lets them catch up; returns how many are listed."""
    first = num_read
    for slot in range(len(object_id)):
        place = np.int32(object_id[slot]) - 1
        if place < 0:
            continue
        rows, _ = taps(uv, places, slot, place)
        for tap in range(4):
            row = rows[tap]
            if not is_read[row]:
                is_read[row] = 1
                read[num_read] = row
                num_read += 1
    _catch_up(moved, read[first:num_read])
    if is_training:
        return num_read
    for row in read[first:num_read]:
        is_read[row] = 0
    return first


@compiled()
def _catch_up_all(
    moved: Moved,
) -> None:
    _catch_up(moved, np.arange(len(moved[0])))


@compiled()
def _step_rows(
    table: Float32[np.ndarray, "texel c"],
    gradient: Float32[np.ndarray, "texel c"],
    mean: Float32[np.ndarray, "texel c"],
    square: Float32[np.ndarray, "texel c"],
    current: Int32[np.ndarray, " texel"],
    is_read: UInt8[np.ndarray, " texel"],
    rows: Int32[np.ndarray, " row"],
    update: int,
    rate: np.float32,
    beta1: np.float32,
    epsilon: np.float32,
) -> None:
    one, beta2 = np.float32(1), np.float32(BETA2)
    for place in range(len(rows)):
        if place + AHEAD < len(rows):
            ahead = rows[place + AHEAD]
            fetch(table, ahead)
            fetch(mean, ahead)
            fetch(square, ahead)
            fetch(gradient, ahead)
        row = rows[place]
        for c in range(table.shape[1]):
            slope = gradient[row, c]
            mean[row, c] = beta1 * mean[row, c] + (one - beta1) * slope
            square[row, c] = beta2 * square[row, c] + (one - beta2) * slope * slope
            table[row, c] -= rate * mean[row, c] / (np.sqrt(square[row, c]) + epsilon)
            gradient[row, c] = 0
        current[row] = update
        is_read[row] = 0


def check_states(states: State, number: int) -> list[State]:
    """The states of this number of tables, as a checkpoint has them.

    Raises:
        HyalineError: the checkpoint has others.
    """
    if not isinstance(states, list) or len(states) != number:
        raise HyalineError("the checkpoint's optimiser is of another version of hyaline; start over with --overwrite")
    return states
