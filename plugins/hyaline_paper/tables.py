"""The tables of the paper, and those that it should have had: which runs each compares."""

import dataclasses

from datagen.data.geometries import NO_GEOMETRY
from hyaline_paper.comparisons import (
    DNR,
    NO_EXTRINSICS,
    SPHERICAL_HARMONICS,
    VIEW_VECTOR,
    Comparison,
    Line,
    comparison_table,
)

OURS = Line(title="paper", method="paper", flags={}, published=VIEW_VECTOR)
BEST = Line(title="paper-best", method="paper-best", flags={})
BEST_NOTE = "paper-best: the paper's idea, tuned: more rays, textures and steps."
LOSS_NOTE = "Unless a run's name says so, none of these has the paper's perceptual loss or its 200 passes."

TABLE1 = comparison_table(
    Comparison(
        title="Table 1, what each layer knows of the camera",
        lines=(
            Line(title="no extrinsics", method="paper", flags={"extrinsics": "none"}, published=NO_EXTRINSICS),
            dataclasses.replace(OURS, title="view vector"),
            Line(
                title="spherical harmonics",
                method="paper",
                flags={"extrinsics": "sh"},
                published=SPHERICAL_HARMONICS,
            ),
        ),
        varied="extrinsics",
        notes=(LOSS_NOTE,),
    )
)
TABLE2 = comparison_table(
    Comparison(
        title="Table 2, Deferred Neural Rendering against the paper",
        lines=(
            Line(title="DNR", method="dnr", published=DNR),
            OURS,
            BEST,
            Line(title="DNR, as the paper ran it", method="dnr-authors"),
            Line(title="the network of its code", method="authors-code"),
            Line(title="DeepVoxels, small", method="deepvoxels", geometry=NO_GEOMETRY),
            Line(title="DeepVoxels", method="deepvoxels-paper", geometry=NO_GEOMETRY),
        ),
        notes=(
            "The paper names no number for DeepVoxels; which of its runs fed Table 2 is not known.",
            LOSS_NOTE,
            BEST_NOTE,
        ),
    )
)
SQUARE = comparison_table(
    Comparison(
        title="What earns the gain, layers or the per-pixel network",
        lines=(
            Line(title="U-Net, first layer (DNR)", method="dnr", published=DNR),
            Line(title="U-Net, all layers", method="dnr-layers"),
            Line(title="per pixel, first layer", method="mlp-first"),
            dataclasses.replace(OURS, title="per pixel, all layers (paper)"),
            dataclasses.replace(BEST, title="per pixel, all layers (paper-best)"),
        ),
        notes=(LOSS_NOTE, BEST_NOTE),
    )
)
ZERO_LAYER = dataclasses.replace(
    comparison_table(
        Comparison(
            title="A random layer of zeros while training (section 4.4)",
            lines=(
                Line(title="without", method="paper", flags={}),
                Line(title="with", method="paper", flags={"zero-layer": ""}),
            ),
            varied="zero-layer",
            notes=("Its purpose is edited scenes, which are in the table of claims.",),
        )
    ),
    needs_more=True,
)
