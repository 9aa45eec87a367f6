"""Functions that Numba compiles, and keeps for later processes where it finds a folder for that."""

from collections.abc import Callable
from typing import TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(
    *, parallel: bool = False, nogil: bool = False, boundscheck: bool | None = None
) -> Callable[[Function], Function]:
    """Numba's `njit` with its cache; without it if neither the folder of the code nor that of the user can be written,
    which Numba answers with an error."""

    def decorate(function: Function) -> Function:
        try:
            made = numba.njit(
                function, cache=True, parallel=parallel, nogil=nogil, boundscheck=boundscheck, error_model="numpy"
            )
        except RuntimeError:
            made = numba.njit(function, parallel=parallel, nogil=nogil, boundscheck=boundscheck, error_model="numpy")
        return cast(Function, made)

    return decorate
