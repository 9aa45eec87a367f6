"""A dataset's geometries: the true meshes of its scene, their proxies, and glass that was fitted to pictures.

scene/meshes/NAME.ply              the truth
proxies/KIND/proxies.json          sealed, written first: one mesh per object, with SHA-256 and statistics
proxies/KIND/meshes/NAME.ply

KIND is a geometry's name: a kind of proxy, or `mixed` and more, where `assignment` in proxies.json names each object's
stand-in; of fitted glass `fitted` or `fitted-NAME`, where `materials` has those that were found, by object.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from datagen.data.dataset import Dataset, check_has_meshes
from datagen.data.meshes import Mesh, check_mesh, is_there, no_mesh
from datagen.data.paths import FITTED, MIXED, PROXY_KINDS, TRUTH, geometry_root, is_fitted
from datagen.data.ply import decode_ply, write_ply
from datagen.disk.errors import HyalineError, shown
from datagen.disk.ownership import PROXIES, begin, is_ours, refuse_taken, remove_files
from datagen.disk.records import Json, dump_json, from_json, load_sealed, to_json
from datagen.disk.storage import check_name, commit_all, is_name, read_all, sha256
from datagen.terminal.command import choose

PROXIES_VERSION = 1

NO_GEOMETRY = "none"
"""The geometry of a method that uses no layers."""


@dataclass(frozen=True, kw_only=True)
class ProxyStatistics:
    """How well a proxy fits its object."""

    volume_ratio: float
    """Volume of the proxy over the volume of the object's convex hull (>= 1 for a conservative convex proxy)."""
    mean_distance: float
    """Mean distance in metres from points on the proxy to the object's surface."""
    max_distance: float
    """Largest such distance in metres."""


@dataclass(frozen=True, kw_only=True)
class ProxyRecord:
    """One object's proxy on disk."""

    object: str
    file: str
    sha256: str
    statistics: ProxyStatistics | None
    """None for fitted glass, which is made where the truth is not known."""

    def __post_init__(self) -> None:
        check_name(self.object, where="object name")
        if self.file != f"meshes/{self.object}.ply":
            raise HyalineError(f"proxy of {self.object}: lies at {self.file!r}; expected meshes/{self.object}.ply")


@dataclass(frozen=True, kw_only=True)
class _Head:
    """proxies.json, but for the materials."""

    version: int
    kind: str
    dataset: str
    proxies: tuple[ProxyRecord, ...]
    assignment: tuple[str, ...] | None = None


def write_proxies(
    dataset: Dataset,
    kind: str,
    meshes: tuple[Mesh, ...],
    statistics: tuple[ProxyStatistics | None, ...],
    assignment: tuple[str, ...] | None = None,
    materials: Mapping[str, Json] | None = None,
) -> None:
    """Commits one proxy mesh per object, in object order; none for objects that an edit removed.

    Args:
        assignment: for a mixture or fitted glass, each object's stand-in: truth, box, fitted, ...
        materials: by name, the materials of objects that do not have those of the scene.
    """
    root = geometry_root(dataset.root, kind)
    listed, files = [], {}
    for item, mesh, numbers in zip(dataset.objects, meshes, statistics, strict=True):
        if not is_there(mesh):
            continue
        file, data = f"meshes/{item.name}.ply", write_ply(mesh)
        files[file] = data
        listed.append(ProxyRecord(object=item.name, file=file, sha256=sha256(data), statistics=numbers))
    content: dict[str, Json] = {
        "version": PROXIES_VERSION,
        "kind": kind,
        "dataset": dataset.seal,
        "proxies": to_json(tuple(listed)),
    }
    if assignment is not None:
        content["assignment"] = to_json(assignment)
    if materials:
        content["materials"] = dict(materials)
    if is_ours(root, PROXIES):
        old = proxy_files(root)
        refuse_taken(root, PROXIES, files, old)
        remove_files(root, sorted(set(old) - set(files)))
    begin(root, PROXIES, content, replace=True)
    commit_all(root, files)


def proxy_files(root: Path) -> list[str]:
    """The meshes that a folder of proxies lists, by path relative to it."""
    return [record.file for record in _read_head(root)[0].proxies]


def _read_head(root: Path) -> tuple[_Head, dict[str, Json]]:
    """The content of proxies.json: its record, and the materials in it."""
    path = root / PROXIES.head
    content = load_sealed(path)
    if (version := content.get("version")) != PROXIES_VERSION:
        raise HyalineError(f"{path}: format version {shown(version)}; this program reads {PROXIES_VERSION}")
    materials = content.pop("materials", {})
    if not isinstance(materials, dict):
        raise HyalineError(f"{path}: materials: is {shown(materials)}; expected an object")
    return from_json(_Head, content, where=str(path)), materials


def read_proxy_records(dataset: Dataset, kind: str) -> tuple[ProxyRecord, ...]:
    """The list of a dataset's proxies of one kind, in object order."""
    dataset = dataset.home
    root = geometry_root(dataset.root, kind)
    if not (root / PROXIES.head).is_file():
        check_has_meshes(dataset)
        if kind.partition("-")[0] not in (*PROXY_KINDS, MIXED, FITTED):
            choose("geometry", kind, {*list_geometries(dataset), *PROXY_KINDS} - {kind})
        raise HyalineError(f"{root / PROXIES.head}: no {kind} proxies; make them with `{_maker(kind)}`")
    head, _ = _read_head(root)
    if (head.kind, head.dataset) != (kind, dataset.seal):
        raise HyalineError(
            f"{root / PROXIES.head}: holds {head.kind!r} of another dataset or folder; make them again with "
            f"--overwrite (`{_maker(kind)}`)"
        )
    return head.proxies


def _maker(kind: str) -> str:
    """The command that makes a geometry, or that explains how to make a mixture."""
    if is_fitted(kind):
        return "model fit"
    return f"proxies make --kind {kind}" if kind in PROXY_KINDS else "proxies make --help"


def read_assignment(dataset: Dataset, geometry: str) -> tuple[str, ...] | None:
    """Each object's stand-in in a mixture, in object order; None for the truth and for one kind of proxy."""
    return None if geometry == TRUTH else _read_head(geometry_root(dataset.root, geometry))[0].assignment


def read_materials(dataset: Dataset, geometry: str) -> dict[str, Json]:
    """The materials, by name of the object, that a geometry has in place of the scene's."""
    return _read_head(geometry_root(dataset.home.root, geometry))[1] if is_fitted(geometry) else {}


def describe_geometry(dataset: Dataset, geometry: str) -> str:
    """A geometry in words, for tables."""
    if geometry == TRUTH:
        return "true geometry"
    assignment = read_assignment(dataset, geometry)
    if assignment is None:
        return f"proxy geometry ({geometry})"
    most = max(sorted(set(assignment)), key=lambda kind: (assignment.count(kind), kind == TRUTH))
    objects = {kind: [] for kind in dict.fromkeys(assignment) if kind != most}
    for item, kind in zip(dataset.objects, assignment, strict=False):
        if kind != most:
            objects[kind].append(item.name)
    parts = [*(f"{kind} for {', '.join(names)}" for kind, names in objects.items()), f"{most} for the rest"]
    return f"{'fitted' if is_fitted(geometry) else 'proxy'} geometry ({geometry}: {'; '.join(parts)})"


def list_geometries(dataset: Dataset) -> list[str]:
    """`truth`, and every kind of proxy in the dataset."""
    made = (path.parent.name for path in dataset.home.root.glob("proxies/*/proxies.json"))
    return [TRUTH, *sorted(filter(is_name, made))]


def check_geometry(dataset: Dataset, geometry: str) -> None:
    """Raises unless the dataset has the geometry; suggests the nearest name, or the command that makes the proxy."""
    if geometry not in list_geometries(dataset):
        read_proxy_records(dataset, geometry)


def read_meshes(dataset: Dataset, geometry: str) -> tuple[Mesh, ...]:
    """The meshes of `truth` or of a proxy kind, in object order, verified against their checksums.

    An object that an edit removed has a mesh without faces.
    """
    dataset = dataset.home
    check_has_meshes(dataset)
    root = geometry_root(dataset.root, geometry)
    files, meshes = _mesh_files(dataset, geometry), {}
    for (name, (file, _)), data in zip(files.items(), read_all(root, dict(files.values())), strict=True):
        meshes[name], _ = decode_ply(data, where=str(root / file))
        check_mesh(meshes[name], where=str(root / file))
    return tuple(meshes.get(item.name) or no_mesh() for item in dataset.objects)


def geometry_hash(dataset: Dataset, geometry: str) -> str:
    """Hash of a geometry's meshes, verified, which layers record."""
    check_has_meshes(dataset)
    root = geometry_root(dataset.home.root, geometry)
    return sha256(b"".join(read_all(root, dict(_mesh_files(dataset.home, geometry).values()))))


@dataclass(frozen=True, kw_only=True)
class GeometryKey:
    """A key for results computed from a geometry: equal if the dataset's head, all meshes and materials are."""

    dataset: Dataset = field(compare=False)
    seal: str
    geometry: str
    hashes: tuple[str, ...]
    """SHA-256 of the meshes, and of the materials that differ from the scene's."""


def geometry_key(dataset: Dataset, geometry: str) -> GeometryKey:
    """The key of a geometry from its sealed list; reads no mesh."""
    hashes = [sha256 for _, sha256 in _mesh_files(dataset.home, geometry).values()]
    hashes.append(sha256(dump_json(read_materials(dataset, geometry))))
    return GeometryKey(dataset=dataset.home, seal=dataset.home.seal, geometry=geometry, hashes=tuple(hashes))


def geometry_digest(dataset: Dataset, geometry: str) -> str:
    """A hash of what `GeometryKey` compares, for records."""
    key = geometry_key(dataset, geometry)
    return sha256(" ".join([key.seal, *key.hashes]).encode())


def _mesh_files(dataset: Dataset, geometry: str) -> dict[str, tuple[str, str]]:
    """File (relative to the geometry's folder) and SHA-256 of each object's mesh, except of objects without one."""
    if geometry != TRUTH:
        return {record.object: (record.file, record.sha256) for record in read_proxy_records(dataset, geometry)}
    promised = dataset.files
    files = {item.name: f"scene/meshes/{item.name}.ply" for item in dataset.objects}
    return {name: (file, promised[file]) for name, file in files.items() if file in promised}
