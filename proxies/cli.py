"""The command line of `proxies`: parse, configure, call one function."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from datagen.data.paths import (
    BUILD,
    DATA_ROOT,
    MIXED,
    TRUTH,
    ProxyKind,
    find_dataset,
    list_datasets,
    train_command,
)
from datagen.disk.errors import HyalineError, UsageError
from datagen.terminal.command import fail, next_command, run
from datagen.terminal.parsing import CommandGroup, group

if TYPE_CHECKING:
    from datagen.data.dataset import Dataset
    from proxies.make import ProxyReport
    from proxies.spec import MixedSpec, ProxySpec


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
    amount: float | None = None,
    assign: tuple[str, ...] = (),
    rest: str = TRUTH,
    name: str = MIXED,
    num_layers: int = 8,
    workers: int = 1,
    overwrite: bool = False,
) -> None:
    """Fit a proxy to every object and peel the proxies for every view; images are not rendered again.

    Args:
        dataset: A dataset's folder, or its name under data/. Default: every dataset there.
        kind: box (oriented, of minimum volume), ellipsoid (of minimum volume), hull (convex, rounded edges), blocks (up
            to 8 boxes), wrap (shrink-wrapped, follows hollows), lowpoly (few triangles, follows hollows) or noise (the
            true surface, randomly displaced; not enclosing).
        amount: With --kind noise: its standard deviation as a fraction of each object's diagonal, 0.001 to 0.05. Each
            amount makes a geometry of its own, such as noise-0.01. Default: 0.01.
        assign: OBJECT=KIND, instead of one kind for all: the kind for one object, or for all that match a pattern such
            as 'fern*'. KIND is one of the above, noise-0.02, or truth. May be repeated.
        rest: With --assign: the kind of all other objects.
        name: With --assign: the geometry's name, mixed or mixed-SOMETHING.
        num_layers: Layers stored per ray.
        workers: Parallel processes.
        overwrite: Replace existing proxies and layers.
    """
    from proxies.make import make_and_peel

    if assign and kind != "ellipsoid":
        raise UsageError(f"--kind {kind}: does not go with --assign; give --rest for the objects that it does not name")
    if assign and amount is not None:
        raise UsageError(f"--amount {amount:g}: does not go with --assign; write OBJECT=noise-{amount:g}")
    if not assign and (rest, name) != (TRUTH, MIXED):
        raise UsageError("--rest, --name: go with --assign OBJECT=KIND; leave them out")
    from datagen.data.layer_writing import check_settings

    one_kind = _one_kind(kind, amount)
    check_settings(num_layers=num_layers, workers=workers)
    datasets = _datasets(dataset)
    specs = [_mixture(opened, name, assign, rest) if assign else one_kind for opened in datasets]
    for opened, spec in zip(datasets, specs, strict=True):
        reports = make_and_peel(opened, spec, num_layers=num_layers, workers=workers, overwrite=overwrite)
        _print_table(opened, spec.geometry, reports)
    next_command(train_command(datasets[0].root, specs[0].geometry))


def check(
    dataset: str | None = None,
    /,
    *,
    kind: ProxyKind = "ellipsoid",
    amount: float | None = None,
    name: str | None = None,
    shapes: bool = False,
) -> None:
    """Verify the proxies on disk: closed, outward, enclosing the object, with texels for every face.

    Args:
        dataset: A dataset's folder, or its name under data/. Default: every dataset there.
        kind: box, ellipsoid, hull, blocks, wrap, lowpoly or noise (checked for the object's faces and uv only).
        amount: With --kind noise: its amount. Default: 0.01.
        name: Name of a mixture or of fitted shapes, instead of --kind.
        shapes: Also print how far each surface is from the true one: Chamfer distance (mean of both directions), mean
            distance, median error of normals, and of the thickness of walls.
    """
    from proxies.make import read_reports

    if name is not None and (kind, amount) != ("ellipsoid", None):
        raise UsageError(f"--kind, --amount: do not go with --name; leave them out to check {name}")
    geometry = name if name is not None else _one_kind(kind, amount).geometry
    problems = []
    for opened in _datasets(dataset):
        reports = read_reports(opened, geometry)
        _print_table(opened, geometry, reports)
        if shapes:
            _print_shapes(opened, geometry, [report.object for report in reports if report.kind != TRUTH])
        problems += [
            f"{opened.root}: the {report.kind} of {report.object} {report.problem}"
            for report in reports
            if report.problem
        ]
    if problems:
        fail(f"{problems[0]}; {len(problems)} of the proxies are unsound, make them again with --overwrite")


def _mixture(dataset: "Dataset", name: str, assign: tuple[str, ...], rest: str) -> "MixedSpec":
    from proxies.spec import MixedSpec, assign_parts

    objects = [item.name for item in dataset.objects]
    return MixedSpec(geometry=name, parts=assign_parts(objects, assign, rest))


def _one_kind(kind: ProxyKind, amount: float | None) -> "ProxySpec":
    from proxies.spec import AMOUNT, ProxySpec

    return ProxySpec(kind=kind, amount=AMOUNT if kind == "noise" and amount is None else amount)


def _datasets(given: str | None) -> "list[Dataset]":
    from datagen.data.dataset import open_dataset

    roots = list_datasets() if given is None else [find_dataset(given)]
    if not roots:
        raise HyalineError(f"{DATA_ROOT}: no dataset there; make one with `{BUILD}`")
    return [open_dataset(Path(root)) for root in roots]


def _print_table(dataset: "Dataset", geometry: str, reports: "tuple[ProxyReport, ...]") -> None:
    is_mixed = any(report.kind != geometry for report in reports)
    numbers = ("triangles", "volume / hull", "mean distance", "max distance", "inside")
    rows = [
        (
            report.object,
            *([report.kind] if is_mixed else []),
            str(report.triangles),
            f"{report.statistics.volume_ratio:.3f}",
            _millimetres(report.statistics.mean_distance),
            _millimetres(report.statistics.max_distance),
            "-" if report.inside_share is None else f"{100 * report.inside_share:.4g} %",
        )
        for report in reports
    ]
    title = f"{geometry} proxies of {dataset.root}"
    _print(title, ["object", *(["kind"] if is_mixed else [])], numbers, rows)


def _print_shapes(dataset: "Dataset", geometry: str, objects: Sequence[str]) -> None:
    from datagen.data.geometries import read_meshes
    from datagen.data.shape_errors import shape_errors

    rows = []
    for item, mesh, truth in zip(dataset.objects, read_meshes(dataset, geometry), read_meshes(dataset, TRUTH)):
        if item.name in objects:
            found = shape_errors(mesh, truth)
            walls = map(_millimetres, (found.wall, found.thickness, found.true_thickness))
            distances = map(_millimetres, (found.chamfer, found.mean_distance))
            rows.append((item.name, *distances, f"{found.normal_deg:.1f}°", *walls))
    numbers = ("Chamfer", "mean distance", "normals", "wall error", "thickness", "true thickness")
    _print(f"{geometry} surfaces of {dataset.root} against the true ones", ["object"], numbers, rows)


def _millimetres(metres: float | None) -> str:
    return "-" if metres is None else f"{1000 * metres:.2f} mm"


def _print(title: str, texts: Sequence[str], numbers: Sequence[str], rows: Sequence[tuple[str, ...]]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from datagen.disk.names import printable

    # Names may hold square brackets, which rich would take for mark-up.
    table = Table(title=Text(printable(title)), box=SIMPLE_HEAD, title_justify="left")
    for name in texts:
        table.add_column(name, no_wrap=True)
    for name in numbers:
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    console = Console()
    # In a pipe there is no width to fit; cut-off names would be of no use there.
    console = console if console.is_terminal else Console(width=160)
    console.print(table)
