"""The commands of the package, called in this process as a person would type them."""

import contextlib
import importlib
import io
import shlex
import sys
from dataclasses import dataclass

MAINS = {
    "datagen": "datagen.cli",
    "proxies": "proxies.cli",
    "model": "model.cli",
    "report": "eval.cli",
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


def run(line: str) -> None:
    """Runs a command line that must succeed."""
    answer = call(line)
    assert answer.status == 0, f"{line}: {answer.err}"
