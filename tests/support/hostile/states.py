"""Hostile weights: pickles that would run code, archives that lie, and states that are no renderer."""

import io
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from support.hostile.jsons import Case, named

from model.run.checkpoint import CHECKPOINT_VERSION, fingerprint

PATH = "runs/one/paper/weights.pt"
MARK = "MARK-OF-CODE-THAT-RAN"
"""A file that a hostile pickle makes in the working folder, when it is let."""


class Bomb:
    """Unpickled, it calls a function."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> Any:
        return self.call


def saved(state: Any) -> bytes:
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return buffer.getvalue()


def signed(state: dict[str, Any], version: Any = CHECKPOINT_VERSION) -> bytes:
    """With the hash that a careful attacker would give it."""
    content = {"version": version, **state}
    return saved({**content, "sha256": fingerprint(content)})


def repacked(data: bytes, change: Any) -> bytes:
    """The same archive with other files in it: `change(name, data)` says what, None leaves a file out."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(buffer, "w") as new:
        for item in old.infolist():
            if (changed := change(item.filename, old.read(item))) is not None:
                new.writestr(*changed)
    return buffer.getvalue()


def state_cases(good: bytes) -> list[Case]:
    """Weights of a run; `good` is the file of a real one."""
    state = torch.load(io.BytesIO(good), weights_only=True)
    renderer = state["renderer"]
    name = sorted(key for key, value in renderer.items() if value.is_floating_point() and value.ndim == 2)[0]
    plain = {key: value for key, value in state.items() if key not in ("sha256", "version")}

    def with_tensor(value: Any, key: str = name) -> bytes:
        return signed({**plain, "renderer": {**renderer, key: value}})

    touch, mark = Path.touch, Path(MARK)
    contents = {
        "good": good,
        "code: os.system": saved(Bomb(os.system, f"touch {MARK}")),
        "code: eval": saved({"a": Bomb(eval, f"open({MARK!r}, 'w')")}),
        "code: a method": saved({"renderer": Bomb(touch, mark)}),
        "code: a plain pickle": pickle.dumps(Bomb(os.system, f"touch {MARK}")),
        "code: getattr": saved(Bomb(getattr, touch, "__globals__")),
        "code: in a key": saved({Bomb(os.system, f"touch {MARK}"): 1}),
        "code: beside good weights": saved({**state, "more": Bomb(os.system, f"touch {MARK}")}),
        "a numpy array": saved({"a": np.arange(3)}),
        "nothing": saved(None),
        "an empty state": saved({}),
        "no hash": saved({"version": 1, **plain}),
        "a wrong hash": saved({"version": 1, **plain, "sha256": "0" * 64}),
        "version 2": signed(plain, 2),
        "no version": signed(plain, None),
        "no renderer": signed({key: value for key, value in plain.items() if key != "renderer"}),
        "no config": signed({key: value for key, value in plain.items() if key != "config"}),
        "a config without a key": signed(
            {**plain, "config": {key: value for key, value in plain["config"].items() if key != "method"}}
        ),
        "a config with a key more": signed({**plain, "config": {**plain["config"], "mystery": 1}}),
        "another config": signed({**plain, "config": {**plain["config"], "steps": 99}}),
        "a tensor less": signed({**plain, "renderer": {k: v for k, v in renderer.items() if k != name}}),
        "a tensor of text": with_tensor("x"),
        "a tensor of another shape": with_tensor(torch.ones(2, 3, 4)),
        "a tensor of integers": with_tensor(torch.ones(renderer[name].shape, dtype=torch.int64)),
        "a tensor of halves": with_tensor(renderer[name].half()),
        "a transposed tensor": with_tensor(renderer[name].t().contiguous().t()),
        "a tensor of NaN": with_tensor(torch.full_like(renderer[name], float("nan"))),
        "an archive without its pickle": repacked(good, lambda n, d: None if n.endswith("data.pkl") else (n, d)),
        "an archive with a pickle of code": repacked(
            good, lambda n, d: (n, pickle.dumps(Bomb(os.system, f"touch {MARK}")) if n.endswith("data.pkl") else d)
        ),
        "an archive without its numbers": repacked(good, lambda n, d: None if n.endswith("data/0") else (n, d)),
        "an archive of short numbers": repacked(good, lambda n, d: (n, d[:3] if n.endswith("data/0") else d)),
        "an archive that climbs out": repacked(good, lambda n, d: (f"../../{n}", d)),
        "an archive with code of TorchScript": repacked(
            good, lambda n, d: (n.replace("data.pkl", "code/__torch__.py") if n.endswith("data.pkl") else n, d)
        ),
        "a zip bomb": repacked(good, lambda n, d: (n, bytes(20_000_000) if n.endswith("data/0") else d)),
        "bytes after the end": good + b"more",
    }
    for length in np.linspace(1, len(good) - 1, 30).astype(int):
        contents[f"cut to {length}"] = good[:length]
    rng, stored = np.random.default_rng(11), places_of_state(good)
    for number in range(30):
        spoilt = bytearray(good)
        place = int(rng.choice(stored))
        spoilt[place] ^= 1 << int(rng.integers(8))
        contents[f"bit {number} flipped at {place}"] = bytes(spoilt)
    return named("weights", "weights", PATH, contents)


def places_of_state(data: bytes) -> np.ndarray:
    """Where an archive of PyTorch's holds the state, and not names, padding and the like, which carry nothing."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        spans = []
        for member in archive.infolist():
            if "/data" in member.filename:
                head = data[member.header_offset : member.header_offset + 30]
                start = member.header_offset + 30 + sum(int.from_bytes(head[at : at + 2], "little") for at in (26, 28))
                spans.append(np.arange(start, start + member.file_size))
    return np.concatenate(spans)
