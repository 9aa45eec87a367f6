"""Remarks of an import: one line for each approximation and each unrequested change."""

from typing import NamedTuple

from datagen.disk.records import Json


class Remark(NamedTuple):
    """One line of import.json."""

    where: str
    """The object, material or file that it is about."""
    what: str
    is_approximation: bool
    """The scene looks other than the file asks for."""


class Remarks:
    """The lines of one import, each once, in the order in which they came up."""

    def __init__(self) -> None:
        self.lines: list[Remark] = []

    def approximate(self, where: str, what: str) -> None:
        """Something is drawn other than the file asks for."""
        self.lines += {Remark(where, what, True)}.difference(self.lines)

    def note(self, where: str, what: str) -> None:
        """Something was decided or mended, and the scene is what the file asks for."""
        self.lines += {Remark(where, what, False)}.difference(self.lines)

    def to_json(self) -> dict[str, Json]:
        """The lines as import.json holds them."""
        return {
            "approximations": [f"{line.where}: {line.what}" for line in self.lines if line.is_approximation],
            "notes": [f"{line.where}: {line.what}" for line in self.lines if not line.is_approximation],
        }
