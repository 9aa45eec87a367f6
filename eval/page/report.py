"""The report: finds the runs, scores them, prints tables, and writes a folder of two files.

REPORT/report.json     with checksum, written first: marks the folder
REPORT/results.json    every score (eval/tables/results.py)
REPORT/index.html      the page (eval/page/page.py)
"""

import dataclasses
import os
import shlex
import shutil
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset, has_glass_mask, open_dataset
from datagen.data.paths import list_datasets
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import FolderKind, begin, holding, refuse_others
from datagen.disk.records import Json, dump_json
from datagen.disk.storage import commit
from datagen.machine.doctor import code_version
from datagen.terminal.command import say, track
from eval.page.page import PAGE, ScenePart, report_page
from eval.score.runs import Run, has_predictions, list_run_folders, open_run
from eval.score.scores import METRIC_NOTES, RunScores, SceneScores, Truth, read_truth, score_run
from eval.tables.grids import TABLE_WIDTH, Grid, grid_text, paragraphs
from eval.tables.plugins import TABLES, EditedPsnr, FoundPart, Table, report_parts
from eval.tables.results import Stored, grid_json, results_data, scene_grids
from eval.variants import edit_grid, object_psnr, score_variants, variant_json

REPORT = FolderKind(what="report", head="report.json", way_out="choose another --out, or empty the folder")
REPORT_VERSION = 1


def make_report(
    runs_root: Path,
    data_root: Path,
    out: Path,
    *,
    output_format: str,
    only: Path | None = None,
) -> None:
    """Scores all runs; errors of runs that cannot be scored come last.

    Args:
        only: score only the runs of this dataset; None: all runs.
    """
    refuse_others(out, REPORT)
    runs, errors = _open_runs(runs_root, data_root, out, only)
    if not runs and not errors:
        raise HyalineError(
            f"{runs_root}: contains no predictions; make some with `model train paper`, or put a method's pictures at "
            f"{runs_root}/SCENE/NAME/predictions/SPLIT/0000.png"
        )
    say(f"{out}: reporting on {len(runs)} runs")
    folders = list_run_folders(runs_root, besides=out)
    words = ["report"] if only is None else ["report", "--dataset", only.name]
    if found := score_runs(runs, errors, folders, command=shlex.join(words)):
        if output_format == "json":
            sys.stdout.write(dump_json(found.results).decode())
        else:
            _print_grids([grid for part in found.parts for grid in part.grids], output_format)
            sys.stdout.write("\n" + paragraphs(METRIC_NOTES, output_format, _output_width()))
        sys.stdout.flush()
        write_page(found, out)
    _raise_last(errors)


@dataclass(frozen=True, kw_only=True, eq=False)
class Scored:
    """What a report says about some runs."""

    parts: list[ScenePart]
    results: Stored
    """The content of results.json."""


def score_runs(
    runs: list[Run], errors: list[HyalineError], folders: Sequence[Path] = (), *, command: str
) -> Scored | None:
    """Scores runs with their variants; None if no run can be scored.

    Args:
        errors: takes why a run could not be scored.
        folders: of runs and of what plug-ins know, such as fits of the runs' datasets.
        command: what asked for it, for results.json.
    """
    scenes = _score_scenes(runs, errors)
    if not scenes:
        return None
    variants = [score_variants(scene, errors) for scene in scenes]
    found: list[dict[str, FoundPart]] = [{} for _ in scenes]  # What plug-ins know of each dataset, by their names.
    for name, part in report_parts().items():
        own = [folder for folder in folders if (folder / part.head).is_file()]
        for of_scene, each in zip(found, part.find([scene.dataset for scene in scenes], own, errors), strict=True):
            of_scene |= {} if each is None else {name: each}
    analyses: dict[str, dict[str, Json]] = {}
    for scene, scored, of_scene in zip(scenes, variants, found, strict=True):
        analyses[scene.title] = {name: part.data for name, part in of_scene.items()}
        if scored:
            analyses[scene.title]["variants"] = {each.variant.name: variant_json(each) for each in scored}
    results = results_data(scenes, analyses, {"made_by": {"command": command, "code": code_version()}})
    parts = [
        ScenePart(
            scene=scene,
            variants=scored,
            grids=[
                *scene_grids(cast(Stored, stored)),
                *(edit_grid(scene, each) for each in scored if each.variant.edit is not None),
            ],
            pages=[page for part in of_scene.values() for page in part.pages],
        )
        for scene, scored, of_scene, stored in zip(scenes, variants, found, results["scenes"], strict=True)
    ]
    return Scored(parts=parts, results=results)


def write_page(found: Scored, out: Path) -> Path:
    """Writes results.json and the page into `out`, which must be new, empty or a report's; returns the page's path."""
    page = report_page(found.parts, out)
    with holding(out, REPORT):
        begin(out, REPORT, {"version": REPORT_VERSION})
        for name, data in {"results.json": dump_json(found.results), PAGE: page}.items():
            commit(out / name, data)
            say(f"wrote {out / name}")
    say(f"open {out / PAGE} in a browser")
    return out / PAGE


def make_tables(
    runs_root: Path, data_root: Path, *, tables: Sequence[str], output_format: str, only: Path | None = None
) -> None:
    """Scores the runs that some tables need and prints those alone.

    Raises:
        HyalineError: an unknown table or format, or a run that cannot be scored.
    """
    asked = {name: TABLES.find(name) for name in tables}
    runs, errors = _open_runs(runs_root, data_root, runs_root / "report", only)
    wanted = [run for run in runs if any(table.shows(run) for table in asked.values())]
    scenes = _score_scenes(wanted, errors)
    if not scenes:
        datasets = list_datasets(data_root) if only is None else [only]
        errors.append(HyalineError(f"{runs_root}: contains no run of {', '.join(tables)}{_hint(asked, datasets)}"))

    def edited(scene: SceneScores) -> EditedPsnr:
        return object_psnr(score_variants(scene, errors, of=lambda variant: variant.edit is not None))

    grids = {name: table.grids(scenes, edited) for name, table in asked.items()}
    if output_format == "json":
        command = shlex.join(["report", *(word for name in tables for word in ("--table", name))])
        made_by: Json = {"command": command, "code": code_version()}
        stored: Json = {name: [grid_json(grid) for grid in found] for name, found in grids.items()}
        sys.stdout.write(dump_json(results_data(scenes, more={"made_by": made_by, "tables": stored})).decode())
    else:
        _print_grids([grid for found in grids.values() for grid in found], output_format)
    sys.stdout.flush()
    _raise_last(errors)


def _raise_last(errors: Sequence[HyalineError]) -> None:
    for error in errors[:-1]:
        say(f"error: {error}", is_error=True)
    if errors:
        raise errors[-1]


def _hint(asked: Mapping[str, Table], datasets: Sequence[Path]) -> str:
    """What trains the runs of the first table."""
    name, table = next(iter(asked.items()))
    places = [] if table.needs_more else [word for place in datasets for word in ("--dataset", str(place))]
    return f"; make them with `{shlex.join(['model', 'sweep', name, *places])}`" if table.is_swept else ""


def _open_runs(runs_root: Path, data_root: Path, out: Path, only: Path | None) -> tuple[list[Run], list[HyalineError]]:
    """The runs that can be opened, and the errors of the others; with `only`, just those of one dataset."""
    if has_predictions(runs_root):
        raise HyalineError(f"{runs_root}: is a run; name a folder of runs, such as {runs_root.resolve().parent}")
    dataset = None if only is None else open_dataset(only)
    runs, errors = [], []
    heads = ["results.json", *(part.head for part in report_parts().values())]
    for folder in list_run_folders(runs_root, besides=out):
        is_own = dataset is None or folder.parent.name == dataset.name
        try:
            if has_predictions(folder):
                run = open_run(folder, data_root, dataset)
                if run.dataset.withheld:
                    say(f"{folder}: a verifier of hyaline-bench keeps the truth; skipped")
                elif dataset is None or run.dataset.seal == dataset.seal:
                    runs.append(run)
            elif is_own and not any((folder / name).is_file() for name in heads):
                say(f"{folder}: no predictions yet; skipped")
        except HyalineError as error:
            if is_own:
                errors.append(error)
    return runs, errors


def _score_scenes(runs: list[Run], errors: list[HyalineError]) -> list[SceneScores]:
    """The scores by dataset, sorted by name; problems of a run's pictures are added to `errors`."""
    datasets: dict[str, Dataset] = {}
    for run in runs:
        datasets.setdefault(run.dataset.seal, run.dataset)
    ordered = sorted(datasets.values(), key=lambda dataset: (dataset.name, dataset.root))
    names = [dataset.name for dataset in ordered]
    scenes = []
    for dataset in ordered:
        here = _with_own_names([run for run in runs if run.dataset.seal == dataset.seal])
        # Two datasets with the same name (an old and a new one) are distinguished by their folders.
        title = dataset.name if names.count(dataset.name) == 1 else dataset.root.as_posix()
        try:
            if scored := _score_scene(dataset, title, here, errors):
                scenes.append(scored)
        except HyalineError as error:
            errors.append(error)
    return scenes


def _with_own_names(runs: list[Run]) -> list[Run]:
    """The runs of a dataset; where two have one name, their paths below the folder that all share instead."""
    counts = Counter(run.name for run in runs)
    shared = os.path.commonpath([run.folder.absolute().parent for run in runs])
    return [
        run if counts[run.name] == 1 else dataclasses.replace(run, name=os.path.relpath(run.folder, shared))
        for run in runs
    ]


def _score_scene(dataset: Dataset, title: str, runs: list[Run], errors: list[HyalineError]) -> SceneScores | None:
    truths: dict[Split, Truth] = {split: read_truth(dataset, split) for split in TEST_SPLITS}
    if not has_glass_mask(dataset):
        say(
            f"{dataset.root}: has no layers of the true geometry, so there is no PSNR on glass; "
            f"make them with `datagen peel {shlex.quote(str(dataset.root))}`"
        )
    scored: list[RunScores] = []
    for run in track(runs, label=f"scoring {title}", total=len(runs)):
        try:
            scored.append(score_run(run, truths))
        except HyalineError as error:
            errors.append(error)
    if not scored:
        return None
    return SceneScores(
        dataset=dataset,
        title=title,
        has_glass_mask=has_glass_mask(dataset),
        truths=truths,
        # As in tables, the best first.
        runs=tuple(sorted(scored, key=lambda scores: -(scores.mean("psnr_db", TEST_SPLITS[0]) or 0))),
    )


def _print_grids(grids: Sequence[Grid], output_format: str) -> None:
    width, color = _output_width(), sys.stdout.isatty()
    sys.stdout.write("\n".join(grid_text(grid, output_format, width=width, color=color) for grid in grids))


def _output_width() -> int:
    """Columns of the terminal; the same 120 everywhere else."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else TABLE_WIDTH
