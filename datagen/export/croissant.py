"""Croissant: what the files of a Hugging Face export hold, in the form that search engines and loaders read.

Source: MLCommons, Croissant Format Specification 1.1, https://docs.mlcommons.org/croissant/docs/croissant-spec-1.1.html
"""

from collections.abc import Mapping
from dataclasses import dataclass

from datagen.data.metadata import OWN_LICENSE, OWN_LICENSE_ADDRESS
from datagen.disk.records import Json
from datagen.disk.storage import dump_json, sha256
from datagen.export.source import Source
from datagen.scene.finding import is_made_by_code
from datagen.terminal.distribution import VERSION

CONFORMS_TO = "http://mlcommons.org/croissant/1.1"
_TERMS = (
    *("arrayShape", "citeAs", "column", "containedIn", "equivalentProperty", "extract", "field", "fileObject"),
    *("fileProperty", "fileSet", "format", "includes", "isArray", "isLiveDataset", "jsonPath", "key", "md5"),
    *("parentField", "path", "recordSet", "references", "regex", "repeated", "replace", "samplingRate", "separator"),
    *("source", "subField", "transform"),
)
CONTEXT: dict[str, Json] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "description": {"@container": "@language"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "name": {"@container": "@language"},
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
    **{name: f"cr:{name}" for name in _TERMS},
}
"""The standard one, which readers compare with their own."""

PICTURES = {
    "image": "8-bit sRGB",
    "depth": "16 bits: millimetres along the axis to the first surface, glass or not; 0: none",
    "glass": "255 where glass is seen first",
}
COLUMNS = {
    "file_name": "the file of the picture, in the folder of the table",
    "depth_file_name": f"the file of its depth, {PICTURES['depth']}",
    "glass_file_name": f"the file of its mask, {PICTURES['glass']}",
    "name": "split and number of the view in the dataset",
    "camera_angle_x": "horizontal field of view, radians",
    "fl_x": "focal length, pixels",
    "fl_y": "focal length, pixels",
    "cx": "principal point, pixels; the upper left pixel has its centre at (0.5, 0.5)",
    "cy": "principal point, pixels",
    "w": "width, pixels",
    "h": "height, pixels",
    "near": "every surface that is seen is farther away, metres along the ray",
    "far": "every surface that is seen is nearer, metres along the ray",
    "transform_matrix": "world from camera, OpenGL axes: +x right, +y up, looking along -z; metres",
}
"""Columns of a table of views, and what each holds."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """The views of one split."""

    folder: str
    names: str
    """How the names of its pictures begin."""
    data: bytes
    """`metadata.jsonl`: a line for each view."""
    columns: Mapping[str, Json]
    """The first line."""


def croissant_bytes(source: Source, tables: Mapping[str, Table], *, description: str, citation: str) -> bytes:
    """`croissant.json`: every file, and a record set for each split.

    The address and the date of publication are for those who publish it, as is the creator of a scene of their own.
    """
    dataset = source.dataset
    is_ours = dataset.imported is None and is_made_by_code(dataset.config.scene)
    creator: dict[str, Json] = {"@type": "sc:Organization", "name": "The hyaline authors"}
    return dump_json(
        {
            "@context": CONTEXT,
            "@type": "sc:Dataset",
            "conformsTo": CONFORMS_TO,
            "name": dataset.name,
            "description": description,
            "license": OWN_LICENSE_ADDRESS if dataset.license == OWN_LICENSE else dataset.license,
            **({"creator": creator} if is_ours else {}),
            "citeAs": citation,
            "version": f"{VERSION}+{dataset.seal[:12]}",
            "distribution": [file for split, table in tables.items() for file in _files(split, table)],
            "recordSet": [_record_set(split, table) for split, table in tables.items()],
        }
    )


def _files(split: str, table: Table) -> list[Json]:
    """The table and the pictures of a split."""
    folders = {name: "" if name == "image" else f"{name}/" for name in PICTURES}
    return [
        {
            "@type": "cr:FileObject",
            "@id": f"{split}-table",
            "name": f"{split}-table",
            "contentUrl": f"{table.folder}/metadata.jsonl",
            "encodingFormat": "application/jsonlines",
            "sha256": sha256(table.data),
        },
        *(
            {
                "@type": "cr:FileSet",
                "@id": f"{split}-{name}-files",
                "name": f"{split}-{name}-files",
                "description": text,
                "encodingFormat": "image/png",
                "includes": f"{table.folder}/{folders[name]}{table.names}*.png",
            }
            for name, text in PICTURES.items()
        ),
    ]


def _record_set(split: str, table: Table) -> Json:
    """The lines of a table, each with its picture."""
    files: Json = {"@id": f"{split}-image-files"}
    fields: list[Json] = []
    for name, value in table.columns.items():
        kind = "sc:Text" if isinstance(value, str) else "sc:Integer" if isinstance(value, int) else "sc:Float"
        column: Json = {"fileObject": {"@id": f"{split}-table"}, "extract": {"column": name}}
        more: dict[str, Json] = {"isArray": True, "arrayShape": "4,4"} if isinstance(value, list) else {}
        if name == "file_name":
            more = {"references": {"fileSet": files, "extract": {"fileProperty": "filename"}}}
        fields.append(_field(split, name, COLUMNS[name], kind, column, more))
    content: Json = {"fileSet": files, "extract": {"fileProperty": "content"}}
    fields.append(_field(split, "image", PICTURES["image"], "sc:ImageObject", content, {}))
    return {"@type": "cr:RecordSet", "@id": split, "name": split, "field": fields}


def _field(split: str, name: str, description: str, kind: str, source: Json, more: dict[str, Json]) -> Json:
    about: dict[str, Json] = {"@type": "cr:Field", "@id": f"{split}/{name}", "name": name, "description": description}
    return {**about, "dataType": kind, "source": source, **more}
