"""What `model view` was asked for: a run, or a dataset, by folder or by name."""

import sys
from pathlib import Path

from datagen.data.dataset import open_dataset
from datagen.data.paths import find_dataset
from datagen.disk.errors import HyalineError
from datagen.terminal.command import say, tell
from model.run.opening import open_trained
from model.run.run_folder import RUN
from model.settings.run_flags import RUNS, Device
from model.settings.runtime import choose_device
from model.view.live_run import LiveRun
from model.view.view import view


def show(what: str, *, host: str, port: int, device: Device) -> None:
    """Shows it until a signal arrives.

    Raises:
        HyalineError: neither a run nor a dataset is there, or what is there cannot be shown.
        Stopped: a signal has arrived.
    """
    run = next((place for place in (Path(what), RUNS / what) if (place / RUN).is_file()), None)
    if run is not None:
        record, opened = open_trained(run)
        live = LiveRun(run, record.config, opened, device=choose_device(device))
    else:
        place = find_dataset(what)
        if not (place / "dataset.json").is_file():
            raise HyalineError(
                f"{what}: no run and no dataset is there; expected the folder of one, such as runs/glass_table/paper "
                "or data/glass_table"
            )
        opened, live = open_dataset(place), None

    def announce(address: str) -> None:
        tell(address)
        sys.stdout.flush()
        say(f"{what}: open the address in a browser; Ctrl-C ends the viewer")

    view(opened, live, host=host, port=port, announce=announce)
