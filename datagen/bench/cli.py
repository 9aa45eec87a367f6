"""Owns the command line of `datagen bench`: what is measured, and how the report is printed."""

from datagen.command import run

DESCRIPTION = "Measures speed: rivals by turns in one process, checked first; exit status 1 when a ratio is missed."


def main(arguments: list[str]) -> None:
    """`datagen bench NAME ...`."""
    run("datagen bench", DESCRIPTION, {"peel": peel}, arguments)


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
    from datagen.bench.peel import ENGINES, bench_peel

    chosen = tuple(name for name in ENGINES if not engines or name in engines)
    for name in engines:
        choose("engine", name, ENGINES)
    show(bench_peel(size=size, num_layers=layers, triangles=triangles, rounds=rounds, engines=chosen), as_json=json)
