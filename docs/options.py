"""The help of every command as one page of the site."""

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

PROGRAMS = ("datagen", "proxies", "model", "report", "hyaline-bench")


def every_option() -> str:
    """The Markdown of all help, made by the commands themselves."""
    parts = [f"## {line}\n\n```\n{text}\n```" for program in PROGRAMS for line, text in _pages(program)]
    return "\n\n".join(["# Every option", "What `--help` says of each command.", *parts])


def _pages(line: str) -> Iterator[tuple[str, str]]:
    """A command and those below it, each with its help."""
    program, *words = line.split()
    command = [Path(sys.executable).with_name(program), *words, "--help"]
    text = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.strip()
    yield line, text
    if text.endswith("describes each."):
        for name in re.findall(r"^  (\S+)", text, flags=re.MULTILINE):
            yield from _pages(f"{line} {name}")
