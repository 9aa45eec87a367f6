"""Tests what is said of a processor, from what Linux says of it."""

from pathlib import Path

import pytest

from datagen.machine import hardware


@pytest.mark.parametrize(
    ("cpuinfo", "found"),
    [
        ("processor\t: 0\nflags\t\t: fpu sse avx512f avx512_bf16\n", "avx512_bf16"),
        ("flags\t\t: amx_bf16 avx512_bf16\n\nflags\t\t: amx_bf16 avx512_bf16\n", "amx_bf16"),
        ("Features\t: fp asimd i8mm bf16\n", "bf16"),
        ("flags\t\t: fpu sse avx2\nmodel name\t: avx512_bf16\n", None),
        ("", None),
    ],
)
def test_the_instructions_for_bf16_are_found(
    cpuinfo: str, found: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "cpuinfo"
    path.write_text(cpuinfo)
    monkeypatch.setattr(hardware, "CPUINFO", path)
    assert hardware.bf16_instructions() == found
    assert (found or "use fp32") in hardware.describe_processor()


def test_where_nobody_can_tell_there_are_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hardware, "CPUINFO", tmp_path / "nothing")
    assert hardware.bf16_instructions() is None
