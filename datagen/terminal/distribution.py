"""The distribution that people install: its name, its version, and the parts that it can be installed in."""

import contextlib
from collections.abc import Iterator

from datagen.disk.errors import HyalineError

DISTRIBUTION = "hyaline-glass"
"""What pip calls it; the package index has another project by the name of `hyaline`."""

VERSION = "0.3.0"

_GENERATE = ("mitsuba", "drjit", "trimesh", "xatlas", "numba", "manifold3d")
PARTS = {
    "generate": _GENERATE,
    "proxies": (*_GENERATE, "pymeshlab"),
    "model": (*_GENERATE, "torch"),
    "view": ("viser",),
    "cluster": ("submitit",),
}
"""The modules that each extra adds to what reads datasets and scores pictures (pyproject.toml has their versions)."""

OWN_PARTS = {"datagen": "generate", "proxies": "proxies", "model": "model"}
"""What each command needs to do all it can."""


def install_command(extra: str) -> str:
    """What adds a part to this installation, from wherever it was installed."""
    return f'pip install "{DISTRIBUTION}[{extra}]"'


@contextlib.contextmanager
def naming_parts(where: str) -> Iterator[None]:
    """Says which part to install where a module of one is missing.

    Args:
        where: the command or function that needs it, its program first.

    Raises:
        HyalineError: the module is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        own = OWN_PARTS.get(where.split()[0], "")
        extra = next((name for name in (own, *PARTS) if error.name in PARTS.get(name, ())), None)
        if extra is None:
            raise
        needed = f"{where}: needs {error.name}, which is not installed"
        raise HyalineError(f"{needed}; `{install_command(extra)}` brings it") from error
