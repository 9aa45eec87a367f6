"""The API reference: what `hyaline` exports, as Markdown from signatures and docstrings. Imports none of it."""

import ast
import contextlib
import inspect
import re
import textwrap
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
WIDTH = 88
"""Characters of a signature that stays on one line."""
RECORDS = "datagen.scene."
"""Classes of this package are records to fill in; their methods are for renderers."""
HEADINGS = {"Args:": "**Arguments**", "Returns:": "**Returns**", "Raises:": "**Raises**"}

Definition = ast.ClassDef | ast.FunctionDef


def reference(name: str) -> str:
    """The Markdown of one name of `hyaline`."""
    module, node, text = _find("hyaline", name)
    if isinstance(node, ast.FunctionDef):
        return f"### {name}\n\n{_code(f'{name}{_signature(node)}')}\n\n{_prose(text)}"
    if not isinstance(node, ast.ClassDef):
        return f"### {name}\n\n{_code(ast.unparse(node))}\n\n{_prose(text)}"
    members = _members(module, node)
    fields = [part for part in members.values() if isinstance(part, tuple)]
    functions = [part for part in members.values() if isinstance(part, ast.FunctionDef)]
    if module.startswith(RECORDS):
        functions = []
    is_made_by_users = not any(part.name == "__init__" for part in functions)
    shown = "\n".join(f"    {field}," for field, _ in fields)
    parts = [f"### {name}", _code(f"{name}(\n{shown}\n)") if fields and is_made_by_users else "", _prose(text)]
    parts += [f"- `{field.partition(':')[0]}`: {_flat(about)}" for field, about in fields if about]
    for part in functions:
        about = ast.get_docstring(part, clean=False) or ""
        if part.name.startswith("_") or not about:
            continue
        is_property = any("property" in ast.unparse(item) for item in part.decorator_list)
        kind = f": {_type(part.returns)}" if is_property else _signature(part)
        parts += [f"#### {name}.{part.name}", _code(f"{part.name}{kind}"), _prose(about)]
    return _joined(parts)


def _joined(parts: list[str]) -> str:
    """Blocks with a blank line between them, but for the items of a list."""
    text = ""
    for part in filter(None, parts):
        is_item = part.startswith("- ") and text.rpartition("\n")[2].startswith("- ")
        text += part if not text else f"\n{part}" if is_item else f"\n\n{part}"
    return text


@cache
def _tree(module: str) -> ast.Module:
    path = ROOT / module.replace(".", "/")
    places = path / "__init__.pyi", path / "__init__.py", path.with_suffix(".py")  # `hyaline` has a stub.
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        raise LookupError(f"{module} is not part of hyaline")
    return ast.parse(found.read_text())


@cache
def _imports(module: str) -> dict[str, str]:
    """The module behind each imported name: that of `a` in `from x import a`, or x.a itself where that is a module."""
    found = {}
    for node in ast.walk(_tree(module)):
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                home = f"{module}.{node.module}" if node.level else node.module
                inner = f"{home}.{alias.name}"
                is_module = (ROOT / (inner.replace(".", "/") + ".py")).is_file()
                found[alias.asname or alias.name] = inner if is_module else home
    return found


def _find(module: str, name: str) -> tuple[str, ast.stmt, str]:
    """The module that defines a name, the statement, and its docstring."""
    body = _tree(module).body
    for place, node in enumerate(body):
        if isinstance(node, Definition) and node.name == name:
            return module, node, ast.get_docstring(node, clean=False) or ""
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if any(isinstance(target, ast.Name) and target.id == name for target in targets):
            return module, node, _text_after(body, place)
    if name in _imports(module):
        return _find(_imports(module)[name], name)
    raise LookupError(f"{module} does not define {name}")


def _members(module: str, node: ast.ClassDef) -> dict[str, tuple[str, str] | ast.FunctionDef]:
    """Fields (as written, with their docstrings) and functions by name, those of base classes included."""
    found: dict[str, tuple[str, str] | ast.FunctionDef] = {}
    for base in node.bases:
        where, _, name = ast.unparse(base).rpartition(".")
        with contextlib.suppress(LookupError):  # A base from elsewhere.
            home, inherited, _ = _find(_imports(module).get(where or name, module), name)
            found |= _members(home, inherited) if isinstance(inherited, ast.ClassDef) else {}
    for place, part in enumerate(node.body):
        if isinstance(part, ast.FunctionDef):
            found[part.name] = part
        elif isinstance(part, ast.AnnAssign) and _is_field(part):
            value = "" if part.value is None else f" = {ast.unparse(part.value)}"
            name = ast.unparse(part.target)
            found[name] = (f"{name}: {_type(part.annotation)}{value}", _text_after(node.body, place))
    return found


def _is_field(part: ast.AnnAssign) -> bool:
    return not (ast.unparse(part.target).startswith("_") or ast.unparse(part.annotation).startswith("ClassVar"))


def _text_after(body: list[ast.stmt], place: int) -> str:
    after = body[place + 1] if place + 1 < len(body) else None
    if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) and isinstance(after.value.value, str):
        return after.value.value
    return ""


def _signature(node: ast.FunctionDef) -> str:
    arguments = ast.unparse(node.args).replace("self, ", "").removeprefix("self")
    line = f"({arguments}) -> {_type(node.returns)}"
    if len(node.name) + len(line) <= WIDTH:
        return line
    inner = re.sub(r", (?=[*\w]+(:|,|$))", ",\n    ", arguments)
    return f"(\n    {inner},\n) -> {_type(node.returns)}"


def _type(annotation: ast.expr | None) -> str:
    return "None" if annotation is None else re.sub(r"^'(.*)'$", r"\1", ast.unparse(annotation))


def _flat(text: str) -> str:
    return " ".join(text.split())


def _code(text: str) -> str:
    return f"```python\n{text}\n```"


def _prose(docstring: str) -> str:
    """A docstring in Google's form as Markdown; examples become blocks of code."""
    parts = []
    for block in re.split(r"\n\s*\n", inspect.cleandoc(docstring)):
        first, _, rest = block.partition("\n")
        if block.startswith(">>>"):
            parts.append(_code(block))
        elif first in HEADINGS:
            entries = re.split(r"\n(?=\S)", textwrap.dedent(rest))
            if first == "Returns:":
                parts.append(f"{HEADINGS[first]} {_flat(rest)}")
            else:
                pairs = [_flat(entry).partition(": ") for entry in entries]
                parts += [HEADINGS[first], "\n".join(f"- `{name}`: {about}" for name, _, about in pairs)]
        else:
            parts.append(block if block.startswith("    ") else _flat(block))
    return "\n\n".join(parts)
