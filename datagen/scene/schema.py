"""The JSON schema of scene.json for editors and other programs, generated from the records that read it.

    python -m datagen.scene.schema > datagen/scene/scene.schema.json
    python -m datagen.scene.schema --page > docs/scene-json.md

A test compares both files with the records. Reading a scene checks more: numbers, meshes and names that a schema cannot
describe.
"""

import dataclasses
import json
import sys
import types
import typing
from typing import Literal

import docstring_parser

from datagen.disk.records import Json
from datagen.scene.folder import FILE_RECORD

DIALECT = "https://json-schema.org/draft/2020-12/schema"


def scene_schema() -> dict[str, Json]:
    """The schema: one definition for each type in scene.json."""
    definitions: dict[str, Json] = {}
    root = _record(FILE_RECORD, definitions)
    # `type` distinguishes records that are alternatives; the file itself has only one kind.
    return {"$schema": DIALECT, "title": "scene.json", **root, "$defs": dict(sorted(definitions.items()))}


def _record(kind: type, definitions: dict[str, Json]) -> dict[str, Json]:
    """An object of a record's fields."""
    hints, docs = typing.get_type_hints(kind), _field_docs(kind)
    is_public = not kind.__name__.startswith("_")  # Others are in no union and have no type.
    properties: dict[str, Json] = {"type": {"const": kind.__name__}} if is_public else {}
    required: list[Json] = []
    for field in dataclasses.fields(kind):
        value = _schema_of(hints[field.name], definitions)
        if text := docs.get(field.name):
            value["description"] = text
        if field.default is not dataclasses.MISSING:
            value["default"] = json.loads(json.dumps(field.default))
        elif field.default_factory is dataclasses.MISSING:
            required.append(field.name)
        properties[field.name] = value
    description = " ".join((kind.__doc__ or "").split())
    return {
        "type": "object",
        "description": description,
        "properties": properties,
        "required": required,
        "additionalProperties": False,
    }


def _schema_of(kind: object, definitions: dict[str, Json]) -> dict[str, Json]:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        return {"enum": list(arguments)}
    if origin in (typing.Union, types.UnionType):
        return _schema_of_union(arguments, definitions)
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return {"type": "array", "items": _schema_of(arguments[0], definitions)}
        items: list[Json] = [_schema_of(item, definitions) for item in arguments]
        return {"type": "array", "prefixItems": items, "items": False, "minItems": len(items)}
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        name = kind.__name__.removeprefix("_")
        if name not in definitions:
            definitions[name] = None  # In progress.
            definitions[name] = _record(kind, definitions)
        return {"$ref": f"#/$defs/{name}"}
    names = {float: "number", int: "integer", bool: "boolean", str: "string", types.NoneType: "null"}
    assert isinstance(kind, type), f"{kind!r} has no place in scene.json"
    return {"type": names[kind]}


def _schema_of_union(kinds: tuple[object, ...], definitions: dict[str, Json]) -> dict[str, Json]:
    """One of several kinds; records are distinguished by their `type`, which is then required."""
    choices: list[Json] = []
    records = [kind for kind in kinds if dataclasses.is_dataclass(kind)]
    for kind in kinds:
        choice = _schema_of(kind, definitions)
        choices.append({"allOf": [choice, {"required": ["type"]}]} if kind in records else choice)
    return {"oneOf": choices}


def _field_docs(kind: type) -> dict[str, str]:
    """The docstrings of a record's fields, including those of its bases."""
    docs = {}
    for base in reversed(kind.__mro__):
        if dataclasses.is_dataclass(base):
            for param in docstring_parser.parse_from_object(base).params:
                docs[param.arg_name] = " ".join((param.description or "").split())
    return docs


def schema_text() -> str:
    """The text of scene.schema.json."""
    return json.dumps(scene_schema(), indent=1) + "\n"


def schema_page() -> str:
    """The documentation page that lists every type and key."""
    schema = scene_schema()
    definitions = typing.cast(dict[str, dict[str, Json]], schema["$defs"])
    parts = [PAGE_START, *_table("The file", schema)]
    for name, definition in definitions.items():
        parts += _table(name, definition)
    return "\n".join(parts) + "\n"


PAGE_START = """# Every key of scene.json

This page is generated from the records that read the file (`python -m datagen.scene.schema --page`);
[scenes](scenes.md) explains them with examples. Editors can use
[scene.schema.json](../datagen/scene/scene.schema.json).
"""


def _table(title: str, record: dict[str, Json]) -> list[str]:
    """A record's description, and a table with a row per key."""
    lines = [f"## {title}", "", str(record["description"]), "", "| key | value | default | |", "|---|---|---|---|"]
    required = typing.cast(list[Json], record["required"])
    for key, value in typing.cast(dict[str, dict[str, Json]], record["properties"]).items():
        default = f"`{json.dumps(value['default'])}`" if "default" in value else ""
        if key in required:
            default = "required"
        lines.append(f"| `{key}` | {_in_words(value)} | {default} | {value.get('description', '')} |")
    return [*lines, ""]


def _in_words(value: dict[str, Json]) -> str:
    """The type of a value in words."""
    if "$ref" in value:
        name = str(value["$ref"]).rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    if "const" in value:
        return f"`{json.dumps(value['const'])}`"
    if "enum" in value:
        return ", ".join(f"`{json.dumps(choice)}`" for choice in typing.cast(list[Json], value["enum"]))
    for key, joint in (("oneOf", " or "), ("allOf", "")):
        if key in value:
            choices = typing.cast(list[dict[str, Json]], value[key])
            return joint.join(_in_words(choice) for choice in choices if set(choice) != {"required"})
    if value["type"] != "array":
        return str(value["type"])
    if "prefixItems" in value:
        items = typing.cast(list[dict[str, Json]], value["prefixItems"])
        return f"{len(items)} x {_in_words(items[0])}"
    return f"list of {_in_words(typing.cast(dict[str, Json], value['items']))}"


if __name__ == "__main__":
    sys.stdout.write(schema_page() if "--page" in sys.argv else schema_text())
