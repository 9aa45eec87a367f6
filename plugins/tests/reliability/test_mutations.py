"""Tests that every kind of damage to every file of a dataset and of a run is noticed, and the file named."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from support.disk import State, read_state
from support.hostile import write_world
from support.promises import spread
from support.synthetic import write_synthetic_dataset

from datagen.builder.verify import verify_dataset
from datagen.data.config import TEST_SPLITS
from datagen.disk.errors import HyalineError
from datagen.disk.records import load_sealed, seal_bytes
from eval.score.runs import open_run, read_prediction
from model.run.predict import load_renderer
from model.run.run_folder import read_run
from model.state import fingerprint, load_state

pytestmark = pytest.mark.promise("R4")

DATASET, RUN = "data/one", "runs/one/paper"
WEIGHTS = f"{RUN}/weights.pt"
ALL, QUICK = 1000, 120
Mutation = tuple[str, str, bytes | None]
"""What is done, to which file, and what it then holds; None: it is gone."""


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, State]:
    """A dataset with layers and proxies, and a run trained on it."""
    root = tmp_path_factory.mktemp("world")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    write_world(root)
    torch.set_num_threads(threads)
    return root, read_state(root)


def mutations(good: dict[str, bytes], other: dict[str, bytes], number: int) -> list[Mutation]:
    """So many, each file with each kind of damage first; bits flip and files end early at random places after that.

    Args:
        other: the same files of another dataset.
    """
    rng = np.random.default_rng(5)

    def flipped(data: bytes) -> bytes:
        spoilt = bytearray(data)
        spoilt[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        return bytes(spoilt)

    found: list[Mutation] = []
    for path, data in good.items():
        found += [("deleted", path, None), ("emptied", path, b""), ("lengthened", path, data + b"\n")]
        found += [("a bit flipped", path, flipped(data)), ("cut short", path, data[: int(rng.integers(1, len(data)))])]
        twin = path.replace("/0000.", "/0001.").replace("/c/0/", "/c/1/")
        if twin != path and twin in good and good[twin] != data:
            found.append(("swapped with another view's", path, good[twin]))
        if path in other and other[path] != data:
            found.append(("of another dataset", path, other[path]))
    paths = sorted(good)
    while len(found) < number:
        path = paths[int(rng.integers(len(paths)))]
        what = ("a bit flipped", "cut short")[int(rng.integers(2))]
        data = good[path]
        found.append((what, path, flipped(data) if what[0] == "a" else data[: int(rng.integers(len(data)))]))
    return found


def complaints(root: Path) -> str:
    """Everything that is said of a dataset and of a run by those who read them."""
    said: list[str] = []

    def hear(read: Callable[[], object]) -> None:
        try:
            read()
        except HyalineError as error:
            said.append(str(error))

    hear(lambda: said.extend(verify_dataset(root / DATASET).problems))
    folder = root / RUN
    hear(lambda: load_renderer(folder, read_run(folder).config, open_run(folder, root / "data").dataset))
    for split in TEST_SPLITS:
        for view in range(2):
            hear(lambda split=split, view=view: read_prediction(open_run(folder, root / "data"), split, view))
    return "\n".join(said)


def is_same_state(path: Path, good: bytes) -> bool:
    """True when weights have the same numbers: some bits of their archive are padding."""
    whole = path.with_name("whole.pt")
    whole.write_bytes(good)
    try:
        return fingerprint(load_state(path)) == fingerprint(load_state(whole))  # pyright: ignore[reportArgumentType]
    except HyalineError:
        return False
    finally:
        whole.unlink()


def test_every_mutation_of_every_file_is_noticed_and_the_file_named(
    world: tuple[Path, State], tmp_path: Path, is_full: bool
) -> None:
    root, state = world
    good = {path: data for path, data in state.files.items() if path.startswith((DATASET + "/", RUN + "/"))}
    # A log for people, which no command reads.
    del good[f"{RUN}/metrics.jsonl"]
    write_synthetic_dataset(tmp_path / DATASET, resolution=8, train_views=3)
    other = {path: data for path, data in read_state(tmp_path).files.items() if path in good}
    assert complaints(root) == ""
    missed = []
    tried = mutations(good, other, ALL)
    for what, path, content in tried if is_full else spread(tried, QUICK):
        place = root / path
        if content is None:
            place.unlink()
        else:
            place.write_bytes(content)
        # A run without its record is none: then the folder is named.
        named = f"{RUN}: holds no run" if (what, path) == ("deleted", f"{RUN}/run.json") else path
        if what == "of another dataset" and "/layers/" in path:
            # Whole, but of other arrays than those beside it: either may be the wrong one, and the arrays are named.
            named = path.replace("/records/", "/arrays/").removesuffix("json")
        said = complaints(root)
        # Of a view that lacks its record, verify tells as of one that is not built yet, by its place in the dataset.
        is_named = named in said or (what == "deleted" and path.removeprefix(f"{DATASET}/") in said)
        if not is_named and not (path == WEIGHTS and is_same_state(root / path, good[path])):
            missed.append(f"{path} {what}")
        place.write_bytes(good[path])
    assert read_state(root).files == state.files
    assert not missed, f"{len(missed)}:\n" + "\n".join(missed[:40])


def test_a_stale_record_with_a_good_seal_is_noticed(world: tuple[Path, State], tmp_path: Path) -> None:
    """A view's record, and its layers', that promises what another view of the same dataset holds."""
    root, state = world
    records = [path for path in state.files if "/records/" in path and path.endswith("0000.json")]
    assert len(records) == 6
    for path in records:
        twin = load_sealed(root / path.replace("0000.json", "0001.json"))
        (root / path).write_bytes(seal_bytes({**twin, "view": 0}))
        before = complaints(root)
        (root / path).write_bytes(state.files[path])
        assert path in before, (path, before)
