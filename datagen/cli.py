"""The command line of `datagen`: parse, configure, call one function."""

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from datagen.build.choices import BuildChoices
from datagen.build.film import FilmChoices
from datagen.build.launch import LaunchChoices
from datagen.data.config import parse_resolution
from datagen.data.dataset import open_dataset
from datagen.data.geometries import check_geometry
from datagen.data.layer_writing import check_settings
from datagen.data.paths import DATA_ROOT, TRUTH, build_command, find_dataset, train_command
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import DATASET, refuse_file, refuse_owned
from datagen.disk.storage import commit
from datagen.import_dataset.choices import DatasetImportChoices
from datagen.scene.foreign_files import ImportChoices, scene_name
from datagen.terminal.command import fail, next_command, run, say, say_all, tell, unwrap_help

SCENES_ROOT = Path("scenes")
"""Where imported scenes go unless told."""

if TYPE_CHECKING:
    from datagen.build.verify import Findings


def main() -> None:
    """Entry point of the console script."""
    unwrap_help(BuildChoices)
    unwrap_help(LaunchChoices)
    unwrap_help(ImportChoices)
    unwrap_help(DatasetImportChoices)
    unwrap_help(FilmChoices)
    commands = {
        "build": build,
        "import": import_file,
        "import-dataset": import_dataset,
        "peel": peel,
        "export": export,
        "verify": verify,
        "look": look,
        "render": render,
        "scenes": scenes,
        "doctor": doctor,
    }
    run("datagen", "Path-traced datasets of transparent objects, with peeled layers.", commands, sys.argv[1:])


def build(
    choices: Annotated[BuildChoices, tyro.conf.arg(name="")] = BuildChoices(),  # noqa: B008
    launch: LaunchChoices = LaunchChoices(),  # noqa: B008
    imports: ImportChoices = ImportChoices(),  # noqa: B008
) -> None:
    """Render a scene and peel its layers; if interrupted, the same command resumes.

    Args:
        choices: The dataset.
        launch: Build the parts as jobs.
        imports: With --scene FILE: what the file does not say, as `datagen import` takes it.
    """
    from datagen.build.build_command import build_or_add

    build_or_add(choices, launch, imports)


def import_file(
    file: tyro.conf.Positional[Path],
    out: Path | None = None,
    overwrite: bool = False,
    resolution: str = "128",
    choices: ImportChoices = ImportChoices(),  # noqa: B008
) -> None:
    """Import a file from another program as a scene: glTF, GLB, OBJ with MTL, PLY, STL, 3MF or Mitsuba XML.

    Writes a scene folder for `datagen build --scene`. Its import.json lists everything that is rendered differently
    from what the file asks for. The file is read in a process of its own, with 8 s of CPU time, 2 GB of memory and
    more for large files: 30 s and 24 MB for each MB.

    Args:
        file: A file that ends in .glb, .gltf, .obj, .ply, .stl, .3mf or .xml.
        out: Folder to write. Default: scenes/NAME.
        overwrite: Replace an existing imported scene.
        resolution: Pictures that the ground's pattern is made for, in pixels: one number for squares, or such as
            320x240.
        choices: What the file does not say.
    """
    from datagen.scene.importers.confined_import import check_free, import_files, write_imported

    root = out or SCENES_ROOT / scene_name(file)
    check_free(root, overwrite=overwrite)
    imported = import_files(file, choices, resolution=parse_resolution(resolution))
    write_imported(imported.files, imported.record, root, overwrite=overwrite)
    say_all(imported.told)
    tell(str(root))
    next_command(shlex.join(["datagen", "build", "--scene", str(root)]))


def import_dataset(
    folder: tyro.conf.Positional[Path],
    out: Path | None = None,
    overwrite: bool = False,
    choices: DatasetImportChoices = DatasetImportChoices(),  # noqa: B008
) -> None:
    """Import another project's dataset: RefRef, OpenMaterial, NeRF's Blender scenes, or nerfstudio's transforms.json.

    Takes pictures, cameras, masks, depth and meshes. With meshes, the dataset can be peeled and trained on. What only
    a renderer knows, such as noise, stays unknown. If interrupted, the same command resumes.

    Args:
        folder: A folder with transforms_train.json or transforms.json.
        out: Folder to write. Default: data/NAME.
        overwrite: Replace an existing dataset.
        choices: What the folder does not say.
    """
    from datagen.import_dataset.import_dataset import plan_import, write_import

    plan = plan_import(folder, choices)
    dataset = write_import(plan, out or DATA_ROOT / plan.config.scene, choices, overwrite=overwrite)
    say_all(list(plan.imported.remarks))
    views = ", ".join(f"{count} {split}" for split, count in dataset.num_views.items())
    say(f"{dataset.root}: {views} views; {len(dataset.objects)} meshes; noise and radiance are unknown")
    tell(str(dataset.root))
    next_command(shlex.join(["datagen", "look", str(dataset.root)]))


def peel(
    dataset: str | None = None,
    geometry: str = TRUTH,
    num_layers: int = 8,
    workers: int = 1,
    overwrite: bool = False,
) -> None:
    """Peel a geometry's layers for every view, without rendering the images again.

    Args:
        dataset: Dataset folder, or its name under data/. Default: the only one there. The flag may be left out if the
            dataset comes first.
        geometry: truth, or a kind of proxy made by `proxies make`.
        num_layers: Layers kept per ray.
        workers: Parallel processes.
        overwrite: Peel again even if layers exist.
    """
    from datagen.build.build import peel_dataset, summary
    from datagen.build.build_variant import peel_variants

    opened = open_dataset(find_dataset(dataset))
    check_settings(num_layers=num_layers, workers=workers)
    check_geometry(opened, geometry)
    peel_dataset(opened, geometry, num_layers=num_layers, overwrite=overwrite, workers=workers)
    say_all(summary(opened, geometry))
    peel_variants(opened, workers=workers)
    tell(str(opened.root))
    next_command(train_command(opened.home.root, geometry))


def export(
    dataset: str | None = None,
    format: str = "nerfstudio",  # noqa: A002
    out: Path | None = None,
    points: int = 20000,
    flow: bool = False,
    overwrite: bool = False,
) -> None:
    """Export a dataset in another tool's format, into its own folder; if interrupted, the same command resumes.

    Args:
        dataset: Dataset folder, or its name under data/. Default: the only one there. The flag may be left out if the
            dataset comes first.
        format: nerfstudio, blender, 3dgs, colmap, nerfbaselines, refref, cleargrasp, webdataset, quantities or
            huggingface.
        out: Folder to write. Default: exports/NAME-FORMAT.
        points: Number of points sampled on the true surfaces, coloured from the training images, for formats that need
            a point cloud.
        flow: With webdataset and quantities: also trace refractive flow and attenuation through the glass.
        overwrite: Replace an existing export.
    """
    from datagen.export.formats import export_dataset

    opened = open_dataset(find_dataset(dataset))
    where, hint = export_dataset(opened, format, out, num_points=points, flow=flow, overwrite=overwrite)
    tell(str(where))
    next_command(hint)


def verify(dataset: str | None = None) -> None:
    """Check every byte of a dataset; if something is damaged, name it and exit with status 1.

    Args:
        dataset: Dataset folder, or its name under data/. Default: the only one there. The flag may be left out if the
            dataset comes first.
    """
    from datagen.build.verify import verify_dataset

    root = find_dataset(dataset)
    found = verify_dataset(root)
    for remark in found.remarks:
        say(remark)
    _tell_problems(root, found)
    tell(f"{root}: {found.verified} files verified")


def look(dataset: str | None = None, out: Path | None = None, overwrite: bool = False) -> None:
    """Show a dataset on one page: images, masks, depth, normals, layers, proxies, cameras, light paths, noise, objects.

    Takes seconds, needs no training, and lists what is missing. Open the page in any browser.

    Args:
        dataset: Dataset folder, or its name under data/. Default: the only one there. The flag may be left out if the
            dataset comes first.
        out: File to write: a page, or an image if it ends in .png. Default: NAME-look.html.
        overwrite: Replace an existing file.
    """
    from datagen.look.look import look_page, look_sheet

    opened = open_dataset(find_dataset(dataset))
    path = out if out is not None else Path(f"{opened.name}-look.html")
    if path.suffix not in (".html", ".png"):
        raise HyalineError(f"--out {path}: ends in {path.suffix!r}; expected .html for a page, or .png for a picture")
    if not overwrite:
        refuse_file(path)
    refuse_owned(path, DATASET)
    commit(path, look_sheet(opened) if path.suffix == ".png" else look_page(opened))
    tell(str(path))


def _tell_problems(root: Path, found: "Findings") -> None:
    """Prints what a search found, and ends with status 1 when that is damage."""
    for problem in found.problems:
        tell(problem)
    if found.problems:
        commands = ", then ".join(f"`{command}`" for command in found.commands)
        fail(f"{root}: {len(found.problems)} problems, which the lines above name; repair them with {commands}")


def render(
    dataset: str | None = None,
    path: str = "orbit",
    spp: int = 128,
    film: FilmChoices = FilmChoices(),  # noqa: B008
    overwrite: bool = False,
) -> None:
    """Path-trace a film of a dataset's scene; `model render` draws the same film with a trained run.

    Args:
        dataset: Dataset folder, or its name under data/. Default: the only one there. The flag may be left out if the
            dataset comes first.
        path: orbit, spline (through the interpolating test views), or a JSON file of key frames as NeRF tools write
            cameras.
        spp: Samples per pixel.
        film: Format and length of the film.
        overwrite: Replace an existing film.
    """
    from datagen.build.film import film_scene, plan_film

    opened = open_dataset(find_dataset(dataset))
    out = film.video or Path(f"{opened.name}-truth.webp")
    cameras = plan_film(opened, path, film, out, overwrite=overwrite)
    film_scene(opened, cameras, out, fps=film.fps, spp=spp)
    tell(str(out))


def scenes() -> None:
    """List the built-in scenes, and how to draw random ones."""
    from datagen.scene.builtin import describe_scenes
    from datagen.scene.random_names import FAMILIES, RANDOM

    for name, description in describe_scenes().items():
        print(f"{name:14} {description}")
    print(f"{RANDOM:14} Glassware drawn from --seed N, with --count M of them; --family {', '.join(FAMILIES.names())}")
    next_command(build_command())


def doctor() -> None:
    """Describe this machine, the Mitsuba variant in use, and how to install what is missing."""
    from datagen.machine.doctor import examine

    findings = examine()
    for finding in findings:
        print(f"{finding.what:10} {finding.found}")
        if finding.remedy:
            print(f"{'':10} mend it with: {finding.remedy}")
    if not any(finding.remedy for finding in findings):
        next_command(build_command())
