"""A look at a dataset before any training: one page of what it holds, what it lacks, and what it looks like."""

import io
import os
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from datagen.build.verify import verify_dataset
from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.geometries import list_geometries
from datagen.data.layer_store import record_path_of_layers
from datagen.data.paths import TRUTH, image_path, layers_root, record_path
from datagen.data.variants import evenly, list_variants
from datagen.disk.errors import HyalineError
from datagen.disk.homes import mend_command
from datagen.disk.records import Json, to_json
from datagen.look.light_paths import draw_light_paths
from datagen.look.scene_drawing import draw_cameras
from datagen.look.training_time import probe, training_time
from datagen.look.view_pictures import Picture, stored_pictures
from datagen.pages.charts import Line, line_chart
from datagen.pages.document import anchor, command, definitions, document, read_part, section
from datagen.pages.html import Markup, Part, join, tag
from datagen.pages.pictures import Gallery
from datagen.quantities.surfaces import surfaces_of

MOST_BYTES = 18_000_000
SHOWN_VIEWS = 6
"""Pictures of each split in the page."""
SHEET_COLUMNS = 6
UNKNOWN = "unknown"
MOST_VERIFIED_BYTES = 250_000_000
"""A dataset of at most so many is compared with its checksums, which takes some seconds."""


def look_page(dataset: Dataset) -> bytes:
    """The page of a dataset, of which something may be missing or damaged: the page then says so."""
    gallery = Gallery(MOST_BYTES)
    splits = [_split_section(dataset, split, gallery) for split in dataset.splits]
    parts: list[Part] = [
        tag("h1", dataset.name),
        section("What it is", definitions(_facts(dataset)), id_="facts"),
        section("What is missing or damaged", _missing(dataset), id_="missing"),
        *splits,
        section("Cameras", _told(lambda: draw_cameras(dataset)), id_="cameras"),
        section("Light paths", _told(lambda: draw_light_paths(dataset)), id_="light-paths"),
        section("Noise of the truth", _told(lambda: _noise_chart(dataset)), id_="noise"),
        section("Objects", _told(lambda: _objects(dataset)), id_="objects"),
    ]
    return document(dataset.name, gallery.store(), *parts, more_script=read_part("turn.js"))


def look_sheet(dataset: Dataset) -> bytes:
    """A PNG: a row for each split with pictures, and one with what is stored of its first view."""
    rows: list[list[Picture]] = []
    for split in dataset.splits:
        views = _shown(dataset, split)
        rows.append([dataset.view(split, view).image for view in views[:SHEET_COLUMNS]])
        if views:
            rows.append(list(_stored(dataset, split, views[0]).values())[:SHEET_COLUMNS])
    rows = [row for row in rows if row]
    if not rows:
        raise HyalineError(
            f"{dataset.root}: no view is built yet; finish with `{mend_command(dataset.root / 'dataset.json')}`"
        )
    (high, wide), gap = dataset.config.resolution.shape, 4
    sheet = np.full((len(rows) * (high + gap) - gap, SHEET_COLUMNS * (wide + gap) - gap, 3), 255, np.uint8)
    for place, row in enumerate(rows):
        for column, picture in enumerate(row):
            top, left = place * (high + gap), column * (wide + gap)
            sheet[top : top + high, left : left + wide] = picture
    buffer = io.BytesIO()
    Image.fromarray(sheet).save(buffer, format="PNG")
    return buffer.getvalue()


def _facts(dataset: Dataset) -> list[tuple[str, Part]]:
    config = dataset.config
    views = ", ".join(f"{count} {split}" for split, count in dataset.num_views.items())
    counts = {split: config.split(split).spp for split in dataset.splits}
    samples = ", ".join(f"{UNKNOWN if spp is None else spp} {split}" for split, spp in counts.items())
    imported = dataset.imported
    origin: list[tuple[str, Part]] = []
    if imported is not None:
        origin = [("imported from", f"{imported.source}, laid out as by {imported.layout}")]
        origin += [("remark", remark) for remark in imported.remarks]
    sizes = "; ".join(f"{name} {size / 1e6:,.1f} MB" for name, size in folder_sizes(dataset.root).items())
    return [
        ("scene", config.scene),
        *origin,
        ("preset", config.preset),
        ("views", views),
        ("pixels", str(config.resolution)),
        ("samples a pixel", samples),
        ("seed", config.seed if imported is None else UNKNOWN),
        ("objects", f"{len(dataset.objects)}, {sum(item.is_glass for item in dataset.objects)} of glass"),
        ("geometries", ", ".join(list_geometries(dataset))),
        ("variants", ", ".join(list_variants(dataset.root)) or "none"),
        ("on disk", sizes),
        *([("training here", training_time(probe()))] if dataset.objects else []),
        ("seal", dataset.seal[:12]),
    ]


def folder_sizes(root: Path) -> dict[str, int]:
    """Bytes below each folder of a dataset, and of the files beside them; no link is followed."""
    sizes: dict[str, int] = {}
    for place, _, names in os.walk(root):
        inside = Path(place).relative_to(root).parts
        name = inside[0] if inside else "heads and cameras"
        sizes[name] = sizes.get(name, 0) + sum((Path(place) / file).lstat().st_size for file in names)
    return dict(sorted(sizes.items(), key=lambda item: -item[1]))


def missing_lines(dataset: Dataset) -> list[str]:
    """What is not there by the names of its files alone: nothing is read, so damage is not found."""
    lines = []
    for split, count in dataset.num_views.items():
        lacking = [view for view in range(count) if not _has_view(dataset, split, view)]
        if lacking:
            lines.append(f"{split}: {len(lacking)} of {count} views are not built, such as {lacking[0]}")
        for geometry in list_geometries(dataset):
            root = layers_root(dataset.root, geometry)
            bare = sum(not record_path_of_layers(root, split, view).is_file() for view in range(count))
            if bare and (root / "layers.json").is_file():
                lines.append(f"{split}: {bare} of {count} views lack layers of {geometry}")
    return lines


def _has_view(dataset: Dataset, split: Split, view: int) -> bool:
    picture = image_path(dataset.root, split, view)
    files = (record_path(dataset.root, split, view), *map(picture.with_suffix, dataset.endings))
    return all(file.is_file() and file.stat().st_size > 0 for file in files)


def _missing(dataset: Dataset) -> Markup:
    verify = command(shlex.join(["datagen", "verify", str(dataset.root)]))
    if sum(folder_sizes(dataset.root).values()) > MOST_VERIFIED_BYTES:
        lines, good = missing_lines(dataset), "No file is missing."
        how = join([tag("p", "This looks at names alone; to compare every byte with its checksum:"), verify])
    else:
        found = verify_dataset(dataset.root)
        lines, good = found.problems, f"Nothing: {found.verified:,} files are what they should be, byte by byte."
        how = join([command(line) for line in found.commands])
    listed = tag("ul", *(tag("li", line, class_="bad") for line in lines)) if lines else tag("p", good)
    return join([listed, how])


def _shown(dataset: Dataset, split: Split) -> list[int]:
    """Views of a split that are there, evenly chosen."""
    there = [view for view in range(dataset.num_views[split]) if _has_view(dataset, split, view)]
    return [there[place] for place in evenly(min(SHOWN_VIEWS, len(there)), len(there))] if there else []


def _first_whole(dataset: Dataset, split: Split, views: Sequence[int]) -> tuple[int, dict[str, Picture]]:
    """The first of some views of which everything can be read, and its pictures.

    Raises:
        HyalineError: there is none; what is wrong with the first.
    """
    errors = []
    for view in views:
        try:
            return view, _stored(dataset, split, view)
        except HyalineError as error:
            errors.append(error)
    raise errors[0]


def _stored(dataset: Dataset, split: Split, view: int) -> dict[str, Picture]:
    """The pictures of one view; of those that cannot be read, none."""

    def has_layers(geometry: str) -> bool:
        root = layers_root(dataset.root, geometry)
        return record_path_of_layers(root, split, view).is_file()

    proxies = tuple(item for item in list_geometries(dataset) if item != TRUTH and has_layers(item))
    return stored_pictures(dataset.view(split, view), has_layers=has_layers(TRUTH), proxies=proxies)


def _split_section(dataset: Dataset, split: Split, gallery: Gallery) -> Markup:
    """What is stored of one view that is whole, and the pictures of some; each that is damaged says so in its place."""
    views = _shown(dataset, split)
    parts: list[Part] = []
    if views:
        parts.append(_told(lambda: _one_view(dataset, split, views, gallery)))
        pictures = [_told(lambda view=view: _picture(dataset, split, view, gallery)) for view in views]
        parts.append(tag("div", *pictures, class_="sheet"))
    else:
        parts.append(tag("p", "No view is built yet.", class_="bad"))
    return section(split, *parts, id_=anchor("split", split))


def _one_view(dataset: Dataset, split: Split, views: Sequence[int], gallery: Gallery) -> Markup:
    """Everything that is stored of the first whole view; a script shows one picture at a time."""
    figures = []
    view, stored = _first_whole(dataset, split, views)
    for name, picture in stored.items():
        key, label = anchor(split, str(view), name), f"{split} view {view}: {name}"
        if gallery.add(key, lambda picture=picture: picture):
            shown = gallery.show(key, label=label)
            figures.append(tag("figure", shown, tag("figcaption", label), data_name=name))
    return tag("div", *figures, class_="choice sheet")


def _picture(dataset: Dataset, split: Split, view: int, gallery: Gallery) -> Markup:
    key, label = anchor(split, str(view), "picture"), f"{split} view {view}"
    if not gallery.add(key, lambda: dataset.view(split, view).image):
        return Markup("")
    return tag("figure", gallery.show(key, label=label), tag("figcaption", label))


def _noise_chart(dataset: Dataset) -> Markup:
    if dataset.imported is not None:
        return tag("p", "The pictures were imported: how noisy they are is unknown.")
    lines = []
    for split in dataset.splits:
        there = [view for view in dataset.views(split) if _has_view(dataset, split, view.index)]
        ceilings = [(float(view.index), view.record.ceiling_db) for view in there]
        known = tuple((index, ceiling) for index, ceiling in ceilings if ceiling is not None)
        lines.append(Line(name=split, points=known))
    title = "PSNR at which the truth's own noise would stop a perfect method"
    return line_chart(lines, title=title, x_title="view", y_title="PSNR (dB)")


def _objects(dataset: Dataset) -> Markup:
    if not dataset.objects:
        return tag("p", "No meshes were imported with the pictures.")
    materials = surfaces_of(dataset).materials
    head = tag(
        "tr",
        *(tag("th", name, scope="col", class_=kind) for name, kind in (("id", "number"), ("object", None))),
        tag("th", "material", scope="col"),
        tag("th", "settings", scope="col"),
    )
    rows = []
    for place, (item, material) in enumerate(zip(dataset.objects, materials, strict=True)):
        told = to_json(material)
        settings = _settings(told) if isinstance(told, dict) else ""
        cells = (tag("td", place + 1, class_="number"), tag("th", item.name, scope="row"))
        rows.append(tag("tr", *cells, tag("td", type(material).__name__), tag("td", settings)))
    caption = tag("caption", "Objects, by the id that layers hold")
    table = tag("table", caption, tag("thead", head), tag("tbody", *rows), class_="sortable")
    return tag("div", table, class_="scroll", tabindex=0, role="region", aria_label="Objects")


def _settings(told: dict[str, Json]) -> str:
    return ", ".join(f"{key} {_setting(value)}" for key, value in told.items() if key != "type")


def _setting(value: Json) -> str:
    """A number, a color, or the name of a texture's kind."""
    if isinstance(value, dict):
        return str(value.get("type", "of several parts"))
    if isinstance(value, list):
        return f"({', '.join(map(_setting, value))})"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _told(draw: Callable[[], Markup]) -> Markup:
    """What `draw` gives, or what is wrong with the files that it reads."""
    try:
        return draw()
    except HyalineError as error:
        return tag("p", str(error), class_="bad")
