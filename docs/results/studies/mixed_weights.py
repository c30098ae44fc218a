"""A released model whose weights lie between those of two others, one of which was trained on from the other.

``python -m docs.results.studies.mixed_weights FIRST SECOND SHARE OUT`` takes two released folders of the same system
and writes a third one: FIRST's weights plus SHARE (0 to 1) of the way to SECOND's. Measure it with ``vpd-eval`` before
it is given to anyone: its ``metrics.json`` is the second one's.
"""

import argparse
import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import safetensors.torch

from vpd_lightning.errors import CheckpointError
from vpd_lightning.release.release_folder import INDEX_FILE, WEIGHTS_FILE, read_release, sha256


def mix(first: Path, second: Path, share: float, out: Path) -> None:
    """Write the folder ``out``.

    Raises:
        CheckpointError: a folder is damaged, or the two hold weights of other names or shapes.
        ValueError: ``share`` is not within 0 to 1.
    """
    if not 0 <= share <= 1:
        raise ValueError(f"share is {share}; allowed: 0 to 1")
    one, other = read_release(first).weights, read_release(second).weights
    if {name: value.shape for name, value in one.items()} != {name: value.shape for name, value in other.items()}:
        raise CheckpointError(f"{first} and {second} are not of one architecture: their weights differ in shape.")
    mixed = {
        name: (value.lerp(other[name], share) if value.is_floating_point() else other[name]).contiguous()
        for name, value in one.items()
    }
    shutil.copytree(second, out)
    content = safetensors.torch.save(mixed)
    (out / WEIGHTS_FILE).write_bytes(content)
    index = json.loads((out / INDEX_FILE).read_text())
    index["name"] = out.name
    index["sha256"][WEIGHTS_FILE] = sha256(content)
    (out / INDEX_FILE).write_text(json.dumps(index, indent=1) + "\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Write a model between two others."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first", type=Path)
    parser.add_argument("second", type=Path)
    parser.add_argument("share", type=float)
    parser.add_argument("out", type=Path)
    options = parser.parse_args(arguments)
    mix(options.first, options.second, options.share, options.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
