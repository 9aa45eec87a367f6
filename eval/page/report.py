"""The report: finds the runs, scores them, prints tables, writes results.json and pictures."""

import dataclasses
import shlex
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from datagen.data.config import MAX_VIEWS, TEST_SPLITS, Split
from datagen.data.dataset import Dataset, has_glass_mask, open_dataset
from datagen.data.paths import list_datasets
from datagen.disk.errors import HyalineError
from datagen.disk.names import file_name
from datagen.disk.records import Json
from datagen.disk.storage import dump_json
from datagen.machine.doctor import code_version
from datagen.terminal.command import choose, say, track
from eval.analyses.edits import object_psnr, score_edits
from eval.analyses.variants import score_variants
from eval.page.further import Further, analyse, figures_of
from eval.page.page import PAGE, USUAL_VIEWS, report_page
from eval.page.report_folder import check_report_folder, write_report
from eval.score.runs import Run, has_predictions, list_run_folders, open_run
from eval.score.scores import RunScores, SceneScores, Truth, read_truth, score_run
from eval.tables.grids import TABLE_WIDTH
from eval.tables.looks import grid_text, tables_text
from eval.tables.named import TABLES, EditedPsnr
from eval.tables.parts import FoundPart, report_parts
from eval.tables.published import published_grid, published_json
from eval.tables.results import grid_json, results_csv, results_data
from eval.tables.scenes import Stored

FORMATS = ("table", "markdown", "csv", "latex", "json")
TABLE_FORMATS = ("table", "markdown", "latex", "json")
"""Formats of `make_tables`; the report's CSV contains the same values."""


def make_report(
    runs_root: Path,
    data_root: Path,
    out: Path,
    *,
    output_format: str,
    only: Path | None = None,
    is_full: bool = False,
    is_published: bool = False,
    most_views: int = USUAL_VIEWS,
) -> None:
    """Scores all runs; errors of runs that cannot be scored come last.

    Args:
        only: score only the runs of this dataset; None: all runs.
        is_full: also describe the runs, and print quality by angle.
        is_published: also print the paper's own numbers, and what its authors' script would print for our runs.
        most_views: views that the page shows of each split and run.
    """
    choose("format", output_format, FORMATS)
    if not 1 <= most_views <= MAX_VIEWS:
        raise HyalineError(f"--shown-views: is {most_views}; expected 1 to {MAX_VIEWS:,} of each split and run")
    check_report_folder(out)
    runs, errors = _open_runs(runs_root, data_root, out, only)
    if not runs and not errors:
        raise HyalineError(
            f"{runs_root}: contains no predictions; make some with `model train paper`, or put a method's pictures at "
            f"{runs_root}/SCENE/NAME/predictions/SPLIT/0000.png"
        )
    say(f"{out}: reporting on {len(runs)} runs")
    folders = list_run_folders(runs_root, besides=out)
    if found := score_runs(runs, errors, folders, made_by=_made_by(only)):
        _print_scores(found, output_format, is_full=is_full, is_published=is_published)
        write_page(found, out, most_views=most_views)
    for error in errors[:-1]:
        say(f"error: {error}")
    if errors:
        raise errors[-1]


@dataclass(frozen=True, kw_only=True, eq=False)
class Scored:
    """What a report says about some runs."""

    scenes: list[SceneScores]
    further: list[Further]
    """The analyses of each scene, in the same order."""
    results: Stored
    """The content of results.json."""


def score_runs(
    runs: list[Run], errors: list[HyalineError], folders: Sequence[Path] = (), *, made_by: dict[str, Json]
) -> Scored | None:
    """Scores and analyses runs; None if no run can be scored.

    Args:
        errors: takes why a run could not be scored or analysed.
        folders: of runs and of what plug-ins know, such as fits of the runs' datasets.
        made_by: the command that asked for it, for results.json.
    """
    scenes = _score_scenes(runs, errors)
    if not scenes:
        return None
    parts = _find_parts([scene.dataset for scene in scenes], folders, errors)
    further = [analyse(scene, errors, found) for scene, found in zip(scenes, parts, strict=True)]
    more: dict[str, Json] = {"made_by": made_by, "published": published_json()}
    results = results_data(scenes, {analyses.title: analyses.data for analyses in further}, more)
    return Scored(scenes=scenes, further=further, results=results)


def _find_parts(
    datasets: Sequence[Dataset], folders: Sequence[Path], errors: list[HyalineError]
) -> list[dict[str, FoundPart]]:
    """What plug-ins know of each dataset, by their names."""
    found: list[dict[str, FoundPart]] = [{} for _ in datasets]
    for name, part in report_parts().items():
        own = [folder for folder in folders if (folder / part.head).is_file()]
        for of_dataset, each in zip(found, part.find(datasets, own, errors), strict=True):
            if each is not None:
                of_dataset[name] = each
    return found


def write_page(found: Scored, out: Path, *, most_views: int) -> Path:
    """Writes results.json, the page and the pictures of a report into `out`; returns the page's path.

    Args:
        most_views: views that the page shows of each split and run.
    """
    files = {
        "results.json": lambda: dump_json(found.results),
        PAGE: partial(report_page, found.scenes, found.further, found.results["scenes"], most_views=most_views),
        **figures_of(found.scenes, found.further),
    }
    for path in write_report(out, files):
        say(f"wrote {path}")
    say(f"open {out / PAGE} in a browser")
    return out / PAGE


def make_tables(
    runs_root: Path, data_root: Path, out: Path, *, tables: Sequence[str], output_format: str, only: Path | None = None
) -> None:
    """Scores the runs that some tables need and prints those alone; pictures of them are written to `out`.

    Raises:
        HyalineError: an unknown table or format, or a run that cannot be scored.
    """
    asked = {name: TABLES.find(name) for name in tables}
    choose("format", output_format, TABLE_FORMATS)
    check_report_folder(out)
    runs, errors = _open_runs(runs_root, data_root, out, only)
    wanted = [run for run in runs if any(table.shows(run) for table in asked.values())]
    scenes = _score_scenes(wanted, errors)
    if not scenes:
        datasets = list_datasets(data_root) if only is None else [only]
        hint = (
            f"; make them with `{_sweep_command(tables[0], [] if asked[tables[0]].needs_more else datasets)}`"
            if asked[tables[0]].is_swept
            else ""
        )
        errors.append(HyalineError(f"{runs_root}: contains no run of {', '.join(tables)}{hint}"))
    grids = {name: table.grids(scenes, lambda scene: _object_psnr(scene, errors)) for name, table in asked.items()}
    if output_format == "json":
        made_by: Json = {
            "command": shlex.join(["report", *(word for name in tables for word in ("--table", name))]),
            "code": code_version(),
        }
        stored: Json = {name: [grid_json(grid) for grid in found] for name, found in grids.items()}
        sys.stdout.write(dump_json(results_data(scenes, more={"made_by": made_by, "tables": stored})).decode())
    else:
        for grid in (grid for found in grids.values() for grid in found):
            sys.stdout.write(grid_text(grid, output_format, width=_output_width(), color=sys.stdout.isatty()) + "\n")
    sys.stdout.flush()
    pictures = {(name, scene.title): table.picture(scene) for name, table in asked.items() for scene in scenes}
    files = {f"{table}_{file_name(title)}.png": png for (table, title), png in pictures.items() if png is not None}
    for path in write_report(out, {name: partial(bytes, png) for name, png in files.items()}) if files else ():
        say(f"wrote {path}")
    for error in errors[:-1]:
        say(f"error: {error}")
    if errors:
        raise errors[-1]


def _sweep_command(table: str, datasets: Sequence[Path]) -> str:
    return shlex.join(["model", "sweep", table, *(word for place in datasets for word in ("--dataset", str(place)))])


def _object_psnr(scene: SceneScores, errors: list[HyalineError]) -> EditedPsnr:
    """PSNR where edited objects are or were."""
    edits = score_variants(scene, errors, of=lambda variant: variant.edit is not None)
    return object_psnr(score_edits(scene, edits, errors))


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
                run = open_run(folder, data_root, dataset if is_own else None)
                if dataset is None or run.dataset.seal == dataset.seal:
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
    """The runs of a dataset; where two have one name, their folders' names come before it."""
    counts = Counter(run.name for run in runs)
    return [
        run if counts[run.name] == 1 else dataclasses.replace(run, name=f"{run.folder.parent.name}/{run.name}")
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
        runs=tuple(sorted(scored, key=lambda scores: scores.run.name)),
    )


def _made_by(only: Path | None) -> dict[str, Json]:
    """The command that scored, without its folders, and the code that it ran."""
    words = [] if only is None else ["--dataset", only.name]
    return {"command": shlex.join(["report", *words]), "code": code_version()}


def _print_scores(found: Scored, output_format: str, *, is_full: bool, is_published: bool) -> None:
    if output_format == "json":
        text = dump_json(found.results).decode()
    elif output_format == "csv":
        text = results_csv(found.scenes)
    else:
        grids = [grid for analyses in found.further for grid in analyses.grids]
        text = tables_text(
            found.results["scenes"],
            output_format,
            width=_output_width(),
            color=sys.stdout.isatty(),
            more=[*grids, *([published_grid()] if is_published else [])],
            is_full=is_full,
            is_wrapped=is_published,
        )
    sys.stdout.write(text)
    sys.stdout.flush()


def _output_width() -> int:
    """Columns of the terminal, at least what the tables need; the same 120 everywhere else."""
    import shutil

    return max(TABLE_WIDTH, shutil.get_terminal_size().columns) if sys.stdout.isatty() else TABLE_WIDTH
