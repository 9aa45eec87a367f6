"""The command `model`: parse, make a configuration, call one function."""

import functools
import inspect
import os
import shlex
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from datagen.build.film import FilmChoices
from datagen.data.dataset import open_dataset
from datagen.data.paths import find_dataset
from datagen.disk.errors import HyalineError, UsageError
from datagen.terminal.command import choose, mute, next_command, run, run_parsed, say, tell, unwrap_help
from model.settings.run_flags import RUNS, Device
from model.settings.runtime import choose_device, wait_briefly

DESCRIPTION = "Train neural renderers on datasets of transparent objects, and render with them."


def train() -> None:
    """Train a method on a dataset, then render its test splits.

    `torchrun --nproc-per-node N -m model train METHOD ...` trains on N GPUs (or CPU processes): each draws its own
    share of every batch, and gradients are averaged. DeepVoxels and discriminators cannot be trained so.
    """


def train_method(words: list[str]) -> None:
    """Run `model train WORDS`: the first word names the method, the others are its flags."""
    from model.methods.table import METHODS, about

    methods = METHODS.names()
    if not words or words[0].startswith("-"):
        if not {"-h", "--help"} & set(words):
            raise UsageError(f"model train: names no method; expected one of {', '.join(methods)} as the next word")
        run("model train", inspect.getdoc(train) or "", {name: _listed(about(name)) for name in methods}, ["--help"])
    method = choose("method", words[0], methods)

    from model.run.logs import LogChoices, Meter, require_tensorboard
    from model.run.train_flags import configure, folder_name, parse_train

    asked = parse_train(method, words[1:])
    if asked.run.tensorboard:
        require_tensorboard()
    if int(os.environ.get("RANK", "0")) > 0:
        mute()
    if asked.run.device != "cpu":
        from model.batches.distributed import see_own_gpu

        see_own_gpu()
    config, opened = configure(method, asked)
    out = asked.run.out or RUNS / opened.name / folder_name(method, asked)
    from model.run.complete import complete_run  # Not before: it imports torch, and `configure` says that it loads.

    is_first = complete_run(
        config,
        opened,
        out,
        label=asked.run.name or out.name,
        device=choose_device(asked.run.device),
        anew=asked.run.overwrite,
        memory=asked.run.memory,
        logs=LogChoices(
            snapshots=asked.run.snapshots == "on",
            tensorboard=asked.run.tensorboard,
            costs=Meter() if asked.run.costs else None,
            preview=asked.run.preview,
        ),
    )
    if is_first:
        _end(out, run=out)


def _listed(line: str) -> Callable[..., None]:
    """A subcommand that help lists, and that nothing calls."""

    def method() -> None: ...

    method.__doc__ = line
    return method


def render(
    *,
    run: Path,
    dataset: str | None = None,
    variant: str | None = None,
    path: str | None = None,
    film: FilmChoices = FilmChoices(),  # noqa: B008
    device: Device = "auto",
    overwrite: bool = False,
) -> None:
    """Render all test splits again from a run's weights; or, with --path, a film.

    Args:
        run: Folder of a trained run.
        dataset: Dataset folder, or its name under data/. Default: where the run found it.
        variant: Render a variant of the dataset instead, into the run's variants/NAME: x2 for what `datagen build
            --super-resolution 2` has made, or what `--edit` was given, such as remove:glass_ball.
        path: Draw a film instead, along orbit, spline (through the interpolating test views), or a JSON file of key
            frames as NeRF tools write cameras. `datagen render` path-traces the same film.
        film: Format and length of the film.
        device: Where to compute; auto takes a GPU where there is one.
        overwrite: Render again even where the predictions are intact, and replace a film that stands there.
    """
    if path is not None:
        if variant is not None:
            raise UsageError("--path: does not go with --variant; a film shows the dataset's own scene")
        _render_film(run, dataset, path, film, device=device, overwrite=overwrite)
        return
    if film != FilmChoices():
        raise UsageError("--video, --frames, --fps, --width, --height: go with --path, such as --path orbit")
    from datagen.data.variants import open_variant, variant_root
    from datagen.disk.ownership import holding
    from datagen.scene.edits import edits_name, parse_edit
    from model.run.predict import (
        check_can_draw,
        check_draws_edits,
        is_all_drawn,
        is_drawn,
        render_predictions,
        render_variant,
    )
    from model.run.run_folder import FOLDER, open_trained

    record, opened = open_trained(run, dataset)
    config, out = record.config, run
    if variant is None:
        is_done, draw = is_all_drawn(run, opened), functools.partial(render_predictions, run, config, opened)
    else:
        name = variant
        if ":" in variant:  # As one types an edit; what cannot be drawn need not be built.
            name = edits_name(tuple(map(parse_edit, variant.split("+"))))
            check_draws_edits(config)
        chosen, out = open_variant(opened, name), variant_root(run, name)
        check_can_draw(config, opened, chosen)
        is_done, draw = is_drawn(run, chosen), functools.partial(render_variant, run, config, opened, chosen)
    if is_done and not overwrite:
        say(f"{out}: its predictions are intact, nothing to do; --overwrite renders them again")
    else:
        with holding(run, FOLDER):
            draw(device=choose_device(device))
    _end(out, run=run)


def export(
    *,
    run: Path,
    out: Path = Path("scene.html"),
    quality: Literal["small", "exact"] = "small",
    truths: Literal["all", "test", "none"] = "all",
    dataset: str | None = None,
    overwrite: bool = False,
) -> None:
    """Write a trained scene as one HTML file, which draws it live in a browser, from disk and without a server.

    Args:
        run: Folder of a trained run, of light-path, paper, mlp-first or another method that brings a web page.
        out: The page; a file that stands there is kept.
        quality: small keeps numbers in few bits; exact keeps each as it is, in about five times the bytes.
        truths: Which views' pictures by the path tracer the page can fade over its own: those of test and training
            views, of test views alone, or none.
        dataset: Dataset folder, or its name under data/. Default: where the run found it.
        overwrite: Replace a file that stands at --out.
    """
    from datagen.disk.ownership import DATASET, refuse_file, refuse_owned
    from model.run.run_folder import FOLDER, OWN_ENDINGS, open_trained
    from model.web.export import export_run

    if not overwrite:
        refuse_file(out)
    refuse_owned(out, DATASET)
    refuse_owned(out, FOLDER, endings=OWN_ENDINGS)
    record, opened = open_trained(run, dataset)
    export_run(run, record, opened, out, quality, truths)
    tell(str(out))


def view(what: str, /, *, host: str = "127.0.0.1", port: int = 8080, device: Device = "auto") -> None:
    """Look at a dataset or a run in a browser, while it trains too: cameras, meshes, proxies, layers, predictions.

    Args:
        what: A run, trained or still training, or a dataset: a folder, a name under runs/ (SCENE/NAME), or one under
            data/.
        host: Address to listen at. The default answers browsers on this machine alone; with 0.0.0.0, whoever can reach
            the machine sees what you see.
        port: Port to listen at; 0 takes any that is free.
        device: Where to compute; auto takes a GPU where there is one.
    """
    from datagen.terminal.signals import Stopped
    from model.view.view import show

    if not 0 <= port <= 65535:
        raise UsageError(f"--port: is {port}; expected 0 to 65535")
    try:
        show(what, host=host, port=port, device=device)
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)
    except Stopped as stopped:  # Ctrl-C is how one leaves it: nothing was interrupted.
        sys.exit(stopped.status)


def _render_film(
    run: Path, dataset: str | None, path: str, film: FilmChoices, *, device: Device, overwrite: bool
) -> None:
    from datagen.build.film import plan_film
    from datagen.data.film import write_film
    from datagen.disk.ownership import refuse_owned
    from model.run.run_folder import FOLDER, OWN_ENDINGS, open_trained

    record, opened = open_trained(run, dataset)
    out = film.video or Path(f"{opened.name}-{run.name}.webp")
    refuse_owned(out, FOLDER, endings=OWN_ENDINGS)
    cameras = plan_film(opened, path, film, out, overwrite=overwrite)
    from model.run.predict import film_pictures

    pictures = film_pictures(run, record.config, opened, cameras, device=choose_device(device))
    write_film(out, pictures, film.fps, frames=len(cameras))
    tell(str(out))


def sweep(
    experiment: str,
    /,
    *,
    dataset: tuple[str, ...] = (),
    seed: tuple[int, ...] = (),
    jobs: int = 1,
    dry_run: bool = False,
) -> None:
    """Train all runs of an experiment file, one process per GPU (or one on the CPU); finished runs are skipped.

    Args:
        experiment: A TOML file (format: model/run/sweep.py), or one of table1, table2, square, zero-layer, claims,
            headline, proxies, ablation, variants, budget and random.
        dataset: Datasets to train on, instead of the file's.
        seed: Seeds to train with, instead of the file's.
        jobs: Parallel processes: on the CPU, which divide its cores equally, or on each GPU. On a CPU, as many as
            memory allows (4 GB each) finish the most runs per hour; a run's numbers then differ by rounding.
        dry_run: Print the command of each run and exit.
    """
    from model.run.sweep import command_line, find_devices, raise_failures, read_experiment, run_experiment

    asked = read_experiment(experiment, datasets=dataset, seeds=seed)
    if dry_run:
        for arguments in asked.runs:
            tell(command_line(arguments))
        return
    raise_failures(asked, run_experiment(asked, devices=find_devices(jobs)))
    next_command("eval report")


def check_method(name: str, /, *, dataset: str | None = None) -> None:
    """Check that a method meets the requirements of training and rendering; prints one line per check.

    Args:
        name: A method, built in or brought by another distribution.
        dataset: Dataset folder, or its name under data/. Default: a tiny one made for the checks.
    """
    import tempfile

    from datagen.build.synthetic import write_synthetic_dataset
    from model.run.conformance import check_method as check

    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        given = (
            open_dataset(find_dataset(dataset))
            if dataset
            else write_synthetic_dataset(place / "data", sees_nothing=True)
        )
        failed = 0
        for verdict in check(name, given, place / "runs"):
            word = "FAIL" if verdict.problem else "skip" if verdict.skipped else "ok"
            why = verdict.problem or verdict.skipped
            tell(f"{word:<5} {verdict.name}" + (f": {why}" if why else ""))
            failed += bool(verdict.problem)
    if failed:
        raise HyalineError(f"method {name}: {failed} checks failed; docs/adding-a-method.md says what each asks for")


def main() -> None:
    unwrap_help(FilmChoices)
    wait_briefly()
    words = sys.argv[1:]
    if words[:1] == ["train"]:
        run_parsed(lambda: train_method(_method_first(words[1:])), words)
    else:
        run(
            "model",
            DESCRIPTION,
            {
                "train": train,
                "render": render,
                "export": export,
                "view": view,
                "sweep": sweep,
                "check-method": check_method,
            },
            words,
        )


def _method_first(words: list[str]) -> list[str]:
    """`--method NAME` anywhere means the same as NAME as the first word."""
    for place, word in enumerate(words):
        if word == "--method":
            return [*words[place + 1 : place + 2], *words[:place], *words[place + 2 :]]
        if word.startswith("--method="):
            return [word.removeprefix("--method="), *words[:place], *words[place + 1 :]]
    return words


def _end(out: Path, *, run: Path) -> None:
    tell(str(out))
    root = os.path.normpath(run / ".." / "..")
    next_command("eval report" if root == str(RUNS) else f"eval report --runs {shlex.quote(root)}")
