"""Annotations that are checked: in every test, functions and records refuse arrays that their types exclude."""

import ast
import contextlib
import typing
from collections.abc import Callable, Iterable, Iterator
from typing import Self

import jaxtyping
import jaxtyping._import_hook as import_hook
from beartype import BeartypeConf, beartype
from jaxtyping import AbstractDtype, config, install_import_hook

PLUGINS = ("import", "photos", "random", "export", "web", "bench", "paper")
PACKAGES = ("hyaline", "datagen", "proxies", "model", "eval", *(f"hyaline_{name}" for name in PLUGINS))

CONF = BeartypeConf(is_pep484_tower=True)
"""An int may stand where a float is expected, as for type checkers."""

ARRAYS = {name for name, kind in vars(jaxtyping).items() if isinstance(kind, type) and issubclass(kind, AbstractDtype)}
"""Float32, UInt8, ...: the names of annotations that say an array's dtype and shape."""

COMPILERS = {"numba", "compiled", "intrinsic", "dr"}
"""Decorators of functions that Numba and Dr.Jit compile from source: they take no wrapped ones."""


def check_annotations() -> None:
    """From now on, a module that is imported has its functions and records wrapped; arrays' shapes are checked, too."""
    import_hook.JaxtypingTransformer = Wrapping
    install_import_hook(PACKAGES, f"{__name__}.check")


@contextlib.contextmanager
def unchecked() -> Iterator[None]:
    """Checks nothing while the block runs: it gives a function what its annotations exclude, to see it refused."""
    config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        config.update("jaxtyping_disable", False)


def check(function: Callable[..., object]) -> Callable[..., object]:
    """Wraps a function so that it checks what it is given and what it returns, but for two kinds of annotation.

    `Self`: beartype 0.22 knows it in a class that it decorates whole; jaxtyping gives it the methods one by one.
    `type[T]`: for type checkers `tuple[int, ...]` is one, for Python an alias of one.
    """
    kinds = function.__annotations__
    function.__annotations__ = {
        name: kind for name, kind in kinds.items() if kind is not Self and typing.get_origin(kind) is not type
    }
    return beartype(conf=CONF)(function)


class Wrapping(import_hook.JaxtypingTransformer):
    """Wraps records, and functions with arrays in their annotations; not those inside of others.

    It keeps files with `jaxtyping` in their names in __pycache__: delete them after a change.
    """

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        has_arrays = bool(_names([node.returns, *(argument.annotation for argument in arguments)]) & ARRAYS)
        names = _names(node.decorator_list)
        is_inner = any(isinstance(parent, ast.FunctionDef) for parent in self._parents)
        if has_arrays and not is_inner and not names & COMPILERS:
            super().visit_FunctionDef(node)
        return node


def _names(nodes: Iterable[ast.expr | None]) -> set[str]:
    """The names in some expressions."""
    return {name.id for node in nodes if node is not None for name in ast.walk(node) if isinstance(name, ast.Name)}
