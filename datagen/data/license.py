"""The licence of data: what may be done with a dataset. Of the code, LICENSE says it."""

OWN = "CC0-1.0"
"""SPDX name of the licence of built-in and random scenes, which code models and colours, and of all that is rendered
from them. CC0 because pictures end up in batches, crops and merged sets that cannot carry attributions."""
OWN_ADDRESS = "https://creativecommons.org/publicdomain/zero/1.0/"

MAX_LENGTH = 500
"""Characters of what a foreign file may say."""


def unknown(source: str) -> str:
    """What is said of data that states no licence: whom to ask."""
    return f"unknown; ask the author of {source}"


def license_line(*parts: object) -> str | None:
    """What a foreign file says of its licence, in one line; None where none of the parts is a text that says it."""
    lines = (" ".join(part.split()) for part in parts if isinstance(part, str))
    return "; ".join(dict.fromkeys(filter(None, lines)))[:MAX_LENGTH] or None
