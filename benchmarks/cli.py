"""The command line of the benchmarks: what is measured, and how the report is printed."""

import sys
from pathlib import Path
from typing import Literal

from benchmarks.choices import BenchChoices
from datagen.scene.finding import ImportChoices
from datagen.terminal.command import run
from datagen.terminal.parsing import CommandGroup, group

DESCRIPTION = (
    "Measure speed: compare alternatives in alternation within one process, after checking that their results agree; "
    "exit status 1 if a ratio is missed. "
    "Compare imports with Cycles, and pages with Python."
)


def main() -> None:
    """`python -m benchmarks NAME ...`."""
    run("python -m benchmarks", commands(), sys.argv[1:])


def commands() -> CommandGroup:
    """All commands of the program."""
    by_name = {
        "peel": peel,
        "truth": truth,
        "cycles": cycles,
        "step": step,
        "gpu": gpu,
        "turntable": turntable,
        "browser": browser,
        "screenshot": screenshot,
    }
    return group(DESCRIPTION, by_name)


def peel(scene: str = "glass_table", size: int = 512, layers: int = 6, rounds: int = 7) -> None:
    """Peeling a view and tracing light paths: the tracers against plain loops.

    Args:
        scene: A name that `datagen scenes` lists, or a folder with a scene.json.
        size: Width and height in pixels.
        layers: Layers kept per ray.
        rounds: Turns of each.
    """
    from datagen.machine.mitsuba_variant import use_mitsuba

    use_mitsuba()
    from benchmarks.harness import show
    from benchmarks.peel import bench_peel
    from benchmarks.truth import open_views

    show(bench_peel(*open_views(scene, size), num_layers=layers, rounds=rounds))


def truth(scene: str = "glass_table", size: int = 128, rounds: int = 7) -> None:
    """Rendering until noise allows 45 dB: the sampling of `datagen build` against Mitsuba's defaults.

    Args:
        scene: A name that `datagen scenes` lists, or a folder with a scene.json; its glass is made clear,
            and drinks and what else has a priority are left out.
        size: Width and height in pixels.
        rounds: Turns of each.
    """
    from datagen.machine.mitsuba_variant import use_mitsuba

    use_mitsuba()
    from benchmarks.harness import show
    from benchmarks.truth import GOAL, bench_truth, open_views

    show(bench_truth(*open_views(scene, size), GOAL, rounds=rounds))


def cycles(
    files: tuple[Path, ...],
    /,
    *,
    python: Path = Path(sys.executable),
    out: Path = Path("cycles"),
    size: str = "192x144",
    spp: int = 1024,
    overwrite: bool = False,
    choices: ImportChoices = ImportChoices(),  # noqa: B008
) -> None:
    """Import files with hyaline and with Blender, draw both under one camera and sky, and compare the pictures.

    Prints decibels between them, what noise alone would leave, and the ratio of mean radiance by channel. Writes
    hyaline's picture, that of Cycles, and their difference four times as strong, side by side.

    Args:
        files: glTF, GLB, OBJ, PLY or STL.
        python: Python interpreter of an environment with bpy; it needs no hyaline.
        out: Folder for NAME.png of each file; files that stand there are kept.
        size: Of the pictures in pixels, such as 192x144.
        spp: Samples per pixel of each picture; Cycles does not denoise.
        overwrite: Replace pictures that stand in --out.
        choices: What hyaline is told about the files.
    """
    from datagen.data.config import parse_resolution
    from datagen.disk.errors import HyalineError
    from datagen.disk.ownership import refuse_file
    from datagen.machine.mitsuba_variant import use_mitsuba
    from datagen.terminal.command import say

    use_mitsuba()
    from benchmarks.blender import Compared, compare_with_cycles, cycles_table, sheet_bytes

    pictures = {file: out / f"{file.name}.png" for file in files}
    for picture in pictures.values():
        if not overwrite:
            refuse_file(picture)
    rows: dict[str, Compared | str] = {}
    for file, picture in pictures.items():
        try:
            found = compare_with_cycles(file, choices, python=python, size=parse_resolution(size), spp=spp)
        except HyalineError as error:
            if len(files) == 1:
                raise
            rows[file.name] = str(error)
            continue
        say(*found.told)
        out.mkdir(parents=True, exist_ok=True)
        picture.write_bytes(sheet_bytes(found))
        rows[file.name] = found
    print(cycles_table(rows))


def step(choices: BenchChoices) -> None:
    """A training step on a CPU: whole, its phases, its texture part."""
    from benchmarks.harness import show
    from benchmarks.step import bench_step

    show(bench_step(choices))


def gpu(choices: BenchChoices) -> None:
    """On a GPU: a 1080p frame and a step beside plain torch, truth, light paths; skipped without CUDA."""
    from datagen.machine.mitsuba_variant import use_mitsuba

    use_mitsuba()
    from benchmarks.gpu import bench_gpu
    from benchmarks.harness import show

    show(bench_gpu(choices))


def turntable(
    runs: tuple[Path, ...],
    out: Path = Path("turntable.webp"),
    path: str = "orbit",
    frames: int = 48,
    size: int = 192,
    spp: int = 192,
    fps: float = 16.0,
    overwrite: bool = False,
) -> None:
    """A film of a scene, path-traced and drawn by runs of its dataset, side by side.

    Args:
        runs: Folders of trained runs.
        out: The film, of any kind that `datagen film` writes.
        path: orbit or spline.
        frames: Pictures in the film.
        size: Width of each picture in pixels.
        spp: Samples per pixel of the path-traced one.
        fps: Frames a second.
        overwrite: Replace an existing file.
    """
    from benchmarks.turntable import draw_turntable
    from datagen.terminal.command import tell

    draw_turntable(runs, out, path=path, frames=frames, size=size, spp=spp, fps=fps, overwrite=overwrite)
    tell(str(out))


def browser(
    run: Path,
    dataset: Path | None = None,
    *,
    quality: Literal["small", "exact"] = "small",
    samples: int = 1,
    views: int = 0,
    edit: tuple[str, ...] = (),
) -> None:
    """A run's page in a headless browser beside Python: decibels between them, and of each to the truth, by view.

    Args:
        run: A run folder of light-path, paper or mlp-first.
        dataset: Its dataset's folder. Default: where the run found it.
        quality: Of the page, as `model export` takes it.
        samples: Rays a pixel, a square number.
        views: How many of each test split; 0 for all.
        edit: Edits of the scene, as `datagen add --edit` takes them: both draw what they make of it.
    """
    from benchmarks.compare import compare_page, page_table

    print(page_table(compare_page(run, dataset, quality, samples=samples, views=views, edits=edit)))


def screenshot(
    page: Path,
    out: Path = Path("browser.png"),
    *,
    width: int = 1100,
    height: int = 640,
    rays: int = 4,
    link: str = "",
    overwrite: bool = False,
) -> None:
    """A picture of a page that `model export`, `eval report` or `datagen look` wrote, as a headless browser shows it.

    Args:
        page: The page.
        out: The picture, a PNG; an existing file is kept.
        width: Of the browser's window, in pixels.
        height: Of the browser's window, in pixels.
        rays: Rays a pixel that the page draws before the picture is taken; 0 for a report or a look, which draw none.
        link: What the page's own "Copy link" gives after the #: a camera and edits; in a report a part of it.
        overwrite: Replace an existing file.
    """
    from benchmarks.compare import take_screenshot
    from datagen.disk.ownership import refuse_file

    if not overwrite:
        refuse_file(out)
    out.write_bytes(take_screenshot(page, width=width, height=height, rays=rays, link=link))
    print(out)
