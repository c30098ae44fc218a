"""Names of run folders: ``<root>/<experiment>/<timestamp>_<hash of overrides>``, chosen once, by rank 0."""

import hashlib
import os
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from omegaconf import OmegaConf

# Rank 0 tells the processes it starts where the run lies.
ENVIRONMENT = "VPD_RUN_FOLDER"


def register_resolvers() -> None:
    """Make ``${vpd_run_folder:...}`` known to OmegaConf."""
    OmegaConf.register_new_resolver("vpd_run_folder", choose_run_folder, replace=True)


def choose_run_folder(folder: str | None, root: str, experiment: str, overrides: Sequence[str]) -> str:
    """Return the absolute folder of a run; one that does not exist yet, unless the caller named it."""
    told = os.environ.get(ENVIRONMENT)
    if told:
        return told
    if folder:
        return str(Path(folder).expanduser().absolute())
    digest = hashlib.sha256("\n".join(sorted(str(word) for word in overrides)).encode()).hexdigest()[:8]
    name = f"{datetime.now():%Y-%m-%d_%H-%M-%S}_{digest}"
    parent = Path(root).expanduser().absolute() / experiment
    chosen, count = parent / name, 2
    while chosen.exists():
        chosen, count = parent / f"{name}_{count}", count + 1
    return str(chosen)
