"""Finding the checkpoint to go on from."""

import logging
from pathlib import Path

from vpd_lightning.errors import CheckpointError
from vpd_lightning.training.checkpoint_files import LAST, PREVIOUS, OpenedCheckpoint, open_checkpoint

FOLDER = "checkpoints"
FIRST_TRAINING = "pretraining"
"""Where the first of two trainings lies in the run folder; ``config.pretraining`` says the same, below this layer."""

log = logging.getLogger(__name__)


def find_resume(folder: str | Path) -> Path:
    """Return the newest good checkpoint of a run folder (or of its checkpoint folder, or the given file itself).

    Where ``last.ckpt`` is damaged, warns and returns the one before it. Raises CheckpointError where none is good.
    """
    return open_resume(folder).path


def open_resume(folder: str | Path) -> OpenedCheckpoint:
    """Open the checkpoint that ``find_resume`` finds."""
    folder = Path(folder)
    if folder.is_file():
        return open_checkpoint(folder)
    inside = folder / FOLDER if (folder / FOLDER).is_dir() else folder
    candidates = [inside / name for name in (LAST, PREVIOUS) if (inside / name).is_file()]
    if not candidates:
        raise CheckpointError(
            f"{folder} holds no checkpoint to go on from.\n"
            "Give the folder of a run that saved one (checkpoints/last.ckpt), or train without resume."
        )
    first_error: CheckpointError | None = None
    for path in candidates:
        try:
            opened = open_checkpoint(path)
        except CheckpointError as error:
            first_error = first_error or error
            continue
        if first_error is not None:
            log.warning("%s Going on from the checkpoint before it, %s.", str(first_error).splitlines()[0], path.name)
        return opened
    assert first_error is not None
    raise first_error


def latest_run(experiment_folder: str | Path) -> Path:
    """Return the run below a folder that saved a ``last.ckpt`` last, be it in the first of two trainings.

    Raises:
        CheckpointError: there is none.
    """
    experiment_folder = Path(experiment_folder)
    found = [(saved, run) for run in experiment_folder.glob("*") if (saved := last_saved(run)) is not None]
    if not found:
        raise CheckpointError(
            f"No run below {experiment_folder} has saved a checkpoint yet.\nTrain without resume=last."
        )
    return max(found)[1]


def last_saved(run: Path) -> float | None:
    """Return when a run, or the first of its two trainings, last saved a checkpoint to go on from; None: never."""
    places = [run / FOLDER, run / FIRST_TRAINING / FOLDER]
    files = [place / name for place in places for name in (LAST, PREVIOUS)]
    return max((path.stat().st_mtime for path in files if path.is_file()), default=None)
