"""The house: how many lines each room has, and may have (house.toml).

`make house` prints the table beside its marks, with what it takes to follow three commands through the code.
`python tests/support/house.py --lower` sets the budgets to today's lines, if these are no more in all.
"""

import argparse
import io
import re
import subprocess
import sys
import tempfile
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
MARKS = {"core": "27,000 in 190 files", "plug-ins": "17,000", "benchmarks": "2,600", "tests": "26,000"}
"""The most lines of each group."""

WALK = """
import sys
root, stop = sys.argv[1:3]
sys.argv = sys.argv[3:]
last, moves, files = None, 0, set()

class Arrived(BaseException): pass

def follow(frame, event, _):
    global last, moves
    code = frame.f_code
    if event == "call" and code.co_filename.startswith(root) and "/.venv/" not in code.co_filename:
        moves, last = moves + (code.co_filename != last), code.co_filename
        if code.co_flags & 1 and code.co_name[0] != "<":  # A function, not the body of a module or a class.
            files.add(last)
        if code.co_qualname == stop:
            raise Arrived

sys.path.insert(0, root)
sys.setprofile(follow)
try:
    module = __import__(sys.argv[0], fromlist=["main"])
    if len(sys.argv) > 1:
        module.main()
except (SystemExit, Arrived):
    pass
sys.setprofile(None)
own = {str(getattr(module, "__file__", "")) for module in list(sys.modules.values())}
own = {name for name in own if name.startswith(root) and "/.venv/" not in name}
print("walk", moves, len(files), len(own), sum(len(open(name).readlines()) for name in own))
"""
"""Runs `module WORDS`; counts its changes from one of the project's files to another, the files whose functions it
enters, and the files it loads with their lines; ends at a function's first call."""


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
    python = read_rooms()["python"].values()
    density = sum(room.density * room.lines for room in python) / sum(room.lines for room in python)
    if density > told["tokens_a_line"]:
        wrong.append(f"{density:.2f} tokens in a line of Python; at most {told['tokens_a_line']}")
    return wrong


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
        sums = sum(room.files for room in chosen), sum(room.lines for room in chosen)
        print(f"{name:32}{sums[0]:7}{sums[1]:8}   at most {MARKS[name]}")
    pages = set(re.findall(r"\]\((docs/[^)#]*)", (ROOT / "RESULTS.md").read_text()))
    print(f"pages that RESULTS.md names: {len(pages)}   at most 8")


def walk(*words: str, stop: str = "") -> list[int]:
    """Changes of file, files whose functions are entered, files loaded and their lines, of `module WORDS`."""
    program = (sys.executable, "-c", WALK, f"{ROOT}/", stop, *words)
    ended = subprocess.run(program, capture_output=True, text=True, check=False)
    (line,) = (line for line in ended.stdout.splitlines() if line.startswith("walk "))
    return [int(word) for word in line.split()[1:]]


def print_walks() -> None:
    """What it takes to follow three commands through the code."""
    _, _, loaded, lines = walk("hyaline")
    print(f"import hyaline: {loaded} modules of ours, {lines} lines   at most 45, 7,000")
    with tempfile.TemporaryDirectory() as folder:
        world = f"{folder}/world"
        moves, *_ = walk("datagen.cli", "build", "glass_table", "--preset", "tiny", "--out", world)
        print(f"a tiny `datagen build`: {moves} changes of file   at most 3,000")
        loss = ("--perceptual", "1", "--vgg-weights", "random", "--out", f"{folder}/run")
        _, entered, *_ = walk("model.cli", "train", "paper", world, *loss, stop="PerceptualLoss.forward")
        print(f"`model train --perceptual` to the first perceptual loss: {entered} files entered   at most 45")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Print the house's rooms beside their budgets.")
    parser.add_argument("--lower", action="store_true", help="lower every budget to today's lines")
    if parser.parse_args().lower:
        lower()
    else:
        print_table()
        print_walks()
