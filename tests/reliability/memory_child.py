"""How much memory this process holds, over a thousand steps of training or five hundred rollouts, as JSON.

``python -m tests.reliability.memory_child train COUNT WORDS...`` or ``rollouts COUNT RUN DATA``.
"""

import gc
import json
import os
import sys
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch

PAGE = os.sysconf("SC_PAGE_SIZE")


def held() -> int:
    """Return the bytes in memory, after the collection of what nobody refers to."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE


class Weigh(pl.Callback):
    """Notes the memory after every tenth step."""

    def __init__(self, found: list[int]) -> None:
        self.found = found

    def on_train_batch_end(self, trainer: pl.Trainer, *args: Any) -> None:
        if trainer.global_step % 10 == 0:
            self.found.append(held())


def train(words: list[str]) -> list[int]:
    """Run ``vpd-train`` with one more callback."""
    from vpd_lightning.commands import train as command
    from vpd_lightning.runs import training_run

    found: list[int] = []
    real = training_run.build_list

    def with_scales(config: Any, kind: type, where: str) -> list[Any]:
        items = real(config, kind, where)
        return [*items, Weigh(found)] if where == "callbacks" else items

    training_run.build_list = with_scales
    if command.main(words) != 0:
        raise SystemExit("the training failed")
    return found


@torch.no_grad()
def rollouts(count: int, run: Path, data: Path) -> list[int]:
    """Encode, predict and render again and again."""
    import vpd_lightning
    from vpd_lightning.data.clip import read_clip
    from vpd_lightning.data.manifest import load_manifest
    from vpd_lightning.evaluation.prediction import encode_clip

    simulator = vpd_lightning.load(run)
    found = []
    files = load_manifest(data).split("train")
    for number in range(count):
        clip = read_clip(files[number % len(files)], number, 0, 4)
        states = simulator.rollout(encode_clip(simulator, clip, [0, 1, 2]), 8)
        simulator.render(states[-1:], clip.target_cameras[0][:1])
        if number % 10 == 9:
            found.append(held())
    return found


def main() -> None:
    """Measure and print."""
    torch.set_num_threads(1)
    what, count, rest = sys.argv[1], int(sys.argv[2]), sys.argv[3:]
    found = train(rest) if what == "train" else rollouts(count, Path(rest[0]), Path(rest[1]))
    print("\n" + json.dumps(found))


if __name__ == "__main__":
    main()
