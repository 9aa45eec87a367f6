"""The command line of the benchmarks: what is measured, and how the report is printed."""

import sys
from pathlib import Path
from typing import Literal

from benchmarks.choices import BenchChoices
from datagen.scene.import_choices import ImportChoices
from datagen.terminal.command import run
from datagen.terminal.parsing import CommandGroup, group

DESCRIPTION = (
    "Measure speed: compare alternatives in alternation within one process, after checking that their results agree; "
    "exit status 1 if a ratio is missed. "
    "Draw what runs have learned. Open exports with other tools' loaders."
)


def main() -> None:
    """`python -m benchmarks NAME ...`."""
    run("python -m benchmarks", commands(), sys.argv[1:])


def commands() -> CommandGroup:
    """All commands of the program."""
    by_name = {
        "peel": peel,
        "truth": truth,
        "scale": scale,
        "random-scenes": random_scenes,
        "random-sheet": random_sheet,
        "peers": peers,
        "cycles": cycles,
        "ceilings": ceilings,
        "step": step,
        "compare": compare,
        "infer": infer,
        "gpu": gpu,
        "sky": sky,
        "errors": errors,
        "turntable": turntable,
        "browser": browser,
        "screenshot": screenshot,
    }
    return group(DESCRIPTION, by_name, {})


def peel(
    size: int = 512,
    layers: int = 6,
    triangles: float = 1.0,
    rounds: int = 7,
    engines: tuple[str, ...] = (),
    json: bool = False,
) -> None:
    """Peeling a view: the tracer against a plain loop, all hits by Embree, and stored layers.

    Args:
        size: Width and height in pixels.
        layers: Layers kept per ray.
        triangles: A factor on the 315,000 triangles of the scene.
        rounds: Turns of each engine.
        engines: Only these of mitsuba-eager, mitsuba-fused, trimesh, exr, light-path-loop, light-path.
        json: Print JSON instead of tables.
    """
    from datagen.machine.mitsuba_variant import use_mitsuba
    from datagen.terminal.command import choose

    use_mitsuba()
    from benchmarks.harness import show
    from benchmarks.peel import ENGINES, Engine, bench_peel

    chosen: tuple[Engine, ...] = tuple(name for name in ENGINES if not engines or name in engines)
    for name in engines:
        choose("engine", name, ENGINES)
    show(bench_peel(size=size, num_layers=layers, triangles=triangles, rounds=rounds, engines=chosen), as_json=json)


def truth(
    scene: str = "glass_table",
    light: Literal["soft", "scene", "lamp"] = "soft",
    size: int = 128,
    rounds: int = 7,
    cycles: Path | None = None,
    json: bool = False,
) -> None:
    """Rendering until noise allows 45 dB: the sampling of `datagen build` against Mitsuba's defaults, and Cycles.

    Args:
        scene: A name that `datagen scenes` lists, or a folder with a scene.json; its glass is made clear,
            and drinks and what else has a priority are left out.
        light: An even sky, the scene's own lights, or a small lamp in a dim sky, which throws caustics; under the lamp,
            noise need only allow 40 dB.
        size: Width and height in pixels.
        rounds: Turns of each.
        cycles: Python interpreter of an environment with Blender (`pip install bpy`), whose Cycles takes turns, too.
        json: Print JSON instead of tables.
    """
    from datagen.machine.mitsuba_variant import use_mitsuba

    use_mitsuba()
    from benchmarks.harness import show
    from benchmarks.truth import GOALS, bench_truth, under_a_lamp, under_soft_light
    from datagen.data.config import DatasetConfig, SplitConfig, square
    from datagen.scene.finding import find_scene
    from datagen.scene.rig import make_cameras

    description = find_scene(scene)
    if light == "soft":
        description = under_soft_light(description)
    elif light == "lamp":
        description = under_a_lamp(description)
    split = SplitConfig(views=4, spp=4)
    config = DatasetConfig(
        scene=description.name,
        preset="bench",
        resolution=square(size),
        train=split,
        interpolating=split,
        extrapolating=split,
    )
    cameras = make_cameras(description.cameras, config)["train"]
    show(bench_truth(description, cameras, GOALS[light], rounds=rounds, cycles=cycles), as_json=json)


def scale(
    factor: tuple[float, ...] = (),
    quantities: tuple[str, ...] = (),
    out: Path = Path("bench-scale.png"),
    rounds: int = 3,
    json: bool = False,
    overwrite: bool = False,
) -> None:
    """How time and memory grow with resolution, layers, objects and triangles: a power law each, and a figure.

    Args:
        factor: Multiply each quantity by this, the others staying as they are. May be repeated. Default: 1, 2, 4 and 8.
        quantities: Only these of pixels, layers, objects, triangles.
        out: The figure, a PNG; an existing file is kept.
        rounds: Turns at each size.
        json: Print JSON instead of a table.
        overwrite: Replace an existing file.
    """
    from datagen.disk.ownership import refuse_file
    from datagen.terminal.command import choose

    if not overwrite:
        refuse_file(out)
    from datagen.machine.mitsuba_variant import use_mitsuba

    use_mitsuba()
    from benchmarks.scale import QUANTITIES, Quantity, bench_scale, show_scale

    for name in quantities:
        choose("quantity", name, QUANTITIES)
    chosen: tuple[Quantity, ...] = tuple(name for name in QUANTITIES if not quantities or name in quantities)
    show_scale(bench_scale(factor or (1, 2, 4, 8), chosen, rounds=rounds), out, as_json=json)


def random_scenes(seeds: int = 100, first: int = 0, family: str | None = None, json: bool = False) -> None:
    """Draw and check random scenes without rendering them: how many draws were refused, and why.

    Exit status 1 where a seed gives no scene.

    Args:
        seeds: How many.
        first: The first of them.
        family: Only object, table or nested. Default: the seeds take turns.
        json: Print JSON instead of a table.
    """
    from json import dumps

    from benchmarks.random_scenes import survey_json, survey_seeds, survey_table
    from datagen.terminal.command import fail

    surveys = survey_seeds(first, seeds, family)
    print(dumps(survey_json(surveys)) if json else survey_table(surveys))
    if failed := sum(len(survey.failed) for survey in surveys):
        fail(f"{failed} of {seeds} seeds give no scene")


def peers(
    dataset: str,
    python: Path,
    *,
    only: tuple[str, ...] = (),
    points: int = 2000,
    json: bool = False,
) -> None:
    """Open exports of a dataset with the tools' own loaders, and compare what they read with the dataset.

    Exit status 1 where something differs, or where no tool is installed.

    Args:
        dataset: A name in data/, or a folder.
        python: Python interpreter of the environment in which the tools are installed; it needs no hyaline.
        only: Only these loaders: nerfstudio-data, nerfstudio-blender, nerfstudio-colmap, nerfbaselines, pycolmap,
            webdataset, datasets.
        points: Points of the surfaces in each export.
        json: Print JSON instead of a table.
    """
    from benchmarks.exports import PEERS, peers_json, peers_table, survey_peers
    from datagen.terminal.command import choose, fail
    from hyaline import open_dataset

    reports = survey_peers(
        open_dataset(dataset), python, [choose("only", name, PEERS) for name in only or PEERS], num_points=points
    )
    print(peers_json(reports) if json else peers_table(reports))
    if all(report.missing for report in reports):
        tools = "nerfstudio, nerfbaselines, pycolmap, webdataset, datasets"
        fail(f"{python}: has none of the tools; install some of {tools} there")
    wrong = sum(not one.passed for report in reports for one in report.findings)
    if wrong:
        fail(f"{wrong} of what the tools read differ from the dataset")


def cycles(
    files: tuple[Path, ...],
    /,
    *,
    python: Path = Path(sys.executable),
    out: Path = Path("cycles"),
    view: int = 0,
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
        view: Which of eight cameras around the scene.
        size: Of the pictures in pixels, such as 192x144.
        spp: Samples per pixel of each picture; Cycles does not denoise.
        overwrite: Replace pictures that stand in --out.
        choices: What hyaline is told about the files.
    """
    from datagen.data.config import parse_resolution
    from datagen.disk.errors import HyalineError
    from datagen.disk.ownership import refuse_file
    from datagen.machine.mitsuba_variant import use_mitsuba
    from datagen.terminal.command import say_all

    use_mitsuba()
    from benchmarks.blender import Compared, compare_with_cycles, cycles_table, sheet_bytes

    pictures = {file: out / f"{file.name}.png" for file in files}
    for picture in pictures.values():
        if not overwrite:
            refuse_file(picture)
    rows: dict[str, Compared | str] = {}
    for file, picture in pictures.items():
        try:
            found = compare_with_cycles(file, choices, python=python, view=view, size=parse_resolution(size), spp=spp)
        except HyalineError as error:
            if len(files) == 1:
                raise
            rows[file.name] = str(error)
            continue
        say_all(found.told)
        out.mkdir(parents=True, exist_ok=True)
        picture.write_bytes(sheet_bytes(found))
        rows[file.name] = found
    print(cycles_table(rows))


def random_sheet(
    seed: tuple[int, ...] = (),
    out: Path = Path("random.webp"),
    *,
    view: int = 1,
    size: int = 192,
    spp: int = 256,
    quality: int = 88,
    overwrite: bool = False,
) -> None:
    """A picture of random scenes, path-traced: a row for each family.

    Args:
        seed: A scene to show; 0 is an object, 1 a table, 2 nested media, and so on. May be repeated. Default: 0 to 8.
        out: The picture, a WebP; an existing file is kept.
        view: Which of six training cameras.
        size: Width and height of each in pixels.
        spp: Samples per pixel.
        quality: Of the WebP, 1 to 100.
        overwrite: Replace an existing file.
    """
    from datagen.disk.ownership import refuse_file

    if not overwrite:
        refuse_file(out)
    from datagen.machine.mitsuba_variant import use_mitsuba

    use_mitsuba()
    from benchmarks.random_sheet import draw_random_sheet

    out.write_bytes(draw_random_sheet(seed or tuple(range(9)), view=view, size=size, spp=spp, quality=quality))
    print(out)


def ceilings(*, json: bool = False) -> None:
    """What this machine does at best: matrix products, copies, gathers, page faults.

    Args:
        json: Print JSON instead of tables.
    """
    from benchmarks.harness import show
    from benchmarks.step import bench_ceilings

    show(bench_ceilings(), as_json=json)


def step(choices: BenchChoices) -> None:
    """A training step on a CPU: whole, its phases, its texture part."""
    from benchmarks.harness import show
    from benchmarks.step import all_ceilings, bench_step

    show(bench_step(choices, ceilings=all_ceilings()), as_json=choices.json)


def compare(
    commit: str, *, rounds: int = 3, python: Path = Path(sys.executable), threads: int = 0, demo: bool = False
) -> None:
    """This version beside an earlier commit: processor time of training, drawing, tracing and short commands, by turns.

    Each version builds small datasets and runs its own commands. A round takes about three minutes of one core. What is
    measured is kept in build/compare, so the same command continues where it was interrupted.

    Args:
        commit: The earlier one, such as 4bd2d80; it is compared with the commit that is checked out.
        rounds: Turns of each version.
        python: Python interpreter of an environment that also has the earlier commit's libraries, such as zarr for
            4bd2d80.
        threads: OpenMP threads of each process; 0: as many as each version takes by itself, which is what its users
            get. Beside other work give 1, since more threads then add waiting that says little about a version.
        demo: Also run all commands of `make demo` once in each version: one to two hours of one core.
    """
    from benchmarks.versions import compare_versions

    print(compare_versions(commit, rounds=rounds, python=python, threads=threads, demo=demo))


def infer(choices: BenchChoices) -> None:
    """A frame from stored layers on a CPU."""
    from benchmarks.harness import show
    from benchmarks.step import all_ceilings, bench_infer

    show(bench_infer(choices, ceilings=all_ceilings()), as_json=choices.json)


def gpu(choices: BenchChoices) -> None:
    """On a GPU: a 1080p frame and a step beside plain torch, truth, light paths; skipped without CUDA."""
    from datagen.machine.mitsuba_variant import use_mitsuba

    use_mitsuba()
    from benchmarks.gpu import bench_gpu
    from benchmarks.harness import show

    show(bench_gpu(choices), as_json=choices.json)


def sky(
    runs: tuple[Path, ...], names: tuple[str, ...] = (), out: Path = Path("sky.png"), *, overwrite: bool = False
) -> None:
    """The sky that runs of light-path have learned beside the true one, as a picture on one scale.

    Args:
        runs: Run folders.
        names: What the picture calls them, instead of their paths.
        out: The picture, a PNG; an existing file is kept.
        overwrite: Replace an existing file.
    """
    from datagen.disk.ownership import refuse_file

    if not overwrite:
        refuse_file(out)
    from benchmarks.drawings import draw_skies

    out.write_bytes(draw_skies(runs, names))
    print(out)


def errors(
    before: Path, after: Path, out: Path = Path("errors.png"), *, views: int = 2, overwrite: bool = False
) -> None:
    """Truth, predictions and error maps of two runs on the views that the first predicts worst, as a picture.

    Args:
        before: A run folder.
        after: Another one, of the same dataset.
        out: The picture, a PNG; an existing file is kept.
        views: How many views are shown.
        overwrite: Replace an existing file.
    """
    from datagen.disk.ownership import refuse_file

    if not overwrite:
        refuse_file(out)
    from benchmarks.drawings import draw_errors

    out.write_bytes(draw_errors(before, after, views=views))
    print(out)


def turntable(
    runs: tuple[Path, ...],
    names: tuple[str, ...] = (),
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
        names: Captions, instead of the folders' names.
        out: The film, of any kind that `datagen film` writes.
        path: orbit, spline, or a JSON file of key frames.
        frames: Pictures in the film.
        size: Width of each picture in pixels.
        spp: Samples per pixel of the path-traced one.
        fps: Frames a second.
        overwrite: Replace an existing file.
    """
    from benchmarks.drawings import draw_turntable
    from datagen.terminal.command import tell

    draw_turntable(runs, names, out, path=path, frames=frames, size=size, spp=spp, fps=fps, overwrite=overwrite)
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
        edit: Edits of the scene, as `datagen build --edit` takes them: both draw what they make of it.
    """
    from benchmarks.compare import compare_page, page_table

    print(page_table(compare_page(run, dataset, quality, samples=samples, views=views, edits=edit)))


def screenshot(
    page: Path,
    out: Path = Path("browser.png"),
    *,
    width: int = 1100,
    height: int = 640,
    dark: bool = False,
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
        dark: Let the browser ask for dark colours.
        rays: Rays a pixel that the page draws before the picture is taken; 0 for a report or a look, which draw none.
        link: What the page's own "Copy link" gives after the #: a camera and edits; in a report a part of it.
        overwrite: Replace an existing file.
    """
    from benchmarks.compare import take_screenshot
    from datagen.disk.ownership import refuse_file

    if not overwrite:
        refuse_file(out)
    out.write_bytes(take_screenshot(page, width=width, height=height, dark=dark, rays=rays, link=link))
    print(out)
