"""Owns the command line of `model bench`: what is measured, and how the report is printed."""

from datagen.command import run, unwrap_help
from model.bench.choices import BenchChoices

DESCRIPTION = "Measure speed; exit with 1 where a check or a ratio is missed."


def main(arguments: list[str]) -> None:
    """`model bench NAME ...`."""
    unwrap_help(BenchChoices)
    commands = {"ceilings": ceilings, "step": step, "infer": infer, "online": online, "gpu": gpu}
    run("model bench", DESCRIPTION, commands, arguments)


def ceilings(*, json: bool = False) -> None:
    """What this machine does at best: matrix products, copies, gathers, page faults.

    Args:
        json: Print JSON instead of tables.
    """
    from datagen.bench.harness import show
    from model.bench.ceilings import bench_ceilings

    show(bench_ceilings(), as_json=json)


def step(choices: BenchChoices) -> None:
    """A training step on a CPU: whole, its phases, its texture part."""
    from datagen.bench.harness import show
    from model.bench.ceilings import all_ceilings
    from model.bench.step import bench_step

    show(bench_step(choices, ceilings=all_ceilings()), as_json=choices.json)


def infer(choices: BenchChoices) -> None:
    """A frame from stored layers on a CPU."""
    from datagen.bench.harness import show
    from model.bench.ceilings import all_ceilings
    from model.bench.infer import bench_infer

    show(bench_infer(choices, ceilings=all_ceilings()), as_json=choices.json)


def online(choices: BenchChoices) -> None:
    """A frame from meshes and a camera alone, on a CPU."""
    from datagen.bench.harness import show
    from model.bench.ceilings import all_ceilings
    from model.bench.online import bench_online

    show(bench_online(choices, ceilings=all_ceilings()), as_json=choices.json)


def gpu(choices: BenchChoices) -> None:
    """A 1080p frame and a step of 262,144 pixels on a GPU, beside plain torch; skipped without CUDA."""
    from datagen.bench.harness import show
    from model.bench.gpu import bench_gpu

    show(bench_gpu(choices), as_json=choices.json)
