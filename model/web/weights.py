"""Linear layers as the page's shader reads them: four outputs beside each other."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32
from torch import Tensor, nn

from model.web.texels import fours

Rows = Float32[np.ndarray, "_ 4"]


def layer_rows(weight: Tensor, bias: Tensor, columns: Sequence[int] | None = None) -> list[Rows]:
    """Weights, for four outputs at once, input by input, then biases; units come in fours.

    Args:
        columns: which input stands in each place, -1 for none; by default all, and none up to the next four.
    """
    values, biases = (value.detach().cpu().numpy().astype(np.float32) for value in (weight, bias))
    if columns is None:
        values = np.pad(values, ((0, 0), (0, fours(values.shape[1]) - values.shape[1])))
    else:
        values = np.concatenate([values, np.zeros((len(values), 1), np.float32)], axis=1)[:, list(columns)]
    more = fours(len(values)) - len(values)
    values, biases = np.pad(values, ((0, more), (0, 0))), np.pad(biases, (0, more))
    return [values.reshape(-1, 4, values.shape[1]).transpose(0, 2, 1).reshape(-1, 4), biases.reshape(-1, 4)]


def mlp_rows(net: nn.Sequential, columns: Sequence[int]) -> list[Rows]:
    """All layers of a network; the columns are those of the first."""
    first, *others = [layer for layer in net if isinstance(layer, nn.Linear)]
    return [
        *layer_rows(first.weight, first.bias, columns),
        *(rows for layer in others for rows in layer_rows(layer.weight, layer.bias)),
    ]


def feature_columns(features: int, others: int, first: int = 0) -> list[int]:
    """The columns of features, filled up to fours, and of the inputs behind them."""
    filler = [-1] * (fours(features) - features)
    return [*range(first, first + features), *filler, *range(first + features, first + features + others)]
