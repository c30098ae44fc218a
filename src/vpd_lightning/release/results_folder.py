"""Where the results of a checkpoint or of a released model go."""

from pathlib import Path

from vpd_lightning.release.release_folder import WEIGHTS_FILE

RUNS = "runs"


def beside_checkpoint(path: Path, name: str) -> Path:
    """Return the folder ``name`` of the run that a checkpoint belongs to.

    A released model's folder stays as it is: its results go to ``runs/<its name>/`` below the current folder.
    """
    if path.name == WEIGHTS_FILE:
        return Path(RUNS).absolute() / path.absolute().parent.name / name
    return run_folder(path) / name


def run_folder(checkpoint: Path) -> Path:
    """Return the folder of the run that a checkpoint belongs to."""
    parent = checkpoint.absolute().parent
    return parent.parent if parent.name == "checkpoints" else parent
