"""The stages of the method built from ``conf/`` by their constructors: no Hydra, so that a bare GPU machine can do it.

python -m benchmarks.stages FILE     # write all sections that the benchmarks use as JSON, for a machine without YAML
"""

import json
import re
import sys
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import torch

import vpd_lightning
from vpd_lightning.simulator import Simulator

FEATURE_DIM = 16
ROOT = {
    "feature_dim": FEATURE_DIM,
    "color_features": False,
    "actions": False,
    "scenery": False,
    "checkpoint_dynamics": True,
}  # keys of the root of conf/train.yaml
USED = (
    "scene/mujoco", "scene/demo", "encoder/unet", "encoder/unet_small", "dynamics/hierarchical_gnn",
    "dynamics/hierarchical_gnn_small", "renderer/point_nerf", "renderer/point_nerf_small", "renderer/surface",
    "renderer/splat", "model/vpd",
)  # fmt: skip
# ${vpd_lookup:${size},{small:0.25},0.1}: what holds without an entry comes last; here nothing has scenery.
_BY_SIZE = re.compile(r"^\$\{vpd_lookup:\$\{(?:size|scenery)\},\{.*\},(.*)\}$")
_PREPARED: dict[str, dict[str, Any]] = {}  # sections read from a JSON file instead of YAML


def use_prepared(path: Path) -> None:
    """Take sections from the JSON file that ``python -m benchmarks.stages FILE`` wrote."""
    _PREPARED.update(json.loads(path.read_text()))


def section(name: str) -> dict[str, Any]:
    """Return a file of ``conf/``, for example ``renderer/surface``, with the files that it builds on merged in."""
    return dict(_PREPARED[name]) if name in _PREPARED else _read(name)


def settings(name: str, scene: str, **changes: Any) -> dict[str, Any]:
    """Return the plain settings of a stage in a scene, with ``changes`` in place of what ``conf/`` says."""
    values = section(name)
    return _filled({**values, **changes}, section(f"scene/{scene}"))


def build(name: str, scene: str, **changes: Any) -> Any:
    """Build a stage (see ``settings``); a key that its constructor does not know is a ``TypeError``."""
    values = settings(name, scene, **changes)
    module, _, kind = values.pop("_target_").rpartition(".")
    return getattr(import_module(module), kind)(**values)


def build_simulator(
    scene: str,
    encoder: tuple[str, Mapping[str, Any]],
    dynamics: tuple[str, Mapping[str, Any]],
    renderer: tuple[str, Mapping[str, Any]],
    **model: Any,
) -> Simulator:
    """Build a simulator with the same random weights every time; each stage is (option, changes)."""
    torch.manual_seed(0)
    stages = {
        kind: build(f"{kind}/{option}", scene, **changes)
        for kind, (option, changes) in {"encoder": encoder, "dynamics": dynamics, "renderer": renderer}.items()
    }
    values = settings("model/vpd", scene)["model"] | model
    del values["_target_"]
    return Simulator(**stages, **values)


def _folder() -> Path:
    package = Path(vpd_lightning.__file__).resolve().parent
    return next(f for f in (package / "conf", package.parents[1] / "conf") if (f / "train.yaml").is_file())


@cache
def _read(name: str) -> dict[str, Any]:
    import yaml

    class Loader(yaml.SafeLoader):
        pass

    # YAML 1.2 floats: PyYAML alone reads 1e-5 as a word.
    number = re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")
    whole = re.compile(r"^[-+]?\d+$")

    def scalar(loader: Any, node: Any) -> Any:
        word = node.value
        if node.style is None and number.match(word):
            return int(word) if whole.match(word) else float(word)
        return word

    Loader.add_constructor("tag:yaml.org,2002:str", scalar)
    values = yaml.load((_folder() / f"{name}.yaml").read_text(), Loader)
    group = name.rpartition("/")[0]
    merged: dict[str, Any] = {}
    for base in values.pop("defaults", ["_self_"]):
        merged |= values if base == "_self_" else _read(f"{group}/{base}")
    return merged


def _filled(value: Any, scene: Mapping[str, Any]) -> Any:
    """Resolve ``${scene.KEY}``, keys of the root of conf/train.yaml, and values by size (the full one)."""
    if isinstance(value, Mapping):
        return {key: _filled(item, scene) for key, item in value.items()}
    if isinstance(value, list):
        return [_filled(item, scene) for item in value]
    if isinstance(value, str) and (by_size := _BY_SIZE.match(value)):
        return json.loads(by_size.group(1))
    if isinstance(value, str) and value.startswith("${"):
        key = value[2:-1]
        return ROOT[key] if key in ROOT else _filled(scene[key.removeprefix("scene.")], scene)
    return value


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(json.dumps({name: section(name) for name in USED}, indent=1) + "\n")
