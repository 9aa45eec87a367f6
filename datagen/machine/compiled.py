"""Functions that Numba compiles, and keeps for later processes where it finds a folder for that."""

import contextlib
from collections.abc import Callable
from typing import TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(
    *, parallel: bool = False, nogil: bool = False, boundscheck: bool | None = None
) -> Callable[[Function], Function]:
    """Numba's `njit` with its cache; without it if neither the folder of the code nor that of the user can be written,
    which Numba answers with an error.

    Division by zero gives what NumPy gives: a check of each divisor would keep loops from being vectorised.
    """

    def decorate(function: Function) -> Function:
        made = numba.njit(function, parallel=parallel, nogil=nogil, boundscheck=boundscheck, error_model="numpy")
        with contextlib.suppress(RuntimeError):
            made.enable_caching()  # pyright: ignore[reportAttributeAccessIssue]
        return cast(Function, made)

    return decorate
