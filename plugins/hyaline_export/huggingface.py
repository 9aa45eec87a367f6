"""Hugging Face: pictures with a table of their cameras, and a short dataset card that names every split.

    README.md                   the card: what it is, splits, conventions, limits, licence, citation
    FOLDER/metadata.jsonl       a line a view: its files, name, lens and pose
    FOLDER/NAME.png             8-bit sRGB
    FOLDER/depth/NAME.png       16 bits, millimetres along the axis to the first surface, glass or not; 0: none
    FOLDER/glass/NAME.png       255 where glass is seen first

FOLDER is train, validation, test_interpolating or test_extrapolating: where a tool does not read the card, it takes the
splits from these names, and leaves out folders without train, validation or test in theirs.
"""

import json
import re
from collections.abc import Iterator

from datagen.data.transforms import CONVENTION, lens_keys
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json
from datagen.terminal.plugins import VERSION
from hyaline_export.formats import Format
from hyaline_export.source import ExportView, Source, depth_png, mask_png, rgb_png, tracked

FOLDERS = {
    "train": "train",
    "val": "validation",
    "interpolating": "test_interpolating",
    "extrapolating": "test_extrapolating",
}
"""The folder of training views, those held out of them, and each test split."""

CARD = """\
---
license: other
license_name: {license}
license_link: LICENSE.txt
pretty_name: {title}
tags: [transparent-objects, glass, refraction, novel-view-synthesis]
configs:
- config_name: default
  data_files:
{data_files}
---

# {name}

{count} pictures of a scene with glass from known cameras, exported by hyaline {version} from the dataset `{seal}`.
`datasets.load_dataset("FOLDER")` opens them.

| split | views |
|---|---:|
{splits}

`interpolating` lies among the training cameras, `extrapolating` leaves them.

- {convention}.
- `fl_x`, `fl_y`, `cx`, `cy`, `w`, `h` are in pixels; the upper left one has its centre at (0.5, 0.5).
- `depth`: millimetres along the axis to the first surface, glass or not; 0: none. `glass`: 255 where glass is seen
  first. Both are those of the ray through a pixel's centre.
- Every surface that is seen lies between `near` and `far`, metres along the ray.
- Shapes, materials, linear radiance and peeled layers are in the archive of the dataset.

Licence: {terms}
"""


def _hugging_face(source: Source) -> Iterator[tuple[str, bytes]]:
    if source.dataset.withheld:
        raise HyalineError("--format huggingface: publishes test pictures, which a verifier keeps; publish the folder")
    groups: dict[str, list[ExportView]] = {}
    for item in tracked(source.views):
        group = item.view.split if item.role == "test" else item.role
        groups.setdefault(group, []).append(item)
        folder, found = FOLDERS[group], item.quantities
        yield f"{folder}/{item.name}.png", rgb_png(item)
        yield f"{folder}/depth/{item.name}.png", depth_png(found.depth_along_axis)
        yield f"{folder}/glass/{item.name}.png", mask_png(found.glass)
    for group, items in groups.items():
        rows = "".join(f"{json.dumps(_row(source, item))}\n" for item in items)
        yield f"{FOLDERS[group]}/metadata.jsonl", rows.encode()
    yield "README.md", _card(source, groups).encode()


def _row(source: Source, item: ExportView) -> dict[str, Json]:
    """One line of the table; `datasets` reads what ends in `file_name` as a picture."""
    return {
        "file_name": f"{item.name}.png",
        "depth_file_name": f"depth/{item.name}.png",
        "glass_file_name": f"glass/{item.name}.png",
        "name": item.name,
        **lens_keys(item.view.camera),
        **source.near_far,
        "transform_matrix": item.view.camera.world_from_camera.tolist(),
    }


def _card(source: Source, groups: dict[str, list[ExportView]]) -> str:
    splits = {"validation" if group == "val" else group: items for group, items in groups.items()}
    return CARD.format(
        license=re.sub(r"[^a-z0-9.]+", "-", source.dataset.license.lower())[:60].strip("-") or "stated",
        title=json.dumps(f"{source.dataset.name} (hyaline)"),
        name=source.dataset.name,
        data_files="\n".join(
            f"  - split: {split}\n    path: {FOLDERS[group]}/**" for split, group in zip(splits, groups, strict=True)
        ),
        count=len(source.views),
        version=VERSION,
        seal=source.dataset.seal,
        splits="\n".join(f"| `{split}` | {len(items)} |" for split, items in splits.items()),
        convention=CONVENTION,
        terms=source.dataset.license,
    )


HUGGING_FACE = Format(
    files=_hugging_face, hint='python -c "import datasets, sys; print(datasets.load_dataset(sys.argv[1]))" OUT'
)
