"""Whether what is evaluated was trained on: trajectories are compared by content, whatever their name or split."""

from collections.abc import Collection
from typing import Any

from data_gen.inspection.split import BACKUP_NAME
from vpd_lightning.data.manifest import FILE_NAME, Manifest
from vpd_lightning.errors import DataError
from vpd_lightning.evaluation.protocol import Protocol


def seen_in_training(
    manifest: Manifest, protocol: Protocol, trained_on: Collection[str] | None, *, force: bool
) -> dict[str, Any]:
    """Return how many of the protocol's trajectories a training of the model saw (None: not known), and of how many.

    ``protocol.split=train`` asks for trajectories that were trained on; elsewhere they would pass for new ones.

    Raises:
        DataError: some of another split than the training one were trained on, and ``force`` is false.
    """
    paths = manifest.split(protocol.split)[: protocol.num_trajectories]
    if trained_on is None:
        return {"trajectories": None, "of": len(paths)}
    seen = [path for path, checksum in zip(paths, manifest.checksums(paths), strict=True) if checksum in trained_on]
    if seen and protocol.split != "train" and not force:
        backup, index = manifest.folder / BACKUP_NAME, manifest.folder / FILE_NAME
        first_one = f"Restore the first split: cp {backup} {index}\n" if backup.is_file() else ""
        raise DataError(
            f"{len(seen)} of the {len(paths)} trajectories of split {protocol.split} were trained on, first "
            f"{manifest.relative(seen[0])}.\n"
            f"Was {manifest.folder} split again after the training? These figures would say nothing about new videos.\n"
            f"{first_one}Evaluate other data: data.folder=FOLDER\n"
            "Or measure these on purpose, marked as such: protocol.split=train, or force=true"
        )
    return {"trajectories": len(seen), "of": len(paths)}
