"""Small block data for tests: ray cast, so that no GL is needed."""

from pathlib import Path
from typing import Any

from data_gen.generate import generate
from data_gen.mujoco_block import Scene as MujocoBlockScene
from data_gen.mujoco_block import Settings as MujocoBlockSettings
from data_gen.settings import load_settings

SMALL = {
    "splits.train": 2,
    "splits.validation": 1,
    "splits.test": 1,
    "num_frames": 4,
    "camera.num_views": 2,
    "camera.height": 24,
    "camera.width": 32,
}


def generate_small(out: Path, *, seed: int = 0, workers: int = 1, sensor: str = "none", **overrides: Any) -> Path:
    return generate(
        scene="mujoco_block",
        preset="tiny",
        out=out,
        seed=seed,
        workers=workers,
        sensor=sensor,
        overrides={**SMALL, **overrides},
    )


def small_scene(renderer: str = "raycast", **overrides: Any) -> MujocoBlockScene:
    settings = load_settings(MujocoBlockSettings, "mujoco_block", "tiny", {**SMALL, "renderer": renderer, **overrides})
    return MujocoBlockScene(settings, renderer)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.glob("*/*.h5"))}
