"""The command `eval report`.

In a POSIX shell `eval report ARGS` runs the shell's builtin, which runs `report ARGS`; so both console scripts come
here, and the word `report` may or may not be there.
"""

import sys
from pathlib import Path

from datagen.terminal.command import run, say

DESCRIPTION = "Score predicted images against a dataset's ground truth: tables, figures, JSON."


def report(
    *,
    runs: Path = Path("runs"),
    data: Path = Path("data"),
    dataset: str | None = None,
    format: str = "table",  # noqa: A002  The flag's name; the builtin is not needed here.
    out: Path | None = None,
    table: tuple[str, ...] = (),
    full: bool = False,
    published: bool = False,
    views: int = 3,
    results: tuple[Path, ...] = (),
) -> None:
    """Scores every folder RUNS/SCENE/NAME/predictions/SPLIT/0000.png, 0001.png, ... and writes a page of them.

    A folder of 8-bit sRGB PNGs from any method works; run.json is optional. Tables go to stdout, one per scene. Open
    the page, RUNS/report/index.html, in any browser: one file that needs no server.

    Args:
        runs: Folder with the runs.
        data: Folder with the datasets, DATA/SCENE, for runs whose record names none.
        dataset: Score only the runs of this dataset: its folder, or its name under DATA.
        format: Format of stdout: table, markdown, csv, latex or json.
        out: Folder for index.html, results.json and pictures; RUNS/report unless given.
        table: Print only these tables, beside the paper's numbers, with contact sheets of their runs: table1
            (extrinsics), table2 (DNR), square (layers or network), zero-layer, headline, proxies (with a figure),
            ablation (parts of light-path), variants (of paper), claims. `model sweep` trains the runs of each.
        full: Also print what each run is, and quality by angle, by number of training views and by layers.
        published: Also print the paper's own numbers, and beside them what its authors' script gives for these runs.
        views: Views of each split and run in index.html: the worst, the median and the best first. Of more than fit
            into 20 MB, the last are left out.
        results: Instead of scoring runs, print the tables of these results.json files as one page of Markdown; from all
            of docs/results, `make results` makes RESULTS.md.
    """
    if results:
        from eval.tables.results import results_page

        sys.stdout.write(results_page(results))
        return
    from datagen.data.paths import find_dataset
    from datagen.trace.surface_tables import make_tables
    from eval.page.report import make_report

    place = out if out is not None else runs / "report"
    only = None if dataset is None else find_dataset(dataset, data)
    if table:
        make_tables(runs, data, place, tables=table, output_format=format, only=only)
        return
    make_report(
        runs,
        data,
        place,
        output_format=format,
        only=only,
        is_full=full,
        is_published=published,
        most_views=views,
    )


def main() -> None:
    arguments = sys.argv[1:]
    if arguments[:1] == ["report"]:
        arguments = arguments[1:]
    try:
        run("eval", DESCRIPTION, {"report": report}, ["report", *arguments])
    except SystemExit as end:
        if end.code == 2:
            say("help: `eval report --help`")  # `eval --help`, which the parser advises, is the shell's builtin.
        raise
