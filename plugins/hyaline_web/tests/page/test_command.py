"""Tests `model export`: a trained run in, one page out, and what is refused."""

import json
import re
from pathlib import Path

import pytest
from support.commands import call, run
from support.synthetic import write_synthetic_dataset

pytestmark = pytest.mark.usefixtures("one_thread")

SMALL = "--steps 1 --batch 16 --device cpu"


def test_a_run_becomes_one_page_of_the_same_bytes_each_time_and_replaces_no_file_unasked(tmp_path: Path) -> None:
    write_synthetic_dataset(tmp_path / "data" / "one", train_views=2)
    run(f"model train light-path one {SMALL} --out run")
    for page in ("one.html", "two.html"):
        answer = call(f"model export run --out {page}")
        assert (answer.status, answer.out) == (0, f"{page}\n")
    data = Path("one.html").read_bytes()
    assert data == Path("two.html").read_bytes()
    assert data.startswith(b"<!doctype html>") and b"http://" not in data and b"https://" not in data
    listed = re.search(rb'id="manifest">(.*?)</script>', data)
    assert listed is not None
    views = [f"{split}/{view}" for split in ("extrapolating", "interpolating", "train") for view in (0, 1)]
    assert sorted(json.loads(listed[1])["truth"]) == views

    assert "already exists; use --overwrite" in call("model export run --out one.html").error
    Path("run/predictions/interpolating/0000.png").unlink()
    answer = call("model export run --out one.html --overwrite")
    assert answer.status == 1 and "render it with `model predict" in answer.error

    run(f"model train authors-code one {SMALL} --texture-size 16 --out other")
    answer = call("model export other --out other.html")
    assert "its method, authors-code, has no web page; docs/browser.md lists those that do" in answer.error
    assert answer.status == 1 and not Path("other.html").exists()
