"""From the words of a command line to a call of the command's function, by tyro: flags, help, errors.

A function's parameters are its flags, and so are the fields of records among them; those before a `/` are words, which
may also be given as flags by their names. A list is a flag that may be repeated, a switch is `--x` or `--no-x`. Help
comes from docstrings. tyro is imported only once a command is chosen, so that lists of commands are printed at once.
Choices are those of a Literal, or what a function in a type names, as in `Annotated[str, METHODS.names]`.
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
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

from datagen.disk.errors import HyalineError, UsageError, shown

Command = Callable[..., None]

HELP = ("-h", "--help")
QUIET = "--quiet"
QUIET_HELP = f"{QUIET} prints no progress and no remarks, with any command."
HELP_WIDTH = 80
MAIN = "choices"
"""The parameter whose record's flags help lists among the command's own; any other makes a group of its name."""

MAX_SUGGESTED = 100
"""Characters of a wrong name for which a similar one is sought; the time that takes grows with their square."""


class Later(NamedTuple):
    """A command that is imported when it is asked for."""

    load: Callable[[Sequence[str]], Command]
    """Makes it from the words that follow its name."""
    line: Callable[[], str] | None = None
    """Describes it in one line; its docstring does unless given."""


@dataclass(frozen=True, kw_only=True)
class CommandGroup:
    """Commands that share their first words, such as those of a program."""

    about: str
    commands: Callable[[], "Mapping[str, Command | CommandGroup | Later]"]
    word: str = "command"
    """What a name is called in messages."""
    absent: Mapping[str, str] = field(default_factory=dict)
    """Plug-ins that are not here, by the names that they would add."""


def group(
    about: str, commands: Mapping[str, Command | CommandGroup | Later], absent: Mapping[str, str] | None = None
) -> CommandGroup:
    """The commands of a program."""
    return CommandGroup(about=about, commands=lambda: commands, absent=absent or {})


def choose(what: str, value: str, choices: Collection[str]) -> str:
    """`value`, when it is one of `choices`.

    Args:
        what: What is chosen, such as `preset`; or `WHERE: preset`, in a file.

    Raises:
        UsageError: it is not; the nearest choice is suggested. In a file, it is a HyalineError.
    """
    if value in choices:
        return value
    near = difflib.get_close_matches(value[:MAX_SUGGESTED], choices, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]!r}? Choose" if near else "choose"
    where, colon, kind = what.rpartition(": ")
    kind_of_error = HyalineError if where else UsageError
    raise kind_of_error(f"{where}{colon}no {kind} {shown(value)}; {hint} from {', '.join(sorted(choices))}")


def parse(program: str, command: Command | CommandGroup, words: Sequence[str]) -> functools.partial[None]:
    """The call that words ask for.

    Raises:
        UsageError: no such command or flag, or a value that a flag does not take.
        SystemExit: help was asked for (status 0), or no command was given (2); it has been printed.
    """
    while isinstance(command, CommandGroup):
        if not words or words[0] in HELP:
            print(_list_commands(program, command))
            sys.exit(0 if words else 2)
        name, *words = words
        if name in command.absent:
            package = command.absent[name]
            raise UsageError(f"{program} {name}: is a {command.word} of the plug-in {package}, which is not here")
        commands = command.commands()
        found = commands[choose(f"{program} {command.word}", name, commands)]
        program, command = f"{program} {name}", found.load(words) if isinstance(found, Later) else found
    return _parse(program, command, words)


def _parse(program: str, command: Command, words: Sequence[str]) -> functools.partial[None]:
    import tyro

    describe(command)

    @functools.wraps(command)
    def asked(*args: Any, **kwargs: Any) -> functools.partial[None]:
        return functools.partial(command, *args, **kwargs)

    shown, refused = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(shown), contextlib.redirect_stderr(refused):
            return tyro.cli(
                asked,
                prog=program,
                description=(inspect.getdoc(command) or "").partition("\n\nArgs:")[0] + "\n\n" + QUIET_HELP,
                args=_words_first(command, words),
                config=(tyro.conf.OmitArgPrefixes, tyro.conf.UseAppendAction, tyro.conf.DisallowNone),
            )
    except HyalineError as error:  # A field of a record is named in it, which may not be its flag.
        name, colon, rest = str(error).partition(": ")
        flag = next((flag for flag, field in flags_of(command).items() if colon and field == name), None)
        raise error if flag is None else type(error)(f"--{flag}: {rest}") from None
    except SystemExit as end:
        if end.code:
            raise UsageError(f"{program}: {_in_one_line(refused.getvalue())}. See `{program} --help`") from None
        print("\n".join(map(_wrapped, shown.getvalue().rstrip().splitlines())))
        raise


def _in_one_line(box: str) -> str:
    """What tyro 1.0 says in blocks: a title, what is wrong, perhaps the flag that was meant, and where to find help."""
    _, wrong, *more = re.split("-{3,}", box)
    near = next((part.split("\n")[2].strip() for part in more if "Perhaps you meant" in part), None)
    what, listed, choices = " ".join(wrong.split()).rstrip(".").partition(". Expected one of ")
    what += listed and "; choose from " + re.sub(r"[(')]", "", choices).strip()
    return what + (f"; did you mean {near}" if near else "")


def _words_first(command: Command, words: Sequence[str]) -> list[str]:
    """The words with positional ones first: `--dataset X` becomes X if the command takes a word `dataset`."""
    first: dict[str, str] = {}
    flags = {flag for name, _, about in _items(command) if about["is_positional"] for flag in _as_flags(command, name)}
    rest, left = [], list(words)
    while left:
        flag, equals, value = left.pop(0).partition("=")
        if flag in flags and (equals or left):
            first[flag] = value if equals else left.pop(0)
        else:
            rest.append(flag + equals + value)
    return [*first.values(), *rest]


def _as_flags(command: Command, word: str) -> list[str]:
    """The flags that may replace a positional word: its name, and --scene for what a scene's name may mean."""
    is_scene = word in ("dataset", "what") and "scene" not in inspect.signature(command).parameters
    return [f"--{word}", *(["--scene"] if is_scene else [])]


def flags_of(documented: type | Command) -> dict[str, str]:
    """The field or parameter behind each flag, those of records in it included; flags without dashes in front."""
    return {word[2:]: name for word, name, _, _ in _typed(documented) if word}


def _typed(documented: type | Command) -> Iterator[tuple[str, str, Any, Mapping[str, Any]]]:
    """Flags, in dashes, and positional words, which are empty: with name, kind and metadata."""
    for name, kind, about in _items(documented):
        if dataclasses.is_dataclass(kind):
            yield from _typed(kind)  # pyright: ignore[reportArgumentType]
        elif not about.get("is_hidden"):
            flag = "--" + (about.get("flag") or name.replace("_", "-"))
            yield "" if about.get("is_positional") else flag, name, kind, about


ABOUT: dict[str, str | None] = {
    "dataset": "A dataset's folder, or its name under data/. Default: the only one there.",
    "run": "A trained run: its folder, or its name under runs/ (SCENE/NAME).",
    "device": "Where to compute; auto uses a GPU if there is one.",
}
"""Describes parameters of these names whose docstrings do not."""
PLACES = {"dataset": ["data/*/dataset.json"], "run": ["runs/*/*/run.json"]}
PLACES["what"] = PLACES["dataset"] + PLACES["run"]
"""Files that mark the folders which parameters of these names mean."""


def complete(command: Command | CommandGroup, words: Sequence[str]) -> list[str]:
    """What may follow words on a command line: commands; choices of the last flag, if there are any; or the positional
    words and all flags."""
    if isinstance(command, CommandGroup):
        commands, name = command.commands(), words[0] if words else ""
        if name not in commands:
            return list(commands)
        chosen = commands[name]
        return complete(chosen.load(words[1:]) if isinstance(chosen, Later) else chosen, words[1:])
    found: list[str] = []
    for word, name, kind, about in _typed(command):
        known = [*(about["choices"] or list)()]
        for pattern in PLACES.get(name, ()):
            known += ["/".join(path.parts[1:-1]) for path in sorted(Path().glob(pattern))]
        if words[-1:] == [word] and kind is not bool:
            return known
        found += [word] if word else known
    return found


def changed_fields(record: object, usual: object) -> Iterator[tuple[dataclasses.Field[Any], Any]]:
    """The fields of `usual`, those of nested records included, in which a record differs, with the record's values."""
    for item in dataclasses.fields(usual):  # pyright: ignore[reportArgumentType]
        value, expected = getattr(record, item.name), getattr(usual, item.name)
        if dataclasses.is_dataclass(expected):
            yield from changed_fields(value, expected)
        elif value != expected and not item.metadata.get("is_hidden"):
            yield item, value


def changed_flags(record: object, usual: object) -> list[tuple[str, str]]:
    """The flags, without dashes in front, and their values on a command line that ask for a record where `usual` is
    the default; a switch has no value, and a list gives its flag several times."""
    flags: list[tuple[str, str]] = []
    for item, value in changed_fields(record, usual):
        flag = item.metadata.get("flag") or item.name.replace("_", "-")
        if isinstance(value, bool):
            flags.append((flag if value else f"no-{flag}", ""))
        else:
            flags += [(flag, str(one)) for one in (value if isinstance(value, tuple) else (value,))]
    return flags


def flag_words(flags: Iterable[tuple[str, str]]) -> list[str]:
    """The words on a command line that give these flags."""
    return [word for flag, value in flags for word in (f"--{flag}", value) if word]


@functools.cache
def describe(documented: type | Command) -> None:
    """Annotates a function's parameters, or a record's fields, with what tyro shows and reads.

    A field's metadata may name its `flag`, or say that it `is_hidden`: no flag. Texts flow: tyro 1.0.17 would keep a
    docstring's line breaks.
    """
    import docstring_parser
    import tyro

    parts = reversed(documented.__mro__) if isinstance(documented, type) else [documented]
    found = [docstring_parser.parse_from_object(part).params for part in parts if part is not object]
    texts = ABOUT | {item.arg_name: item.description for params in found for item in params}
    annotated = {}
    for name, kind, about in list(_items(documented)):
        if dataclasses.is_dataclass(kind):
            describe(kind)  # pyright: ignore[reportArgumentType]
            annotated[name] = Annotated[kind, tyro.conf.arg(name="")] if name == MAIN else kind
        elif about.get("is_hidden"):
            annotated[name] = tyro.conf.Suppress[kind]
        else:
            text, choices = " ".join((texts.get(name) or "").split()), about["choices"]
            if about.get("is_positional") and not isinstance(documented, type):
                names = f" Names: {', '.join(choices())}." if choices else ""
                text += f"{names} Also as {' or '.join(_as_flags(documented, name))}."
            shown = tyro.conf.arg(
                name=about.get("flag") or None,
                metavar=about.get("metavar") or (choices and f"{{{','.join(choices())}}}"),
                help=text,
                help_behavior_hint=_default,
            )
            annotated[name] = Annotated[kind, shown, choices]
    documented.__annotations__ = {**documented.__dict__.get("__annotations__", {}), **annotated}


def _items(documented: type | Command) -> Iterator[tuple[str, Any, Mapping[str, Any]]]:
    """The name, kind and metadata of each field or parameter."""
    kinds = get_type_hints(documented, include_extras=True)
    plain = get_type_hints(documented)
    if isinstance(documented, type):
        for item in dataclasses.fields(documented):
            yield item.name, plain[item.name], {**item.metadata, "choices": _choices(kinds[item.name])}
        return
    for name, parameter in inspect.signature(documented).parameters.items():
        word = name.upper() if parameter.default is parameter.empty else f"[{name.upper()}]"
        is_positional = parameter.kind is parameter.POSITIONAL_ONLY
        metavar, choices = word if is_positional else None, _choices(kinds[name])
        yield name, plain[name], {"is_positional": is_positional, "metavar": metavar, "choices": choices}


def _choices(kind: Any) -> Callable[[], Iterable[str]] | None:
    """What lists the choices of a type."""
    if inspect.isroutine(kind):
        return kind
    if get_origin(kind) is Literal:
        return functools.partial(get_args, kind)
    return next(filter(None, map(_choices, get_args(kind))), None)


def _default(value: str) -> str:
    """What help says about a default; where it is empty, the text itself does."""
    shown = {"None": "", "False": "", "True": "(default: on)", "": ""}
    return shown.get(value, f"(default: {value})")


def _list_commands(program: str, group: CommandGroup) -> str:
    """The help of a group."""
    commands = group.commands()
    indent = max(map(len, commands)) + 4
    lines = [f"usage: {program} [-h] {group.word.upper()} ...", "", _wrapped(group.about), ""]
    for name, command in commands.items():
        if isinstance(command, Later):
            text = command.line() if command.line else inspect.getdoc(command.load(()))
        else:
            text = command.about if isinstance(command, CommandGroup) else inspect.getdoc(command)
        text = f"  {name:{indent - 2}}" + " ".join((text or "").partition("\n\n")[0].split())
        lines += textwrap.wrap(text, HELP_WIDTH, subsequent_indent=" " * indent, drop_whitespace=True)
    return "\n".join([*lines, "", f"`{program} {group.word.upper()} --help` describes each."])


def _wrapped(line: str) -> str:
    """A line of text as lines of the width of help; tyro has wrapped those of its boxes, but not the description."""
    return line if line.startswith(" ") else textwrap.fill(line, HELP_WIDTH)
