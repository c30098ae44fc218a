"""The training mean, which takes decoding the whole training split, kept beside the data set."""

import hashlib
import logging
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.data.kept_files import keep_file, kept_files
from vpd_lightning.data.manifest import Manifest
from vpd_lightning.evaluation.references import training_mean

_VERSION = "1"  # of what is computed

log = logging.getLogger(__name__)


def kept_training_mean(manifest: Manifest) -> Float[Tensor, "view height width 3"]:
    """Return ``training_mean`` of the training split, bit for bit, from a file where one was kept.

    The file is named by the checksums of the training files, their sizes and when they were last written, so that
    another file, or a file that changed, makes it anew. A file that is damaged counts as none.
    """
    paths = manifest.split("train")
    name = f".cache/training_mean_{_key(manifest, paths)}.npz"
    for path in kept_files(manifest, name):
        mean = _read(path)
        if mean is not None:
            return mean
    mean = training_mean(paths)
    keep_file(manifest, name, lambda path: _write(path, mean))
    return mean


def _key(manifest: Manifest, paths: list[Path]) -> str:
    facts = [path.stat() for path in paths]
    lines = [f"{item.st_size} {item.st_mtime_ns} " for item in facts]
    named = sorted(line + checksum for line, checksum in zip(lines, manifest.checksums(paths), strict=True))
    return hashlib.sha256("\n".join([_VERSION, *named]).encode()).hexdigest()[:32]


def _write(path: Path, mean: Tensor) -> None:
    with path.open("wb") as stream:
        np.savez(stream, allow_pickle=False, mean=mean.numpy())


def _read(path: Path) -> Tensor | None:
    try:
        with np.load(path, allow_pickle=False) as stored:  # each array of it has a checksum
            mean = stored["mean"]
    except Exception as error:  # whatever NumPy makes of bytes that are not its own
        log.warning("%s is damaged and is made anew (%s)", path, type(error).__name__)
        return None
    return torch.from_numpy(mean) if mean.dtype == np.float32 and mean.ndim == 4 else None
