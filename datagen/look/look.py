"""The page that shows a dataset: its contents, what is missing or damaged, and what it looks like."""

from collections.abc import Callable

import numpy as np

from datagen.builder.verify import verify_dataset
from datagen.data.config import Split
from datagen.data.dataset import Dataset, View, has_glass_mask
from datagen.data.geometries import list_geometries
from datagen.data.variants import evenly, list_variants
from datagen.disk.errors import HyalineError
from datagen.disk.storage import MAKE_AGAIN
from datagen.look.drawings import (
    draw_cameras,
    draw_light_paths,
    find_light_paths,
    object_colors,
    stored_pictures,
)
from datagen.pages.html import Gallery, Markup, Part, anchor, definitions, document, join, prose, row, section, tag
from datagen.quantities import surfaces_of

MOST_BYTES = 18_000_000
SHOWN_VIEWS = 5
"""Pictures shown per split."""
UNKNOWN = "unknown"
CAMERAS = "Cameras from above, and the glass"
STORED = (
    "Glass: everything else is dark. Depth: distance to the first surface along the ray, from the nearest (bright) to "
    "the farthest (dark). Normals: red, green and blue are x, y and z of the world. Layer 0 is the first surface on a "
    "straight ray, layer 1 the one behind it, and so on, in the colours of the objects. Proxies are laid over "
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
    count = len(found.problems)
    missing = f"{count} of the files are missing or damaged."
    end = f"To mend this, {MAKE_AGAIN}." if count else f"All {len(found.files):,} files match their checksums."
    problems = tag("ul", *(tag("li", prose(line), class_="bad") for line in found.problems))
    drawn: dict[str, Callable[[], Part]] = {
        "Pictures": lambda: join(_pictures(dataset, split, gallery) for split in dataset.splits),
        "Light paths": lambda: _light_paths(dataset, gallery),
        "Cameras": lambda: gallery.figure(anchor("cameras"), lambda: draw_cameras(dataset), label=CAMERAS),
        "Stored with a view": lambda: join(_stored_views(dataset, gallery)),
        "Objects": lambda: _objects(dataset),
        "What it is": lambda: definitions(_facts(dataset)),
        "Missing or damaged": lambda: join([problems if count else None, tag("p", end)]),
    }
    parts = [section(title, or_error(draw), id_=title.lower().replace(" ", "-")) for title, draw in drawn.items()]
    warning = tag("p", tag("a", missing, href="#missing-or-damaged"), class_="bad") if count else None
    health = or_error(lambda: definitions([(split, _health(dataset, split)) for split in dataset.splits]))
    return document(dataset.name, gallery.store(), tag("h1", dataset.name), warning, health, *parts)


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
        ("digest", dataset.seal[:12]),
    ]


def _shown(dataset: Dataset, split: Split) -> list[int]:
    """An even selection of the views of a split that exist."""
    there = [view.index for view in dataset.views(split) if view.record_path.is_file()]
    return [there[place] for place in evenly(min(SHOWN_VIEWS, len(there)), len(there))] if there else []


def _pictures(dataset: Dataset, split: Split, gallery: Gallery) -> Markup:
    """Pictures of some views of a split; a damaged one is replaced by its error."""

    def show(view: int) -> Part:
        key, label = anchor(split, str(view), "picture"), f"{split} view {view}"
        return gallery.figure(key, lambda: dataset.view(split, view).image, label=label, caption=f"view {view}")

    shown = [or_error(lambda view=view: show(view)) for view in _shown(dataset, split)]
    sheet = row(*shown, label=f"{split} views") if shown else tag("p", "No view is built yet.", class_="bad")
    return section(f"{split}: {dataset.num_views[split]:,} views", sheet, id_=anchor("split", split), level=3)


def _stored_views(dataset: Dataset, gallery: Gallery) -> list[Part]:
    """All stored data of the first view of each split that can be read; a script shows one picture at a time."""
    parts: list[Part] = []
    for split in dataset.splits:
        for view in _shown(dataset, split):
            try:
                pictures = stored_row(dataset.view(split, view), gallery)
            except HyalineError:  # Listed among what is damaged.
                continue
            parts.append(tag("details", tag("summary", f"{split} view {view}"), pictures, open=not parts))
            break
    return parts


def stored_row(view: View, gallery: Gallery) -> Markup:
    """All that is stored of a view, as pictures that fit, below what they mean.

    Raises:
        HyalineError: a file is missing or damaged.
    """
    what, seal = f"{view.split} view {view.index}", view.dataset.seal
    figures = [
        gallery.figure(anchor(name, what, seal), lambda pixels=pixels: pixels, label=f"{what}: {name}", caption=name)
        for name, pixels in stored_pictures(view).items()
    ]
    names = []
    for item, color in zip(view.dataset.objects, object_colors(len(view.dataset.objects))[1:], strict=True):
        square = tag("rect", width=18, height=18, fill="#" + bytes(color.tolist()).hex())
        names.append(tag("span", tag("svg", square, width=18, height=18, aria_hidden="true"), item.name))
    legend = tag("p", *names, class_="legend note")
    return join([tag("p", STORED, class_="note"), legend, row(*figures, label=f"stored of {what}")])


def _light_paths(dataset: Dataset, gallery: Gallery) -> Markup:
    """The paths over a view's picture, and the objects on each path in words."""
    found = find_light_paths(dataset)
    if found is None:
        return tag("p", "No ray of the training views hits glass.")
    view, paths = found
    name = f"Light paths over {view.split} view {view.index}"
    figure = gallery.figure(anchor("light paths"), lambda: draw_light_paths(view, paths), label=name)
    words = {(path.ray, path.is_reflected): f"{path.through} → {path.end}" for path in paths}
    rows: list[list[Part]] = [
        [number, f"{column}, {row}", *(words.get((number, kind), "nothing") for kind in (False, True))]
        for number, (column, row) in {path.ray: path.pixel for path in paths}.items()
    ]
    table = _table(("ray", "column, row", "refracted", "reflected"), rows, head=0)
    return join([tag("p", PATHS, class_="note"), figure, table])


def _table(titles: tuple[str, ...], rows: list[list[Part]], *, head: int) -> Markup:
    """A table; the cells of column `head` name their rows."""

    def line(row: list[Part]) -> Markup:
        cells = (tag("th", cell, scope="row") if place == head else tag("td", cell) for place, cell in enumerate(row))
        return tag("tr", *cells)

    top = tag("thead", tag("tr", *(tag("th", title, scope="col") for title in titles)))
    return tag("div", tag("table", top, tag("tbody", *map(line, rows))), class_="scroll", tabindex=0)


def _health(dataset: Dataset, split: Split) -> str:
    """The noise of a split, and what its shown views consist of."""
    views = [dataset.view(split, view) for view in _shown(dataset, split)]
    if not views:
        return "no view is built yet"
    black = 100 * np.mean([(view.image == 0).all(axis=-1).mean() for view in views])
    ceiling, glass = dataset.noise_ceiling_db(split), UNKNOWN
    if has_glass_mask(dataset):
        glass = f"{100 * np.mean([view.mask('glass').mean() for view in views]):.1f} %"
    noise = UNKNOWN if ceiling is None else f"{ceiling:.1f} dB"
    return f"noise ceiling {noise}; pixels that see glass: {glass}; black pixels: {black:.1f} %"


def _objects(dataset: Dataset) -> Markup:
    """The objects with their ids and materials."""
    if not dataset.objects:
        return tag("p", "No meshes were imported with the pictures.")
    materials = surfaces_of(dataset).materials
    rows: list[list[Part]] = [
        [number, item.name, repr(material)]
        for number, (item, material) in enumerate(zip(dataset.objects, materials), 1)
    ]
    return _table(("id", "object", "material"), rows, head=1)


def or_error(draw: Callable[[], Part]) -> Part:
    """The result of `draw`, or its error about the files that it reads."""
    try:
        return draw()
    except HyalineError as error:
        return tag("p", prose(str(error)), class_="bad")
