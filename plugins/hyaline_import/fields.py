"""Values of an untrusted JSON object, each read with a type and a range."""

import math
from collections.abc import Iterator

from datagen.disk.errors import HyalineError
from datagen.disk.records import Json, shown

MAX_COUNT = 1 << 40


class Fields:
    """A JSON object, and its place in the file for errors."""

    def __init__(self, data: Json, where: str) -> None:
        if not isinstance(data, dict):
            raise HyalineError(f"{where}: is {shown(data)}; expected an object")
        self.data = data
        self.where = where

    def __contains__(self, key: str) -> bool:
        return key in self.data

    def integer(self, key: str, default: int | None = None, *, low: int = 0, high: int = MAX_COUNT) -> int:
        """An integer in a range; without a default it has to be there."""
        value = self._value(key, default)
        # Exporters write 3.0, too.
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
            raise HyalineError(f"{self.where}.{key}: is {shown(value)}; expected an integer from {low} to {high}")
        return value

    def number(self, key: str, default: float) -> float:
        """A finite number."""
        value = self._value(key, default)
        if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
            raise HyalineError(f"{self.where}.{key}: is {shown(value)}; expected a number")
        return float(value)

    def numbers(self, key: str, default: tuple[float, ...]) -> tuple[float, ...]:
        """As many finite numbers as the default has."""
        value = self._value(key, list(default))
        if not isinstance(value, list) or len(value) != len(default):
            raise HyalineError(f"{self.where}.{key}: is {shown(value)}; expected {len(default)} numbers")
        return tuple(Fields({key: item}, self.where).number(key, 0.0) for item in value)

    def color(self, key: str, default: tuple[float, float, float]) -> tuple[float, float, float]:
        """Three numbers, clipped to [0, 1]."""
        red, green, blue = (min(max(value, 0.0), 1.0) for value in self.numbers(key, default))
        return red, green, blue

    def share(self, key: str, default: float) -> float:
        """A number, clipped to [0, 1]."""
        return min(max(self.number(key, default), 0.0), 1.0)

    def flag(self, key: str) -> bool:
        """True where the value is true."""
        return self.data.get(key) is True

    def text(self, key: str, default: str = "") -> str:
        """A string."""
        value = self._value(key, default)
        if not isinstance(value, str):
            raise HyalineError(f"{self.where}.{key}: is {shown(value)}; expected a string")
        return value

    def fields(self, key: str) -> "Fields":
        """An object; empty if missing."""
        return Fields(self.data.get(key, {}), f"{self.where}.{key}")

    def extension(self, name: str) -> "Fields | None":
        """What an extension adds; None where it adds nothing."""
        extensions = self.fields("extensions")
        return extensions.fields(name) if name in extensions else None

    def extensions(self) -> list[str]:
        """The names of all extensions that add something."""
        return sorted(self.fields("extensions").data)

    def indices(self, key: str, *, count: int) -> list[int]:
        """A list of places in another list of `count` items."""
        listed = self.data.get(key, [])
        if not isinstance(listed, list):
            raise HyalineError(f"{self.where}.{key}: is {shown(listed)}; expected a list")
        where = f"{self.where}.{key}"
        return [Fields({"[]": item}, where).integer("[]", high=count - 1) for item in listed]

    def listed(self, key: str) -> list["Fields"]:
        """A list of objects; empty if missing."""
        value = self.data.get(key, [])
        if not isinstance(value, list):
            raise HyalineError(f"{self.where}.{key}: is {shown(value)}; expected a list")
        return [Fields(item, f"{self.where}.{key}[{index}]") for index, item in enumerate(value)]

    def __iter__(self) -> Iterator[str]:
        return iter(self.data)

    def _value(self, key: str, default: Json) -> Json:
        value = self.data.get(key, default)
        if value is None:
            raise HyalineError(f"{self.where}: has no {shown(key)}; the file is incomplete, export it again")
        return value
