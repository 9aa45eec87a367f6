"""The page that shows a dataset: its contents, what is missing or damaged, and what it looks like."""

import os
from collections.abc import Callable
from pathlib import Path

from datagen.builder.verify import verify_dataset
from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.geometries import list_geometries
from datagen.data.layers import record_path_of_layers
from datagen.data.paths import TRUTH, layers_root
from datagen.data.variants import evenly, list_variants
from datagen.disk.errors import HyalineError
from datagen.disk.storage import MAKE_AGAIN
from datagen.look.drawings import DrawnPath, draw_cameras, draw_light_paths, find_light_paths
from datagen.look.view_pictures import Picture, object_colors, stored_pictures
from datagen.pages.charts import Line, line_chart
from datagen.pages.html import Markup, Part, anchor, definitions, document, join, prose, section, tag
from datagen.pages.pictures import Gallery
from datagen.quantities import surfaces_of

MOST_BYTES = 18_000_000
SHOWN_VIEWS = 6
"""Pictures shown per split."""
UNKNOWN = "unknown"
STORED = (
    "Glass: everything else is dark. Depth: distance to the first surface along the ray, from the nearest (bright) to "
    "the farthest (dark). Normals: red, green and blue are x, y and z of the world. Layer 0 is the first surface on a "
    "straight ray, layer 1 the one behind it, and so on, in the colours of the objects below. Proxies are laid over "
    "the picture."
)
PATHS = (
    "A ray from the camera splits where it hits glass: one part is refracted (solid, to a disc), the other is "
    "reflected (dashed, to a diamond). Each part is followed until it ends on something opaque or in the sky, which is "
    "what the pixel in the ring shows. Lines without a mark at their end lead to the sky or out of the picture."
)


def look_page(dataset: Dataset) -> bytes:
    """The page of a dataset, every file of which is read; it lists whatever is missing or damaged."""
    gallery = Gallery(MOST_BYTES)
    found = verify_dataset(dataset.root)
    pictures = [_pictures(dataset, split, gallery) for split in dataset.splits]
    stored = [_one_view(dataset, split, gallery, is_open=place == 0) for place, split in enumerate(dataset.splits)]
    count = len(found.problems)
    number = f"{count} things are missing or damaged." if count > 1 else "1 thing is missing or damaged."
    whole = f"Nothing: all {len(found.files):,} files match their checksums."
    missing = [tag("ul", *(tag("li", prose(line), class_="bad") for line in found.problems)) if count else None]
    parts: list[Part] = [
        tag("h1", dataset.name),
        tag("p", tag("a", number, href="#missing"), class_="bad") if count else None,
        section("Pictures", *pictures, id_="pictures"),
        section("Light paths", _or_error(lambda: _light_paths(dataset, gallery)), id_="light-paths"),
        section("Cameras", _or_error(lambda: _cameras(dataset, gallery)), id_="cameras"),
        section("What is stored with a view", tag("p", STORED, class_="note"), *stored, id_="stored"),
        section("Noise of the truth", _or_error(lambda: _noise_chart(dataset)), id_="noise"),
        section("Objects", _or_error(lambda: _objects(dataset)), id_="objects"),
        section("What it is", definitions(_facts(dataset)), id_="facts"),
        section(
            "What is missing or damaged",
            *missing,
            tag("p", f"To mend this, {MAKE_AGAIN}." if count else whole),
            id_="missing",
        ),
    ]
    return document(dataset.name, gallery.store(), *parts)


def _facts(dataset: Dataset) -> list[tuple[str, Part]]:
    config, imported = dataset.config, dataset.imported
    counts = {split: config.split(split).spp for split in dataset.splits}
    origin: list[tuple[str, Part]] = []
    if imported is not None:
        origin = [("imported from", f"{imported.source}, laid out as by {imported.layout}")]
        origin += [("remark", remark) for remark in imported.remarks]
    return [
        ("scene", config.scene),
        *origin,
        ("preset", config.preset),
        ("views", ", ".join(f"{count:,} {split}" for split, count in dataset.num_views.items())),
        ("pixels", str(config.resolution)),
        ("samples a pixel", ", ".join(f"{spp or UNKNOWN} {split}" for split, spp in counts.items())),
        ("seed", config.seed if imported is None else UNKNOWN),
        ("objects", f"{len(dataset.objects)}, {sum(item.is_glass for item in dataset.objects)} of glass"),
        ("geometries", ", ".join(list_geometries(dataset))),
        ("variants", ", ".join(list_variants(dataset.root)) or "none"),
        ("on disk", "; ".join(f"{name} {size / 1e6:,.1f} MB" for name, size in folder_sizes(dataset.root).items())),
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


def _shown(dataset: Dataset, split: Split) -> list[int]:
    """An even selection of the views of a split that exist."""
    there = [view.index for view in dataset.views(split) if view.record_path.is_file()]
    return [there[place] for place in evenly(min(SHOWN_VIEWS, len(there)), len(there))] if there else []


def _figure(gallery: Gallery, key: str, read: Callable[[], Picture], label: str, caption: str) -> Markup:
    """A picture with a caption; nothing if the page has no room for it."""
    if not gallery.add(key, read):
        return Markup("")
    return tag("figure", gallery.show(key, label=label), tag("figcaption", caption), data_name=caption)


def _pictures(dataset: Dataset, split: Split, gallery: Gallery) -> Markup:
    """Pictures of some views of a split; a damaged one is replaced by its error."""

    def show(view: int) -> Markup:
        key, label = anchor(split, str(view), "picture"), f"{split} view {view}"
        return _figure(gallery, key, lambda: dataset.view(split, view).image, label, f"view {view}")

    shown = [_or_error(lambda view=view: show(view)) for view in _shown(dataset, split)]
    sheet = tag("div", *shown, class_="sheet") if shown else tag("p", "No view is built yet.", class_="bad")
    return section(f"{split}: {dataset.num_views[split]:,} views", sheet, id_=anchor("split", split), level=3)


def _one_view(dataset: Dataset, split: Split, gallery: Gallery, *, is_open: bool) -> Markup | None:
    """All stored data of the first view that can be read; a script shows one picture at a time."""
    errors = []
    for view in _shown(dataset, split):
        try:
            stored = _stored(dataset, split, view)
        except HyalineError as error:
            errors.append(tag("p", prose(str(error)), class_="bad"))
            continue
        figures = [
            _figure(gallery, anchor(name, split), lambda pixels=pixels: pixels, f"{split} view {view}: {name}", name)
            for name, pixels in stored.items()
        ]
        summary = tag("summary", f"{split} view {view}: {len(stored)} pictures")
        return tag("details", summary, tag("div", *figures, class_="choice sheet"), open=is_open)
    return errors[0] if errors else None


def _stored(dataset: Dataset, split: Split, view: int) -> dict[str, Picture]:
    """The pictures of one view; raises if anything cannot be read."""
    with_layers = [
        geometry
        for geometry in list_geometries(dataset)
        if record_path_of_layers(layers_root(dataset.root, geometry), split, view).is_file()
    ]
    proxies = tuple(geometry for geometry in with_layers if geometry != TRUTH)
    return stored_pictures(dataset.view(split, view), has_layers=TRUTH in with_layers, proxies=proxies)


def _light_paths(dataset: Dataset, gallery: Gallery) -> Markup:
    """The paths over a view's picture, and the objects on each path in words."""
    found = find_light_paths(dataset)
    if found is None:
        return tag("p", "No ray of the training views hits glass.")
    view, paths = found
    name = f"Light paths over {view.split} view {view.index}"
    figure = _figure(gallery, anchor("light paths"), lambda: draw_light_paths(view, paths), name, name)
    head = tag("tr", *(tag("th", name, scope="col") for name in ("ray", "column, row", "refracted", "reflected")))
    rows = [_row_of_paths([path for path in paths if path.ray == ray]) for ray in sorted({path.ray for path in paths})]
    table = tag("table", tag("thead", head), tag("tbody", *rows))
    return join([tag("p", PATHS, class_="note"), figure, tag("div", table, class_="scroll", tabindex=0)])


def _row_of_paths(paths: list[DrawnPath]) -> Markup:
    words = {path.is_reflected: f"{path.through} → {path.end}" for path in paths}
    column, row = paths[0].pixel
    cells = (f"{column}, {row}", words.get(False, "nothing"), words.get(True, "nothing"))
    return tag("tr", tag("th", paths[0].ray, scope="row"), *(tag("td", cell) for cell in cells))


def _cameras(dataset: Dataset, gallery: Gallery) -> Markup:
    name = "Cameras from above"
    return _figure(gallery, anchor("cameras"), lambda: draw_cameras(dataset), name, f"{name}, and the glass")


def _noise_chart(dataset: Dataset) -> Markup:
    if dataset.imported is not None:
        return tag("p", "The pictures were imported, so their noise is unknown.")
    lines = []
    for split in dataset.splits:
        built = [view for view in dataset.views(split) if view.record_path.is_file()]
        ceilings = [(float(view.index), view.record.ceiling_db) for view in built]
        known = tuple((index, ceiling) for index, ceiling in ceilings if ceiling is not None)
        lines.append(Line(name=split, points=known))
    title = "Noise ceiling: the highest PSNR that a perfect method could reach"
    return line_chart(tuple(lines), title=title, x_title="view", y_title="PSNR (dB)")


def _objects(dataset: Dataset) -> Markup:
    """The objects with their ids, their colours in layers, and their materials."""
    if not dataset.objects:
        return tag("p", "No meshes were imported with the pictures.")
    colors = object_colors(len(dataset.objects))
    head = tag("tr", *(tag("th", name, scope="col") for name in ("id", "colour", "object", "material")))
    rows = []
    for number, (item, material) in enumerate(zip(dataset.objects, surfaces_of(dataset).materials, strict=True), 1):
        square = tag("rect", x=1, y=1, width=18, height=18, fill="#" + bytes(colors[number].tolist()).hex())
        swatch = tag("svg", square, width=20, height=20, viewBox="0 0 20 20", aria_hidden="true")
        cells = (tag("td", number), tag("td", swatch), tag("th", item.name, scope="row"), tag("td", repr(material)))
        rows.append(tag("tr", *cells))
    table = tag("table", tag("thead", head), tag("tbody", *rows), class_="sortable")
    return tag("div", table, class_="scroll", tabindex=0, role="region", aria_label="Objects")


def _or_error(draw: Callable[[], Markup]) -> Markup:
    """The result of `draw`, or its error about the files that it reads."""
    try:
        return draw()
    except HyalineError as error:
        return tag("p", prose(str(error)), class_="bad")
