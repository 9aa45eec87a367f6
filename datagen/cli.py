"""The command line of `datagen`: each command calls a function of a room, which is imported when it is called."""

import shlex
import sys
from pathlib import Path
from textwrap import fill
from typing import Annotated

from datagen.builder.choices import AddChoices, BuildChoices, FilmChoices, ShardChoices, SizeChoices
from datagen.data.paths import BUILD, BUILT_IN_SCENES, TRUTH, Geometry, find_dataset, train_command
from datagen.disk.errors import UsageError
from datagen.scene.finding import ImportChoices, list_families
from datagen.terminal.command import fail, next_command, run, say, tell
from datagen.terminal.parsing import CommandGroup, group
from datagen.terminal.plugins import absent_commands, commands_of


def main() -> None:
    """Entry point of the console script."""
    run("datagen", commands(), sys.argv[1:])


def commands() -> CommandGroup:
    """All commands of the program."""
    by_name = {
        "build": build,
        "add": add,
        "peel": peel,
        "film": film,
        "look": look,
        "verify": verify,
        "scenes": scenes,
        "doctor": doctor,
    }
    return group(
        "Path-traced datasets of transparent objects, with peeled layers.",
        by_name | commands_of("datagen"),
        absent_commands("datagen"),
    )


def build(
    scene: Annotated[str, BUILT_IN_SCENES.keys] = "glass_table",
    /,
    *,
    choices: BuildChoices = BuildChoices(),  # noqa: B008
    size: SizeChoices = SizeChoices(),  # noqa: B008
    cluster: ShardChoices = ShardChoices(),  # noqa: B008
    file: ImportChoices = ImportChoices(),  # noqa: B008
) -> None:
    """Render a scene and peel its layers; if interrupted, the same command resumes.

    Args:
        scene: A name, a folder with a scene.json, a file that `datagen import` reads, or random: glassware generated
            from --seed. random-0007 is the random scene of seed 7.
    """
    from datagen.builder.build_command import build_scenes

    built = build_scenes(scene, choices, size, cluster, file)
    for one in built:
        tell(str(one.root))
    if choices.shard is None:
        next_command(shlex.join(["proxies", "make", str(built[-1].root), "--kind", "ellipsoid"]))


def add(dataset: str | None = None, /, *, choices: AddChoices = AddChoices()) -> None:  # noqa: B008
    """Add views to a dataset: edited scenes, scenes without glass, other angles, larger pictures, stereo pairs."""
    from datagen.builder.build_command import add_variants
    from datagen.data.dataset import open_dataset

    opened = open_dataset(find_dataset(dataset))
    made = add_variants(opened, choices)
    for one in made:
        tell(str(one.root))
    runs = sorted(Path("runs", opened.name).glob("*/run.json"))
    if runs:
        next_command(shlex.join(["model", "predict", str(runs[0].parent), "--variant", made[-1].name]))
    else:
        next_command(train_command(opened.root))


def peel(
    dataset: str | None = None,
    /,
    *,
    geometry: Geometry = TRUTH,
    num_layers: int | None = None,
    workers: int = 1,
    overwrite: bool = False,
) -> None:
    """Peel a geometry's layers for every view, without rendering the images again.

    Args:
        geometry: truth, or proxies made by `proxies make`, such as ellipsoid.
        num_layers: Layers stored per ray. Default: as many as before, or 8.
        workers: Parallel processes.
        overwrite: Peel again even if layers exist.
    """
    from datagen.builder.build import peel_dataset, summary
    from datagen.builder.variants import peel_variants
    from datagen.data.dataset import find_num_layers, open_dataset
    from datagen.data.geometries import check_geometry
    from datagen.data.layers import check_settings

    opened = open_dataset(find_dataset(dataset))
    if num_layers is None:
        num_layers = find_num_layers(opened, geometry) or 8
    check_settings(num_layers=num_layers, workers=workers)
    check_geometry(opened, geometry)
    say(f"{opened.root}: peeling {geometry} into {num_layers} layers")
    peel_dataset(opened, geometry, num_layers=num_layers, overwrite=overwrite, workers=workers)
    say(*summary(opened, geometry))
    peel_variants(opened, workers=workers)
    tell(str(opened.root))
    next_command(train_command(opened.home.root, geometry))


def film(
    dataset: str | None = None,
    /,
    *,
    spp: int = 128,
    labels: bool = False,
    choices: FilmChoices = FilmChoices(),  # noqa: B008
) -> None:
    """Path-trace a film of a dataset's scene; `model film` renders the same film with a trained run.

    Args:
        spp: Samples per pixel.
        labels: Keep the frames as views of a variant, film-PATH, with depth, masks and all other labels.
    """
    from datagen.builder.film import build_labelled, path_trace, plan_film, write_film
    from datagen.data.dataset import open_dataset

    opened = open_dataset(find_dataset(dataset))
    out = choices.out or Path(f"{opened.name}-truth.webp")
    cameras = plan_film(opened, choices, out)
    say(f"{opened.root}: rendering {out}")
    if labels:
        variant = build_labelled(opened, cameras, choices, spp=spp)
        write_film(out, (view.image for view in variant.views("interpolating")), choices.fps)
        tell(str(variant.root))
    else:
        write_film(out, path_trace(opened, cameras, spp=spp), choices.fps)
    tell(str(out))


def look(dataset: str | None = None, /, *, out: Path | None = None, overwrite: bool = False) -> None:
    """Show a dataset on one page: images, masks, depth, normals, layers, proxies, cameras, light paths, noise, objects.

    Needs no training; reads every file, and lists what is missing or damaged. Open the page in any browser.

    Args:
        out: Page to write, a .html file. Default: NAME-look.html.
        overwrite: Replace a file that is not such a page.
    """
    from datagen.data.dataset import open_dataset
    from datagen.disk.ownership import refuse_file
    from datagen.disk.storage import commit
    from datagen.look.look import look_page
    from datagen.pages.html import GENERATOR

    opened = open_dataset(find_dataset(dataset))
    path = out if out is not None else Path(f"{opened.name}-look.html")
    is_own = path.is_file() and GENERATOR.encode() in path.read_bytes()[:200]
    refuse_file(path, overwrite=overwrite or is_own)
    if path.suffix != ".html":
        raise UsageError(f"--out {path}: ends in {path.suffix!r}; expected .html")
    say(f"{opened.root}: writing {path}")
    commit(path, look_page(opened))
    tell(str(path))


def verify(dataset: str | None = None, /, *, json: bool = False) -> None:
    """Check every byte of a dataset; report damage, and exit with status 1 if there is any.

    Args:
        json: Print the result as JSON: dataset, verified (number of files), problems, remarks.
    """
    from json import dumps

    from datagen.builder.verify import verify_dataset
    from datagen.disk.storage import MAKE_AGAIN

    root = find_dataset(dataset)
    files, problems, remarks = verify_dataset(root)
    say(*remarks)
    if json:
        result = {"dataset": str(root), "verified": len(files), "problems": problems, "remarks": remarks}
        print(dumps(result, indent=2))
    else:
        for problem in problems:
            tell(problem)
    if problems:
        fail(f"{root}: {len(problems)} problems, listed above; {MAKE_AGAIN}")
    if not json:
        tell(f"{root}: {len(files)} files verified")


def scenes() -> None:
    """List the built-in scenes, and how to generate random ones."""
    listed = dict(BUILT_IN_SCENES)
    if families := list_families():
        listed["random"] = f"Glassware from --seed N, with --count M of them; --family {', '.join(families)}"
    for name, description in listed.items():
        print(fill(f"{name:14} {description}", 80, subsequent_indent=15 * " "))
    next_command(BUILD)


def doctor() -> None:
    """Describe this machine, the Mitsuba variant in use, and how to install what is missing."""
    from datagen.machine.doctor import examine

    findings = examine()
    for finding in findings:
        tell(f"{finding.what:10} {finding.found}")
        if finding.remedy:
            tell(f"{'':10} fix it with: {finding.remedy}")
    if not any(finding.remedy for finding in findings):
        next_command(BUILD)
