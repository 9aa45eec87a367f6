"""The command `eval report`.

In a POSIX shell `eval report ARGS` runs the shell's builtin, which runs `report ARGS`; so both console scripts come
here, and the word `report` may or may not be there.
"""

import sys
from pathlib import Path
from typing import Annotated, Literal

from datagen.terminal.command import run
from eval.tables.plugins import TABLES

Format = Literal["table", "markdown"]


def report(
    runs: Path = Path("runs"),
    /,
    *,
    data: Path = Path("data"),
    dataset: str | None = None,
    format: Format = "table",  # noqa: A002  The flag's name; the builtin is not needed here.
    out: Path | None = None,
    table: Annotated[tuple[str, ...], TABLES.names] = (),
    json: bool = False,
) -> None:
    """Score predicted images against a dataset's ground truth, and write a page about all runs.

    Scores 8-bit sRGB PNGs of any method, RUNS/SCENE/NAME/predictions/SPLIT/0000.png, 0001.png, ...; run.json is
    optional. Prints one table per scene to stdout. The page, RUNS/report/index.html, is one file that opens in any
    browser without a server.

    Args:
        runs: Folder with the runs.
        data: Folder with the datasets, DATA/SCENE, for runs that do not name their dataset.
        dataset: Score only the runs of this dataset: its folder, or its name under DATA.
        format: Format of the tables on stdout.
        out: Folder for index.html and results.json. Default: RUNS/report, with --dataset
            RUNS/report-NAME.
        table: Print only this table, beside the paper's numbers: table1 (extrinsics), table2 (DNR), square (layers or
            network), larger (pictures) or claims, whose runs `model sweep` trains; or errors (by what
            pixels show). May be repeated. With --json, these tables are part of the results.
        json: Print the results as JSON, as in results.json, instead of tables.
    """
    output_format = "json" if json else format
    from datagen.data.paths import find_dataset
    from eval.page.report import make_report, make_tables

    only = None if dataset is None else find_dataset(dataset, data)
    if table:
        make_tables(runs, data, tables=table, output_format=output_format, only=only)
    else:
        place = out or runs / ("report" if only is None else f"report-{only.name}")
        make_report(runs, data, place, output_format=output_format, only=only)


def main() -> None:
    """Entry point of both console scripts."""
    words = sys.argv[1:]
    run("report", report, words[1:] if words[:1] == ["report"] else words)
