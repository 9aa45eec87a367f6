"""Adds a table of learning curves to a results.json: PSNR of training, held-out and test views by passes over pictures.

report --json > RESULTS.json && python docs/curves.py RESULTS.json RUNS
"""

import json
import sys
from pathlib import Path

from datagen.data.dataset import open_dataset
from eval.tables.grids import Column, Grid, format_number
from eval.tables.results import grid_json
from model.run.run_folder import read_run

PARTS = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1)
"""Parts of a training after which its curves are read."""
TESTS = ("interpolating", "extrapolating")


def main() -> None:
    """See the module."""
    path, runs = Path(sys.argv[1]), Path(sys.argv[2])
    results = json.loads(path.read_text())
    rows: list[tuple[str, ...]] = []
    for scene in results["scenes"]:
        for scored in scene["runs"]:
            found = curve(runs / scene["scene"] / scored["run"], scored["splits"])
            rows += [(scene["scene"], *cells) for cells in found]
    grid = Grid(
        title="Learning curves",
        columns=(
            *(Column(group=group, is_number=False) for group in ("scene", "run")),
            *(Column(group=group) for group in ("pass", "train", "held out")),
            *(Column(group="test", split=split) for split in TESTS),
        ),
        rows=tuple(rows),
        notes=("PSNR in dB, of four training views and of four held-out ones; test views after the last pass.",),
    )
    results["tables"] = {"curves": [grid_json(grid)]}
    path.write_text(json.dumps(results, indent=2, sort_keys=True) + "\n")


def curve(folder: Path, scores: dict[str, dict[str, dict[str, float]]]) -> list[tuple[str, ...]]:
    """The rows of a run."""
    record = read_run(folder)
    size = open_dataset(Path(record.dataset)).config
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    measured = {line["step"]: line for line in lines if "held_out_psnr" in line}
    rows = []
    for part in PARTS:
        step = min(measured, key=lambda step: abs(step - part * record.config.steps))
        passes = step * record.config.batch / (size.train.views * size.resolution.width * size.resolution.height)
        tests = [scores[split]["psnr_db"]["mean"] if part == 1 else None for split in TESTS]
        values = (measured[step]["train_psnr"], measured[step]["held_out_psnr"], *tests)
        cells = (format_number(value, 2) for value in values)
        rows.append((folder.name, format_number(passes, 1), *cells))
    return list(dict.fromkeys(rows))


if __name__ == "__main__":
    main()
