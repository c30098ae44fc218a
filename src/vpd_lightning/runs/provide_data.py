"""Where a data set is missing: make it where the configuration says so, else say how."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vpd_lightning.data.manifest import FILE_NAME
from vpd_lightning.errors import DataError


def provide_data(config: Mapping[str, Any]) -> None:
    """Generate the data set of a training's configuration where it is missing and ``generate.when_missing`` is true.

    Raises:
        DataError: it is missing, and nothing makes it here.
    """
    folder, wanted = Path(config["data"]["folder"]), config.get("generate")
    if (folder / FILE_NAME).is_file():
        return
    if wanted is None or wanted["scene"] is None:
        raise DataError(
            f"there is no data set in {folder} (no {FILE_NAME}).\n"
            "Point data.folder at one; vpd-data --help says how to generate or import recordings."
        )
    command = f"vpd-data generate scene={wanted['scene']} preset={wanted['preset']} out={folder}"
    if not wanted["when_missing"]:
        raise DataError(
            f"there is no data set in {folder} (no {FILE_NAME}).\nMake it: {command}\n"
            "Or look first whether everything works, with a tiny one that makes itself: budget=tiny"
        )
    if int(os.environ.get("LOCAL_RANK", "0")) > 0:
        raise DataError(f"there is no data set in {folder}.\nMake it before training on several devices: {command}")
    from data_gen.generate import generate

    print(f"there is no data set in {folder}; making it: {command}", flush=True)
    generate(scene=wanted["scene"], preset=wanted["preset"], out=folder, seed=wanted["seed"])
