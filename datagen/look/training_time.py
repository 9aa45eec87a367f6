"""How long training takes on this machine, estimated before any training by a short calculation of the same kind."""

import time

import numpy as np

from datagen.machine.mitsuba_variant import num_cores

STEPS = 2500
"""What both methods take unless told otherwise."""
METHODS = {"light-path": 790.0, "paper": 205.0}
"""Processor seconds of so many steps on the demo's glass table, on two cores of a cloud machine in 2026."""
PROBE_S = 0.13
"""Processor seconds that `probe` took on that machine."""
MOST_CORES = 4
"""More were not measured."""


def probe() -> float:
    """Processor seconds for what training mostly does, on one core: multiply and add, and look up random places."""
    rng = np.random.default_rng(0)
    values, weights = rng.random((2, 1 << 17), np.float32)
    texels, places = rng.random((1 << 18, 16), np.float32), rng.integers(0, 1 << 18, 1 << 16)
    started = time.process_time()
    for _ in range(20):
        for _ in range(40):
            np.multiply(values, weights, out=values)
            np.add(values, weights, out=values)
        texels[places].sum(axis=1)
    return time.process_time() - started


def training_time(probe_s: float, cores: int | None = None) -> str:
    """What training takes where `probe` took so long, in words.

    Args:
        cores: of this machine, unless given.
    """
    used = min(num_cores() if cores is None else cores, MOST_CORES)
    minutes = {method: seconds / 60 * probe_s / PROBE_S for method, seconds in METHODS.items()}
    each = " and ".join(f"{method} {_number(value)}" for method, value in minutes.items())
    shared = " and ".join(_number(value / used) for value in minutes.values())
    on = f"; on {used} cores that do nothing else {shared} minutes" if used > 1 else ""
    return f"about {each} processor minutes for {STEPS:,} steps{on} (an estimate, within a factor of two or so)"


def _number(value: float) -> str:
    return f"{value:.0f}" if value >= 2 else f"{value:.1f}"
