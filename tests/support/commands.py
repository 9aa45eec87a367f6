"""The commands of the package, called in this process as a person would type them."""

import contextlib
import functools
import importlib
import inspect
import io
import re
import shlex
import sys
from dataclasses import dataclass

from datagen.terminal.parsing import parse

MAINS = {
    "datagen": "datagen.cli",
    "proxies": "proxies.cli",
    "model": "model.cli",
    "report": "eval.cli",
    "hyaline": "hyaline.cli",
    "hyaline-bench": "hyaline_bench.cli",  # A plug-in.
    "benchmarks": "benchmarks.cli",
}


@dataclass(frozen=True, kw_only=True)
class Answer:
    """How a command ended."""

    status: int
    out: str
    err: str

    @property
    def error(self) -> str:
        """The last line that it said."""
        return (self.err.strip().splitlines() or [""])[-1]


def call(line: str) -> Answer:
    """Runs a command line, such as `datagen verify data/one`, to its end."""
    words = shlex.split(line)
    main = importlib.import_module(MAINS["report" if words[0] == "eval" else words[0]]).main
    before, sys.argv = sys.argv, words
    out, err = io.StringIO(), io.StringIO()
    status = 0
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main()
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    finally:
        sys.argv = before
    return Answer(status=status, out=out.getvalue(), err=err.getvalue())


def parsed(line: str) -> dict[str, object]:
    """What a command line would call its function with, by the names of its parameters; nothing is run.

    Raises:
        UsageError: the line is not one of ours.
    """
    program, *words = shlex.split(re.sub("^(eval|python -m) ", "", line.replace(" --quiet", "")))
    module = importlib.import_module(MAINS[program])
    asked = parse(program, module.report if program == "report" else module.commands(), words)
    assert isinstance(asked, functools.partial)
    return dict(zip(inspect.signature(asked.func).parameters, asked.args)) | asked.keywords


def run(line: str) -> None:
    """Runs a command line that must succeed."""
    answer = call(line)
    assert answer.status == 0, f"{line}: {answer.err}"
