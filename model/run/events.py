"""TensorBoard's event files of a run: loss and score as curves, held-out views as pictures.

RUN/tensorboard/events.out.tfevents.*   written with --tensorboard alone

TensorBoard puts the time, the host and the process into them and their names, so no two are equal: of all that a run
writes they alone are left out where equal bytes are promised. No command reads them.
"""

from pathlib import Path

from model.run.snapshots import Picture

FOLDER = "tensorboard"
EVENTS = "events.out.tfevents.*"
LOSS_EVERY = 10
"""Steps between two points of the loss."""


class Events:
    """What training tells TensorBoard."""

    def __init__(self, run: Path, *, first_step: int) -> None:
        """Points after `first_step`, which a run that was stopped has left, are hidden.

        Raises:
            ModuleNotFoundError: TensorBoard is not installed.
        """
        from torch.utils.tensorboard.writer import SummaryWriter

        self._writer = SummaryWriter(str(run / FOLDER), purge_step=first_step + 1)

    def add_loss(self, step: int, loss: float) -> None:
        if step % LOSS_EVERY == 0:
            self._writer.add_scalar("loss", loss, step)

    def add_evaluation(self, step: int, score: float | None, picture: Picture | None) -> None:
        """A held-out PSNR in dB, and the picture of the held-out views."""
        if score is not None:
            self._writer.add_scalar("held-out PSNR (dB)", score, step)
        if picture is not None:
            self._writer.add_image("held-out views", picture, step, dataformats="HWC")
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()


def require_tensorboard() -> None:
    """Fails where TensorBoard is not installed, before work is done.

    Raises:
        ModuleNotFoundError: it is not.
    """
    import tensorboard  # noqa: F401  # pyright: ignore[reportUnusedImport]


def list_events(run: Path) -> list[str]:
    """The event files of a run, by path relative to its folder."""
    return sorted(path.relative_to(run).as_posix() for path in (run / FOLDER).glob(EVENTS))
