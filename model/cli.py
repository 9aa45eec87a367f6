"""The command line of `model`: each command calls a function of a room, which is imported when it is called."""

import os
import shlex
import sys
from functools import partial
from pathlib import Path

from datagen.builder.choices import FilmChoices
from datagen.data.paths import find_dataset
from datagen.disk.errors import HyalineError
from datagen.terminal.command import next_command, run, say, tell
from datagen.terminal.parsing import CommandGroup, Later, group
from datagen.terminal.plugins import absent_commands, commands_of
from model.methods.protocol import METHODS, about
from model.run.sweep import sweep
from model.run.train_flags import Asked, complete_run, make_command
from model.runtime import choose_device, wait_briefly
from model.settings import RUNS, Device

TRAIN = "Train a method on a dataset, then predict its test splits."


def main() -> None:
    """Entry point of the console script."""
    wait_briefly()
    run("model", commands(), sys.argv[1:])


def commands() -> CommandGroup:
    """All commands of the program."""
    by_name = {
        "train": CommandGroup(about=TRAIN, commands=_methods, word="method", absent=METHODS.absent()),
        "predict": predict,
        "film": film,
        "sweep": sweep,
        "check-method": check_method,
    }
    return group(
        "Train neural renderers on datasets of transparent objects, and render with them.",
        by_name | commands_of("model"),
        absent_commands("model"),
    )


def _methods() -> dict[str, Later]:
    make = partial(make_command, then=_train_method)
    return {name: Later(partial(make, name), partial(about, name)) for name in METHODS.names()}


def _train_method(method: str, asked: Asked) -> None:
    out = complete_run(method, asked)
    _end(out, run=out)


def predict(
    run: Path,
    /,
    *,
    dataset: str | None = None,
    variant: str | None = None,
    device: Device = "auto",
    overwrite: bool = False,
) -> None:
    """Predict all test splits again with a trained run.

    Args:
        dataset: A dataset's folder, or its name under data/. Default: where the run found it.
        variant: Predict a variant of the dataset instead, into the run's variants/NAME: x2 for what `datagen add
            --larger 2` made, or an edit, such as remove:glass_ball.
        overwrite: Predict again even where the predictions are intact.
    """
    from datagen.data.variants import open_variant
    from datagen.disk.ownership import holding
    from datagen.scene.edits import edits_name, parse_edit
    from model.run.run_folder import FOLDER, find_run, is_all_drawn, is_drawn, open_trained, predictions_folder

    run = find_run(run)
    record, opened = open_trained(run, dataset)
    home, name = opened, variant
    if variant is not None and ":" in variant:  # As one types an edit; what cannot be drawn need not be built.
        from model.run.predict import check_draws_edits

        check_draws_edits(record.config)
        name = edits_name(tuple(map(parse_edit, variant.split("+"))))
    if name is not None:
        home = open_variant(opened, name)
    out = predictions_folder(run, home)
    if not overwrite and (is_all_drawn(run, home) if home is opened else is_drawn(run, home)):
        say(f"{out}: its predictions are intact, nothing to do; --overwrite makes them again")
        return _end(out, run=run)
    from model.run.predict import render_predictions, render_variant  # Not before: they need torch.

    with holding(run, FOLDER):
        if home is opened:
            render_predictions(run, record.config, opened, device=choose_device(device))
        else:
            render_variant(run, record.config, opened, home, device=choose_device(device))
    _end(out, run=run)


def film(
    run: Path,
    /,
    *,
    dataset: str | None = None,
    device: Device = "auto",
    choices: FilmChoices = FilmChoices(),  # noqa: B008
) -> None:
    """Render a film with a trained run; `datagen film` path-traces the same film.

    Args:
        dataset: A dataset's folder, or its name under data/. Default: where the run found it.
    """
    from datagen.builder.film import plan_film, write_film
    from model.run.run_folder import find_run, open_trained

    run = find_run(run)
    record, opened = open_trained(run, dataset)
    out = choices.out or Path(f"{opened.name}-{run.name}.webp")
    cameras = plan_film(opened, choices, out)
    say(f"{run}: rendering {out}")
    from model.run.predict import film_pictures

    pictures = film_pictures(run, record.config, opened, cameras, device=choose_device(device))
    write_film(out, pictures, choices.fps)
    tell(str(out))


def check_method(name: str, /, *, dataset: str | None = None) -> None:
    """Check that a method meets the requirements of training and rendering; prints one line per check.

    Args:
        name: A method, built in or from an installed package.
        dataset: A dataset's folder, or its name under data/. Default: a tiny one made for the checks.
    """
    import tempfile

    from datagen.builder.synthetic import write_synthetic_dataset
    from datagen.data.dataset import open_dataset
    from model.run.conformance import check_method as check

    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        given = (
            open_dataset(find_dataset(dataset))
            if dataset
            else write_synthetic_dataset(place / "data", sees_nothing=True)
        )
        failed = check(name, given, place / "runs")
    if failed:
        raise HyalineError(f"method {name}: {failed} checks failed; docs/extending.md says what each asks for")


def _end(out: Path, *, run: Path) -> None:
    tell(str(out))
    root = os.path.normpath(run / ".." / "..")
    next_command("eval report" if root == str(RUNS) else f"eval report {shlex.quote(root)}")
