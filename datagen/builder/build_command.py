"""What `datagen build` and `datagen add` do: build datasets from a scene, and add variants to one."""

import dataclasses
from pathlib import Path

from datagen.builder.build import build_dataset, refuse_unlit
from datagen.builder.choices import (
    AddChoices,
    BuildChoices,
    ShardChoices,
    SizeChoices,
    check_baseline,
    configure,
    fit_to_scene,
    parse_shard,
)
from datagen.builder.variants import build_variant, peel_variants, plan_angles, plan_edit, plan_larger, plan_stereo
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.layers import check_settings
from datagen.data.paths import DATA_ROOT
from datagen.data.variants import TWINS
from datagen.disk.errors import HyalineError, UsageError
from datagen.disk.ownership import DATASET, refuse_others
from datagen.machine.launch import raise_failures, run_in_jobs
from datagen.scene.edits import parse_edit
from datagen.scene.finding import ImportChoices, find_scene, find_source, numbered_scenes
from datagen.terminal.command import say
from datagen.terminal.parsing import changed_flags, flag_words


def build_scenes(
    scene: str, choices: BuildChoices, size: SizeChoices, launch: ShardChoices, imports: ImportChoices
) -> list[Dataset]:
    """Builds the dataset of a scene; of `random`, as many as `choices` count."""
    in_parts = "--shard" if choices.shard else "--launcher" if launch.launcher else ""
    if in_parts and choices.overwrite:
        raise UsageError(f"--overwrite: cannot be combined with {in_parts}; delete the folder first")
    if choices.shard and launch.launcher:
        raise UsageError("--launcher: builds all parts; leave out --shard")
    source = numbered_scenes(scene)
    if source is None or source.name_of is None:
        if choices.family is not None or choices.count is not None:
            raise UsageError("--family, --count: only for random scenes; type `datagen build random`")
        return [_build_scene(scene, choices, size, launch, imports)]
    if choices.count is None:
        name = source.name_of(choices.seed, choices.family)
        return [_build_scene(name, dataclasses.replace(choices, family=None), size, launch, imports)]
    if choices.count < 1:
        raise UsageError(f"--count: is {choices.count}; expected at least 1")
    names = {seed: source.name_of(seed, choices.family) for seed in range(choices.seed, choices.seed + choices.count)}
    if launch.launcher is not None:
        _build_seeds_in_jobs(scene, choices, choices.count, size, launch)
        return [open_dataset((choices.out or DATA_ROOT) / name) for name in names.values()]
    built, failed = [], 0
    for seed, name in names.items():
        out = None if choices.out is None else choices.out / name
        one = dataclasses.replace(choices, seed=seed, out=out, family=None, count=None)
        try:
            built.append(_build_scene(name, one, size, launch, imports))
        except UsageError:
            raise
        except HyalineError as error:
            say(f"failed: {name}: {error}", is_error=True)
            failed += 1
    if failed:
        raise HyalineError(
            f"{failed} of {choices.count} scenes failed (see above); the others are built, and the same "
            "command skips them"
        )
    return built


def _build_scene(
    name: str, choices: BuildChoices, size: SizeChoices, launch: ShardChoices, imports: ImportChoices
) -> Dataset:
    check_settings(num_layers=size.num_layers, workers=choices.workers)
    check_baseline(choices.stereo)
    config = configure(choices.preset, size, seed=choices.seed)
    part = None if choices.shard is None else parse_shard(choices.shard)
    if choices.out is not None or ("/" not in name and find_source(name, is_of_files=True) is None):
        # Before anything is modelled.
        refuse_others(choices.out or DATA_ROOT / name, DATASET)
    scene = find_scene(name, resolution=config.resolution, imports=imports)
    root = choices.out or DATA_ROOT / scene.name
    if launch.launcher is not None:
        # What follows then finds all views made, and reads every byte of them.
        words = _job_words(name, choices, size, imports)
        parts = [f"{number}/{launch.shards}" for number in range(1, launch.shards + 1)]
        _run_jobs(root, {f"part {part}": [*words, "--shard", part] for part in parts}, launch)
    made = build_dataset(
        scene,
        root,
        fit_to_scene(config, scene, size),
        num_layers=size.num_layers,
        workers=choices.workers,
        overwrite=choices.overwrite,
        shard=part,
    )
    if part is not None:
        say(f"{root}: part {part} is done; without --shard, the same command makes the rest, and stereo pairs")
        return made
    peel_variants(made, workers=choices.workers)
    if choices.stereo is not None:
        build_variant(made, plan_stereo(made, choices.stereo), workers=choices.workers)
    return made


def _build_seeds_in_jobs(
    scene: str, choices: BuildChoices, count: int, size: SizeChoices, launch: ShardChoices
) -> None:
    """Builds random scenes in jobs of consecutive seeds, and returns when all have succeeded."""
    each = -(-count // launch.shards)
    jobs = {}
    for first in range(choices.seed, choices.seed + count, each):
        seeds = min(each, choices.seed + count - first)
        part = dataclasses.replace(choices, seed=first, count=seeds)
        jobs[f"seeds {first} to {first + seeds - 1}"] = _job_words(scene, part, size, ImportChoices())
    _run_jobs(choices.out or DATA_ROOT / scene, jobs, launch)


def _run_jobs(root: Path, jobs: dict[str, list[str]], launch: ShardChoices) -> None:
    failures = run_in_jobs("datagen", jobs, root.parent / f"{root.name}-jobs", launch.launcher, launch.parameters())
    raise_failures(str(root), failures, len(jobs))


def _job_words(scene: str, choices: BuildChoices, size: SizeChoices, imports: ImportChoices) -> list[str]:
    kinds = ((choices, BuildChoices()), (size, SizeChoices()), (imports, ImportChoices()))
    return ["build", scene, *flag_words(flag for kind in kinds for flag in changed_flags(*kind))]


def add_variants(base: Dataset, choices: AddChoices) -> list[Dataset]:
    """Adds an edited scene, twins, splits by angle or larger pictures to a dataset."""
    refuse_unlit(base, what="another view")
    check_baseline(choices.stereo)
    edits = [choices.edit] if choices.edit else []
    edits += [(twin,) for twin in TWINS] if choices.twins else []
    if not (edits or choices.angles or choices.larger or choices.stereo is not None):
        raise UsageError("datagen add: nothing to add; give --edit, --twins, --angles, --larger or --stereo")
    if choices.larger_views is not None and not choices.larger:
        raise UsageError("--larger-views: goes with --larger; give that, too, or leave it out")
    plans = [plan_edit(base, tuple(map(parse_edit, edit))) for edit in edits]
    plans += [plan_angles(base)] if choices.angles else []
    plans += [plan_larger(base, scale, views=choices.larger_views) for scale in choices.larger]
    plans += [] if choices.stereo is None else [plan_stereo(base, choices.stereo)]
    return [build_variant(base, plan, workers=choices.workers, overwrite=choices.overwrite) for plan in plans]
