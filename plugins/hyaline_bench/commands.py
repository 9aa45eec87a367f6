"""The command lines of the benchmark: for `model sweep`, which runs them."""

from collections.abc import Iterator

from hyaline_bench.protocol import Protocol

SHAPES = ("paper", "paper-best", "dnr", "dnr-layers", "mlp-first", "authors-code", "light-path")
"""The built-in methods that know shapes, and so can predict edits."""
STEPS = {
    "small": {
        "paper": 900, "paper-best": 900, "mlp-first": 900, "authors-code": 700, "dnr": 170, "dnr-layers": 170,
        "light-path": 400,
    },
    "tiny": dict.fromkeys(SHAPES, 30),
}  # fmt: skip
"""Steps of each method where they are not the usual ones. Small: as many as take about 45 CPU seconds. In presets that
are listed here, deepvoxels is left out: it learns nothing in that time."""
FITTED = ("glass_table", "plant_shelf", "drinks")
"""Scenes whose glass `model fit` can find, in a quarter of an hour or more. Left out: vitrine has only thin panes,
prism_bench bends colours apart, and pool's water is no vessel's; random scenes may hold shapes that no fit finds."""


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
    for scene in FITTED:
        if scene in protocol.public_scenes(preset):
            yield from _build(scene, preset, protocol)
            yield f"model fit {scene}-{preset} --room matt"
            yield f"{_train('light-path', f'{scene}-{preset}', preset)} --geometry fitted"


def _build(scene: str, preset: str, protocol: Protocol) -> Iterator[str]:
    yield f"datagen build {scene} --preset {preset} --out data/{scene}-{preset} --quiet"
    if scene in protocol.scenes:
        yield f"datagen add {scene}-{preset} --angles"


def _train(method: str, data: str, preset: str) -> str:
    steps = STEPS.get(preset, {}).get(method)
    return f"model train {method} {data} --costs" + (f" --steps {steps}" if steps else "")
