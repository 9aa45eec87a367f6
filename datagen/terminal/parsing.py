"""From the words of a command line to a call of the command's function, by tyro: flags, help, errors, completion.

A function's parameters are its flags, and so are the fields of records among them; those before a `/` are words, which
may also be given as flags by their names. A list is a flag that may be repeated, a switch is `--x` or `--no-x`. Help
comes from docstrings. tyro is imported only once a command is chosen, so that lists of commands are printed at once.
"""

import contextlib
import dataclasses
import difflib
import functools
import inspect
import io
import re
import sys
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, NamedTuple, get_args, get_origin

from datagen.disk.errors import HyalineError, UsageError

Command = Callable[..., None]

HELP = ("-h", "--help")
COMPLETION = "--print-completion"
SHELLS = ("bash", "zsh", "fish")
HELP_WIDTH = 80
MAIN = "choices"
"""The parameter whose record's flags help lists among the command's own; any other makes a group of its name."""

REASONS = {
    r"Error parsing (\S+): .*invalid literal for int\(\) with base 10: (.*)": r"\1: is \2; expected a whole number",
    r"Error parsing (\S+): .*could not convert string to float: (.*)": r"\1: is \2; expected a number",
    r"Missing value for argument '(\S+)'.*": r"\1: needs a value",
    r".*(?:required|Missing from).*?: (\S+).*": r"\1 is missing",
}
"""What tyro 1.0 says about words that it rejects, and how we say it; anything else is passed on."""


@dataclass(frozen=True, kw_only=True)
class CommandGroup:
    """Commands that share their first words, such as those of a program."""

    about: str
    names: Callable[[], Sequence[str]]
    line: Callable[[str], str]
    """Describes a command in one line."""
    choose: Callable[[str, Sequence[str]], "Command | CommandGroup"]
    """Finds a command by its name, and the words that follow."""
    word: str = "command"
    """What its names are called in messages."""
    moved: Mapping[str, str] = field(default_factory=dict)
    """What replaces the commands and flags of earlier versions, by their words, such as `datagen build --edit`."""


def group(about: str, commands: Mapping[str, Command | CommandGroup], moved: Mapping[str, str]) -> CommandGroup:
    """The commands of a program."""

    def line(name: str) -> str:
        command = commands[name]
        text = command.about if isinstance(command, CommandGroup) else inspect.getdoc(command) or ""
        return text.partition("\n\n")[0]

    return CommandGroup(
        about=about, names=lambda: list(commands), line=line, choose=lambda name, _: commands[name], moved=moved
    )


def parse(program: str, command: Command | CommandGroup, words: Sequence[str]) -> Callable[[], None]:
    """The call that words ask for.

    Raises:
        UsageError: no such command or flag, or a value that a flag does not take.
        SystemExit: help or completion was asked for (status 0), or no command was given (2); it has been printed.
    """
    if list(words[:1]) == [COMPLETION]:
        _print_completion(program, command, words[1:])
    moved: Mapping[str, str] = {}
    while isinstance(command, CommandGroup):
        moved = {**moved, **command.moved}
        if not words or words[0] in HELP:
            print(_list_commands(program, command))
            sys.exit(0 if words else 2)
        name, *words = words
        if name not in command.names():
            raise _unknown(program, command.word, name, command.names(), moved)
        program, command = f"{program} {name}", command.choose(name, words)
    given = collect(program, command, words, moved)
    return functools.partial(command, *given.args, **given.kwargs)


class Given(NamedTuple):
    """The arguments for a command's function."""

    args: tuple[Any, ...]
    kwargs: dict[str, Any]


def collect(program: str, command: Command, words: Sequence[str], moved: Mapping[str, str] | None = None) -> Given:
    """The arguments that words give to a command's function; raises what `parse` does."""
    import tyro

    describe(command)

    @functools.wraps(command)
    def given(*args: Any, **kwargs: Any) -> Given:
        return Given(args, kwargs)

    shown, refused = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(shown), contextlib.redirect_stderr(refused):
            words = _words_first(command, words)
            found, unknown = tyro.cli(
                given,
                prog=program,
                description=(inspect.getdoc(command) or "").partition("\n\nArgs:")[0],
                args=words,
                config=_config(),
                return_unknown_args=True,
            )
    except HyalineError as error:
        raise _with_flag(error, command) from None
    except SystemExit as end:
        if not end.code:
            # A record within a record makes a group of a dotted name.
            text = re.sub(r"^ \w+\.(\w+ options)", r" \1", shown.getvalue().rstrip(), flags=re.MULTILINE)
            print("\n".join(map(_wrapped, text.splitlines())))
            raise
        # tyro may take a mistyped flag for a value.
        _check_flags(program, command, words, moved or {})
        raise UsageError(f"{program}: {_reason(refused.getvalue())}. {_see(program)}") from None
    if unknown:
        _check_flags(program, command, unknown, moved or {})
        raise UsageError(f"{program}: {unknown[0]!r} is one word too many. {_see(program)}")
    return found


def _with_flag(error: HyalineError, command: Command) -> HyalineError:
    """Replaces a field's name at the start of a record's error by its flag."""
    name, colon, rest = str(error).partition(": ")
    flag = next((flag for flag, field in flags_of(command).items() if colon and field == name), None)
    return error if flag is None else type(error)(f"--{flag}: {rest}")


def _check_flags(program: str, command: Command, words: Sequence[str], moved: Mapping[str, str]) -> None:
    """Raises a UsageError for the first word that looks like a flag and is none."""
    words_by_flag = [name for name, _, about in _items(command) if about["is_positional"]]
    flags = [f"--{flag}" for flag in (*flags_of(command), *words_by_flag)]
    known = {*flags, *(f"--no-{flag[2:]}" for flag in flags), *HELP}
    for word in words:
        name = word.partition("=")[0]
        if re.fullmatch(r"--?[A-Za-z].*", name) and name not in known:
            raise _unknown(program, "flag", name, flags, moved)


def _words_first(command: Command, words: Sequence[str]) -> list[str]:
    """The words with positional ones first: `--scene X` becomes X if the command takes a word `scene`."""
    first: dict[str, str] = {}
    flags = {f"--{name}" for name, _, about in _items(command) if about["is_positional"]}
    rest, left = [], list(words)
    while left:
        flag, equals, value = left.pop(0).partition("=")
        if flag in flags and (equals or left):
            first[flag] = value if equals else left.pop(0)
        else:
            rest.append(flag + equals + value)
    return [*first.values(), *rest]


def flags_of(documented: type | Command) -> dict[str, str]:
    """The field or parameter behind each flag, those of records in it included; flags without dashes in front."""
    flags: dict[str, str] = {}
    for name, kind, about in _items(documented):
        if dataclasses.is_dataclass(kind):
            flags |= flags_of(kind)  # pyright: ignore[reportArgumentType]
        elif not about.get("is_hidden") and not about.get("is_positional"):
            flags[about.get("flag") or name.replace("_", "-")] = name
    return flags


def flag_words(record: object, usual: object) -> list[str]:
    """The words on a command line that ask for a record: a flag for each field of `usual` that differs from it."""
    words: list[str] = []
    for item in dataclasses.fields(usual):  # pyright: ignore[reportArgumentType]
        value, expected = getattr(record, item.name), getattr(usual, item.name)
        if dataclasses.is_dataclass(expected):
            words += flag_words(value, expected)
        elif value != expected and not item.metadata.get("is_hidden"):
            flag = item.metadata.get("flag") or item.name.replace("_", "-")
            if isinstance(value, bool):
                words.append(f"--{flag}" if value else f"--no-{flag}")
            else:
                for one in value if isinstance(value, tuple) else (value,):
                    words += [f"--{flag}", str(one)]
    return words


@functools.cache
def describe(documented: type | Command) -> None:
    """Annotates a function's parameters, or a record's fields, with what tyro shows and reads.

    A field's metadata may name its `flag`, or say that it `is_hidden`: no flag. Texts flow: tyro 1.0.17 would keep a
    docstring's line breaks.
    """
    import docstring_parser
    import tyro

    parts = _bases(documented) if isinstance(documented, type) else [documented]
    texts = {
        item.arg_name: item.description for part in parts for item in docstring_parser.parse_from_object(part).params
    }
    annotated = {}
    for name, kind, about in list(_items(documented)):
        if dataclasses.is_dataclass(kind):
            describe(kind)  # pyright: ignore[reportArgumentType]
            annotated[name] = Annotated[kind, tyro.conf.arg(name="")] if name == MAIN else kind
        elif about.get("is_hidden"):
            annotated[name] = tyro.conf.Suppress[kind]
        else:
            shown = tyro.conf.arg(
                name=about.get("flag") or None,
                metavar=about.get("metavar"),
                help=" ".join((texts.get(name) or "").split()),
                help_behavior_hint=_default,
            )
            annotated[name] = Annotated[kind, shown]
    documented.__annotations__ = {**documented.__dict__.get("__annotations__", {}), **annotated}


def _items(documented: type | Command) -> Iterator[tuple[str, Any, Mapping[str, Any]]]:
    """The name, kind and metadata of each field or parameter."""
    if isinstance(documented, type):
        kinds = {
            name: kind for base in _bases(documented) for name, kind in base.__dict__.get("__annotations__", {}).items()
        }
        for item in dataclasses.fields(documented):
            yield item.name, _plain(kinds[item.name]), item.metadata
    else:
        for name, parameter in inspect.signature(documented).parameters.items():
            kind = _plain(documented.__annotations__[name])
            word = name.upper() if parameter.default is parameter.empty else f"[{name.upper()}]"
            is_positional = parameter.kind is parameter.POSITIONAL_ONLY
            yield name, kind, {"is_positional": is_positional, "metavar": word if is_positional else None}


def _bases(record: type) -> list[type]:
    return [base for base in reversed(record.__mro__) if dataclasses.is_dataclass(base)]


def _plain(kind: Any) -> Any:
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def _default(value: str) -> str:
    """What help says about a default; where it is empty, the text itself does."""
    shown = {"None": "", "False": "", "True": "(default: on)", "": ""}
    return shown.get(value, f"(default: {value})")


def _config() -> tuple[Any, ...]:
    import tyro

    return (tyro.conf.OmitArgPrefixes, tyro.conf.UseAppendAction, tyro.conf.DisallowNone)


def _list_commands(program: str, commands: CommandGroup) -> str:
    """The help of a group."""
    names = commands.names()
    indent = max(map(len, names)) + 4
    lines = [f"usage: {program} [-h] {commands.word.upper()} ...", ""]
    for paragraph in inspect.cleandoc(commands.about).split("\n\n"):
        lines += [_wrapped(" ".join(paragraph.split())), ""]
    for name in names:
        text = f"  {name:{indent - 2}}" + " ".join(commands.line(name).split())
        lines += textwrap.wrap(text, HELP_WIDTH, subsequent_indent=" " * indent, drop_whitespace=True)
    return "\n".join([*lines, "", f"`{program} {commands.word.upper()} --help` describes each."])


def _wrapped(line: str) -> str:
    """A line of text as lines of the width of help; those of tyro's blocks, which begin with a blank, fit already."""
    return line.rstrip() if line.startswith(" ") else textwrap.fill(line, HELP_WIDTH)


def _unknown(program: str, word: str, given: str, known: Sequence[str], moved: Mapping[str, str]) -> UsageError:
    """What to say about a command or flag that does not exist: what replaces it, or what was probably meant."""
    places = (f"{program} {given}", f"{program.rpartition(' ')[0]} {given}", given)
    if now := next((moved[place] for place in places if place in moved), None):
        return UsageError(f"{program} {given} {now}")
    near = difflib.get_close_matches(given[:100], known, n=1, cutoff=0.7)
    hint = f"; did you mean {near[0]}?" if near else "."
    return UsageError(f"{program}: no {word} {given[:100]}{hint} {_see(program)}")


def _see(program: str) -> str:
    return f"See `{program} --help`"


def _reason(said: str) -> str:
    """What tyro said in a block, as one line: without its title, and the help of the flag."""
    _, text, *_ = [" ".join(part.split()) for part in re.split(r"-{3,}", said)]
    line = text.rstrip(". ")
    if choice := re.fullmatch(r"invalid choice '(.*)' for argument '(\S+)'. Expected one of \((.*)\)", line):
        names = sorted(set(re.findall(r"'([^']*)'", choice[3])) - {"None"})
        near = difflib.get_close_matches(choice[1][:100], names, n=1)
        hint = f"did you mean {near[0]}? Expected" if near else "expected"
        return f"{choice[2]}: is {choice[1]!r}; {hint} {', '.join(names[:-1])} or {names[-1]}"
    for pattern, ours in REASONS.items():
        if match := re.fullmatch(pattern, line):
            return match.expand(ours)
    return line


def _print_completion(program: str, command: Command | CommandGroup, words: Sequence[str]) -> None:
    """Prints what makes a shell complete a program's words."""
    shell = words[0] if words else ""
    if shell not in SHELLS:
        raise UsageError(f"{program} {COMPLETION}: expected one of {', '.join(SHELLS)} behind it")
    import tyro

    tree = _app(command)
    given = ["--tyro-print-completion", shell]
    if isinstance(command, CommandGroup):
        tree.cli(prog=program, args=given, config=_config())
    else:
        tyro.cli(tree, prog=program, args=given, config=_config())


def _app(command: Command | CommandGroup) -> Any:
    """The same commands as tyro nests them."""
    import tyro

    if not isinstance(command, CommandGroup):
        describe(command)
        return command
    app = tyro.extras.SubcommandApp()
    for name in command.names():
        app.command(_app(command.choose(name, ())), name=name, help=command.line(name))
    return app
