"""What a checkpoint can hold."""

from torch import Tensor

State = None | bool | int | float | str | Tensor | list | tuple | dict
"""What `weights_only=True` reads back; the containers hold states again."""
