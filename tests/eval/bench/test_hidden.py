"""Tests of hidden tests: what is published, what stays with the verifier, and that both score alike."""

import re
import shutil
from pathlib import Path

import pytest
from support.builds import tree
from support.commands import call, run

from datagen.data.dataset import Dataset, open_dataset
from datagen.disk.storage import sha256
from datagen.scene.folder import load_scene
from eval.bench.hidden import GREY, hidden_seed
from eval.bench.protocol import Protocol
from eval.bench.score import read_scored


@pytest.fixture
def here(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_protocol: Protocol) -> Path:
    """A folder with a dataset, split into both."""
    shutil.copytree(made / "data" / "random-7100-tiny", tmp_path / "secret")
    monkeypatch.chdir(tmp_path)
    run("hyaline-bench hide secret --scene hidden-1")
    return tmp_path


def test_the_published_dataset_is_that_of_the_verifier_without_test_pictures_colours_light_and_seed(here: Path) -> None:
    source, public, truth = map(open_dataset, map(Path, ("secret", "public/hidden-1-tiny", "truth/hidden-1-tiny")))
    assert public.seal == truth.seal != source.seal
    assert (public.config.scene, public.config.seed, public.num_views) == ("hidden-1", 0, source.num_views)
    published, kept = tree(here / "public/hidden-1-tiny"), tree(here / "truth/hidden-1-tiny")
    assert published.items() < kept.items()
    withheld = sorted(set(kept) - set(published))
    secret_file = r"(images|records)/(interpolating|extrapolating)"
    assert all(re.match(secret_file, path) for path in withheld)
    assert len(withheld) == 3 * 4  # PNG, EXR and record of each view.
    pictures = {sha256(data) for path, data in tree(here / "secret").items() if re.match(secret_file, path)}
    assert pictures.isdisjoint(map(sha256, published.values()))
    for split in ("interpolating", "extrapolating"):
        assert not any(view.is_built for view in public.views(split))
        assert [view.image_sha256 for view in truth.views(split)] == [view.image_sha256 for view in source.views(split)]
        assert (public.cameras(split).world_from_camera == source.cameras(split).world_from_camera).all()
    scene, before = load_scene(public.root / "scene"), load_scene(source.root / "scene")
    assert scene.objects[1].material.color == GREY and scene.environment.zenith == GREY  # pyright: ignore
    assert scene.objects[0].material == before.objects[0].material
    assert not any(b"7100" in data for path, data in published.items() if path.endswith(".json"))


def test_a_method_trains_on_what_is_published_and_is_scored_by_the_verifier(here: Path, made: Path) -> None:
    run("model train paper public/hidden-1-tiny --steps 2 --batch 64 --device cpu --costs")
    run("hyaline-bench submit paper-batch64-2-steps --preset tiny --data public --out paper.tar")
    assert "which is not there" in call(f"hyaline-bench score paper.tar --data {made / 'data'} --out none.json").error
    answer = call("hyaline-bench score paper.tar --data public --out none.json")
    assert answer.status == 1 and "the view is not built yet" in answer.error and not Path("none.json").exists()
    run("hyaline-bench score paper.tar --data truth --out paper.json")
    scored = read_scored(Path("paper.json"))
    assert scored.track == "shapes" and scored.scenes["hidden-1"].costs["cpu_seconds"] > 0
    assert not scored.failures  # Their pictures would give the truth away.


def test_a_secret_is_drawn_once_and_names_the_scenes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_protocol: Protocol
) -> None:
    monkeypatch.chdir(tmp_path)
    answer = call("hyaline-bench secret secret.txt --preset tiny")
    text = Path("secret.txt").read_text().strip()
    assert Path("secret.txt").stat().st_mode & 0o777 == 0o600 and re.fullmatch("[0-9a-f]{64}", text)
    assert answer.out.startswith(f"# commitment: {sha256(text.encode())}\n")
    assert call("hyaline-bench secret secret.txt --preset tiny") == answer
    seeds = [int(seed) for seed in re.findall(r"datagen build random-(\d+) --preset tiny", answer.out)]
    assert [seed % 3 for seed in seeds] == [0, 1]
    assert seeds == [hidden_seed(text, place, small_protocol) for place in (0, 1)]
    assert not set(seeds) & {hidden_seed("f" * 64, place, small_protocol) for place in (0, 1)}
    assert "hyaline-bench hide secret/hidden-1-tiny --scene hidden-1" in answer.out
    Path("short.txt").write_text("glass")
    assert (
        "short.txt: has 5 characters; expected a secret of 64"
        in call("hyaline-bench secret short.txt --preset tiny").error
    )


def test_what_cannot_be_hidden_is_refused(here: Path, other: Dataset) -> None:
    before = tree(here)
    for line, message in (
        ("hyaline-bench hide secret --scene random-7100", "no scene 'random-7100'"),
        (f"hyaline-bench hide {other.root} --scene hidden-1", "hidden-1-tiny: holds another scene; choose another"),
        ("hyaline-bench hide secret/variants/angles --scene hidden-0", "is imported, or a variant"),
    ):
        answer = call(line)
        assert answer.status == 1 and message in answer.error
    assert tree(here) == before


def test_a_damaged_view_is_not_published(here: Path) -> None:
    path = Path("secret/images/train/0000.png")
    path.write_bytes(path.read_bytes() + b"!")
    assert "damaged" in call("hyaline-bench hide secret --scene hidden-0").error
