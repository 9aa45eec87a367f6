"""The commands of `hyaline-bench`: floors, scores, the leaderboard, and hidden tests; and those of its sweep."""

import sys
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, cast

from datagen.data.dataset import open_dataset
from datagen.data.variants import TWINS
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json, commit_sealed, to_json
from datagen.disk.storage import sha256
from datagen.terminal.command import choose, next_command, run, say, tell
from datagen.terminal.parsing import CommandGroup, group
from hyaline_bench.protocol import Protocol, left_out, load_protocol

BENCH = Path("bench")
Preset = Annotated[str, lambda: load_protocol().presets]
Track = Annotated[str, lambda: load_protocol().tracks]


def main() -> None:
    """Entry point of the console script."""
    run("hyaline-bench", commands(), sys.argv[1:])


def commands() -> CommandGroup:
    """All commands of the program."""
    by_name = {
        "commands": list_all,
        "floors": floors,
        "score": score,
        "leaderboard": leaderboard,
        "secret": secret,
        "hide": hide,
    }
    return group("Score methods on the benchmark, and print the leaderboard.", by_name)


def list_all(*, preset: Preset = "demo", fitted: bool = False) -> None:
    """Print every command of the benchmark on public scenes, for `model sweep - --jobs 2` to run.

    Args:
        preset: Size of the benchmark's datasets.
        fitted: The track of masks instead: light-path on glass that `model fit` finds.
    """
    for line in (list_fitted_commands if fitted else list_commands)(preset, _protocol(preset)):
        tell(line)


def floors(*, preset: Preset = "demo", runs: Path = Path("runs"), data: Path = Path("data")) -> None:
    """Predict with two methods that learn nothing: the mean training picture, and that of the nearest camera.

    Args:
        preset: Size of the benchmark's datasets.
        runs: Folder for the predictions.
        data: Folder with the datasets.
    """
    from hyaline_bench.floors import write_floors

    for folder in write_floors(runs, data, preset, _protocol(preset)):
        tell(str(folder))
    next_command(f"hyaline-bench score --preset {preset}")


def score(
    method: str | None = None,
    /,
    *,
    preset: Preset = "demo",
    track: Track | None = None,
    runs: Path = Path("runs"),
    data: Path = Path("data"),
) -> None:
    """Score a method's predictions of all scenes against the truth, without running any code or network from it.

    The runs are the folders RUNS/SCENE/METHOD, from any method; `eval report` scores the same folders. Scores are
    written to bench/PRESET/scores/METHOD.json, in place of those of earlier predictions.

    Args:
        method: Name of the runs' folders. Default: all methods; incomplete ones are left out.
        preset: Size of the benchmark's datasets.
        track: The method's inputs. Default: from its run.json.
        runs: Folder with the runs.
        data: Folder with the datasets, DATA/SCENE, including their truth.
    """
    from eval.tables.grids import TABLE_WIDTH, grid_text
    from hyaline_bench.leaderboard import scene_grid
    from hyaline_bench.score import find_runs, score_runs

    protocol = _protocol(preset)
    found = find_runs(runs, data, preset, protocol)
    if not found:
        raise HyalineError(
            f"{runs}: has no predictions of the {preset} datasets, other than any left out above; make some with "
            f"`hyaline-bench commands --preset {preset} | model sweep -`"
        )
    names = sorted(found) if method is None else [choose("method", method, found)]
    done = []
    for name in names:
        with left_out() if method is None else nullcontext():
            scored = score_runs(found[name], protocol, preset=preset, track=track)
            path = BENCH / preset / "scores" / f"{name}.json"
            commit_sealed(path, cast(dict[str, Json], to_json(scored)))
            sys.stdout.write(grid_text(scene_grid([scored]), "table", width=TABLE_WIDTH) + "\n")
            say(f"{path}: track {scored.track}, {len(scored.scenes)} scenes")
            done.append(name)
    if not done:
        raise HyalineError(f"{runs}: no method could be scored at {preset}; the lines above say why")
    next_command(f"hyaline-bench leaderboard --preset {preset}")


def leaderboard(scores: Path | None = None, /, *, preset: Preset = "demo") -> None:
    """Print the leaderboard as Markdown: for each track, a table of methods and one of every scene.

    Args:
        scores: Folder of files from `hyaline-bench score`. Default: bench/PRESET/scores.
        preset: Without SCORES: size of the datasets.
    """
    from hyaline_bench.leaderboard import results_page
    from hyaline_bench.score import read_scores

    protocol = _protocol(preset)
    folder = scores or BENCH / preset / "scores"
    found = read_scores(folder)
    if not found:
        raise HyalineError(f"{folder}: has no scores; make them with `hyaline-bench score --preset {preset}`")
    sys.stdout.write(results_page(found, protocol))


def secret(file: Path, /, *, preset: Preset = "demo") -> None:
    """For verifiers: print the commitment of a secret, and the commands that build its hidden scenes.

    Args:
        file: File with the secret; if it is missing, a secret is drawn. Keep it private until the round is over.
        preset: Size of the hidden datasets; tiny has none.
    """
    from hyaline_bench.hidden import hidden_names, read_secret, verifier_commands

    protocol = _protocol(preset)
    hidden_names(preset, protocol)  # Before a secret is drawn.
    text = read_secret(file)
    tell(f"# commitment: {sha256(text.encode())}")
    for line in verifier_commands(text, preset, protocol):
        tell(line)


def hide(dataset: Path, /, *, scene: str, out: Path = Path()) -> None:
    """For verifiers: split a dataset into one to publish, without the truth of its test views, and one for scoring.

    Args:
        dataset: Folder of a dataset with a secret seed.
        scene: Name of the hidden scene, such as hidden-0.
        out: Folder for public/SCENE-PRESET and truth/SCENE-PRESET.
    """
    from hyaline_bench.hidden import hide_truth

    for folder in hide_truth(open_dataset(dataset), scene, out, load_protocol()):
        tell(str(folder))


def _protocol(preset: str) -> Protocol:
    """The protocol, which must have this preset."""
    protocol = load_protocol()
    protocol.size(preset)
    return protocol


# The sweep


SHAPES = ("paper", "paper-best", "dnr", "dnr-layers", "mlp-first", "authors-code", "light-path")
"""The built-in methods that know shapes, and so can predict edits."""
STEPS = {
    "small": dict(zip(SHAPES, (900, 900, 170, 170, 900, 700, 400), strict=True)),
    "tiny": dict.fromkeys(SHAPES, 30),
}
"""Steps of each method where they are not the usual ones. Small: as many as take about 45 CPU seconds. In presets that
are listed here, deepvoxels is left out: it learns nothing in that time."""
UNFITTED = ("vitrine", "prism_bench", "pool")
"""Scenes whose glass `model fit` cannot find: thin panes, colours bent apart, water without a vessel. Random scenes may
hold such shapes, too; a fit takes a quarter of an hour or more."""


def list_commands(preset: str, protocol: Protocol) -> Iterator[str]:
    """Builds every public scene, trains every built-in method, and prints the leaderboard."""
    for scene in protocol.public_scenes(preset):
        data, edits = f"{scene}-{preset}", protocol.scenes.get(scene, ())
        yield from _build(scene, preset, protocol)
        yield from (f"datagen add {data} --edit {edit}" for edit in edits)
        for method in SHAPES:
            yield _train(method, data, preset)
            yield from (f"model predict $run --variant {edit}" for edit in edits)
        if preset not in STEPS:
            yield _train("deepvoxels", data, preset)  # Told pictures and cameras alone.
        yield f"proxies make {data} --kind ellipsoid"
        yield f"{_train('paper', data, preset)} --geometry ellipsoid"  # Told proxies alone.
    yield f"hyaline-bench floors --preset {preset}"
    yield f"hyaline-bench score --preset {preset}"
    yield f"hyaline-bench leaderboard --preset {preset}"


def list_fitted_commands(preset: str, protocol: Protocol) -> Iterator[str]:
    """The track of masks: `light-path` on shapes and materials that `model fit` finds, where it can.

    Everything that is not glass is taken as matt, because the track tells its shape alone.
    """
    for scene in protocol.public_scenes(preset):
        if scene not in UNFITTED:
            yield from _build(scene, preset, protocol)
            yield f"model fit {scene}-{preset} --room matt"
            yield f"{_train('light-path', f'{scene}-{preset}', preset)} --geometry fitted"


def _build(scene: str, preset: str, protocol: Protocol) -> Iterator[str]:
    yield protocol.build_command(scene, preset, f"data/{scene}-{preset} --quiet")
    yield f"datagen add {scene}-{preset} --edit {TWINS[0]}"
    if scene in protocol.scenes:
        yield f"datagen add {scene}-{preset} --angles"


def _train(method: str, data: str, preset: str) -> str:
    steps = STEPS.get(preset, {}).get(method)
    return f"model train {method} {data} --costs" + (f" --steps {steps}" if steps else "")


if __name__ == "__main__":
    main()
