"""Tests that pages state what the stored results hold: RESULTS.md, README and the report, by docs/claims.md."""

import re
import runpy
from pathlib import Path
from types import SimpleNamespace

import pytest
from support.commands import call

ROOT = Path(__file__).resolve().parents[3]
NUMBER = re.compile(r"[−+-]?\d+(?:,\d{3})*(?:\.\d+)?")  # noqa: RUF001


tables = SimpleNamespace(**runpy.run_path(str(ROOT / "docs/tables.py"), run_name="tables"))
results_page = runpy.run_path(str(ROOT / "docs/results.py"), run_name="results")["results_page"]
ROWS = list(tables.ROW.finditer((ROOT / "docs/claims.md").read_text()))
TEXTS = {
    "README.md": (ROOT / "README.md").read_text().partition("## Results\n")[2].partition("\n## ")[0],
    "paper.md": (ROOT / "docs/paper.md").read_text(),
}


def without_code(text: str) -> str:
    """The words of a page: no code, no addresses."""
    return re.sub(r"`[^`]*`|\]\([^)]*\)", " ", text)


@pytest.mark.parametrize("page", tables.PAGES, ids=lambda page: page.name)
def test_tables_are_those_of_the_stored_results(page: Path) -> None:
    text = page.read_text()
    assert tables.TABLE.findall(text)
    assert tables.filled(text) == text


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row["claim"])
def test_a_claim_has_the_numbers_of_its_cell_and_is_on_a_page(row: re.Match[str]) -> None:
    printed = [word.replace("−", "-").replace(",", "") for word in NUMBER.findall(without_code(row["claim"]))]  # noqa: RUF001
    found = tables.evaluated(row["cell"]).numbers
    assert len(printed) == len(found) > 0
    for word, number in zip(printed, found, strict=True):
        assert abs(float(word) - number) <= 0.5 * 10 ** -len(word.partition(".")[2]) + 1e-9
    assert any(row["claim"] in text for text in TEXTS.values())


@pytest.mark.parametrize("name", TEXTS)
def test_no_number_of_a_page_is_without_a_row(name: str) -> None:
    rest = tables.TABLE.sub(" ", TEXTS[name])
    for claim in sorted((row["claim"] for row in ROWS), key=len, reverse=True):
        rest = rest.replace(claim, " ")
    assert len(ROWS) > 40 and re.findall(r".{0,40}\d.{0,20}", without_code(rest)) == []


def test_the_pages_of_results_are_what_the_commands_write(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    folders = sorted(path for path in Path("docs/results").iterdir() if path.is_dir())
    assert sorted(Path("docs/results").glob("*.md")) == [folder.with_suffix(".md") for folder in folders]
    for folder in folders:
        page = call(f"hyaline-bench leaderboard {folder}").out if folder.name == "bench" else results_page(folder)
        assert folder.with_suffix(".md").read_text() == page, "write it with `make results`"
        assert f"({folder.with_suffix('.md').as_posix()}" in Path("RESULTS.md").read_text()
