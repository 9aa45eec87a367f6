"""Distributions of somebody else: a module and its entry points, as an installer leaves them on the path."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]


def install(place: Path, group: str, name: str, value: str, source: str) -> None:
    """A distribution with one entry point of a group, and the module that it refers to."""
    module = value.partition(":")[0]
    metadata = place / f"{module}-1.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module.replace('_', '-')}\nVersion: 1\n")
    (metadata / "entry_points.txt").write_text(f"[{group}]\n{name} = {value}\n")
    (place / f"{module}.py").write_text(source)


def guide_to(part: str) -> str:
    """The section of docs/extending.md about a part."""
    text = (ROOT / "docs" / "extending.md").read_text()
    return text.partition(f"\n## {part}\n")[2].partition("\n## ")[0]


def install_from_guide(place: Path, part: str) -> list[str]:
    """The examples of a section: each module with the entry point below it; the modules' names."""
    examples = re.findall(r"```python\n(.*?)```\s*```toml\n(.*?)```", guide_to(part), flags=re.DOTALL)
    modules = []
    for source, points in examples:
        ((group, entries),) = tomllib.loads(points)["project"]["entry-points"].items()
        ((name, value),) = entries.items()
        install(place, group, name, value, source)
        modules.append(value.partition(":")[0])
    return modules
