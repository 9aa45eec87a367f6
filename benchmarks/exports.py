"""Exports opened by other tools' loaders, and compared with the dataset: cameras, pictures, splits, depth, points.

Each loader runs in its tool's own environment (`exports_child.py`). Cameras are compared by mesh vertices: a visible
vertex is projected by the dataset's camera, the loader gives its ray through that pixel, and the point of this ray
nearest to the vertex is projected again.
"""

import dataclasses
import json
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, UInt8

from datagen.data.cameras import Camera
from datagen.data.dataset import Dataset
from datagen.disk.errors import HyalineError
from datagen.disk.storage import sha256
from datagen.terminal.command import say
from hyaline_export.formats import export_dataset
from hyaline_export.source import ExportView, Source

LOADERS = Path(__file__).with_name("exports_child.py")

PEERS: dict[str, tuple[str, ...]] = {
    "nerfstudio-data": ("nerfstudio",),
    "nerfstudio-blender": ("blender", "3dgs"),
    "nerfstudio-colmap": ("colmap",),
    "nerfbaselines": ("nerfbaselines",),
    "pycolmap": ("colmap",),
    "datasets": ("huggingface",),
}
"""Loaders, and the formats that each opens."""

PLACES = 32
"""Vertices to project in each picture."""

MAX_OFF_PX = 0.05
"""Tolerance of a reprojected vertex in pixels. Loaders use single precision; the errors to detect are half a pixel."""

MAX_OFF_M = 1e-5
"""Tolerance of a point."""

MAX_OFF_DEPTH_M = 0.0006
"""Tolerance of depth: PNGs have whole millimetres."""

NOT_INSTALLED = 3
"""Exit status of `exports_child.py`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Places:
    """Places of a picture at which something is known of the truth."""

    pixels: Float[np.ndarray, "place 2"]
    """Column and row; (0.5, 0.5) is the centre of the upper left pixel."""
    p_world: Float[np.ndarray, "place 3"]
    """The vertex at each place, in metres."""
    depth: Float32[np.ndarray, " place"]
    """Metres along the axis to the first surface, at the pixel's centre; 0: none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Read:
    """A loader's answer, as `exports_child.py` wrote it."""

    about: dict
    arrays: Mapping[str, np.ndarray]


@dataclass(frozen=True, kw_only=True)
class Unread:
    """Why a loader gave no answer."""

    reason: str
    is_installed: bool


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing that was compared."""

    what: str
    passed: bool
    detail: str


@dataclass(frozen=True, kw_only=True)
class PeerReport:
    """The findings of one loader on one export."""

    peer: str
    form: str
    versions: dict[str, str]
    missing: str | None
    """The missing package; then there are no findings."""
    findings: tuple[Finding, ...]


def find_places(item: ExportView, rng: np.random.Generator) -> Places:
    """Some visible vertices of a view, each on its own object's pixels; without any, pixel centres."""
    found = item.quantities
    camera, size = item.view.camera, np.array([item.view.camera.width, item.view.camera.height])
    candidates, pixels = [], []
    for object_id, mesh in enumerate(found.surfaces.meshes, 1):
        p_world = mesh.vertices.astype(np.float64)
        place, ahead = project(camera, p_world)
        inside = (ahead > 0) & (place > 0).all(axis=-1) & (place < size).all(axis=-1)
        column, row = np.where(inside[:, None], np.floor(place), 0).astype(int).T
        near = np.abs(ahead - found.depth_along_axis[row, column]) < 0.01 * ahead
        shown = inside & near & (found.object_id[row, column] == object_id)
        candidates.append(p_world[shown])
        pixels.append(place[shown])
    known, at = np.concatenate(candidates), np.concatenate(pixels)
    if not len(known):
        rows, columns = np.indices(found.object_id.shape)
        at = np.stack([columns, rows], axis=-1).reshape(-1, 2) + 0.5
        origin, directions = camera.rays()
        known = origin + directions.reshape(-1, 3).astype(np.float64)
    chosen = rng.integers(0, len(known), PLACES)
    column, row = np.floor(at[chosen]).astype(int).T
    return Places(pixels=at[chosen], p_world=known[chosen], depth=found.depth_along_axis[row, column])


def project(
    camera: Camera, p_world: Float[np.ndarray, "place 3"]
) -> tuple[Float[np.ndarray, "place 2"], Float[np.ndarray, " place"]]:
    """Pixels (column, row) and metres ahead, by the camera's matrices alone."""
    p_camera = (p_world - camera.world_from_camera[:3, 3]) @ camera.world_from_camera[:3, :3] * [1, -1, -1]
    image = p_camera @ camera.intrinsics.T
    return image[:, :2] / np.where(image[:, 2:] == 0, 1, image[:, 2:]), p_camera[:, 2]


def check_python(python: Path) -> None:
    """Raises a HyalineError for anything but a Python interpreter."""
    try:
        done = subprocess.run([str(python.absolute()), "-I", "-c", "import numpy"], capture_output=True, check=False)
    except OSError as error:
        raise HyalineError(
            f"--python: {python} does not run ({error.strerror}); expected a Python interpreter"
        ) from None
    if done.returncode:
        raise HyalineError(f"--python: {python} has no numpy; expected the interpreter of the tools' environment")


def ask(python: Path, peer: str, root: Path, places: Mapping[str, Places], folder: Path) -> Read | Unread:
    """The loader's answer, or why it gave none.

    Args:
        python: interpreter of the tool's environment.
        root: the export.
        folder: where question and answer may be written.
    """
    question, answer = folder / "question.npz", folder / "answer.npz"
    # numpy's stubs take the names for their own arguments.
    np.savez(question, **{name: found.pixels for name, found in places.items()})  # pyright: ignore[reportArgumentType]
    # The interpreter of a virtual environment is a link that must not be resolved: its path selects the packages.
    command = [str(python.absolute()), "-I", str(LOADERS), peer, str(root.resolve()), str(question), str(answer)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, check=False)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
        return Unread(reason=last, is_installed=done.returncode != NOT_INSTALLED)
    with np.load(answer) as file:
        return Read(
            about=json.loads(str(file["about"])), arrays={name: file[name] for name in file.files if name != "about"}
        )


def report_on(peer: str, form: str, source: Source, places: Mapping[str, Places], answer: Read | Unread) -> PeerReport:
    """The report on a loader's answer."""
    if isinstance(answer, Read):
        findings = compare(source, places, answer)
        return PeerReport(peer=peer, form=form, versions=answer.about["versions"], missing=None, findings=findings)
    if answer.is_installed:
        failed = Finding(what="opens", passed=False, detail=answer.reason)
        return PeerReport(peer=peer, form=form, versions={}, missing=None, findings=(failed,))
    return PeerReport(peer=peer, form=form, versions={}, missing=answer.reason, findings=())


def compare(source: Source, places: Mapping[str, Places], read: Read) -> tuple[Finding, ...]:
    """Everything that the loader answered, against the dataset."""
    views = {item.name: item for item in source.pictures if item.name in read.about["names"]}
    findings = [_splits(source, read), _pictures(views, read), _cameras(views, places, read)]
    if "points" in read.arrays:
        findings.append(_points(source, read))
    if read.about["track_px"] is not None:
        off = read.about["track_px"]
        findings.append(Finding(what="tracks", passed=off < MAX_OFF_PX, detail=f"off by at most {off:.1e} px"))
    if "depth" in read.arrays:
        truth = np.stack([places[name].depth for name in read.about["names"]])
        off = float(np.abs(read.arrays["depth"] - truth).max())
        detail = f"along the axis, off by at most {1000 * off:.2g} mm"
        findings.append(Finding(what="depth", passed=off < MAX_OFF_DEPTH_M, detail=detail))
    if read.about["near_far"] is not None:
        near, far = read.about["near_far"]
        passed = (near, far) == (source.bounds.near, source.bounds.far)
        findings.append(Finding(what="near and far", passed=passed, detail=f"{near:.3g} to {far:.3g} m"))
    if "box" in read.arrays:
        findings.append(_box(views, read))
    return tuple(findings)


def _splits(source: Source, read: Read) -> Finding:
    splits = read.about["splits"]
    wanted = {role: sorted(item.name for item in source.of_role(role)) for role in splits}
    passed = {role: sorted(names) for role, names in splits.items()} == wanted
    if not splits:  # A tool that knows none reads every picture.
        passed = sorted(read.about["names"]) == sorted(item.name for item in source.pictures)
        return Finding(what="splits", passed=passed, detail=f"none; {len(read.about['names'])} pictures")
    detail = ", ".join(f"{len(names)} {role}" for role, names in splits.items())
    return Finding(what="splits", passed=passed and bool(read.about["names"]), detail=detail)


def _pictures(views: Mapping[str, ExportView], read: Read) -> Finding:
    about, wrong = read.about, []
    for index, name in enumerate(about["names"]):
        image = views[name].view.image if name in views else np.zeros((0, 0, 3), np.uint8)
        height, width = image.shape[:2]
        same = about["hashes"][index] == sha256(image.tobytes())
        if not (same and about["sizes"][index] == [width, height] and about["is_opaque"][index]):
            wrong.append(name)
    channels = " or ".join(map(str, sorted(set(about["channels"]))))
    sizes = ", ".join(sorted({f"{width} x {height}" for width, height in about["sizes"]}))
    detail = f"{wrong[0]} and {len(wrong) - 1} more differ" if wrong else f"equal, {sizes}, {channels} channels"
    return Finding(what="pictures", passed=not wrong, detail=detail)


def _cameras(views: Mapping[str, ExportView], places: Mapping[str, Places], read: Read) -> Finding:
    worst = 0.0
    for index, name in enumerate(read.about["names"]):
        if name not in views:
            continue
        origins, directions = read.arrays["origins"][index], read.arrays["directions"][index]
        towards = places[name].p_world - origins
        along = (towards * directions).sum(axis=-1) / (directions**2).sum(axis=-1)
        pixels, _ = project(views[name].view.camera, origins + along[:, None] * directions)
        off = np.where(along > 0, np.linalg.norm(pixels - places[name].pixels, axis=-1), np.inf)
        worst = max(worst, float(off.max()))
    count = PLACES * len(views)
    return Finding(
        what="cameras", passed=worst < MAX_OFF_PX, detail=f"{count:,} vertices, off by at most {worst:.1e} px"
    )


def _points(source: Source, read: Read) -> Finding:
    truth, points = source.points, read.arrays["points"]
    if points.shape != truth.position.shape:
        detail = f"{len(points)}; expected {len(truth.position)}"
        return Finding(what="points", passed=False, detail=detail)
    off = float(np.abs(points - truth.position).max())
    colored: UInt8[np.ndarray, "point 3"] = read.arrays["colors"]
    # A loader that goes through fractions may round down by one.
    same = bool((np.abs(colored.astype(int) - truth.color) <= 1).all())
    detail = f"{len(points):,}, off by at most {1000 * off:.1e} mm" + ("" if same else ", in other colours")
    return Finding(what="points", passed=same and off < MAX_OFF_M, detail=detail)


def _box(views: Mapping[str, ExportView], read: Read) -> Finding:
    """How much glass is inside the box that the tool assumes: worth knowing, and not for an export to decide."""
    (low, high), matrix = read.arrays["box"], read.arrays["box_from_world"]
    inside, total = 0, 0
    for item in views.values():
        found = item.quantities
        p_box = found.position[found.glass] @ matrix[:, :3].T + matrix[:, 3]
        inside += int(((p_box > low) & (p_box < high)).all(axis=-1).sum())
        total += len(p_box)
    detail = "no glass is seen" if not total else f"holds {inside / total:.1%} of the glass that is seen first"
    return Finding(what="scene box", passed=True, detail=detail)


def survey_peers(dataset: Dataset, python: Path, peers: Sequence[str], *, num_points: int) -> list[PeerReport]:
    """Exports into a folder that is gone afterwards, and opens each export with each tool that reads its format.

    Args:
        python: interpreter of the tools' environment.
        peers: names in `PEERS`.
    """
    check_python(python)
    source = Source(dataset=dataset, num_points=num_points, flow=False)
    rng = np.random.default_rng(0)
    places = {item.name: find_places(item, rng) for item in source.pictures}
    reports = []
    with tempfile.TemporaryDirectory(prefix="hyaline-peers-") as folder:
        for peer in peers:
            for form in PEERS[peer]:
                root = Path(folder) / f"{peer}-{form}"
                export_dataset(dataset, form, root, num_points=num_points, flow=False)
                say(f"peers: {peer} opens {form}")
                answer = ask(python, peer, root, places, Path(folder))
                reports.append(report_on(peer, form, source, places, answer))
    return reports


def peers_table(reports: Sequence[PeerReport]) -> str:
    """A line for each thing that was compared."""
    lines = []
    for report in reports:
        versions = ", ".join(f"{name} {version}" for name, version in report.versions.items())
        state = f"not installed ({report.missing})" if report.missing else versions
        lines.append(f"{report.peer}, --format {report.form}: {state}")
        lines += [f"  {'ok   ' if one.passed else 'WRONG'} {one.what}: {one.detail}" for one in report.findings]
    return "\n".join(lines)


def peers_json(reports: Sequence[PeerReport]) -> str:
    """The same as JSON."""
    return json.dumps([dataclasses.asdict(report) for report in reports], indent=2)
