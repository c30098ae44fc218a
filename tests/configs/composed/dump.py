"""Compose every experiment x model x budget, every option, jobs of every sweep, and write what comes out.

``python -m tests.configs.composed.dump OUT.json [DIGESTS.json]`` takes about five minutes on one idle core. OUT.json
maps the words of a command line to the resolved and checked configuration, or to the error; DIGESTS.json to its
SHA-256. ``compare.py`` beside it compares two such files.
"""

import hashlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from vpd_lightning.commands.train import _check_sections
from vpd_lightning.config import compose, config_folder, expand_sweep
from vpd_lightning.errors import VPDError

BUDGETS = ("paper", "minutes", "hour", "tiny")
SIZES = ("full", "small", "tiny")
STAGES = ("encoder", "dynamics", "renderer")
GROUPS = ("scene", *STAGES, "data", "loss", "optimizer", "trainer", "callbacks", "logger", "protocol")
PLACES = (
    "data.folder=anywhere", "experiment=mujoco_block", "experiment=demo", "experiment=movi_a budget=minutes",
    "budget=tiny experiment=deformable_multi",
)  # fmt: skip
ROOTS = {
    "eval": ("ckpt=a", "ckpt=a protocol=paper", "ckpt=a protocol=demo protocol.num_steps=3"),
    "render": ("ckpt=a", "ckpt=a camera=ring num_views=4"),
    "view": ("ckpt=a", "ckpt=a port=0"),
    "export": ("ckpt=a out=b",),
    "plan": ("ckpt=a", "ckpt=a task=off_table solver.name=mppi"),
    "bench": ("suite=all", "suite=data data.preset=paper"),
}
WORDS = (
    # The words of a person win over everything, in whatever order.
    "budget=minutes model=slotformer experiment=movi_a",
    "model=slotformer experiment=movi_a budget=minutes",
    "model=slotformer renderer=splat dynamics=inertial encoder=unet_objects experiment=mujoco_block",
    "model=vpd renderer=splat experiment=mujoco_block budget=minutes",
    "renderer=splat dynamics=inertial encoder=unet_objects model=vpd experiment=movi_a budget=hour",
    "model=inertial optimizer=adam_paper budget=minutes experiment=movi_b",
    "optimizer=adam_cosine model=sequential experiment=movi_b",
    "trainer=ddp_cpu budget=minutes experiment=demo",
    "protocol=paper budget=tiny experiment=movi_c",
    "scene=deformable experiment=movi_a budget=minutes model=savi",
    "scene=demo model=slotformer data.folder=anywhere",
    "scene=tiny model=slotformer data.folder=anywhere",
    "scene.r_s=0.3 model=vpd experiment=mujoco_block budget=minutes",
    "optimizer.lr=0.5 model=global experiment=mujoco_block budget=minutes",
    "data.batch_size=3 model=slotformer experiment=deformable_block budget=minutes",
    "pretraining.settings.trainer.max_steps=7 model=slotformer experiment=movi_a",
    "model.savi.num_slots=5 model=slotformer experiment=movi_a budget=tiny",
    "feature_dim=24 experiment=tiny",
    "loss=pixel_and_depth model=inertial experiment=demo",
    "model=savi loss=slot experiment=movi_a",
    "callbacks=weight_averaging logger=csv experiment=tiny",
    "sweep=null experiment=tiny",
)


def options(group: str) -> list[str]:
    """Return the names of a group's options."""
    return sorted(path.stem for path in (config_folder() / group).glob("*.yaml"))


def command_lines() -> Iterator[tuple[str, str]]:
    """Yield root and words of every configuration to compose."""
    experiments = ["data.folder=anywhere", *(f"experiment={name}" for name in options("experiment"))]
    models = ["", *(f" model={name}" for name in MODELS)]
    for experiment in experiments:
        for model in models:
            for budget in BUDGETS:
                yield "train", f"{experiment}{model} budget={budget}"
    for place in PLACES[1:4]:
        for size in SIZES:
            yield from (("train", f"{place}{model} size={size}") for model in models)
    for group in GROUPS:
        for option in options(group):
            yield from (("train", f"{place} {group}={option}") for place in PLACES[:4])
    yield from (("train", words) for words in WORDS)
    for sweep in options("sweep"):
        for budget in ("", " budget=minutes"):
            jobs = expand_sweep("train", f"sweep={sweep}{budget}".split())
            yield from (("train", " ".join(words)) for words in (jobs[0], jobs[-1]))
    for root, lines in ROOTS.items():
        yield from ((root, words) for words in lines)


MODELS = (
    "global", "inertial", "inertial_gnn", "persistence", "savi", "sequential", "slotformer", "vpd",
    "vpd_feature_network", "vpd_predicted_depth", "vpd_two_steps",
)  # fmt: skip


def composed(root: str, words: str) -> dict[str, Any]:
    """Return the configuration, or the error where it is refused."""
    overrides = words.split() + ["run.folder=nowhere"] * (root == "train")
    try:
        config = compose(root, overrides)
        if root == "train":
            _check_sections(config)
    except VPDError as error:
        return {"error": str(error)}
    return config


def digest(config: dict[str, Any]) -> str:
    """Return the start of the SHA-256; the order of keys counts for callbacks, losses and loggers only."""
    ordered = {**config, "order": [list(config.get(name) or ()) for name in ("callbacks", "loss", "logger")]}
    return hashlib.sha256(json.dumps(ordered, sort_keys=True).encode()).hexdigest()[:12]


def main(out: str, digests: str | None = None) -> None:
    """Write all configurations, and their digests."""
    found: dict[str, dict[str, Any]] = {}
    for root, words in dict.fromkeys(command_lines()):
        found[f"vpd-{root} {words}"] = composed(root, words)
        if len(found) % 100 == 0:
            print(len(found), flush=True)
            Path(out).write_text(json.dumps(found))
    Path(out).write_text(json.dumps(found))
    if digests is not None:
        Path(digests).write_text(json.dumps({key: digest(config) for key, config in found.items()}, indent=0) + "\n")


if __name__ == "__main__":
    yaml.SafeLoader = yaml.CSafeLoader  # type: ignore[misc]  # OmegaConf's parser, a third faster
    main(*sys.argv[1:])
