"""A trained scene as one HTML file, which draws it live in a browser, from disk and without a server.

The page's parts are next to this file: page.html has a {{placeholder}} for each. Nothing is loaded from outside, which
a content security policy enforces. Equal runs give equal bytes.
"""

import base64
import hashlib
import html
import json
import re
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import cast

from datagen.data.dataset import Dataset
from datagen.data.paths import view_name
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json
from datagen.disk.storage import commit, read_regular
from datagen.pages.html import data_uri, lossless_uri
from datagen.terminal.plugins import VERSION
from hyaline_web.page.scene import Quality, web_scene
from model.methods.page import package_text
from model.methods.protocol import MethodConfig
from model.methods.renderer import Renderer
from model.run.predict import load_renderer
from model.run.run_folder import RunRecord

SCRIPTS = (
    "vectors.js",
    "unpack.js",
    "floats.js",
    "bvh.js",
    "camera.js",
    "objects.js",
    "tracer.js",
    "frames.js",
    "paths.js",
    "gestures.js",
    "panel.js",
    "page.js",
)

MAX_PICTURE = 1 << 26
"""Largest still picture in bytes."""


def export_run(run: Path, record: RunRecord, dataset: Dataset, out: Path, quality: Quality) -> None:
    """Writes the page of a trained run."""
    if not record.config.net.page:
        raise HyalineError(f"{run}: its method, {record.method}, has no web page; docs/browser.md lists those that do")
    renderer = load_renderer(run, record.config, dataset)
    still = run / "predictions" / "interpolating" / f"{view_name(0)}.png"
    if not still.is_file():
        raise HyalineError(f"{still}: missing; render it with `{shlex.join(['model', 'predict', str(run)])}`")
    page = scene_page(
        renderer,
        record.config.net,
        dataset,
        record.geometry,
        quality,
        label=record.label,
        still=read_regular(still, at_most=MAX_PICTURE),
    )
    commit(out, page)


def scene_page(
    renderer: Renderer,
    config: MethodConfig,
    dataset: Dataset,
    geometry: str,
    quality: Quality,
    *,
    label: str,
    still: bytes,
) -> bytes:
    """The page of a renderer.

    Args:
        label: the run's label.
        still: a PNG, shown until the first picture is drawn, and where WebGL is missing.
    """
    scene = web_scene(renderer, config, dataset, geometry, quality)
    manifest = {**scene.manifest, "arrays": scene.packed.entries, "truth": cast(Json, _truths(dataset))}
    script = f'"use strict";\n(() => {{\n{package_text("hyaline_web.page", *SCRIPTS)}}})();\n'
    style = package_text("datagen.pages", "page.css") + package_text("hyaline_web.page", "page.css")
    title = f"{dataset.name}: {label}"
    return fill(
        package_text("hyaline_web.page", "page.html"),
        {
            "policy": _policy(script, style),
            "generator": f"hyaline {VERSION}",
            "title": html.escape(title),
            "style": style,
            "alternative": html.escape(f"Still picture of {dataset.name}"),
            "still": "data:image/png;base64," + base64.b64encode(still).decode(),
            "label": html.escape(f"{dataset.name}, drawn live"),
            "heading": html.escape(title),
            "about": html.escape(
                f"Drawn by the networks that hyaline's {label} learned from pictures of {dataset.name} "
                f"(quality {quality}; dataset {dataset.seal[:12]}). The page's program is under the MIT licence. "
                f"The scene: {dataset.license}."
            ),
            "manifest": json.dumps(manifest, sort_keys=True).replace("<", "\\u003c"),
            "shader": scene.shader,
            "data": scene.packed.text(),
            "script": script,
        },
    ).encode()


def _truths(dataset: Dataset) -> dict[str, str]:
    """The path tracer's picture of each view that is built, by split/view: without loss, 20 kB for a view of the demo;
    of training views in an eighth of the bytes, at 31 dB."""
    return {
        f"{split}/{view.index}": data_uri(view.image, "webp", quality=75)
        if split == "train"
        else lossless_uri(view.image)
        for split in dataset.splits
        for view in dataset.views(split)
        if view.is_built
    }


def fill(template: str, parts: Mapping[str, str]) -> str:
    """The template with its placeholders filled in; each must occur exactly once."""
    places = re.findall(r"\{\{(\w+)\}\}", template)
    assert sorted(places) == sorted(parts), "every place of the page has its part, and every part its place"
    return re.sub(r"\{\{(\w+)\}\}", lambda place: parts[place[1]], template)


def _policy(script: str, style: str) -> str:
    """A content security policy that allows this script and this style, pictures in the page, and nothing else."""
    hashes = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in (script, style))
    allowed = [f"{kind}-src 'sha256-{digest}'" for kind, digest in zip(("script", "style"), hashes)]
    return "; ".join(["default-src 'none'", *allowed, "img-src data: blob:"])
