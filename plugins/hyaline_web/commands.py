"""The commands `model export` and `model view`."""

import signal
import sys
from pathlib import Path
from typing import Literal

from datagen.disk.errors import UsageError
from datagen.terminal.command import say, tell
from model.settings import Device


def export(
    run: Path,
    /,
    *,
    out: Path = Path("scene.html"),
    quality: Literal["small", "exact"] = "small",
    dataset: str | None = None,
    overwrite: bool = False,
) -> None:
    """Write a trained scene as one HTML file that renders it live in a browser, without a server.

    Args:
        run: A trained run (its folder, or SCENE/NAME under runs/) whose method has a web page, such as light-path.
        out: File to write.
        quality: small stores numbers in few bits; exact keeps all of them, in about five times the bytes.
        dataset: A dataset's folder, or its name under data/. Default: where the run found it.
        overwrite: Replace an existing file.
    """
    from datagen.disk.ownership import refuse_file
    from model.run.run_folder import find_run, open_trained

    run = find_run(run)
    refuse_file(out, overwrite=overwrite)
    record, opened = open_trained(run, dataset)
    say(f"{run}: writing {out}")
    from hyaline_web.page.export import export_run

    export_run(run, record, opened, out, quality)
    tell(str(out))


def view(what: str, /, *, port: int = 8080, device: Device = "auto") -> None:
    """Look at a dataset or a run in a browser, even during training: cameras, meshes, predictions.

    Args:
        what: A run, trained or still training, or a dataset: its folder, or its name under runs/ (SCENE/NAME) or data/.
        port: Port of this machine to listen at; 0 takes any free one. From another machine, `ssh -L 8080:localhost:8080
            THIS_MACHINE` brings the viewer to that one's port 8080.
    """
    from datagen.terminal.command import Stopped
    from hyaline_web.view.view import show

    if not 0 <= port <= 65535:
        raise UsageError(f"--port: is {port}; expected 0 to 65535")
    try:
        show(what, port=port, device=device)
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)
    except Stopped as stopped:  # Ctrl-C is how one leaves it: nothing was interrupted.
        sys.exit(stopped.status)
