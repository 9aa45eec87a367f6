"""Tests that code is compiled where nothing can be kept."""

import pytest
from numba.core.caching import CacheImpl

from datagen.machine.compiled import compiled


def test_code_is_compiled_where_no_folder_can_keep_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CacheImpl, "_locator_classes", [])

    @compiled(nogil=True)
    def next_one(value: int) -> int:
        return value + 1

    assert next_one(41) == 42
