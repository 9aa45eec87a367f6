"""The command line of `proxies`: parse, configure, call one function."""

import sys
from typing import TYPE_CHECKING

from datagen.data.paths import MIXED, ProxyKind, find_dataset, train_command
from datagen.disk.errors import UsageError
from datagen.terminal.command import fail, next_command, run, tell
from datagen.terminal.parsing import CommandGroup, group

if TYPE_CHECKING:
    from datagen.data.dataset import Dataset
    from proxies.make import ProxyReport


def main() -> None:
    """Entry point of the console script."""
    run("proxies", commands(), sys.argv[1:])


def commands() -> CommandGroup:
    """All commands of the program."""
    return group("Coarse closed meshes with UV around the objects of a dataset.", {"make": make, "check": check})


def make(
    dataset: str | None = None,
    /,
    *,
    kind: ProxyKind = "ellipsoid",
    assign: tuple[str, ...] = (),
    name: str = MIXED,
    num_layers: int = 8,
    workers: int = 1,
    overwrite: bool = False,
) -> None:
    """Fit a proxy to every object and peel the proxies for every view; images are not rendered again.

    Args:
        kind: box (oriented, of minimum volume), ellipsoid (of minimum volume), hull (convex, rounded edges) or wrap
            (shrink-wrapped, follows hollows).
        assign: OBJECT=KIND, instead of one kind for all: the kind for one object, or for all that match a pattern, as
            'fern*'. KIND is one of the above, or truth, which others keep. May be repeated; the last one counts.
        name: With --assign: the geometry's name, mixed or mixed-SOMETHING.
        num_layers: Layers stored per ray.
        workers: Parallel processes.
        overwrite: Replace existing proxies and layers.
    """
    from datagen.data.dataset import open_dataset
    from datagen.data.layers import check_settings
    from proxies.make import assign_kinds, make_and_peel

    if kind != "ellipsoid" if assign else name != MIXED:
        raise UsageError("--kind does not go with --assign, and --name needs it; write --assign OBJECT=KIND")
    check_settings(num_layers=num_layers, workers=workers)
    opened, geometry = open_dataset(find_dataset(dataset)), name if assign else kind
    kinds = assign_kinds([item.name for item in opened.objects], assign) if assign else None
    reports = make_and_peel(opened, geometry, kinds, num_layers=num_layers, workers=workers, overwrite=overwrite)
    _print_table(opened, geometry, reports)
    next_command(train_command(opened.root, geometry))


def check(dataset: str | None = None, /, *, geometry: str = "ellipsoid") -> None:
    """Verify the proxies on disk: closed, outward, enclosing the object, with texels for every face.

    Args:
        geometry: box, ellipsoid, hull, wrap, or the name of a mixture or of fitted shapes.
    """
    from datagen.data.dataset import open_dataset
    from proxies.make import read_reports

    opened = open_dataset(find_dataset(dataset))
    reports = read_reports(opened, geometry)
    _print_table(opened, geometry, reports)
    if unsound := [report for report in reports if report.problem]:
        what = f"the {unsound[0].kind} of {unsound[0].object} {unsound[0].problem}"
        fail(f"{opened.root}: {what}; {len(unsound)} of the proxies are unsound, make them again with --overwrite")


def _print_table(dataset: "Dataset", geometry: str, reports: "tuple[ProxyReport, ...]") -> None:
    tell(f"{geometry} proxies of {dataset.root}")
    rows: list[tuple[str, ...]] = [
        ("object", "kind", "triangles", "volume / hull", "mean distance", "max distance", "inside")
    ]
    for report in reports:
        numbers = report.statistics
        distances = (f"{1000 * value:.2f} mm" for value in (numbers.mean_distance, numbers.max_distance))
        inside = "-" if report.inside_share is None else f"{100 * report.inside_share:.4g} %"
        row = report.object, report.kind, str(report.triangles), f"{numbers.volume_ratio:.3f}", *distances, inside
        rows.append(row)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        tell("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
