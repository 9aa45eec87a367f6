"""Which dataset a file lies in, and the command that makes it whole again."""

import shlex
from pathlib import Path

HEADS = "heads"
"""The folder of a dataset with the second copies of its heads."""


def home_of(root: Path) -> Path:
    """The dataset's folder that keeps the copies: for a variant, that of the dataset around it."""
    outer = root.parent.parent
    is_inner = root.parent.name == "variants"
    return (
        outer if is_inner and any((outer / path).is_file() for path in ("dataset.json", "heads/dataset.json")) else root
    )


def mend_command(path: Path) -> str:
    """What makes a lost or damaged file of a dataset again, as one types it."""
    return f"datagen mend {shlex.quote(str(_around(path) or path.parent))}"


def way_out(path: Path) -> str:
    """What to do about a damaged or lost file, of a dataset or not."""
    home = _around(path)
    if home is None:
        return "restore it, or make it again"
    return f"`datagen verify {shlex.quote(str(home))}` names what makes it again"


def _around(path: Path) -> Path | None:
    """The dataset's folder in which a file lies, or would lie; None where there is none."""
    heads = ("dataset.json", f"{HEADS}/dataset.json")
    inner = next((folder for folder in path.parents if any((folder / head).is_file() for head in heads)), None)
    return None if inner is None else home_of(inner)
