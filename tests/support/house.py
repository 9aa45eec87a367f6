"""The house: how many lines each room has, and may have (house.toml).

`make house` prints the table.
`python tests/support/house.py --lower` sets the budgets to today's lines, if these are no more in all.
"""

import argparse
import io
import tokenize
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
BUDGETS = ROOT / "house.toml"
CORE = ("datagen", "proxies", "model", "eval", "hyaline")
HOUSE = (*CORE, "plugins", "benchmarks", "tests")
KINDS = {".py": "python", ".js": "web", ".css": "web", ".html": "web", ".glsl": "web"}
SLACK = 0.05
"""The share of a room by which its budget may exceed it."""
LAYOUT = {
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT),
    *(tokenize.ENCODING, tokenize.ENDMARKER),
}
"""Tokens that are not code."""


@dataclass(frozen=True, kw_only=True)
class Room:
    """What a folder holds of one kind of code."""

    files: int
    lines: int
    density: float
    """Tokens in a line of Python code, without comments and docstrings; 0 for other kinds."""


def room_of(path: Path) -> str:
    """The folder, at most two levels deep, that a file counts for; a plug-in's tests are a room of their own."""
    parts = path.relative_to(ROOT).parent.parts
    return "/".join(parts[:3] if parts[2:3] == ("tests",) else parts[:2])


def read_rooms() -> dict[str, dict[str, Room]]:
    """The rooms of the house by kind of code, then by folder."""
    files: dict[tuple[str, str], list[Path]] = defaultdict(list)
    for top in HOUSE:
        for path in sorted((ROOT / top).rglob("*")):
            if path.suffix in KINDS and path.is_file():
                files[KINDS[path.suffix], room_of(path)].append(path)
    rooms: dict[str, dict[str, Room]] = defaultdict(dict)
    for (kind, place), paths in sorted(files.items()):
        lines = sum(len(path.read_text().splitlines()) for path in paths)
        density = 0.0
        if kind == "python":
            counts = [count for path in paths for count in tokens_of_lines(path.read_text())]
            density = sum(counts) / max(len(counts), 1)
        rooms[kind][place] = Room(files=len(paths), lines=lines, density=density)
    return dict(rooms)


def tokens_of_lines(text: str) -> Iterator[int]:
    """How many tokens of code begin on each line that has any; strings that stand alone (docstrings) are left out."""
    counts: dict[int, int] = defaultdict(int)
    before = tokenize.NEWLINE
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        alone = token.type == tokenize.STRING and before in (tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
        if token.type not in LAYOUT and not alone:
            counts[token.start[0]] += 1
        if token.type not in (tokenize.COMMENT, tokenize.NL):
            before = token.type
    yield from counts.values()


def faults() -> list[str]:
    """What in the house is beyond its budget, or has a budget that could be lower."""
    told = tomllib.loads(BUDGETS.read_text())
    wrong = []
    for kind, rooms in read_rooms().items():
        budgets = told[kind]
        for place in sorted(rooms.keys() | {place for place in budgets if (ROOT / place.split("/")[0]).exists()}):
            lines, budget = rooms[place].lines if place in rooms else 0, budgets.get(place, 0)
            if lines > budget:
                wrong.append(f"{place}: {lines} lines of {kind}; its budget is {budget}: what can go?")
            elif budget > lines * (1 + SLACK):
                wrong.append(f"{place}: {lines} of {budget} lines of {kind}; run tests/support/house.py --lower")
    density = average_density(read_rooms()["python"])
    if density > told["tokens_a_line"]:
        wrong.append(f"{density:.2f} tokens in a line of Python; at most {told['tokens_a_line']}")
    return wrong


def average_density(rooms: dict[str, Room]) -> float:
    """Tokens in a line of code of the whole house, its rooms weighted by their lines."""
    return sum(room.density * room.lines for room in rooms.values()) / sum(room.lines for room in rooms.values())


def lower() -> None:
    """Writes today's lines as budgets, so that lines may move between rooms.

    Raises:
        ValueError: there is more code of a kind than its budgets allow together.
    """
    told = tomllib.loads(BUDGETS.read_text())
    text = BUDGETS.read_text().partition("[python]")[0]
    for kind, places in read_rooms().items():
        lines, budget = sum(room.lines for room in places.values()), sum(told[kind].values())
        if lines > budget:
            raise ValueError(f"{kind}: {lines} lines, and {budget} in all budgets together")
        text += f"[{kind}]\n" + "".join(f'"{place}" = {room.lines}\n' for place, room in places.items()) + "\n"
    BUDGETS.write_text(text.rstrip() + "\n")


def print_table() -> None:
    """Every room beside its budget, and the sums."""
    told = tomllib.loads(BUDGETS.read_text())
    rooms = read_rooms()
    for kind, places in rooms.items():
        print(f"{kind:32}{'files':>7}{'lines':>8}{'budget':>8}{'tokens a line':>15}")
        for place, room in places.items():
            density = f"{room.density:15.1f}" if room.density else ""
            print(f"  {place:30}{room.files:7}{room.lines:8}{told[kind].get(place, 0):8}{density}")
    python = rooms["python"]
    groups = {"core": CORE, "plug-ins": ("plugins",), "benchmarks": ("benchmarks",), "tests": ("tests",)}
    for name, tops in groups.items():
        parts = {place: ["tests"] if "tests" in place.split("/") else place.split("/") for place in python}
        chosen = [room for place, room in python.items() if parts[place][0] in tops]
        print(f"{name:32}{sum(room.files for room in chosen):7}{sum(room.lines for room in chosen):8}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Print the house's rooms beside their budgets.")
    parser.add_argument("--lower", action="store_true", help="lower every budget to today's lines")
    if parser.parse_args().lower:
        lower()
    else:
        print_table()
