"""Owns the command line of `datagen bench`: what is measured, and how the report is printed."""

from pathlib import Path
from typing import Literal

from datagen.command import run

DESCRIPTION = "Measures speed: rivals by turns in one process, checked first; exit status 1 when a ratio is missed."


def main(arguments: list[str]) -> None:
    """`datagen bench NAME ...`."""
    run("datagen bench", DESCRIPTION, {"peel": peel, "truth": truth, "scale": scale}, arguments)


def peel(
    size: int = 512,
    layers: int = 6,
    triangles: float = 1.0,
    rounds: int = 7,
    engines: tuple[str, ...] = (),
    json: bool = False,
) -> None:
    """Peeling a view: the tracer and the rasteriser against a plain loop, all hits by Embree, and stored layers.

    Args:
        size: Width and height in pixels.
        layers: Layers kept per ray.
        triangles: A factor on the 315,000 triangles of the scene.
        rounds: Turns of each engine.
        engines: Only these of mitsuba-eager, mitsuba-fused, raster, trimesh, exr, light-path-loop, light-path.
        json: Print JSON instead of tables.
    """
    from datagen.command import choose
    from datagen.variant import use_mitsuba

    use_mitsuba()
    from datagen.bench.harness import show
    from datagen.bench.peel import ENGINES, Engine, bench_peel

    chosen: tuple[Engine, ...] = tuple(name for name in ENGINES if not engines or name in engines)
    for name in engines:
        choose("engine", name, ENGINES)
    show(bench_peel(size=size, num_layers=layers, triangles=triangles, rounds=rounds, engines=chosen), as_json=json)


def truth(
    scene: str = "glass_table",
    light: Literal["soft", "scene"] = "soft",
    size: int = 128,
    rounds: int = 7,
    json: bool = False,
) -> None:
    """Rendering until noise allows 45 dB: the sampling of `datagen build` against Mitsuba's defaults.

    Args:
        scene: A name that `datagen scenes` lists, or a folder with a scene.json; its glass is made clear.
        light: An even sky, or the scene's own lights.
        size: Width and height in pixels.
        rounds: Turns of each.
        json: Print JSON instead of tables.
    """
    from datagen.variant import use_mitsuba

    use_mitsuba()
    from datagen.bench.harness import show
    from datagen.bench.truth import bench_truth, under_soft_light
    from datagen.cameras import make_cameras
    from datagen.dataset import DatasetConfig, SplitConfig
    from datagen.scenes import find_scene

    description = find_scene(scene)
    if light == "soft":
        description = under_soft_light(description)
    split = SplitConfig(views=4, spp=4)
    config = DatasetConfig(scene=description.name, preset="bench", resolution=size, train=split, interpolating=split,
                           extrapolating=split)  # fmt: skip
    cameras = make_cameras(description.cameras, config)["train"]
    show(bench_truth(description, cameras, rounds=rounds), as_json=json)


def scale(
    factors: tuple[float, ...] = (1, 2, 4, 8),
    quantities: tuple[str, ...] = (),
    out: Path = Path("bench-scale.png"),
    rounds: int = 3,
    json: bool = False,
    overwrite: bool = False,
) -> None:
    """How time and memory grow with resolution, layers, objects and triangles: a power law each, and a figure.

    Args:
        factors: Each quantity is multiplied by these, the others staying as they are.
        quantities: Only these of pixels, layers, objects, triangles.
        out: The figure, a PNG; a file that stands there is kept.
        rounds: Turns of each engine at each size.
        json: Print JSON instead of a table.
        overwrite: Replace a file that stands at --out.
    """
    from datagen.command import choose
    from datagen.ownership import refuse_file

    if not overwrite:
        refuse_file(out)
    from datagen.variant import use_mitsuba

    use_mitsuba()
    from datagen.bench.scale import QUANTITIES, Quantity, bench_scale, show_scale

    for name in quantities:
        choose("quantity", name, QUANTITIES)
    chosen: tuple[Quantity, ...] = tuple(name for name in QUANTITIES if not quantities or name in quantities)
    show_scale(bench_scale(factors, chosen, rounds=rounds), out, as_json=json)
