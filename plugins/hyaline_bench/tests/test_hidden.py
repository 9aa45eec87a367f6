"""Tests of hidden tests: what is published, what stays with the verifier, and that both score alike."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.builds import tree
from support.commands import call, run
from support.export_readers import read_nerfstudio, read_picture
from support.synthetic import write_synthetic_dataset

from datagen.data.dataset import Dataset, open_dataset
from datagen.disk.errors import HyalineError
from datagen.disk.storage import sha256
from datagen.scene.folder import load_scene
from hyaline_bench.hidden import GREY, hidden_seed
from hyaline_bench.protocol import Protocol
from hyaline_bench.score import read_scored


@pytest.fixture
def here(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_protocol: Protocol) -> Path:
    """A folder with a dataset, split into both."""
    shutil.copytree(made / "data" / "random-nested-7100-tiny", tmp_path / "secret")
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
    secret_file = r"(images|records)/(interpolating|extrapolating)|variants/no-glass/edit-masks/"
    assert all(re.match(secret_file, path) for path in withheld)
    assert len(withheld) == 3 * 4 + 5  # PNG, EXR and record of each view; the masks of where light meets glass.
    pictures = {sha256(data) for path, data in tree(here / "secret").items() if re.match(secret_file, path)}
    assert pictures.isdisjoint(map(sha256, published.values()))
    for split in ("interpolating", "extrapolating"):
        assert not any(view.is_built for view in public.views(split))
        for view, shown in zip(truth.views(split), source.views(split), strict=True):
            assert np.array_equal(view.image, shown.image)
        assert (public.cameras(split).world_from_camera == source.cameras(split).world_from_camera).all()
    scene, before = load_scene(public.root / "scene"), load_scene(source.root / "scene")
    assert scene.objects[1].material.color == GREY and scene.environment.zenith == GREY  # pyright: ignore
    assert scene.objects[0].material == before.objects[0].material
    assert not any(re.search(rb"\b7100\b", data) for path, data in published.items() if path.endswith(".json"))


def test_a_method_trains_on_what_is_published_and_is_scored_by_the_verifier(here: Path, made: Path) -> None:
    run("model train paper public/hidden-1-tiny --steps 2 --batch 64 --device cpu --costs")
    name = "paper-batch64-2-steps"
    other = call(f"hyaline-bench score {name} --preset tiny --data {made / 'data'}")
    assert other.status == 1 and "which is not in " in other.err
    answer = call(f"hyaline-bench score {name} --preset tiny --data public")
    assert answer.status == 1 and "a verifier keeps their truth" in answer.error and not Path("bench").exists()
    run(f"hyaline-bench score {name} --preset tiny --data truth")
    scored = read_scored(Path(f"bench/tiny/scores/{name}.json"))
    assert scored.track == "shapes" and scored.scenes["hidden-1"].costs["cpu_seconds"] > 0


def test_scenes_without_truth_are_left_out_and_the_others_scored(
    here: Path, made: Path, small_protocol: Protocol
) -> None:
    shutil.copytree(made / "data", "data")
    shutil.copytree("public/hidden-1-tiny", "data/hidden-1-tiny")
    run("hyaline-bench floors --preset tiny")
    answer = call("hyaline-bench score mean-picture --preset tiny")
    assert answer.status == 0 and "left out: hidden-1: a verifier keeps the truth" in answer.err
    assert set(read_scored(Path("bench/tiny/scores/mean-picture.json")).scenes) == {"synthetic", "random-nested-7100"}
    # Beside what is published, the truth counts, whatever the folders are called.
    shutil.copytree("truth/hidden-1-tiny", "data/a-hidden-1-tiny")
    run("hyaline-bench score mean-picture --preset tiny")
    scenes = read_scored(Path("bench/tiny/scores/mean-picture.json")).scenes
    assert set(scenes) == {"synthetic", "random-nested-7100", "hidden-1"}


def test_no_command_makes_the_test_views_of_a_published_scene(here: Path) -> None:
    before = tree(here)
    public = "public/hidden-1-tiny"
    answer = call(f"datagen verify {public}")
    assert answer.status == 0 and "a verifier keeps the pictures of its 4 test views" in answer.err
    refusals = {
        f"datagen build {public}/scene --preset tiny --out {public}": "scene hidden-1: is not rendered",
        f"datagen add {public} --edit remove:pane": "only a verifier knows its light and colours",
        f"datagen film {public} --out film.webp": "only a verifier knows its light and colours",
        f"datagen export {public} --format huggingface --out hub": "publishes test pictures, which a verifier keeps",
    }
    for line, message in refusals.items():
        answer = call(line)
        assert answer.status == 1 and message in answer.error
    with pytest.raises(HyalineError, match="which a verifier of hyaline-bench keeps"):
        _ = open_dataset(Path(public)).view("interpolating", 0).image
    assert tree(here) == before


def test_what_is_published_can_be_copied_and_exported_with_all_cameras(here: Path) -> None:
    shutil.copytree("public/hidden-1-tiny", "data/hidden-1-tiny")
    run("datagen verify hidden-1-tiny")
    answer = call("datagen export hidden-1-tiny --format nerfstudio")
    assert answer.status == 0 and "the test pictures are grey" in answer.err
    views, splits = read_nerfstudio(Path("exports/hidden-1-tiny-nerfstudio"))
    assert len(views) == 12 and len(splits["test"]) == 4
    for name, read in views.items():
        assert (np.ptp(read_picture(read.file)) == 0) == (name in splits["test"])
    run("datagen export hidden-1-tiny --format capture")
    pictures = Path("exports/hidden-1-tiny-capture/images").iterdir()
    assert sorted(path.stem for path in pictures) == sorted(set(views) - set(splits["test"]))


def test_a_secret_is_drawn_once_and_names_the_scenes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_protocol: Protocol
) -> None:
    monkeypatch.chdir(tmp_path)
    answer = call("hyaline-bench secret secret.txt --preset tiny")
    text = Path("secret.txt").read_text().strip()
    assert Path("secret.txt").stat().st_mode & 0o777 == 0o600 and re.fullmatch("[0-9a-f]{64}", text)
    assert answer.out.startswith(f"# commitment: {sha256(text.encode())}\n")
    assert call("hyaline-bench secret secret.txt --preset tiny") == answer
    built = re.findall(r"datagen build random-(\w+)-(\d+) --preset tiny", answer.out)
    families, seeds = [family for family, _ in built], [int(seed) for _, seed in built]
    assert families == ["nested", "table"]
    assert seeds == [hidden_seed(text, place, small_protocol) for place in (0, 1)]
    assert not set(seeds) & {hidden_seed("f" * 64, place, small_protocol) for place in (0, 1)}
    lines = "datagen add secret/hidden-1-tiny --edit no-glass\nhyaline-bench hide secret/hidden-1-tiny --scene hidden-1"
    assert lines in answer.out
    Path("short.txt").write_text("glass")
    assert (
        "short.txt: has 5 characters; expected a secret of 64"
        in call("hyaline-bench secret short.txt --preset tiny").error
    )


def test_what_cannot_be_hidden_is_refused(here: Path, other: Dataset) -> None:
    same_size = write_synthetic_dataset(here / "same size", scene_name="random-nested-7103", sees_nothing=True)
    shutil.copytree("secret/variants/no-glass", same_size.root / "variants/no-glass")
    before = tree(here)
    for line, message in (
        ("hyaline-bench hide secret --scene random-nested-7100", "no scene 'random-nested-7100'"),
        (f"hyaline-bench hide {other.root} --scene hidden-0", "differs from the protocol's tiny (train is 8 views"),
        (
            f"hyaline-bench hide '{same_size.root}' --scene hidden-1",
            "hidden-1-tiny: holds another scene; choose another",
        ),
        ("hyaline-bench hide secret/variants/angles --scene hidden-0", "is imported, or a variant"),
    ):
        answer = call(line)
        assert answer.status in (1, 2) and message in answer.error
    assert tree(here) == before
