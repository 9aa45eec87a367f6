"""Processor seconds of a command, or of its parts, in the version of hyaline that comes first in Python's path.

    python -P versions_child.py REPORT.json first-line MODULE WORD ...   until its first line of output, where it ends
    python -P versions_child.py REPORT.json steps LAST MODULE WORD ...   after each training step; ends after step LAST
    python -P versions_child.py REPORT.json views MODULE WORD ...        the same, and after each drawn test view
    python -P versions_child.py REPORT.json paths DATASET                before the first and after each bundle of paths

Every version that is compared must have the names that are imported here; if not, the command ends with a traceback.
"""

import json
import os
import resource
import runpy
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

PIXELS = 2048
RAYS = 4 * PIXELS
"""Rays in a bundle of light paths."""
BUNDLES = 9
"""Bundles of paths; kernels are recorded in the first ones."""


def main(report: Path, kind: str, words: list[str]) -> None:
    match kind:
        case "first-line":
            reader = end_at_first_line(report)
            try:
                run_command(words)
            finally:
                reader.join(timeout=10)  # It ends the process.
            sys.exit(f"{' '.join(words)}: printed nothing")
        case "steps":
            stamps = watch(report, last_step=int(words[0]))
            run_command(words[1:])
        case "views":
            stamps = watch(report)
            run_command(words)
        case _:
            stamps = {"paths": trace_bundles(words[0])}
    report.write_text(json.dumps(stamps))


def spent() -> float:
    """Processor seconds of all threads, and of children that have ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


def run_command(words: list[str]) -> None:
    """Runs `python -m WORDS` in this process."""
    sys.argv = words
    try:
        runpy.run_module(words[0], run_name="__main__", alter_sys=True)
    except SystemExit as end:
        if end.code:
            raise


def end_at_first_line(report: Path) -> threading.Thread:
    """A thread that ends the process with a report when it prints something."""
    source, sink = os.pipe()
    errors = os.dup(2)
    os.dup2(sink, 1)
    os.dup2(sink, 2)

    def wait() -> None:
        line = os.read(source, 1 << 16)
        has_failed = line.startswith((b"Traceback", b"error"))
        if has_failed:
            os.write(errors, line)
        else:
            report.write_text(json.dumps({"first line": [spent()]}))
        os._exit(has_failed)

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    return thread


def watch(report: Path, *, last_step: int = 0) -> dict[str, list[float]]:
    """Notes when training steps and predictions end, from now on.

    Args:
        last_step: the process ends after this one, with a report; 0: it goes on.
    """
    from model.run import predict, train

    stamps: dict[str, list[float]] = {"steps": [], "views": []}

    def noting(call: Callable[..., Any], name: str, last: int = 0) -> Callable[..., Any]:
        def noted(*args: Any, **more: Any) -> Any:
            found = call(*args, **more)
            stamps[name].append(spent())
            if last and len(stamps[name]) == last:
                report.write_text(json.dumps(stamps))
                os._exit(0)
            return found

        return noted

    train.take_step = noting(train.take_step, "steps", last_step)
    predict.predict_pixels = noting(predict.predict_pixels, "views")
    return stamps


def trace_bundles(dataset: str) -> list[float]:
    """Takes training batches of light paths from a dataset."""
    import numpy as np
    import torch

    from datagen.data.dataset import open_dataset
    from model.methods.light_path.config import default_light_path
    from model.methods.light_path.pixels import load_light_path_pixels

    opened = open_dataset(Path(dataset))
    config = default_light_path((2,) * len(opened.objects), is_proxy=False)
    pixels = load_light_path_pixels(config, opened, "truth", "train", range(opened.config.train.views), False)
    rng = np.random.default_rng(0)
    stamps = [spent()]
    for _ in range(BUNDLES):
        pixels.take(torch.from_numpy(rng.integers(len(pixels.rgb), size=PIXELS)), rng)
        stamps.append(spent())
    return stamps


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3:])
