"""The command line of `datagen`: each command calls a function of a room, which is imported when it is called."""

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from hyaline_import.datasets.choices import DatasetImportChoices
from hyaline_photos.capture.choices import CaptureChoices

from datagen.build.choices import AddChoices, BuildChoices, FilmChoices, ShardChoices, SizeChoices
from datagen.data.paths import (
    BUILT_IN_SCENES,
    DATA_ROOT,
    TRUTH,
    build_command,
    find_dataset,
    predict_command,
    train_command,
)
from datagen.disk.errors import UsageError
from datagen.scene.import_choices import ImportChoices
from datagen.terminal.command import hush, next_command, run, say, say_all, tell, tell_json
from datagen.terminal.parsing import CommandGroup, group

if TYPE_CHECKING:
    from datagen.data.dataset import Dataset

SCENES_ROOT = Path("scenes")
"""Default folder for imported scenes."""


def main() -> None:
    """Entry point of the console script."""
    run("datagen", commands(), sys.argv[1:])


def commands() -> CommandGroup:
    """All commands of the program."""
    by_name = {
        "build": build,
        "add": add,
        "import": import_file,
        "import-dataset": import_dataset,
        "capture": capture,
        "peel": peel,
        "film": film,
        "export": export,
        "pack": pack,
        "unpack": unpack,
        "look": look,
        "verify": verify,
        "scenes": scenes,
        "doctor": doctor,
    }
    return group("Path-traced datasets of transparent objects, with peeled layers.", by_name)


def build(
    scene: str = "glass_table",
    /,
    *,
    choices: BuildChoices = BuildChoices(),  # noqa: B008
    size: SizeChoices = SizeChoices(),  # noqa: B008
    cluster: ShardChoices = ShardChoices(),  # noqa: B008
    file: ImportChoices = ImportChoices(),  # noqa: B008
) -> None:
    """Render a scene and peel its layers; if interrupted, the same command resumes.

    Args:
        scene: A name that `datagen scenes` lists, a folder with a scene.json, a file that `datagen import` reads, or
            random: glassware generated from --seed. random-0007 is the random scene of seed 7.
    """
    from datagen.build.build_command import build_scenes
    from datagen.build.shards import count_missing

    hush(choices.quiet)
    built = build_scenes(scene, choices, size, cluster, file)
    if choices.json:
        tell_json(
            {
                "datasets": [
                    {"dataset": str(made.root), "views": {**made.num_views}, "missing": count_missing(made)[0]}
                    for made in built
                ]
            }
        )
    else:
        _tell_roots(built)
    if choices.shard is None:
        next_command(shlex.join(["proxies", "make", str(built[-1].root), "--kind", "ellipsoid"]))


def add(dataset: str | None = None, /, *, choices: AddChoices = AddChoices()) -> None:  # noqa: B008
    """Add test views to a dataset: edited scenes, scenes without glass, other angles, larger pictures.

    Args:
        dataset: A dataset's folder, or its name under data/. Default: the only one there.
    """
    from datagen.build.build_command import add_variants
    from datagen.data.dataset import open_dataset

    made = add_variants(open_dataset(find_dataset(dataset)), choices)
    _tell_roots(made)
    next_command(predict_command(made[-1].name))


def _tell_roots(datasets: "list[Dataset]") -> None:
    for dataset in datasets:
        tell(str(dataset.root))


def import_file(
    file: Path,
    /,
    *,
    out: Path | None = None,
    overwrite: bool = False,
    resolution: str = "128",
    choices: ImportChoices = ImportChoices(),  # noqa: B008
) -> None:
    """Import a file from another program as a scene: glTF, GLB, OBJ with MTL, PLY, STL or Mitsuba XML.

    Writes a scene folder for `datagen build`. Its import.json lists everything that is rendered differently from what
    the file asks for. The file is read in a separate process, limited to 8 s of CPU time and 2 GB of memory, and for
    large files to 30 s and 24 MB per MB.

    Args:
        file: A file that ends in .glb, .gltf, .obj, .ply, .stl or .xml.
        out: Folder to write. Default: scenes/NAME.
        overwrite: Replace an existing imported scene.
        resolution: Image size in pixels that the ground's pattern is made for: one number (square), or WIDTHxHEIGHT.
    """
    from hyaline_import.confined_import import check_free, import_files, write_imported
    from hyaline_import.foreign_files import scene_name

    from datagen.data.config import parse_resolution

    root = out or SCENES_ROOT / scene_name(file)
    check_free(root, overwrite=overwrite)
    imported = import_files(file, choices, resolution=parse_resolution(resolution))
    write_imported(imported.files, imported.record, root, overwrite=overwrite)
    say_all(imported.told)
    tell(str(root))
    next_command(shlex.join(["datagen", "build", str(root)]))


def import_dataset(
    folder: Path,
    /,
    *,
    out: Path | None = None,
    overwrite: bool = False,
    choices: DatasetImportChoices = DatasetImportChoices(),  # noqa: B008
) -> None:
    """Import another project's dataset: RefRef, OpenMaterial, NeRF's Blender scenes, or nerfstudio's transforms.json.

    Takes pictures, cameras, masks, depth and meshes. With meshes, the dataset can be peeled and trained on. Noise and
    other data of a renderer stay unknown. If interrupted, the same command resumes.

    Args:
        folder: A folder with transforms_train.json or transforms.json.
        out: Folder to write. Default: data/NAME.
        overwrite: Replace an existing dataset.
    """
    from hyaline_import.datasets.import_dataset import plan_import, write_import

    plan = plan_import(folder, choices)
    dataset = write_import(plan, out or DATA_ROOT / plan.config.scene, overwrite=overwrite)
    say_all(list(plan.imported.remarks))
    views = ", ".join(f"{count} {split}" for split, count in dataset.num_views.items())
    say(f"{dataset.root}: {views} views; {len(dataset.objects)} meshes; noise and radiance are unknown")
    tell(str(dataset.root))
    next_command(shlex.join(["datagen", "look", str(dataset.root)]))


def capture(
    folder: Path,
    /,
    *,
    out: Path | None = None,
    overwrite: bool = False,
    choices: CaptureChoices = CaptureChoices(),  # noqa: B008
) -> None:
    """Make a dataset from a folder of pictures and masks of glass.

    Reads cameras from a transforms file or COLMAP's sparse/0, or finds them (needs the extra `capture`). Fits the
    opaque room to points as planes, surfaces and boxes, unless --room gives it. Each glass object is an ellipsoid until
    `model fit` finds its shape. If interrupted, the same command resumes.

    Args:
        folder: A folder with images/ and masks/OBJECT/, one mask per picture, white where the object is visible.
        out: Folder to write. Default: data/NAME.
        overwrite: Replace an existing dataset.
    """
    from hyaline_import.datasets.import_dataset import write_import
    from hyaline_photos.capture.capture import plan_capture

    plan = plan_capture(folder, choices)
    dataset = write_import(plan, out or DATA_ROOT / plan.config.scene, overwrite=overwrite)
    say_all(list(plan.imported.remarks))
    tell(str(dataset.root))
    next_command(shlex.join(["datagen", "peel", str(dataset.root)]))


def peel(
    dataset: str | None = None,
    /,
    *,
    geometry: str = TRUTH,
    num_layers: int | None = None,
    workers: int = 1,
    overwrite: bool = False,
) -> None:
    """Peel a geometry's layers for every view, without rendering the images again.

    Args:
        dataset: A dataset's folder, or its name under data/. Default: the only one there.
        geometry: truth, or proxies made by `proxies make`, such as ellipsoid.
        num_layers: Layers stored per ray. Default: as many as before, or 8.
        workers: Parallel processes.
        overwrite: Peel again even if layers exist.
    """
    from datagen.build.build import peel_dataset, summary
    from datagen.build.build_variant import peel_variants
    from datagen.data.dataset import open_dataset
    from datagen.data.geometries import check_geometry
    from datagen.data.layer_writing import check_settings, find_num_layers

    opened = open_dataset(find_dataset(dataset))
    if num_layers is None:
        num_layers = find_num_layers(opened, geometry) or 8
    check_settings(num_layers=num_layers, workers=workers)
    check_geometry(opened, geometry)
    say(f"{opened.root}: peeling {geometry} into {num_layers} layers")
    peel_dataset(opened, geometry, num_layers=num_layers, overwrite=overwrite, workers=workers)
    say_all(summary(opened, geometry))
    peel_variants(opened, workers=workers)
    tell(str(opened.root))
    next_command(train_command(opened.home.root, geometry, opened.imported))


def film(
    dataset: str | None = None,
    /,
    *,
    spp: int = 128,
    choices: FilmChoices = FilmChoices(),  # noqa: B008
) -> None:
    """Path-trace a film of a dataset's scene; `model film` renders the same film with a trained run.

    Args:
        dataset: A dataset's folder, or its name under data/. Default: the only one there.
        spp: Samples per pixel.
    """
    from datagen.build.film import film_scene, plan_film
    from datagen.data.dataset import open_dataset

    opened = open_dataset(find_dataset(dataset))
    out = choices.out or Path(f"{opened.name}-truth.webp")
    cameras = plan_film(opened, choices, out)
    say(f"{opened.root}: rendering {out}")
    film_scene(opened, cameras, out, fps=choices.fps, spp=spp, overwrite=choices.overwrite)
    tell(str(out))


def export(
    dataset: str | None = None,
    /,
    *,
    format: str = "nerfstudio",  # noqa: A002
    out: Path | None = None,
    points: int = 20000,
    flow: bool = False,
) -> None:
    """Export a dataset in another tool's format, into a new folder.

    Args:
        dataset: A dataset's folder, or its name under data/. Default: the only one there.
        format: nerfstudio, blender, 3dgs, colmap, nerfbaselines, capture, quantities or huggingface.
        out: Folder to write, new or empty. Default: exports/NAME-FORMAT.
        points: Number of points, for formats with a point cloud: on the true surfaces, coloured from training images.
        flow: With quantities: also trace refractive flow and attenuation through the glass.
    """
    from hyaline_export.formats import export_dataset

    from datagen.data.dataset import open_dataset

    opened = open_dataset(find_dataset(dataset))
    where, hint = export_dataset(opened, format, out, num_points=points, flow=flow)
    tell(str(where))
    next_command(hint)


def pack(dataset: str | None = None, /, *, out: Path | None = None, overwrite: bool = False) -> None:
    """Pack a finished dataset into one tar file, every byte verified.

    Args:
        dataset: A dataset's folder, or its name under data/. Default: the only one there.
        out: File to write, which ends in .tar. Default: exports/NAME.tar.
        overwrite: Replace an existing file.
    """
    from hyaline_export.pack import pack_dataset

    path = pack_dataset(find_dataset(dataset), out, overwrite=overwrite)
    tell(str(path))
    next_command(shlex.join(["datagen", "unpack", str(path)]))


def unpack(file: Path, /, *, out: Path | None = None) -> None:
    """Unpack a packed dataset into a new folder, every byte verified.

    Args:
        file: A file from `datagen pack`.
        out: Folder to write, new or empty. Default: data/NAME, for NAME.tar.
    """
    from hyaline_export.pack import unpack_archive

    root = unpack_archive(file, out)
    tell(str(root))
    next_command(shlex.join(["datagen", "look", str(root)]))


def look(dataset: str | None = None, /, *, out: Path | None = None, overwrite: bool = False) -> None:
    """Show a dataset on one page: images, masks, depth, normals, layers, proxies, cameras, light paths, noise, objects.

    Takes seconds, needs no training, and lists what is missing. Open the page in any browser.

    Args:
        dataset: A dataset's folder, or its name under data/. Default: the only one there.
        out: File to write: a page, or an image if it ends in .png. Default: NAME-look.html.
        overwrite: Replace an existing file.
    """
    from datagen.data.dataset import open_dataset
    from datagen.disk.ownership import DATASET, refuse_file, refuse_owned
    from datagen.disk.storage import commit
    from datagen.look.look import look_page, look_sheet

    opened = open_dataset(find_dataset(dataset))
    path = out if out is not None else Path(f"{opened.name}-look.html")
    if path.suffix not in (".html", ".png"):
        raise UsageError(f"--out {path}: ends in {path.suffix!r}; expected .html for a page, or .png for a picture")
    refuse_file(path, overwrite=overwrite)
    refuse_owned(path, DATASET)
    say(f"{opened.root}: writing {path}")
    commit(path, look_sheet(opened) if path.suffix == ".png" else look_page(opened))
    tell(str(path))


def verify(dataset: str | None = None, /, *, quiet: bool = False, json: bool = False) -> None:
    """Check every byte of a dataset; report damage, and exit with status 1 if there is any.

    Args:
        dataset: A dataset's folder, or its name under data/. Default: the only one there.
        quiet: Print no remarks.
        json: Print the result as JSON: dataset, verified (number of files), problems, remarks.
    """
    from datagen.build.verify import tell_findings, verify_dataset

    hush(quiet)
    root = find_dataset(dataset)
    tell_findings(root, verify_dataset(root), as_json=json)


def scenes() -> None:
    """List the built-in scenes, and how to generate random ones."""
    from hyaline_random.names import FAMILIES, RANDOM

    for name, description in BUILT_IN_SCENES.items():
        print(f"{name:14} {description}")
    print(f"{RANDOM:14} Glassware from --seed N, with --count M of them; --family {', '.join(FAMILIES.names())}")
    next_command(build_command())


def doctor(*, quiet: bool = False, json: bool = False) -> None:
    """Describe this machine, the Mitsuba variant in use, and how to install what is missing.

    Args:
        quiet: Print no advice on what to type next.
        json: Print the result as JSON: findings (each with what, found and remedy).
    """
    from datagen.machine.doctor import examine, tell_findings

    hush(quiet)
    findings = examine()
    tell_findings(findings, as_json=json)
    if not json and not any(finding.remedy for finding in findings):
        next_command(build_command())
