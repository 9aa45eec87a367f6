"""The command line of `datagen`: parse, configure, call one function."""

import dataclasses
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from datagen.build.film import FilmChoices
from datagen.build.launch import LaunchChoices
from datagen.build.presets import PRESETS, resize
from datagen.data.advice import after_build, after_edit, after_layers
from datagen.data.cameras import TRANSFORMS_FILES
from datagen.data.config import DatasetConfig
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.finding import DATA_ROOT, build_command, find_dataset
from datagen.data.geometries import check_geometry
from datagen.data.layer_writing import check_settings
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from datagen.scene.importers.choices import ImportChoices
from datagen.terminal.command import choose, fail, next_command, run, say, tell, unwrap_help

SCENES_ROOT = Path("scenes")
"""Where imported scenes go unless told."""

if TYPE_CHECKING:
    from datagen.build.shards import Shard
    from datagen.build.verify import Findings


def main() -> None:
    """Entry point of the console script."""
    unwrap_help(LaunchChoices)
    unwrap_help(ImportChoices)
    unwrap_help(FilmChoices)
    commands = {
        "build": build,
        "import": import_file,
        "peel": peel,
        "verify": verify,
        "mend": mend,
        "render": render,
        "scenes": scenes,
        "doctor": doctor,
    }
    run("datagen", "Path-traced datasets of transparent objects, with peeled layers.", commands, sys.argv[1:])


def build(
    scene: str = "glass_table",
    preset: str = "demo",
    num_layers: int = 8,
    out: Path | None = None,
    seed: int = 0,
    workers: int = 1,
    overwrite: bool = False,
    ceiling: float | None = None,
    resolution: int | None = None,
    views: int | None = None,
    test_views: int | None = None,
    spp: int | None = None,
    test_spp: int | None = None,
    max_depth: int = 24,
    edit: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    angle_splits: bool = False,
    super_resolution: tuple[int, ...] = (),
    super_resolution_views: int | None = None,
    dataset: str | None = None,
    shard: str | None = None,
    launch: LaunchChoices = LaunchChoices(),  # noqa: B008
) -> None:
    """Renders a scene and peels its layers; the same command again goes on where it was stopped.

    Args:
        scene: A name that `datagen scenes` lists, a folder with a scene.json, or a file that `datagen import` reads.
        preset: tiny, demo, standard or paper.
        num_layers: Layers kept per ray; the share of rays with more is reported.
        out: Where the dataset goes; data/SCENE unless given.
        seed: Fixes cameras and noise; the same seed gives the same bytes.
        workers: Processes that render side by side; the bytes do not depend on it.
        overwrite: Replace a dataset that stands there with other settings.
        ceiling: Noise ceiling in dB that each test view is rendered to, instead of a fixed number of samples.
        resolution: Width and height in pixels, instead of the preset's.
        views: Training views, instead of the preset's.
        test_views: Views in each of the two test splits, instead of the preset's.
        spp: Samples per pixel of training views, instead of the preset's.
        test_spp: Samples per pixel of test views, instead of the preset's; where --ceiling starts.
        max_depth: Longest light path in segments.
        angle_splits: Also render test cameras 10, 20 and 40 degrees outside of what training cameras cover; may be
            added to a finished dataset.
        super_resolution: Also render the test splits so many times as wide and high, such as 2 4; may be added to a
            finished dataset.
        super_resolution_views: Views of each test split at those sizes, evenly chosen; all unless given.
        dataset: Instead of --scene: the folder of a dataset that is there, or its name under data/, to which --edit,
            --angle-splits or --super-resolution add.
        edit: Renders a scene whose dataset is there after an edit, at the same test cameras, into its variants/NAME:
            remove:OBJECT, move:OBJECT:dx,dy,dz (metres), duplicate:OBJECT:dx,dy,dz, glass:OBJECT (which makes glass of
            what is opaque, and the reverse) or swap:OBJECT:OBJECT. Several --edit change one scene one after the other.
        shard: Makes part I of N (such as 2/4) of all views into the folder, beside any other parts, on any machines of
            one kind that share it. The dataset is complete when every part is, byte for byte as if made by one; the
            same command without --shard, when all parts have ended, makes what a failed one left out.
        launch: Parts as jobs.
    """
    _check_parts(shard, launch, overwrite=overwrite, edit=edit)
    if edit or dataset is not None:
        given = {
            "num-layers": num_layers != 8,
            "seed": seed != 0,
            "ceiling": ceiling is not None,
            "views": views is not None,
            "resolution": resolution is not None,
            "test-views": test_views is not None,
            "spp": spp is not None,
            "test-spp": test_spp is not None,
            "max-depth": max_depth != 24,
        }
        _refuse("--edit" if edit else "--dataset", given)
        base = _open_base(scene, out, dataset, preset)
        if edit:
            _refuse("--edit", {"angle-splits": angle_splits, "super-resolution": bool(super_resolution)})
            _build_edit(base, edit, workers=workers, overwrite=overwrite)
            return
        parts = {"shard": shard is not None, "launcher": launch.launcher is not None}
        _refuse("--dataset", {"overwrite": overwrite, **parts})
        if not angle_splits and not super_resolution:
            raise HyalineError(
                "--dataset: goes with --edit, --angle-splits or --super-resolution; a new one takes --scene"
            )
        _check_build(
            num_layers=8,
            workers=workers,
            scales=super_resolution,
            scaled_views=super_resolution_views,
            test_views=base.config.interpolating.views,
        )
        _build_more(base, angles=angle_splits, scales=super_resolution, views=super_resolution_views, workers=workers)
        tell(str(base.root))
        next_command(after_build(base))
        return
    from datagen.build.build import build_dataset, summary
    from datagen.build.build_variant import peel_variants
    from datagen.build.launch import launch as send_off
    from datagen.build.shards import count_missing, parse_shard
    from datagen.disk.ownership import DATASET, refuse_strangers
    from datagen.scene.importers.finding import find_scene, is_foreign
    from datagen.scene.rig import with_listed_views

    size = resize(
        PRESETS[choose("preset", preset, PRESETS)],
        resolution=resolution,
        views=views,
        test_views=test_views,
        spp=spp,
        test_spp=test_spp,
    )
    _check_build(
        num_layers=num_layers,
        workers=workers,
        scales=super_resolution,
        scaled_views=super_resolution_views,
        test_views=size.interpolating.views,
    )
    config = DatasetConfig(
        scene="scene",  # Its name is known when it is read.
        preset=preset,
        resolution=size.resolution,
        train=size.train,
        interpolating=size.interpolating,
        extrapolating=size.extrapolating,
        ceiling_db=ceiling,
        max_depth=max_depth,
        seed=seed,
    )
    if out is not None or ("/" not in scene and not is_foreign(scene)):
        # Before anything is modelled; what may be a dataset's is judged when it is known what should stand there.
        refuse_strangers(out or DATA_ROOT / scene, DATASET, {DATASET.head, *TRANSFORMS_FILES.values()})
    description = find_scene(scene, built=None if overwrite else out or DATA_ROOT / scene, resolution=size.resolution)
    root = out or DATA_ROOT / description.name
    config = dataclasses.replace(config, scene=description.name)
    if views is None and test_views is None:
        config = with_listed_views(config, description.cameras)
    if launch.launcher is not None:
        # What follows then finds all views made, and reads every byte of them.
        send_off(sys.argv[1:], root, launch, workers=workers)
    part = None if shard is None else parse_shard(shard)
    made = build_dataset(
        description, root, config, num_layers=num_layers, workers=workers, overwrite=overwrite, shard=part
    )
    if part is None:
        _say_all(summary(made, TRUTH))
    _build_more(
        made, angles=angle_splits, scales=super_resolution, views=super_resolution_views, workers=workers, shard=part
    )
    peel_variants(made, workers=workers, shard=part)
    tell(str(root))
    if part is not None:
        missing, total = count_missing(made)
        if missing:
            say(
                f"{root}: part {part} is done; {missing} of {total} pictures and layers are for the other parts to make"
            )
            return
        say(f"{root}: part {part} is done, and with it the dataset")
        _say_all(summary(made, TRUTH))
    next_command(after_build(made))


def import_file(
    file: tyro.conf.Positional[Path],
    out: Path | None = None,
    overwrite: bool = False,
    choices: ImportChoices = ImportChoices(),  # noqa: B008
) -> None:
    """Makes a scene of a file from elsewhere: glTF, GLB, OBJ with MTL, PLY, STL or 3MF.

    Writes the folder that `datagen build --scene` takes, with an import.json that has a line for each thing that is
    drawn other than the file asks for.

    Args:
        file: A file that ends in .glb, .gltf, .obj, .ply, .stl or .3mf.
        out: Where the scene goes; scenes/NAME unless given.
        overwrite: Replace an imported scene that stands there.
        choices: What the file leaves open.
    """
    from datagen.scene.importers.imported_folder import check_free, write_imported
    from datagen.scene.importers.importing import import_scene, scene_name

    root = out or SCENES_ROOT / scene_name(file)
    check_free(root, overwrite=overwrite)
    imported = import_scene(file, choices)
    write_imported(imported.scene, imported.record, root, overwrite=overwrite)
    _say_all(imported.told())
    tell(str(root))
    next_command(shlex.join(["datagen", "build", "--scene", str(root)]))


def _check_build(
    *, num_layers: int, workers: int, scales: tuple[int, ...], scaled_views: int | None, test_views: int
) -> None:
    """Refuses numbers that cannot be before anything is modelled."""
    from datagen.build.plan_variant import MAX_SCALE

    check_settings(num_layers=num_layers, workers=workers)
    for scale in scales:
        if not 2 <= scale <= MAX_SCALE:
            raise HyalineError(f"super_resolution: is {scale}; expected 2 to {MAX_SCALE} times the dataset's size")
    if scaled_views is not None and not scales:
        raise HyalineError("--super-resolution-views: goes with --super-resolution; give that, too, or leave it out")
    if scaled_views is not None and not 1 <= scaled_views <= test_views:
        raise HyalineError(f"super_resolution_views: is {scaled_views}; expected 1 to {test_views}")


def _say_all(lines: list[str]) -> None:
    for line in lines:
        say(line)


def _check_parts(shard: str | None, launch: LaunchChoices, *, overwrite: bool, edit: tuple[str, ...]) -> None:
    from datagen.build.shards import parse_shard

    flag = "--shard" if shard is not None else "--launcher"
    if shard is None and launch.launcher is None:
        return
    if shard is not None:
        parse_shard(shard)
        if launch.launcher is not None:
            raise HyalineError("--launcher: makes all parts itself; leave out --shard")
    if overwrite:
        raise HyalineError(f"--overwrite: does not go with {flag}, which deletes nothing; delete the folder first")
    if edit:
        raise HyalineError(f"--edit: does not go with {flag}; its few views are made by one machine")


def _refuse(wanted: str, given: dict[str, bool]) -> None:

    for flag, is_given in given.items():
        if is_given:
            raise HyalineError(f"--{flag}: does not go with {wanted}, which takes it from the dataset; leave it out")


def _open_base(scene: str, out: Path | None, dataset: str | None, preset: str) -> Dataset:
    """The dataset that is added to: what --dataset names, or what --scene or --out would have been built into."""
    from datagen.scene.folder import load_scene
    from datagen.scene.importers.finding import is_foreign
    from datagen.scene.importers.importing import scene_name

    if dataset is None:
        name = scene_name(Path(scene)) if is_foreign(scene) else scene
        name = load_scene(Path(scene), is_sealed=True).name if (Path(scene) / "scene.json").is_file() else name
        base = open_dataset(out or find_dataset(name))
    else:
        _refuse("--dataset", {"scene": scene != "glass_table", "out": out is not None})
        base = open_dataset(find_dataset(dataset))
    if preset not in ("demo", base.config.preset):
        raise HyalineError(f"--preset: is {preset}, but {base.root} was built with {base.config.preset}; leave it out")
    return base


def _build_more(
    base: Dataset,
    *,
    angles: bool,
    scales: tuple[int, ...],
    views: int | None,
    workers: int,
    shard: "Shard | None" = None,
) -> None:
    from datagen.build.build_variant import build_variant
    from datagen.build.plan_variant import plan_angles, plan_larger

    plans = [plan_angles(base)] if angles else []
    for plan in [*plans, *(plan_larger(base, scale, views=views) for scale in scales)]:
        build_variant(base, plan, workers=workers, shard=shard)


def _build_edit(base: Dataset, edit: tuple[str, ...], *, workers: int, overwrite: bool) -> None:
    from datagen.build.build import summary
    from datagen.build.build_variant import build_variant
    from datagen.build.plan_variant import plan_edit
    from datagen.scene.edits import parse_edit

    plan = plan_edit(base, tuple(map(parse_edit, edit)))
    edited = build_variant(base, plan, workers=workers, overwrite=overwrite)
    _say_all(summary(edited, TRUTH))
    tell(str(edited.root))
    next_command(after_edit(base, edited))


def peel(
    dataset: str | None = None,
    geometry: str = TRUTH,
    num_layers: int = 8,
    workers: int = 1,
    overwrite: bool = False,
) -> None:
    """Peels layers of a geometry for every view, without rendering images again.

    Args:
        dataset: A dataset's folder or its name under data/; the only one there unless given. May stand first, without
            the flag.
        geometry: truth, or a kind of proxy that `proxies make` has made.
        num_layers: Layers kept per ray.
        workers: Processes that peel side by side.
        overwrite: Peel again what is there.
    """
    from datagen.build.build import peel_dataset, summary
    from datagen.build.build_variant import peel_variants

    opened = open_dataset(find_dataset(dataset))
    check_settings(num_layers=num_layers, workers=workers)
    check_geometry(opened, geometry)
    peel_dataset(opened, geometry, num_layers=num_layers, overwrite=overwrite, workers=workers)
    _say_all(summary(opened, geometry))
    peel_variants(opened, workers=workers)
    tell(str(opened.root))
    next_command(after_layers(opened, geometry))


def verify(dataset: str | None = None) -> None:
    """Checks every byte of a dataset; exit status 1 names what is damaged.

    Args:
        dataset: A dataset's folder or its name under data/; the only one there unless given. May stand first, without
            the flag.
    """
    from datagen.build.verify import verify_dataset

    root = find_dataset(dataset)
    found = verify_dataset(root)
    for remark in found.remarks:
        say(remark)
    _tell_problems(root, found)
    tell(f"{root}: {found.verified} files verified")


def _tell_problems(root: Path, found: "Findings") -> None:
    """Prints what a search found, and ends with status 1 when that is damage."""
    for problem in found.problems:
        tell(problem)
    if found.problems:
        commands = ", then ".join(f"`{command}`" for command in found.commands)
        fail(f"{root}: {len(found.problems)} problems, which the lines above name; mend them with {commands}")


def mend(dataset: str | None = None, scene: str | None = None, workers: int = 1) -> None:
    """Makes a damaged or unfinished dataset whole, from what its own heads say; touches nothing that verifies.

    Args:
        dataset: A dataset's folder or its name under data/; the only one there unless given.
        scene: The folder that the dataset was built from: needed where a file of its scene is lost, and the scene is
            no built-in one.
        workers: Processes that render side by side.
    """
    from datagen.build.mend import mend_dataset
    from datagen.build.verify import verify_dataset

    root = find_dataset(dataset)
    mended = mend_dataset(root, scene=scene, workers=workers)
    found = verify_dataset(mended.root)
    _tell_problems(mended.root, found)
    tell(f"{mended.root}: {found.verified} files verified")


def render(
    dataset: str | None = None,
    path: str = "orbit",
    spp: int = 128,
    film: FilmChoices = FilmChoices(),  # noqa: B008
    overwrite: bool = False,
) -> None:
    """Path-trace a film of a dataset's scene; `model render --path` draws the same film with a trained run.

    Args:
        dataset: A dataset's folder or its name under data/; the only one there unless given. May stand first, without
            the flag.
        path: orbit, spline (through the interpolating test views), or a JSON file of key frames as NeRF tools write
            cameras.
        spp: Samples per pixel.
        film: What the film is.
        overwrite: Replace a film that stands there.
    """
    from datagen.build.film import film_scene, plan_film

    opened = open_dataset(find_dataset(dataset))
    out = film.video or Path(f"{opened.name}-truth.webp")
    cameras = plan_film(opened, path, film, out, overwrite=overwrite)
    film_scene(opened, cameras, out, fps=film.fps, spp=spp)
    tell(str(out))


def scenes() -> None:
    """Lists the scenes that `datagen build --scene` knows by name."""
    from datagen.scene.builtin import describe_scenes

    for name, description in describe_scenes().items():
        print(f"{name:14} {description}")
    next_command(build_command())


def doctor() -> None:
    """Says what this machine has, which Mitsuba variant will be used, and what mends what is missing."""
    from datagen.machine.doctor import examine

    findings = examine()
    for finding in findings:
        print(f"{finding.what:10} {finding.found}")
        if finding.remedy:
            print(f"{'':10} mend it with: {finding.remedy}")
    if not any(finding.remedy for finding in findings):
        next_command(build_command())
