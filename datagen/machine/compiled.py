"""Functions that Numba compiles, and keeps for later processes where it finds a folder for that."""

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core.caching import FunctionCache

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(
    *, parallel: bool = False, nogil: bool = False, boundscheck: bool | None = None
) -> Callable[[Function], Function]:
    """Numba's `njit` with its cache; without it if neither the folder of the code nor that of the user can be written,
    which Numba answers with an error, and without a home directory.

    Division by zero gives what NumPy gives: a check of each divisor would keep loops from being vectorised.
    """

    def decorate(function: Function) -> Function:
        options = {"parallel": parallel, "nogil": nogil, "boundscheck": boundscheck, "error_model": "numpy"}
        made = numba.njit(function, **options)
        if _has_home():
            with contextlib.suppress(RuntimeError):
                # As Numba 0.68 does for `cache=True`.
                made._cache = _Cache(function)  # pyright: ignore[reportAttributeAccessIssue]
        return cast(Function, made)

    return decorate


def _has_home() -> bool:
    """False where Numba's cache would be a folder called `~` in the working directory, whose code it would run."""
    cache = os.environ.get("XDG_CACHE_HOME", os.path.expanduser("~"))  # noqa: PTH111 - Path raises an error.
    return bool(os.environ.get("NUMBA_CACHE_DIR")) or Path(cache).is_absolute()


class _Cache(FunctionCache):
    """Numba's cache, without which code works, too: on a full disk it is compiled again by each process."""

    def save_overload(self, sig: Any, data: Any) -> None:
        with contextlib.suppress(OSError):
            super().save_overload(sig, data)
