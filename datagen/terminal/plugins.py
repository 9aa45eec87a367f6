"""The distribution that people install, the parts of it, and the plug-ins that it and others bring.

Another distribution adds a name by an entry point, `[project.entry-points."hyaline.exports"]` in its pyproject.toml.
What is built in is a table in code, so that a source checkout needs no metadata. A name is only ever looked up: no name
that somebody types, or that a file holds, imports a module.
"""

import contextlib
import functools
import importlib
import importlib.util
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Generic, TypeVar, cast

from datagen.disk.errors import HyalineError, UsageError
from datagen.terminal.parsing import Later, choose

Plugin = TypeVar("Plugin")

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


@dataclass(frozen=True, kw_only=True, eq=False)
class Group(Generic[Plugin]):
    """The plug-ins of one kind, such as all formats of `datagen export`."""

    name: str
    """The entry-point group, such as hyaline.exports."""
    what: str
    """What a plug-in is called in errors, such as method."""
    guide: str
    """The page that says how to add one."""
    built_in: Mapping[str, str] = field(default_factory=dict)
    """`module:attribute` by name."""
    kind: str | None = None
    """`module:class` that a plug-in is an instance of; None: a plug-in is a function."""
    is_class: bool = False
    """A plug-in is a class that derives from `kind`."""

    own: dict[str, Plugin] = field(default_factory=dict)
    """Plug-ins that this process has added, and that no other process knows."""

    def places(self) -> dict[str, str]:
        """`module:attribute` by name: those built in, and those of other distributions."""
        return {**self.built_in, **{point.name: point.value for point in self._points()}}

    def names(self) -> tuple[str, ...]:
        """All names: those built in first, in their order, then those of other distributions, sorted."""
        others = sorted(point.name for point in self._points())
        names = (*self.built_in, *others, *self.own)
        if doubled := sorted({name for name in names if names.count(name) > 1}):
            sources = ", ".join(self.sources(doubled[0]))
            raise HyalineError(f"{self.what} {doubled[0]!r}: two distributions bring it ({sources}); uninstall one")
        return names

    def find(self, name: str) -> Plugin:
        """The plug-in of a name; an unknown name gets the nearest one as a suggestion."""
        if name not in (names := self.names()) and (package := self.absent().get(name)):
            raise UsageError(f"{self.what} {name!r}: is of the plug-in {package}, which is not here")
        choose(self.what, name, names)
        if name in self.own:
            return self.own[name]
        if name in self.built_in:
            return cast(Plugin, _load(self.built_in[name]))
        (point,) = self._points().select(name=name)
        where = f"{self.what} {name!r}: {point.value} of {self.sources(name)[0]}"
        try:
            found = point.load()
        except (Exception, SystemExit) as error:  # A stranger's module may raise anything.
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise HyalineError(f"{where} cannot be imported ({reason}); update or uninstall it") from error
        if not self._is_one(found):
            kind = "function" if self.kind is None else self.kind.partition(":")[2]
            raise HyalineError(f"{where} is not a {'subclass of ' * self.is_class}{kind}; see {self.guide}")
        return cast(Plugin, found)

    def absent(self) -> dict[str, str]:
        """The packages of this distribution that are not here, by the names that they would bring."""
        points = metadata.entry_points(group=self.name)
        return {point.name: point.module.partition(".")[0] for point in points if not _is_there(point)}

    def sources(self, name: str) -> list[str]:
        """The distributions that bring a name; "this process" for one that it has added."""
        points = self._points().select(name=name)
        built_in = [DISTRIBUTION] if name in self.built_in else []
        own = ["this process"] if name in self.own else []
        return built_in + [point.dist.name if point.dist else point.value for point in points] + own

    def _points(self) -> metadata.EntryPoints:
        times = [path.stat().st_mtime_ns if path.exists() else 0 for path in map(Path, sys.path)]
        return _installed(self.name, tuple(sys.path), tuple(times))

    def _is_one(self, found: object) -> bool:
        if self.kind is None:
            return callable(found)
        kind = cast(type, _load(self.kind))
        return isinstance(found, type) and issubclass(found, kind) if self.is_class else isinstance(found, kind)


@functools.cache
def _installed(group: str, _paths: tuple[str, ...], _times: tuple[int, ...]) -> metadata.EntryPoints:
    """A group's entry points in the distributions on these paths of `sys.path`, whose folders were last changed at
    these times. Reading them takes 10 ms, and an experiment asks for hundreds.

    Those of this distribution whose package is not there are left out: a checkout works without plugins/.
    """
    return metadata.EntryPoints(point for point in metadata.entry_points(group=group) if _is_there(point))


def _is_there(point: metadata.EntryPoint) -> bool:
    is_ours = point.dist is not None and point.dist.name == DISTRIBUTION
    return not is_ours or importlib.util.find_spec(point.module.partition(".")[0]) is not None


def _load(place: str) -> object:
    module, _, attribute = place.partition(":")
    return getattr(importlib.import_module(module), attribute)


COMMANDS: Group[Callable[..., None]] = Group(name="hyaline.commands", what="command", guide="docs/architecture.md")
"""Functions by program and command, such as `datagen.import`; their arguments are its flags."""


def commands_of(program: str) -> dict[str, Later]:
    """The commands that plug-ins add to a program, by their words."""
    names = [name for name in COMMANDS.names() if name.startswith(f"{program}.")]
    return {name.removeprefix(f"{program}."): Later(lambda _, name=name: COMMANDS.find(name)) for name in names}


def absent_commands(program: str) -> dict[str, str]:
    """The plug-ins of this distribution that are not here, by the words of their commands."""
    absent = COMMANDS.absent().items()
    return {name.removeprefix(f"{program}."): package for name, package in absent if name.startswith(program)}
