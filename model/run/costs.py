"""What a training took: time, work of the processor, memory; for people to read.

RUN/costs.json   when `model train` ends or is stopped: sums over its sessions, and the most memory of any of them

Written with --costs alone: two equal trainings take different times, and leave equal bytes otherwise. The file has no
hash, and no command relies on it. Sessions that were killed are not in it.
"""

import json
import resource
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from datagen.disk.errors import HyalineError
from datagen.disk.records import from_json, parse_json, read_regular
from datagen.disk.storage import commit

COSTS = "costs.json"
MAX_BYTES = 1 << 16


def _cpu_seconds() -> float:
    """Of this process and of the children that have ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


@dataclass(frozen=True, kw_only=True)
class Meter:
    """What clocks showed when a session began."""

    seconds: float = field(default_factory=time.monotonic)
    cpu_seconds: float = field(default_factory=_cpu_seconds)

    def add_to(self, run: Path) -> None:
        """Adds the session that ends now to those of the run before it."""
        import torch  # Only here: whoever scores pictures reads this file without it.

        before = read_costs(run)
        spent = {
            "seconds": before.get("seconds", 0.0) + time.monotonic() - self.seconds,
            "cpu_seconds": before.get("cpu_seconds", 0.0) + _cpu_seconds() - self.cpu_seconds,
            "peak_memory_bytes": max(before.get("peak_memory_bytes", 0.0), _peak_memory()),
        }
        if torch.cuda.is_initialized():
            most = float(torch.cuda.max_memory_allocated())
            spent["peak_gpu_memory_bytes"] = max(before.get("peak_gpu_memory_bytes", 0.0), most)
        rounded = {name: round(value, 2) if "seconds" in name else int(value) for name, value in spent.items()}
        commit(run / COSTS, (json.dumps(rounded, indent=2) + "\n").encode())


def _peak_memory() -> float:
    """The most that this process ever had in memory, in bytes."""
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return float(most if sys.platform == "darwin" else 1024 * most)


def read_costs(run: Path) -> dict[str, float]:
    """What the sessions of a run took; nothing where no file says so that can be read."""
    path = run / COSTS
    try:
        found = parse_json(read_regular(path, at_most=MAX_BYTES), where=str(path)) if path.is_file() else {}
        return from_json(dict[str, float], found, where=str(path))
    except HyalineError:
        return {}
