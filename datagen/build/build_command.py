"""What `datagen build` does: builds a dataset, or one part of it, or adds edits and more test views to one."""

import dataclasses
import shlex
import sys
from pathlib import Path

from datagen.build.build import build_dataset, refuse_imported, summary
from datagen.build.build_variant import build_variant, peel_variants
from datagen.build.choices import BuildChoices
from datagen.build.launch import LaunchChoices
from datagen.build.launch import launch as send_off
from datagen.build.plan_variant import MAX_SCALE, plan_angles, plan_edit, plan_larger
from datagen.build.presets import configure, fit_to_scene
from datagen.build.shards import Shard, count_missing, parse_shard
from datagen.data.config import DatasetConfig, parse_resolution
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.layer_writing import check_settings
from datagen.data.paths import DATA_ROOT, TRUTH, find_dataset, render_command, train_command
from datagen.data.transforms import TRANSFORMS_FILES
from datagen.data.variants import TWINS
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import DATASET, refuse_strangers
from datagen.scene.edits import parse_edit
from datagen.scene.finding import find_scene, is_foreign
from datagen.scene.folder import load_scene
from datagen.scene.foreign_files import ImportChoices, scene_name
from datagen.scene.random_names import RANDOM, RandomName
from datagen.terminal.command import next_command, say, say_all, tell
from datagen.terminal.preview import preview

DEFAULTS = BuildChoices()
SETTINGS = ("num_layers", "seed", "ceiling", "views", "resolution", "test_views", "spp", "test_spp", "max_depth")
"""What a dataset that is added to has decided."""


def build_or_add(choices: BuildChoices, launch: LaunchChoices, imports: ImportChoices) -> None:
    """Carries out one command line of `datagen build`.

    Raises:
        HyalineError: choices that do not go together, or what building raises.
    """
    _check_parts(choices, launch)
    _check_random(choices, launch)
    if not choices.edit and choices.dataset is None:
        for one in _each(choices):
            _build_new(one, launch, imports)
        return
    if flags := imports.given():
        raise HyalineError(f"{flags[0]}: does not go with {'--edit' if choices.edit else '--dataset'}; leave it out")
    _refuse(choices, "--edit" if choices.edit else "--dataset", *SETTINGS)
    base = _open_base(choices)
    if choices.edit:
        _add_edit(base, choices)
    else:
        _add_views(base, choices, launch)


def _each(choices: BuildChoices) -> list[BuildChoices]:
    """The choices for each dataset: one, or as many random scenes as --count says."""
    if choices.scene != RANDOM:
        return [choices]
    each = []
    for seed in range(choices.seed, choices.seed + (1 if choices.count is None else choices.count)):
        name = str(RandomName(seed=seed, chosen=choices.family))
        out = choices.out / name if choices.out is not None and choices.count is not None else choices.out
        each.append(dataclasses.replace(choices, scene=name, seed=seed, out=out))
    return each


def _check_random(choices: BuildChoices, launch: LaunchChoices) -> None:
    """Refuses flags of random scenes without one, and what works on one dataset where it is not known which."""
    if choices.scene != RANDOM:
        for name in ("family", "count"):
            if getattr(choices, name) is not None:
                raise HyalineError(f"--{name}: goes with --scene {RANDOM}; leave it out")
        return
    if choices.edit:
        raise HyalineError(f"--scene {RANDOM}: does not say which scene to edit; name one, as in --dataset random-0000")
    if choices.count is not None and choices.count < 1:
        raise HyalineError(f"count: is {choices.count}; expected at least 1 dataset")
    if choices.count is not None and launch.launcher is not None:
        raise HyalineError("--count: does not go with --launcher; send off one random scene at a time, by its --seed")


def _build_new(choices: BuildChoices, launch: LaunchChoices, imports: ImportChoices) -> None:
    config = _configure(choices)
    if choices.out is not None or ("/" not in choices.scene and not is_foreign(choices.scene)):
        # Before anything is modelled; what may be a dataset's is judged when it is known what should stand there.
        place = choices.out or DATA_ROOT / choices.scene
        refuse_strangers(place, DATASET, {DATASET.head, *TRANSFORMS_FILES.values()})
    built = None if choices.overwrite else choices.out or DATA_ROOT / choices.scene
    scene = find_scene(choices.scene, built=built, resolution=config.resolution, imports=imports)
    root = choices.out or DATA_ROOT / scene.name
    are_views_chosen = choices.views is not None or choices.test_views is not None
    config = fit_to_scene(config, scene, keep_resolution=choices.resolution is not None, keep_views=are_views_chosen)
    if launch.launcher is not None:
        # What follows then finds all views made, and reads every byte of them.
        send_off(sys.argv[1:], root, launch, workers=choices.workers)
    part = None if choices.shard is None else parse_shard(choices.shard)
    made = build_dataset(
        scene,
        root,
        config,
        num_layers=choices.num_layers,
        workers=choices.workers,
        overwrite=choices.overwrite,
        shard=part,
    )
    if part is None:
        say_all(summary(made, TRUTH))
        _preview(made, choices)
    _build_more(made, choices, part)
    peel_variants(made, workers=choices.workers, shard=part)
    tell(str(root))
    if part is not None:
        missing, total = count_missing(made)
        if missing:
            say(
                f"{root}: part {part} is done; {missing} of {total} pictures and layers are for the other parts to make"
            )
            return
        say(f"{root}: part {part} is done, and with it the dataset")
        say_all(summary(made, TRUTH))
    next_command(shlex.join(["proxies", "make", "--dataset", str(root), "--kind", "ellipsoid"]))


def _preview(dataset: Dataset, choices: BuildChoices) -> None:
    if choices.preview:
        preview([dataset.view(split, 0).image for split in dataset.splits], f"first of {', '.join(dataset.splits)}")


def _configure(choices: BuildChoices) -> DatasetConfig:
    """The configuration of a new dataset, but for its scene's name, which is known when the scene is read."""
    config = configure(
        choices.preset,
        resolution=None if choices.resolution is None else parse_resolution(choices.resolution),
        views=choices.views,
        test_views=choices.test_views,
        spp=choices.spp,
        test_spp=choices.test_spp,
        ceiling_db=choices.ceiling,
        max_depth=choices.max_depth,
        seed=choices.seed,
    )
    _check_numbers(choices, test_views=config.interpolating.views)
    return config


def _add_edit(base: Dataset, choices: BuildChoices) -> None:
    _refuse(choices, "--edit", "twins", "angle_splits", "super_resolution")
    plan = plan_edit(base, tuple(map(parse_edit, choices.edit)))
    edited = build_variant(base, plan, workers=choices.workers, overwrite=choices.overwrite)
    say_all(summary(edited, TRUTH))
    _preview(edited, choices)
    tell(str(edited.root))
    next_command(render_command(edited.name))


def _add_views(base: Dataset, choices: BuildChoices, launch: LaunchChoices) -> None:
    _refuse(choices, "--dataset", "overwrite", "shard")
    if launch.launcher is not None:
        raise _does_not_go_with("launcher", "--dataset")
    if not (choices.twins or choices.angle_splits or choices.super_resolution):
        raise HyalineError(
            "--dataset: goes with --edit, --twins, --angle-splits or --super-resolution; a new one takes --scene"
        )
    _check_numbers(choices, test_views=base.config.interpolating.views)
    _build_more(base, choices, None)
    tell(str(base.root))
    next_command(train_command(base.root))


def _build_more(base: Dataset, choices: BuildChoices, shard: Shard | None) -> None:
    """The twins, and the test splits by angle and in larger pictures, that are asked for."""
    plans = [plan_edit(base, (parse_edit(twin),)) for twin in TWINS] if choices.twins else []
    plans += [plan_angles(base)] if choices.angle_splits else []
    larger = (plan_larger(base, scale, views=choices.super_resolution_views) for scale in choices.super_resolution)
    for plan in [*plans, *larger]:
        build_variant(base, plan, workers=choices.workers, shard=shard)


def _open_base(choices: BuildChoices) -> Dataset:
    """The dataset that is added to: what --dataset names, or what --scene or --out would have been built into."""
    if choices.dataset is None:
        base = open_dataset(choices.out or find_dataset(_name_of(choices.scene)))
    else:
        _refuse(choices, "--dataset", "scene", "out")
        base = open_dataset(find_dataset(choices.dataset))
    if choices.preset not in (DEFAULTS.preset, base.config.preset):
        raise HyalineError(
            f"--preset: is {choices.preset}, but {base.root} was built with {base.config.preset}; leave it out"
        )
    refuse_imported(base, what="another view")
    return base


def _name_of(scene: str) -> str:
    """The name of the dataset that --scene would have been built into."""
    if (Path(scene) / "scene.json").is_file():
        return load_scene(Path(scene), is_sealed=True).name
    return scene_name(Path(scene)) if is_foreign(scene) else scene


def _check_parts(choices: BuildChoices, launch: LaunchChoices) -> None:
    flag = "--shard" if choices.shard is not None else "--launcher"
    if choices.shard is None and launch.launcher is None:
        return
    if choices.shard is not None:
        parse_shard(choices.shard)
        if launch.launcher is not None:
            raise HyalineError("--launcher: makes all parts itself; leave out --shard")
    if choices.overwrite:
        raise HyalineError(f"--overwrite: does not go with {flag}, which deletes nothing; delete the folder first")
    for name in ("edit", "twins"):
        if getattr(choices, name):
            raise HyalineError(f"--{name}: does not go with {flag}; its few views are made by one machine")


def _check_numbers(choices: BuildChoices, *, test_views: int) -> None:
    """Refuses numbers that cannot be before anything is modelled."""
    scales, views = choices.super_resolution, choices.super_resolution_views
    check_settings(num_layers=choices.num_layers, workers=choices.workers)
    for scale in scales:
        if not 2 <= scale <= MAX_SCALE:
            raise HyalineError(f"super_resolution: is {scale}; expected 2 to {MAX_SCALE} times the dataset's size")
    if views is not None and not scales:
        raise HyalineError("--super-resolution-views: goes with --super-resolution; give that, too, or leave it out")
    if views is not None and not 1 <= views <= test_views:
        raise HyalineError(f"super_resolution_views: is {views}; expected 1 to {test_views}")


def _refuse(choices: BuildChoices, wanted: str, *names: str) -> None:
    """Raises for the first choice of these that was made: the flag `wanted` takes it from the dataset."""
    for name in names:
        if getattr(choices, name) != getattr(DEFAULTS, name):
            raise _does_not_go_with(name, wanted)


def _does_not_go_with(name: str, wanted: str) -> HyalineError:
    flag = name.replace("_", "-")
    return HyalineError(f"--{flag}: does not go with {wanted}, which takes it from the dataset; leave it out")
