"""Hugging Face: pictures with a table of their cameras, and a dataset card that names every split.

    README.md                   the card: licence, splits, columns, conventions
    FOLDER/metadata.jsonl       a line a view: its files, name, lens and pose
    FOLDER/NAME.png             8-bit sRGB
    FOLDER/depth/NAME.png       16 bits, millimetres along the axis to the first surface, glass or not; 0: none
    FOLDER/glass/NAME.png       255 where glass is seen first

FOLDER is train, validation, test_interpolating or test_extrapolating: where a tool does not read the card, it takes the
splits from these names, and leaves out folders without train, validation or test in theirs.
"""

import json
import re
from collections.abc import Mapping

from datagen.data.config import TEST_SPLITS
from datagen.data.transforms import CONVENTION
from datagen.disk.records import Json
from datagen.export.files import depth_png, lens_keys, mask_png, rgb_png
from datagen.export.plan import Part, Plan
from datagen.export.samples import sample_groups
from datagen.export.source import ExportView, Source

IMAGES = ("image", "depth", "glass")
MATRIX = "transform_matrix"
HUB_LICENSES = r"cc0-1\.0|cc-by(-nc)?(-sa|-nd)?-[234]\.0|mit|apache-2\.0"
"""Those that the hub knows by name, in small letters."""

CARD = """\
---
{license}
pretty_name: {title}
tags: [transparent-objects, glass, refraction, novel-view-synthesis, synthetic]
configs:
- config_name: default
  data_files:
{data_files}
dataset_info:
  features:
{features}
---

# {name}

{count} pictures of a scene with glass from known cameras, path-traced by hyaline.

    datasets.load_dataset("FOLDER, or its name on the hub")

- Licence: {terms}
- Splits: {splits}.
  `validation` is held out of training; `interpolating` lies among the training cameras, `extrapolating` leaves them.
- `depth` is in millimetres along the axis to the first surface, glass or not; 0: none. `glass` is 255 where glass is
  seen first.
- {convention}.
  `fl_x`, `fl_y`, `cx`, `cy`, `w`, `h` are in pixels; the upper left one has its centre at (0.5, 0.5).
- Every surface that is seen lies between `near` and `far`, metres along the ray.
"""


def plan_huggingface(source: Source) -> Plan:
    """The whole folder."""
    groups = {"validation" if group == "val" else group: items for group, items in sample_groups(source).items()}
    views = [_view_part(split, item) for split, items in groups.items() for item in items]
    tables = [_table_part(source, split, items) for split, items in groups.items()]
    card = Part(name="card", files=("README.md",), make=lambda: {"README.md": _card(source, groups)})
    return Plan(
        parts=(*views, *tables, card), hint="python -c \"import datasets; print(datasets.load_dataset('OUT'))\""
    )


def _folder(split: str) -> str:
    return f"test_{split}" if split in TEST_SPLITS else split


def _files(item: ExportView) -> tuple[str, str, str]:
    """Picture, depth and mask, relative to the folder of their split."""
    return f"{item.name}.png", f"depth/{item.name}.png", f"glass/{item.name}.png"


def _view_part(split: str, item: ExportView) -> Part:
    files = tuple(f"{_folder(split)}/{file}" for file in _files(item))

    def make() -> Mapping[str, bytes]:
        found = item.quantities
        data = (rgb_png(item), depth_png(found.depth_along_axis), mask_png(found.glass))
        return dict(zip(files, data, strict=True))

    return Part(name=f"{split}-{item.name}", files=files, make=make)


def _table_part(source: Source, split: str, items: list[ExportView]) -> Part:
    file = f"{_folder(split)}/metadata.jsonl"

    def make() -> Mapping[str, bytes]:
        return {file: "".join(f"{json.dumps(_row(source, item))}\n" for item in items).encode()}

    return Part(name=f"table-{split}", files=(file,), make=make)


def _row(source: Source, item: ExportView) -> dict[str, Json]:
    """One line of the table; `datasets` reads what ends in `file_name` as a picture."""
    picture, depth, glass = _files(item)
    return {
        "file_name": picture,
        "depth_file_name": depth,
        "glass_file_name": glass,
        "name": item.name,
        **lens_keys(item.view.camera),
        "near": source.bounds.near,
        "far": source.bounds.far,
        MATRIX: item.view.camera.world_from_camera.tolist(),
    }


def _license(terms: str) -> str:
    """The lines of the card's head about it."""
    lower = terms.lower()
    if re.fullmatch(HUB_LICENSES, lower):
        return f"license: {lower}"
    if lower.startswith("unknown"):
        return "license: unknown"
    name = re.sub(r"[^a-z0-9.]+", "-", lower)[:60].strip("-") or "stated"
    return f"license: other\nlicense_name: {name}\nlicense_link: LICENSE.txt"


def _card(source: Source, groups: dict[str, list[ExportView]]) -> bytes:
    terms = source.dataset.license
    first = _row(source, source.pictures[0])
    columns = (
        dict.fromkeys(IMAGES, "dtype: image")
        | {"name": "dtype: string"}
        | {
            name: f"dtype: {'int64' if isinstance(value, int) else 'float64'}"
            for name, value in first.items()
            if isinstance(value, int | float)
        }
    )
    columns[MATRIX] = "sequence:\n      sequence: float64"
    return CARD.format(
        license=_license(terms),
        title=json.dumps(f"{source.dataset.name} (hyaline)"),
        data_files="\n".join(f"  - split: {split}\n    path: {_folder(split)}/**" for split in groups),
        features="\n".join(f"  - name: {name}\n    {kind}" for name, kind in columns.items()),
        name=source.dataset.name,
        count=len(source.pictures),
        terms=terms,
        splits=", ".join(f"`{split}` {len(items)}" for split, items in groups.items()),
        convention=CONVENTION,
    ).encode()
