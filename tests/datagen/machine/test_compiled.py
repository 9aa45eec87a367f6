"""Tests that code is compiled where nothing can be kept."""

import errno
import os
from pathlib import Path
from typing import NoReturn

import pytest
from numba.core.caching import CacheImpl, IndexDataCacheFile

from datagen.machine.compiled import compiled


def test_code_is_compiled_where_no_folder_can_keep_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CacheImpl, "_locator_classes", [])

    @compiled(nogil=True)
    def next_one(value: int) -> int:
        return value + 1

    assert next_one(41) == 42


def test_code_is_compiled_where_the_disk_of_the_cache_is_full(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def refuse(*_: object) -> NoReturn:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("numba.core.config.CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(IndexDataCacheFile, "_save_data", refuse)

    @compiled()
    def next_one(value: int) -> int:
        return value + 1

    assert next_one(41) == 42
    assert list(tmp_path.rglob("*.nbi"))  # It was tried.


def test_without_a_home_directory_no_code_is_kept_in_the_working_folder(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("HOME", raising=False)
    for name in ("XDG_CACHE_HOME", "NUMBA_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "getuid", lambda: 12345)  # Whom no machine knows.
    monkeypatch.setattr(CacheImpl, "_locator_classes", CacheImpl._locator_classes[2:])  # The code is read-only.
    monkeypatch.chdir(tmp_path)

    @compiled()
    def next_one(value: int) -> int:
        return value + 1

    assert next_one(41) == 42
    assert not list(tmp_path.iterdir())
