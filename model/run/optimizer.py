"""Adam, without the 3 s of CPU time in which torch's own loads the compiler that nothing here uses."""

import inspect

import torch

from model.methods.renderer import ParameterGroup


class Adam(torch.optim.Adam):
    """torch's Adam, bit for bit, without `import torch._dynamo`.

    torch wraps its optimizers' methods so that `torch.compile` leaves them alone, and each wrapper imports the compiler
    to say so. `step` here is the method inside the wrapper; the others find their answer where torch 2.13 stores it. A
    torch that stores it elsewhere imports its compiler as before.
    """

    @torch.no_grad()
    def step(self, closure: None = None) -> None:
        """Moves every parameter by its gradient."""
        inspect.unwrap(torch.optim.Adam.step)(self, closure)


for _name in ("add_param_group", "zero_grad", "state_dict", "load_state_dict"):
    _method = inspect.unwrap(getattr(torch.optim.Optimizer, _name))
    _method.__dict__.setdefault("__dynamo_disable", _method)


def make_optimizer(groups: list[ParameterGroup], *, beta1: float) -> Adam:
    """Dense Adam, as in the paper: a texel moves on by its momentum after the step that touched it."""
    return Adam(
        [{"params": group.parameters, "lr": group.lr, "weight_decay": group.weight_decay} for group in groups],
        betas=(beta1, 0.999),
        fused=True,
    )
