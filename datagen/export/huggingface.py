"""Hugging Face: pictures with a table of their cameras, and a dataset card that names every split.

    README.md                   the card: what it is, how it was made, splits, columns, conventions, licence, limits
    croissant.json              the same for search engines and other loaders (datagen/export/croissant.py)
    FOLDER/metadata.jsonl       a line a view: its files, name, lens and pose
    FOLDER/NAME.png             8-bit sRGB
    FOLDER/depth/NAME.png       16 bits, millimetres along the axis to the first surface, glass or not; 0: none
    FOLDER/glass/NAME.png       255 where glass is seen first

FOLDER is train, validation, test_interpolating or test_extrapolating: where a tool does not read the card, it takes the
splits from these names, and leaves out folders without train, validation or test in theirs.
"""

import json
import re
import shlex
from statistics import mean

from datagen.build.verify import build_words
from datagen.data.config import TEST_SPLITS
from datagen.data.dataset import Dataset
from datagen.data.metadata import OWN_LICENSE, OWN_LICENSE_ADDRESS
from datagen.data.paths import BUILT_IN_SCENES
from datagen.data.transforms import CONVENTION
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json
from datagen.export.croissant import Table, croissant_bytes
from datagen.export.files import lens_keys
from datagen.export.nerfstudio import picture_depth_mask
from datagen.export.plan import Part, Plan, one_file
from datagen.export.samples import sample_groups
from datagen.export.source import ExportView, Source
from datagen.scene.finding import is_made_by_code
from datagen.terminal.distribution import VERSION

IMAGES = ("image", "depth", "glass")
MATRIX = "transform_matrix"
HUB_LICENSES = (
    r"cc0-1\.0|mit|apache-2\.0|cc-by-(2\.[05]|[34]\.0)|cc-by-sa-[34]\.0|cc-by-nd-4\.0|"
    r"cc-by-nc-[234]\.0|cc-by-nc-sa-[234]\.0|cc-by-nc-nd-[34]\.0"
)
"""Those that the hub knows by name, in small letters."""

CROISSANT = "croissant.json"
RENDERED_LIMITS = """One synthetic scene, whose numbers say little about others. Pinhole cameras without blur, steady
  light, no sensor; pictures have noise, and radiance above 1 is clipped."""
IMPORTED_LIMITS = "The noise of the pictures is unknown, and so is all that the folder did not say."
CITATION = f"""\
@software{{hyaline,
  title = {{hyaline: path-traced datasets of transparent objects, deferred neural renderers, and their evaluation}},
  author = {{{{The hyaline authors}}}},
  version = {{{VERSION}}},
}}"""
"""As in CITATION.cff, which is not installed."""

CARD = """\
---
{license}
pretty_name: {title}
tags: [transparent-objects, glass, refraction, novel-view-synthesis{synthetic}]
configs:
- config_name: default
  data_files:
{data_files}
dataset_info:
  features:
{features}
---

# {name}

{description}

    datasets.load_dataset("FOLDER, or its name on the hub")

## How it was made

{made}

Exported by hyaline {version}: `datagen export {name} --format huggingface`. Digest of the dataset: `{seal}`.

## Splits

| split | views | samples per pixel | noise ceiling |
|---|---:|---:|---:|
{splits}

`validation` {held_out}; `interpolating` lies among the training cameras, `extrapolating` leaves them. The
noise ceiling is the PSNR that a perfect method would reach in spite of the noise of the pictures.

## Units and conventions

- {convention}.
- `fl_x`, `fl_y`, `cx`, `cy`, `w`, `h` are in pixels; the upper left one has its centre at (0.5, 0.5).
- `image` is 8-bit sRGB. `depth` is in millimetres along the axis to the first surface, glass or not; 0: none.
  `glass` is 255 where glass is seen first.
- Every surface that is seen lies between `near` and `far`, metres along the ray.

## Limits

- {limits}
- `depth` and `glass` are those of the ray through a pixel's centre, and tell nothing of what is seen through glass.
  Shapes, materials, linear radiance and peeled layers are in the packed dataset (`datagen pack`).

## Licence

{terms}

## Citation

```bibtex
{citation}
```
"""


def plan_huggingface(source: Source) -> Plan:
    """The whole folder."""
    if source.dataset.withheld:
        raise HyalineError(
            "--format huggingface: publishes test pictures, which a verifier keeps; publish `datagen pack`"
        )
    groups = {"validation" if group == "val" else group: items for group, items in sample_groups(source).items()}
    views = [_view_part(split, item) for split, items in groups.items() for item in items]
    tables = [_table_part(source, split, items) for split, items in groups.items()]
    card = one_file("card", "README.md", lambda: _card(source, groups))
    croissant = one_file("croissant", CROISSANT, lambda: _croissant(source, groups))
    return Plan(
        parts=(*views, *tables, card, croissant),
        hint="python -c \"import datasets; print(datasets.load_dataset('OUT'))\"",
    )


def _folder(split: str) -> str:
    return f"test_{split}" if split in TEST_SPLITS else split


def _files(item: ExportView) -> tuple[str, str, str]:
    """Picture, depth and mask, relative to the folder of their split."""
    return f"{item.name}.png", f"depth/{item.name}.png", f"glass/{item.name}.png"


def _view_part(split: str, item: ExportView) -> Part:
    picture, depth, mask = (f"{_folder(split)}/{file}" for file in _files(item))
    return picture_depth_mask(f"{split}-{item.name}", (picture, depth, mask), item)


def _table_part(source: Source, split: str, items: list[ExportView]) -> Part:
    file = f"{_folder(split)}/metadata.jsonl"

    return Part(name=f"table-{split}", files=(file,), make=lambda: {file: _table(source, items)})


def _table(source: Source, items: list[ExportView]) -> bytes:
    return "".join(f"{json.dumps(_row(source, item))}\n" for item in items).encode()


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
    learned = {item.view.index for item in source.views if item.role == "train"}
    is_held_out = learned.isdisjoint(item.view.index for item in source.views if item.role == "val")
    return CARD.format(
        license=_license(terms),
        title=json.dumps(f"{source.dataset.name} (hyaline)"),
        synthetic=", synthetic" if source.dataset.imported is None else "",
        data_files="\n".join(f"  - split: {split}\n    path: {_folder(split)}/**" for split in groups),
        features="\n".join(f"  - name: {name}\n    {kind}" for name, kind in columns.items()),
        name=source.dataset.name,
        description=_description(source),
        made=_made(source.dataset),
        version=VERSION,
        seal=source.dataset.seal,
        held_out="is held out of training" if is_held_out else "repeats a training view",
        splits="\n".join(_split_line(split, items) for split, items in groups.items()),
        convention=CONVENTION,
        limits=RENDERED_LIMITS if source.dataset.imported is None else IMPORTED_LIMITS,
        terms=terms if terms != OWN_LICENSE else f"[{terms}]({OWN_LICENSE_ADDRESS}): nobody has to ask or to be named.",
        citation=CITATION,
    ).encode()


def _croissant(source: Source, groups: dict[str, list[ExportView]]) -> bytes:
    tables = {
        split: Table(
            folder=_folder(split),
            names=f"{items[0].view.split}_",
            data=_table(source, items),
            columns=_row(source, items[0]),
        )
        for split, items in groups.items()
    }
    return croissant_bytes(source, tables, description=_description(source), citation=CITATION)


def _description(source: Source) -> str:
    dataset = source.dataset
    glass = [item.name for item in dataset.objects if item.is_glass]
    line = BUILT_IN_SCENES.get(dataset.config.scene, "")
    return (
        f"{len(source.pictures)} pictures of a scene with glass from known cameras"
        f"{', path-traced by hyaline' if dataset.imported is None else ''}. {line}{'. ' * bool(line)}"
        f"Objects: {len(dataset.objects)}, of these glass: {', '.join(glass) or 'none'}."
    )


def _made(dataset: Dataset) -> str:
    config = dataset.config
    if (imported := dataset.imported) is not None:
        return f"Imported by hyaline from a folder in the layout of {imported.layout}; it was not rendered by hyaline."
    scene = config.scene if is_made_by_code(config.scene) else "SCENE"
    return (
        f"Path-traced with Mitsuba 3, {config.resolution.width} x {config.resolution.height} pixels, at most "
        f"{config.max_depth} segments a path, by `{shlex.join(build_words(dataset, scene))}`. The same version of "
        "hyaline gives the same bytes again on a machine of the same kind."
    )


def _split_line(split: str, items: list[ExportView]) -> str:
    records = [item.view.record for item in items]
    ceilings = [record.ceiling_db for record in records if record.ceiling_db is not None]
    spps = sorted({record.spp for record in records if record.spp is not None})
    spp = f"{spps[0]} to {spps[-1]}" if len(spps) > 1 else str(*spps) or "unknown"
    return f"| `{split}` | {len(items)} | {spp} | {f'{mean(ceilings):.1f} dB' if ceilings else 'unknown'} |"
