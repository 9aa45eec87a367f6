"""The page that shows a dataset: its contents, what is missing or damaged, and what it looks like."""

import os
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from datagen.builder.verify import verify_dataset
from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.geometries import list_geometries
from datagen.data.layers import record_path_of_layers
from datagen.data.paths import TRUTH, image_path, layers_root, record_path
from datagen.data.variants import evenly, list_variants
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json, to_json
from datagen.disk.storage import MAKE_AGAIN
from datagen.look.cameras import draw_cameras
from datagen.look.light_paths import draw_light_paths
from datagen.look.view_pictures import FARTHEST, NEAREST, StoredPicture, object_colors, stored_pictures
from datagen.pages.charts import Line, line_chart
from datagen.pages.html import Markup, Part, anchor, command, definitions, document, join, prose, section, tag
from datagen.pages.pictures import Gallery
from datagen.quantities.surfaces import surfaces_of

MOST_BYTES = 18_000_000
SHOWN_VIEWS = 6
"""Pictures shown per split."""
UNKNOWN = "unknown"
STORED = (
    "Glass: everything else is dark. Depth: distance to the first surface, in metres along the ray. Normals: red, "
    "green and blue are x, y and z of the world. Layer 0 is the first surface on a straight ray, layer 1 the one "
    "behind it, and so on. Proxies are laid over the picture."
)
SHADES = 24
"""Greys in the bar next to a depth picture."""
MOST_VERIFIED_BYTES = 250_000_000
"""Datasets up to this size are compared with their checksums, which takes some seconds."""


def look_page(dataset: Dataset) -> bytes:
    """The page of a dataset; it lists whatever is missing or damaged."""
    gallery = Gallery(MOST_BYTES)
    problems, how = _problems(dataset)
    pictures = [_pictures(dataset, split, gallery) for split in dataset.splits]
    paths = _or_error(lambda: draw_light_paths(dataset, gallery))
    stored = [_one_view(dataset, split, gallery, is_open=place == 0) for place, split in enumerate(dataset.splits)]
    parts: list[Part] = [
        tag("h1", dataset.name),
        tag("p", _summary(dataset), class_="note"),
        tag("p", tag("a", _number_of(problems), href="#missing"), class_="bad") if problems else None,
        section("Pictures", *pictures, id_="pictures"),
        section("Light paths", paths, id_="light-paths"),
        section("Cameras", _or_error(lambda: draw_cameras(dataset)), id_="cameras"),
        section("What is stored with a view", tag("p", STORED, class_="note"), *stored, id_="stored"),
        section("Noise of the truth", _or_error(lambda: _noise_chart(dataset)), id_="noise"),
        section("Objects", _or_error(lambda: _objects(dataset)), id_="objects"),
        section("What it is", definitions(_facts(dataset)), id_="facts"),
        section("What is missing or damaged", _missing(problems, how), id_="missing"),
    ]
    return document(dataset.name, gallery.store(), *parts)


def _summary(dataset: Dataset) -> str:
    views = ", ".join(f"{count:,} {split}" for split, count in dataset.num_views.items())
    glass = sum(item.is_glass for item in dataset.objects)
    return f"{views} views of {dataset.config.resolution} pixels; {len(dataset.objects)} objects, {glass} of glass"


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
        ("digest", dataset.seal[:12]),
    ]


def folder_sizes(root: Path) -> dict[str, int]:
    """Bytes in each folder of a dataset, and in the files next to them; links are not followed."""
    sizes: dict[str, int] = {}
    for place, _, names in os.walk(root):
        inside = Path(place).relative_to(root).parts
        name = inside[0] if inside else "heads and cameras"
        sizes[name] = sizes.get(name, 0) + sum((Path(place) / file).lstat().st_size for file in names)
    return dict(sorted(sizes.items(), key=lambda item: -item[1]))


def missing_lines(dataset: Dataset) -> list[str]:
    """What is missing, by file names alone: nothing is read, so damage is not found."""
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


def _problems(dataset: Dataset) -> tuple[list[str], Part]:
    """The problems, one line each, and how they were found or how to fix them."""
    if sum(folder_sizes(dataset.root).values()) > MOST_VERIFIED_BYTES:
        lines = missing_lines(dataset)
        good = None if lines else tag("p", "No file is missing.")
        more = tag("p", "Only names were checked; to compare every byte with its checksum:")
        return lines, join([good, more, command(shlex.join(["datagen", "verify", str(dataset.root)]))])
    found = verify_dataset(dataset.root)
    if found.problems:
        return found.problems, tag("p", f"To mend this, {MAKE_AGAIN}.")
    return [], tag("p", f"Nothing: all {found.verified:,} files match their checksums.")


def _missing(problems: list[str], how: Part) -> Markup:
    listed = tag("ul", *(tag("li", prose(line), class_="bad") for line in problems)) if problems else None
    return join([listed, how])


def _number_of(problems: list[str]) -> str:
    return f"{len(problems)} things are missing or damaged." if len(problems) > 1 else "1 thing is missing or damaged."


def _shown(dataset: Dataset, split: Split) -> list[int]:
    """An even selection of the views of a split that exist."""
    there = [view for view in range(dataset.num_views[split]) if _has_view(dataset, split, view)]
    return [there[place] for place in evenly(min(SHOWN_VIEWS, len(there)), len(there))] if there else []


def _first_whole(dataset: Dataset, split: Split, views: Sequence[int]) -> tuple[int, dict[str, StoredPicture]]:
    """The first of some views that can be read completely, and its pictures; raises the first error if none can."""
    errors = []
    for view in views:
        try:
            return view, _stored(dataset, split, view)
        except HyalineError as error:
            errors.append(error)
    raise errors[0]


def _stored(dataset: Dataset, split: Split, view: int) -> dict[str, StoredPicture]:
    """The pictures of one view; raises if anything cannot be read."""

    def has_layers(geometry: str) -> bool:
        root = layers_root(dataset.root, geometry)
        return record_path_of_layers(root, split, view).is_file()

    proxies = tuple(item for item in list_geometries(dataset) if item != TRUTH and has_layers(item))
    return stored_pictures(dataset.view(split, view), has_layers=has_layers(TRUTH), proxies=proxies)


def _pictures(dataset: Dataset, split: Split, gallery: Gallery) -> Markup:
    """Pictures of some views of a split; a damaged one is replaced by its error."""
    views, count = _shown(dataset, split), dataset.num_views[split]
    shown = [_or_error(lambda view=view: _picture(dataset, split, view, gallery)) for view in views]
    sheet = tag("div", *shown, class_="sheet") if views else tag("p", "No view is built yet.", class_="bad")
    title = f"{split}: {count:,} views" if count != 1 else f"{split}: 1 view"
    return section(title, sheet, id_=anchor("split", split), level=3)


def _picture(dataset: Dataset, split: Split, view: int, gallery: Gallery) -> Markup:
    key = anchor(split, str(view), "picture")
    if not gallery.add(key, lambda: dataset.view(split, view).image):
        return Markup("")
    return tag("figure", gallery.show(key, label=f"{split} view {view}"), tag("figcaption", f"view {view}"))


def _one_view(dataset: Dataset, split: Split, gallery: Gallery, *, is_open: bool) -> Markup | None:
    """All stored data of the first complete view; a script shows one picture at a time."""
    views = _shown(dataset, split)
    if not views:
        return None
    try:
        view, stored = _first_whole(dataset, split, views)
    except HyalineError as error:
        return tag("p", prose(str(error)), class_="bad")
    figures = []
    for name, picture in stored.items():
        key = anchor(split, str(view), name)
        if gallery.add(key, lambda picture=picture: picture.pixels):
            shown = gallery.show(key, label=f"{split} view {view}: {name}")
            bar = None if picture.metres is None else _depth_bar(*picture.metres)
            figures.append(tag("figure", shown, tag("figcaption", name), bar, data_name=name))
    summary = tag("summary", f"{split} view {view}: {len(stored)} pictures")
    ids = sorted({object_id for picture in stored.values() for object_id in picture.object_ids})
    legend = _objects_legend(dataset, ids) if ids else None
    return tag("details", summary, tag("div", *figures, class_="choice sheet"), legend, open=is_open)


def _depth_bar(near: float, far: float) -> Markup:
    """A bar of the picture's greys, with the depths of its nearest and farthest pixel in metres."""
    greys = (NEAREST - (NEAREST - FARTHEST) * np.arange(SHADES) / (SHADES - 1)).astype(np.uint8)
    bars = [tag("rect", x=place, width=1.1, height=1, fill=_hex([grey] * 3)) for place, grey in enumerate(greys)]
    label = f"depth from {near:.2f} m, bright, to {far:.2f} m, dark"
    bar = tag(
        "svg", *bars, viewBox=f"0 0 {SHADES} 1", preserveAspectRatio="none", role="img", aria_label=label, class_="bar"
    )
    return tag("div", tag("span", f"{near:.2f} m"), bar, tag("span", f"{far:.2f} m"), class_="depth")


def _objects_legend(dataset: Dataset, ids: list[int]) -> Markup:
    colors = object_colors(len(dataset.objects))
    lines = []
    for object_id in ids:
        square = tag("rect", x=1, y=1, width=18, height=18, fill=_hex(colors[object_id]), class_="swatch")
        key = tag("svg", square, class_="key square", viewBox="0 0 20 20", aria_hidden="true")
        lines.append(tag("li", key, dataset.objects[object_id - 1].name))
    return tag("ul", *lines, class_="legend keys", aria_label="Objects by colour")


def _hex(color: Sequence[int]) -> str:
    return "#" + bytes(map(int, color)).hex()


def _noise_chart(dataset: Dataset) -> Markup:
    if dataset.imported is not None:
        return tag("p", "The pictures were imported, so their noise is unknown.")
    lines = []
    for split in dataset.splits:
        there = [view for view in dataset.views(split) if _has_view(dataset, split, view.index)]
        ceilings = [(float(view.index), view.record.ceiling_db) for view in there]
        known = tuple((index, ceiling) for index, ceiling in ceilings if ceiling is not None)
        lines.append(Line(name=split, points=known))
    title = "Noise ceiling: the highest PSNR that a perfect method could reach"
    return line_chart(tuple(lines), title=title, x_title="view", y_title="PSNR (dB)")


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
        record = to_json(material)
        settings = _settings(record) if isinstance(record, dict) else ""
        cells = (tag("td", place + 1, class_="number"), tag("th", item.name, scope="row"))
        rows.append(tag("tr", *cells, tag("td", type(material).__name__), tag("td", settings)))
    caption = tag("caption", "Objects, by their id in layers")
    table = tag("table", caption, tag("thead", head), tag("tbody", *rows), class_="sortable")
    return tag("div", table, class_="scroll", tabindex=0, role="region", aria_label="Objects")


def _settings(record: dict[str, Json]) -> str:
    return ", ".join(f"{key} {_setting(value)}" for key, value in record.items() if key != "type")


def _setting(value: Json) -> str:
    """A number, a colour, or the kind of a texture."""
    if isinstance(value, dict):
        return str(value.get("type", "of several parts"))
    if isinstance(value, list):
        return f"({', '.join(map(_setting, value))})"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _or_error(draw: Callable[[], Markup]) -> Markup:
    """The result of `draw`, or its error about the files that it reads."""
    try:
        return draw()
    except HyalineError as error:
        return tag("p", prose(str(error)), class_="bad")
