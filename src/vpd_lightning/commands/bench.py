"""``vpd-bench``: run time against error, against peers, and against the plain way of doing the same."""

import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vpd_lightning.commands.report_errors import run_command
from vpd_lightning.errors import ConfigError


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the console command; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    return run_command(lambda: _run(words))


def _run(words: list[str]) -> int:
    from vpd_lightning.commands.hydra_application import configure

    # Hydra takes a bare comma for a sweep; here it is a list.
    config = configure("bench", [re.sub(r"^suite=([^\[\]'\"]*,.*)$", r"suite=[\1]", word) for word in words])
    if config is not None:
        _bench(config)
    return 0


def _bench(config: Mapping[str, Any]) -> None:
    import torch

    from benchmarks.measuring import Options
    from benchmarks.results_files import default_folder, write
    from benchmarks.suites import chosen, load
    from vpd_lightning.errors import OutOfMemoryError
    from vpd_lightning.loading import find_device
    from vpd_lightning.runs.threads import set_threads

    wanted = config["suite"]
    names = chosen([str(name) for name in (wanted if isinstance(wanted, list) else [wanted])])
    if config["repeats"] < 1:
        raise ConfigError(f"repeats={config['repeats']} is out of range.\nAllowed: 1 or more.")
    set_threads(config["num_threads"])
    folder = config["data"]["folder"]
    options = Options(
        device=find_device(config["device"]),
        size="quick" if config["quick"] else "full",
        repeats=config["repeats"],
        checkpoints=[Path(path).expanduser() for path in config["ckpt"]],
        data=None if folder is None else Path(folder),
        preset=config["data"]["preset"],
    )
    out = default_folder() if config["out"] is None else Path(config["out"]).expanduser()
    paths = []
    for name in names:
        suite = load(name)
        try:
            result = suite.run(options)
        except torch.OutOfMemoryError as error:
            raise OutOfMemoryError(
                f"The device ran out of memory in suite {name}.\nUse quick=true, or a device with more memory."
            ) from error
        paths.append(write(name, options.device, result, out))
        suite.draw(result, paths[-1].with_suffix(".png"))
    print()
    print("\n".join(str(path) for path in paths))


if __name__ == "__main__":
    sys.exit(main())
