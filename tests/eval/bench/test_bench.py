"""Tests of the benchmark from predictions to the leaderboard, and of what it refuses."""

import dataclasses
import io
import json
import math
import os
import re
import shutil
import signal
import tarfile
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.stats
from support.builds import tree
from support.commands import call, run
from support.synthetic import look_at

from datagen.data.cameras import Cameras
from datagen.data.dataset import open_dataset
from datagen.data.images import png_bytes, read_png
from datagen.data.variants import open_variant
from datagen.disk.errors import HyalineError
from datagen.disk.storage import seal_bytes, sha256
from datagen.terminal.signals import Stopped
from eval.bench.floors import nearest_view
from eval.bench.leaderboard import check_comparable, track_grid
from eval.bench.protocol import ALL, EDITS, Bootstrap, Protocol, choose_track
from eval.bench.score import mean_interval, read_scored, summarise
from eval.bench.submission import INDEX, submit
from eval.score.runs import open_run

SUBMISSION = Path("bench/tiny/submissions/nearest-view.tar")
SCORES = Path("bench/tiny/scores/nearest-view.json")
MEAN = Path("bench/tiny/scores/mean-picture.json")


@pytest.fixture
def here(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_protocol: Protocol) -> Path:
    """A copy of both datasets, as the working directory."""
    shutil.copytree(made / "data", tmp_path / "here" / "data")
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path / "here"


@pytest.fixture
def packed(here: Path) -> Path:
    """The same with the floors' predictions and submissions."""
    run("hyaline-bench floors --preset tiny")
    run("hyaline-bench submit --preset tiny")
    return here


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    return 10 * math.log10(255**2 / np.mean((one.astype(float) - other) ** 2))


# From predictions to the leaderboard


def test_floors_are_submitted_scored_and_shown(packed: Path, small_protocol: Protocol) -> None:
    answer = call("hyaline-bench score --preset tiny")
    assert answer.status == 0 and "nearest-view: each scene" in answer.out
    scored = read_scored(SCORES)
    assert (scored.track, scored.preset, len(scored.scenes)) == ("pictures", "tiny", 2)
    assert scored.submission == sha256(SUBMISSION.read_bytes())
    for name, scene in scored.scenes.items():
        dataset = open_dataset(Path(f"data/{name}-tiny"))
        assert scene.dataset == dataset.seal
        angles = open_variant(dataset, "angles")
        values, gaps = [], []
        parts = [(dataset, "interpolating"), (dataset, "extrapolating"), (angles, "extrapolating-10deg")]
        for source, split in parts if name == "synthetic" else parts[:2]:
            folder = Path(f"runs/{name}-tiny/nearest-view") / ("variants/angles" if source is angles else "")
            own = [
                psnr(read_png(folder / "predictions" / split / f"{view.index:04d}.png"), view.image)
                for view in source.views(split)
            ]
            values.append(np.mean(own))
            gaps.append((50 if source is dataset else 40) - np.mean(own))
        assert scene.psnr_db(ALL) == pytest.approx(np.mean(values))
        assert scene.gap_db(ALL) == pytest.approx(np.mean(gaps))  # noise_mse is 1e-5 and 1e-4.
    edited = summarise(scored, EDITS, small_protocol.bootstrap)
    assert edited is not None and edited.worst_scene == "synthetic" and edited.low is None
    one, other = (scene.psnr_db(ALL) for scene in scored.scenes.values())
    summary = summarise(scored, ALL, small_protocol.bootstrap)
    assert summary is not None and one is not None and other is not None
    assert (summary.low, summary.worst, summary.high) == pytest.approx(
        (min(one, other), min(one, other), max(one, other))
    )
    assert {failure.scene for failure in scored.failures} == {"synthetic", "random-7100"}

    run("hyaline-bench leaderboard --preset tiny")
    page = Path("bench/tiny/leaderboard/index.html").read_text()
    assert f">{summary.mean:.2f}<" in page and page.count('class="compare"') == 4
    assert page.count('class="sortable"') == 3  # The track, and each submission's scenes.
    assert "default-src 'none'; img-src data:" in page and "http:" not in page and "https:" not in page
    printed = call("hyaline-bench leaderboard --preset tiny --track pictures").out
    assert printed.startswith("# hyaline-bench 1, tiny: pictures\n")
    assert f"| synthetic | {read_scored(MEAN).scenes['synthetic'].psnr_db(ALL):.2f} | " in printed
    assert f"| synthetic | {open_dataset(Path('data/synthetic-tiny')).seal[:12]} | " in printed
    answer = call("hyaline-bench leaderboard --preset tiny --track shapes")
    assert answer.status == 1 and "shapes: the track has no submission" in answer.error
    before = tree(packed)
    for command in ("floors", "submit", "score", "leaderboard"):
        run(f"hyaline-bench {command} --preset tiny")
    assert tree(packed) == before


def test_a_foreign_method_names_its_track_and_need_not_predict_edits(here: Path) -> None:
    run("hyaline-bench floors --preset tiny")
    for name in ("synthetic", "random-7100"):
        folder = Path(f"runs/{name}-tiny/mine")
        shutil.copytree(f"runs/{name}-tiny/mean-picture", folder)
        (folder / "run.json").unlink()
        (folder / "costs.json").write_text('{"cpu_seconds": 90, "frames_per_second": 5}')
    shutil.rmtree("runs/synthetic-tiny/mine/variants/remove-pane")
    assert "name the track with --track" in call("hyaline-bench submit mine --preset tiny").error
    Path("runs/gone/mine/predictions/interpolating").mkdir(parents=True)
    answer = call("hyaline-bench submit mine --preset tiny --track masks --out mine.tar")
    assert answer.status == 0 and "left out: runs/gone/mine: no dataset at data/gone" in answer.err
    assert "mine.tar: track masks, 2 of 4 scenes" in answer.err
    run("hyaline-bench score mine.tar --preset tiny --out mine.json")
    scored = read_scored(Path("mine.json"))
    assert scored.track == "masks" and not scored.scenes["synthetic"].values(EDITS)
    assert scored.scenes["synthetic"].costs == {"cpu_seconds": 90, "frames_per_second": 5}
    Path("scores").mkdir()
    Path("mine.json").rename("scores/mine.json")
    run("hyaline-bench leaderboard scores --preset tiny --out page")
    row = re.search(r"<tr><th.*?>mine<.*?</tr>", Path("page/index.html").read_text())
    assert row is not None and ">1.50<" in row[0] and ">5.00<" in row[0]


def test_a_submission_does_not_choose_its_truth(packed: Path, small_protocol: Protocol) -> None:
    scene = Path("runs/random-7100-tiny/mine")
    shutil.copytree("runs/random-7100-tiny/mean-picture/predictions", scene / "predictions")
    runs = {"random-7100": open_run(scene, Path("data"))}
    other = open_dataset(Path("data/synthetic-tiny"))
    record = {"dataset": str(other.root.resolve()), "dataset_seal": other.seal}
    (scene / "run.json").write_text(json.dumps(record))
    submit(runs, preset="tiny", track="masks", out=Path("mine.tar"), protocol=small_protocol, overwrite=False)
    answer = call("hyaline-bench score mine.tar --preset tiny --out mine.json")
    assert answer.status == 1 and "the predictions are for other data" in answer.error
    assert not Path("mine.json").exists()


def test_a_second_dataset_of_a_scene_is_left_out(packed: Path) -> None:
    before = tree(packed)
    shutil.copytree("data/synthetic-tiny", "data/synthetic")
    shutil.copytree("runs/synthetic-tiny", "runs/synthetic")
    for path in Path("runs/synthetic").glob("*/run.json"):
        path.write_text(path.read_text().replace("data/synthetic-tiny", "data/synthetic"))
    run("hyaline-bench floors --preset tiny")
    answer = call("hyaline-bench submit --preset tiny")
    assert answer.status == 0 and "left out: runs/synthetic/mean-picture: is a second run" in answer.err
    shutil.rmtree("data/synthetic")
    shutil.rmtree("runs/synthetic")
    assert tree(packed) == before


def test_submissions_of_earlier_predictions_are_named_and_replaced_on_demand(packed: Path) -> None:
    before = SUBMISSION.read_bytes()
    for name in ("synthetic", "random-7100"):
        (Path(f"runs/{name}-tiny/nearest-view") / "costs.json").write_text('{"cpu_seconds": 90}')
    answer = call("hyaline-bench submit --preset tiny")
    assert answer.status == 1 and f"{SUBMISSION}: from earlier predictions or code; replace" in answer.error
    assert SUBMISSION.read_bytes() == before
    run("hyaline-bench submit --preset tiny --overwrite")
    assert SUBMISSION.read_bytes() != before


def test_truth_that_came_later_asks_for_new_scores(packed: Path) -> None:
    variant = Path("data/synthetic-tiny/variants/remove-pane")
    shutil.move(variant, "kept")
    run("hyaline-bench score --preset tiny")
    assert not read_scored(SCORES).scenes["synthetic"].values(EDITS)
    shutil.move("kept", variant)
    answer = call("hyaline-bench score --preset tiny")
    assert answer.status == 1 and answer.err.count("is there already; pass --overwrite") == 2
    run("hyaline-bench score --preset tiny --overwrite")
    assert read_scored(SCORES).scenes["synthetic"].values(EDITS)


def test_scores_of_another_submission_stay(packed: Path) -> None:
    run(f"hyaline-bench score {SUBMISSION} --preset tiny --out kept.json")
    before = Path("kept.json").read_bytes()
    other = SUBMISSION.with_name("mean-picture.tar")
    assert "is there already; pass --overwrite" in call(f"hyaline-bench score {other} --out kept.json").error
    assert Path("kept.json").read_bytes() == before
    run(f"hyaline-bench score {other} --out kept.json --overwrite")
    assert read_scored(Path("kept.json")).name == "mean-picture"


def test_files_that_are_no_scores_of_this_protocol_are_named_and_left_out(packed: Path) -> None:
    run("hyaline-bench score --preset tiny")
    content = json.loads(SCORES.read_text())
    del content["sha256"]
    folder = SCORES.parent
    for name, keys in {"newer": {"version": 2}, "magic": {"track": "magic"}, "again": {}}.items():
        (folder / f"{name}.json").write_bytes(seal_bytes(content | keys))
    answer = call(f"hyaline-bench leaderboard {folder}")
    assert answer.status == 0 and "3 submissions" in answer.err
    assert "left out: bench/tiny/scores/newer.json: was scored with protocol 2; expected 1" in answer.err
    assert "left out: bench/tiny/scores/magic.json: is of the track 'magic'; expected one of pictures" in answer.err
    # The preset is that of the scores; two submissions of one name are told apart by their files.
    assert answer.out == "bench/tiny/leaderboard/index.html\n"
    printed = call(f"hyaline-bench leaderboard {folder} --track pictures").out
    assert "hyaline-bench leaderboard --preset tiny --track pictures\n" in printed
    assert {line.split(" | ")[0] for line in printed.splitlines() if "2/4" in line} == {
        "| again",
        "| mean-picture",
        "| nearest-view",
    }


def test_scoring_that_is_stopped_goes_on_by_the_same_command(packed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run("hyaline-bench score --preset tiny")

    def stop(*_: object) -> None:
        raise Stopped(signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr("eval.bench.score.score_run", stop)
        answer = call("hyaline-bench score --preset tiny --overwrite")
    assert (answer.status, answer.error) == (143, "error: stopped; run the same command again to go on")
    run("hyaline-bench score --preset tiny --overwrite")


@pytest.mark.parametrize(
    ("costs", "message"),
    [
        ('{"cpu_seconds": "120 s", "machine": "mine"}', "cpu_seconds is '120 s'; expected a number of at least 0"),
        ('{"peak_memory_bytes": -1}', "peak_memory_bytes is -1; expected a number of at least 0"),
        ('{"cpu_seconds": NaN}', "NaN"),
    ],
)
def test_costs_that_scores_will_lack_are_named_when_a_method_is_packed(packed: Path, costs: str, message: str) -> None:
    Path("runs/synthetic-tiny/nearest-view/costs.json").write_text(costs)
    answer = call("hyaline-bench submit nearest-view --preset tiny --out new.tar")
    assert answer.status == 0 and answer.err.count("left out: ") == 1
    assert message in answer.err and "runs/synthetic-tiny/nearest-view/costs.json" in answer.err


@pytest.mark.parametrize(
    ("file", "message"),
    [
        ("predictions/interpolating/0001.png", r"missing \(1 of 2 are\)"),
        ("variants/angles", "the protocol asks for extrapolating-10deg"),
        ("predictions/extrapolating", "the protocol asks for all its views"),
    ],
)
def test_incomplete_predictions_are_not_packed(packed: Path, file: str, message: str) -> None:
    path = Path("runs/synthetic-tiny/nearest-view") / file
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    answer = call("hyaline-bench submit nearest-view --preset tiny --out new.tar")
    assert answer.status == 1 and re.search(message, answer.error) and not Path("new.tar").exists()
    SUBMISSION.unlink()
    run("hyaline-bench submit --preset tiny")  # The other floor is complete.
    assert not SUBMISSION.exists()
    shutil.rmtree("runs/synthetic-tiny/mean-picture/predictions")
    assert "mean-picture.tar: from earlier predictions" in call("hyaline-bench submit --preset tiny").error
    shutil.rmtree("runs/random-7100-tiny/mean-picture/predictions")
    assert "no method has all predictions" in call("hyaline-bench submit --preset tiny").error


def test_datasets_of_another_size_are_no_part_of_the_benchmark(here: Path, made: Path) -> None:
    text = (made / "protocol.toml").read_text()
    (here / "protocol.toml").write_text(text.replace("resolution = 32", "resolution = 64"))
    with pytest.MonkeyPatch.context() as patch:
        from eval.bench import protocol

        patch.setattr(protocol, "PROTOCOL", here / "protocol.toml")
        protocol.load_protocol.cache_clear()
        answer = call("hyaline-bench floors --preset tiny")
    protocol.load_protocol.cache_clear()
    assert answer.status == 1 and "left out: " in answer.err and "names for tiny: 64 pixels" in answer.err
    assert "data: has no dataset of tiny" in answer.error


# Hostile submissions

HOME = "synthetic/nearest-view"
PICTURE = f"{HOME}/predictions/interpolating/0000.png"
Files = dict[str, bytes]


def read_files() -> tuple[dict[str, Any], Files]:
    """The index of the submission without its digest, and its files, as tarfile reads them."""
    with tarfile.open(SUBMISSION) as archive:
        read = {entry.name.partition("/")[2]: archive.extractfile(entry).read() for entry in archive}  # pyright: ignore
    index = json.loads(read.pop(INDEX))
    del index["sha256"]
    return index, read


def write_archive(
    index: dict[str, Any], files: Files, change: Callable[[tarfile.TarInfo], object] | None = None
) -> bytes:
    """An archive of these files, as an attacker writes it, whose index is sealed again."""
    index["files"] = {path: {"size": len(data), "sha256": sha256(data)} for path, data in files.items()}
    index["files"] |= index.pop("more", {})
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.PAX_FORMAT) as archive:
        for path, data in [(INDEX, seal_bytes(index)), *sorted(files.items())]:
            entry = tarfile.TarInfo(f"{index['name']}/{path}")
            entry.size = len(data)
            if change is not None and path == PICTURE:
                change(entry)
            archive.addfile(entry, io.BytesIO(data))
        length = archive.offset + 1024
    return buffer.getvalue()[:length]


def with_index(**keys: Any) -> Callable[[], bytes]:
    """The submission with other values in its index."""

    def make() -> bytes:
        index, files = read_files()
        return write_archive(index | keys, files)

    return make


def with_file(path: str, data: bytes | None) -> Callable[[], bytes]:
    """The submission with another file; None: without it."""

    def make() -> bytes:
        index, files = read_files()
        files.pop(path, None)
        return write_archive(index, files if data is None else files | {path: data})

    return make


def with_entry(**keys: Any) -> Callable[[], bytes]:
    """The submission with another header of one picture."""

    def make() -> bytes:
        index, files = read_files()
        return write_archive(index, files, lambda entry: [setattr(entry, key, value) for key, value in keys.items()])

    return make


def zipped() -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("../../up.png", b"")
    return buffer.getvalue()


def huge_png(side: int) -> bytes:
    """A small file that unpacks to side x side pixels."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return len(body).to_bytes(4) + kind + body + zlib.crc32(kind + body).to_bytes(4)

    header = side.to_bytes(4) * 2 + bytes((8, 2, 0, 0, 0))
    rows = zlib.compress(bytes(side * (1 + 3 * side)), 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


RECORD = b'{"method": "light-path", "geometry": "truth", "knowledge": "everything"}'
HOSTILE: dict[str, tuple[Callable[[], bytes], str]] = {
    "a zip": (zipped, "is no archive of `hyaline-bench submit`"),
    "empty": (lambda: b"", "is no archive of `hyaline-bench submit`"),
    "cut off": (lambda: SUBMISSION.read_bytes()[:-600], r"has [\d,]+ bytes; expected"),
    "longer": (lambda: SUBMISSION.read_bytes() + b"!", r"has [\d,]+ bytes; expected"),
    "nothing": (lambda: write_archive(read_files()[0] | {"datasets": {}}, {}), "datasets: is empty"),
    "a way up": (with_file("../up.png", b""), "names '../up.png'; expected a file inside"),
    "an absolute path": (with_file("/tmp/up.png", b""), "names '/tmp/up.png'; expected a file inside"),
    "a program": (with_file(f"{HOME}/predictions/interpolating/run.sh", b""), "only records and predictions of the"),
    "another run": (with_file("synthetic/other/run.json", b"{}"), "only records and predictions of the"),
    "training views": (with_file(f"{HOME}/predictions/train/0000.png", b""), "only records and predictions of the"),
    "a link": (with_entry(type=tarfile.SYMTYPE, linkname="/etc/passwd"), r"is damaged|has [\d,]+ bytes"),
    "a hard link": (with_entry(type=tarfile.LNKTYPE, linkname="x"), r"is damaged|has [\d,]+ bytes"),
    "a device": (with_entry(type=tarfile.CHRTYPE), "0000.png is damaged"),
    "a sparse file": (with_entry(type=tarfile.GNUTYPE_SPARSE), "0000.png is damaged"),
    "a bomb": (with_index(more={PICTURE: {"size": 1 << 50, "sha256": "0" * 64}}), r"expected at most 16,777,216"),
    "a later version": (with_index(version=2), "version is 2; expected 1; update hyaline"),
    "an unknown key": (with_index(extra=1), "unknown key 'extra'"),
    "a long text": (with_index(code="x" * 201), "code: has 201 characters; expected at most 200"),
    "a name that is a path": (with_index(name="../up"), "name: is '../up'; expected a name"),
    "an unknown track": (with_index(track="all"), "no track 'all'"),
    "an unknown scene": (with_index(datasets={"attic": "0"}), "no scene 'attic'"),
    "another dataset": (with_index(datasets={"synthetic": "0" * 64}), "only records and pred|which is not there"),
    "more told than the track allows": (
        with_file(f"{HOME}/run.json", RECORD),
        "uses inputs .everything. that",
    ),
    "a missing view": (with_file(PICTURE, None), r"0000.png: missing \(1 of 2 are\)"),
    "a view too many": (
        with_file(PICTURE.replace("0000", "0002"), png_bytes(np.zeros((32, 32, 3), np.uint8))),
        "not a",
    ),
    "no picture": (with_file(PICTURE, b"GIF89a"), "not a PNG"),
    "another size": (with_file(PICTURE, png_bytes(np.zeros((32, 31, 3), np.uint8))), "is 31 x 32 pixels; expected 32"),
    "a huge picture": (lambda: with_file(PICTURE, huge_png(9000))(), "is 9000 x 9000 pixels; expected 32 x 32"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_submission_is_one_line_and_leaves_nothing(
    packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    make, reason = HOSTILE[name]
    index, files = read_files()
    assert write_archive(index, files) == SUBMISSION.read_bytes(), "what is changed here is a submission"
    Path("hostile.tar").write_bytes(make())
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", os.fspath(tmp_path / "temporary"))
    before = tree(tmp_path)
    answer = call("hyaline-bench score hostile.tar --preset tiny --out new.json")
    assert answer.status == 1 and answer.err.count("error: ") == 1
    assert re.search(reason, answer.error), answer.error
    assert "hostile.tar" in answer.error and tree(tmp_path) == before


def test_the_truth_itself_is_no_prediction(packed: Path) -> None:
    for view in open_dataset(Path("data/synthetic-tiny")).views("interpolating"):
        Path(f"runs/synthetic-tiny/nearest-view/predictions/interpolating/{view.index:04d}.png").write_bytes(
            png_bytes(view.image)
        )
    run("hyaline-bench submit nearest-view --preset tiny --out new.tar")
    answer = call("hyaline-bench score new.tar --preset tiny --out new.json")
    assert answer.status == 1 and "synthetic: interpolating: pictures equal the truth with its noise" in answer.error


def test_pictures_better_than_the_noise_of_the_truth_are_refused(packed: Path) -> None:
    dataset = open_dataset(Path("data/synthetic-tiny"))
    for view in dataset.views("interpolating"):
        near = view.image.copy()
        near[0, 0, 0] ^= 1
        path = Path(f"runs/synthetic-tiny/nearest-view/predictions/interpolating/{view.index:04d}.png")
        path.write_bytes(png_bytes(near))
    run("hyaline-bench submit nearest-view --preset tiny --out new.tar")
    answer = call("hyaline-bench score new.tar --preset tiny --out new.json")
    assert answer.status == 1 and "is above the noise ceiling of" in answer.error


def test_scores_on_another_dataset_of_a_scene_do_not_enter_a_table(packed: Path, small_protocol: Protocol) -> None:
    run("hyaline-bench score --preset tiny")
    scored = read_scored(MEAN)
    scene = dataclasses.replace(scored.scenes["synthetic"], dataset="0" * 64)
    other = dataclasses.replace(scored, name="other", scenes={**scored.scenes, "synthetic": scene})
    check_comparable([scored, dataclasses.replace(scored, name="again")], small_protocol)
    with pytest.raises(HyalineError, match="other: was scored on another dataset of synthetic"):
        check_comparable([scored, other], small_protocol)


# Tracks


@pytest.mark.parametrize(
    ("geometry", "uses_materials", "told", "track"),
    [
        ("none", False, None, "pictures"),
        ("none", True, None, "materials"),
        ("fitted", True, (), "masks"),
        ("fitted", True, None, "materials"),
        ("fitted", True, ("floor",), "materials"),
        ("fitted", False, None, "masks"),
        ("fitted", False, ("pane",), "shapes"),
        ("fitted-hull", True, (), "masks"),
        ("fitted-materials", True, (), "shapes"),
        ("ellipsoid", False, None, "proxies"),
        ("ellipsoid", True, None, "materials"),
        ("noise-0.001", False, None, "shapes"),
        ("mixed-b", False, None, "shapes"),
        ("truth", False, None, "shapes"),
        ("truth", True, None, "materials"),
    ],
)
def test_a_run_belongs_to_the_first_track_that_may_be_told_as_much(
    here: Path,
    small_protocol: Protocol,
    geometry: str,
    uses_materials: bool,
    told: tuple[str, ...] | None,
    track: str,
) -> None:
    folder = here / "runs" / "synthetic-tiny" / "one"
    folder.mkdir(parents=True)
    of_any = dataclasses.replace(
        open_run(folder, here / "data"), geometry=geometry, uses_materials=uses_materials, told=told
    )
    found = dataclasses.replace(of_any, seal="of model train")
    assert choose_track(found, None, small_protocol.tracks) == track
    assert choose_track(found, "materials", small_protocol.tracks) == "materials"
    for lower in list(small_protocol.tracks)[: list(small_protocol.tracks).index(track)]:
        with pytest.raises(HyalineError, match=f"that the track {lower} does not allow; submit it to {track}"):
            choose_track(found, lower, small_protocol.tracks)
    if geometry != "none":  # The record of a foreign method may leave out what it was told.
        with pytest.raises(HyalineError, match="does not show all inputs of the method; name the track"):
            choose_track(of_any, None, small_protocol.tracks)


@pytest.mark.parametrize("geometry", ["true meshes", "Truth", "masks", ""])
def test_an_unknown_geometry_has_no_track_of_its_own(here: Path, small_protocol: Protocol, geometry: str) -> None:
    folder = here / "runs" / "synthetic-tiny" / "one"
    folder.mkdir(parents=True)
    found = dataclasses.replace(open_run(folder, here / "data"), geometry=geometry, seal="of model train")
    with pytest.raises(HyalineError, match="name the track with --track, one of pictures, masks"):
        choose_track(found, None, small_protocol.tracks)
    assert choose_track(found, "masks", small_protocol.tracks) == "masks"


# Floors and averages


def test_the_nearest_view_is_chosen_by_cameras_alone() -> None:
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(9, 3)) + np.array([0, 0, 2])
    poses = np.stack([look_at(3 * way / np.linalg.norm(way), np.zeros(3)) for way in ways])
    train = Cameras(world_from_camera=poses, fov_x=1.0, width=4, height=4)
    pictures = np.arange(9, dtype=np.uint8)[:, None, None, None] * np.ones((1, 4, 4, 3), np.uint8)
    shuffled = rng.permutation(9)
    nudged = poses[shuffled].copy()
    nudged[:, :3, 3] += 1e-3
    test = Cameras(world_from_camera=nudged, fov_x=1.0, width=4, height=4)
    assert nearest_view(pictures, train, test)[:, 0, 0, 0].tolist() == shuffled.tolist()
    # At one place, the viewing direction decides.
    turned = np.stack([look_at(np.array([0.0, 0, 3]), np.array(target)) for target in ([0.1, 0, 0], [3.0, 0, 3])])
    pair = Cameras(world_from_camera=turned, fov_x=1.0, width=4, height=4)
    asked = Cameras(world_from_camera=turned[1:], fov_x=1.0, width=4, height=4)
    assert nearest_view(pictures[:2], pair, asked)[0, 0, 0, 0] == 1


def test_the_interval_is_that_of_scipys_percentile_bootstrap() -> None:
    values = np.random.default_rng(1).normal(30, 3, 22)
    low, high = mean_interval(values, Bootstrap(resamples=20_000, seed=0, confidence=0.95))
    theirs = scipy.stats.bootstrap(
        (values,), np.mean, method="percentile", n_resamples=20_000, rng=np.random.default_rng(5)
    ).confidence_interval
    assert (low, high) == pytest.approx((theirs.low, theirs.high), abs=0.03)  # Resampling alone spreads by 0.01.


def test_the_interval_of_two_scenes_has_a_closed_form_and_one_scene_has_none() -> None:
    # Resampled means are 20, 24 and 28 with probabilities 1/4, 1/2 and 1/4.
    bootstrap = Bootstrap(resamples=4000, seed=0, confidence=0.6)
    assert mean_interval(np.array([20.0, 28.0]), bootstrap) == (20, 28)
    assert mean_interval(np.array([20.0, 28.0]), dataclasses.replace(bootstrap, confidence=0.4)) == (24, 24)
    assert mean_interval(np.array([20.0]), bootstrap) == (None, None)


def test_rows_with_fewer_scenes_come_last(packed: Path, small_protocol: Protocol) -> None:
    run("hyaline-bench score --preset tiny")
    scored = read_scored(SCORES)
    few = dataclasses.replace(scored, name="few", scenes={"synthetic": scored.scenes["synthetic"]})
    rows = track_grid("", [few, scored], small_protocol).rows
    assert [(row[0], row[1]) for row in rows] == [("nearest-view", "2/4"), ("few", "1/4")]
