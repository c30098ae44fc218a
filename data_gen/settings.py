"""Settings of a scene: YAML presets in ``conf/data_gen/<scene>/``, checked against the scene's dataclass."""

import difflib
import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from data_gen.presets import preset_folder, preset_names, scene_names
from vpd_lightning.errors import ConfigError

_MAX_EXTENDS = 8
SPLIT_CODES = {"train": 0, "validation": 1, "test": 2}  # what a split adds to a trajectory's seed

Settings = TypeVar("Settings")


def require_choice(what: str, value: str, choices: Sequence[str]) -> None:
    """Refuse a value that is not among the choices, with the nearest one."""
    if value not in choices:
        raise ConfigError(f"{what}={value} is unknown{did_you_mean(value, choices)}\nAvailable: {', '.join(choices)}.")


def did_you_mean(value: str, choices: Iterable[str]) -> str:
    """Return ``; did you mean 'x'?`` or a full stop."""
    near = difflib.get_close_matches(value, list(choices), n=1)
    return f"; did you mean {near[0]!r}?" if near else "."


def load_preset(scene: str, preset: str) -> tuple[str, DictConfig]:
    """Return a preset's family (the package in ``data_gen`` that makes it) and its values.

    ``extends: SCENE/PRESET`` in a preset names another whose values (and family) hold where it says nothing. Without
    ``family`` a scene is its own. ``about`` is for ``vpd-data --help`` and decides nothing.
    """
    require_choice("scene", scene, scene_names())
    require_choice("preset", preset, preset_names(scene))
    chain: list[DictConfig] = []
    name = f"{scene}/{preset}"
    while name:
        path = preset_folder() / f"{name}.yaml"
        if len(chain) > _MAX_EXTENDS or not path.is_file():
            raise ConfigError(f"Preset {scene}/{preset} extends {name}, which is missing or extends it in turn.")
        values = OmegaConf.load(path)
        assert isinstance(values, DictConfig)
        chain.append(values)
        name = values.pop("extends", "")
    merged = OmegaConf.merge(*reversed(chain))
    assert isinstance(merged, DictConfig)
    merged.pop("about", None)
    return merged.pop("family", scene), merged


def load_settings(schema: type[Settings], scene: str, preset: str, overrides: Mapping[str, Any]) -> Settings:
    """Read a preset, apply overrides (nested, or with dotted keys) and check names, types and ranges.

    Raises:
        ConfigError: unknown scene, preset or key (with the nearest name), a value of the wrong type or out of range.
    """
    _, base = load_preset(scene, preset)
    return checked_settings(schema, base, overrides, f"scene {scene}, preset {preset}")


def checked_settings(schema: type[Settings], base: DictConfig, overrides: Mapping[str, Any], where: str) -> Settings:
    """Merge overrides (nested, or with dotted keys) into ``base`` and check names, types and ranges by ``schema``.

    ``where`` says in messages which settings these are.

    Raises:
        ConfigError: an unknown key (with the nearest name), a value of the wrong type or out of range.
    """
    changes = OmegaConf.create()
    for key, value in overrides.items():
        OmegaConf.update(changes, key, value)
    known = _leaf_names(OmegaConf.to_container(base))
    for key in _leaf_names(OmegaConf.to_container(changes)):
        members = [name for name in known if name.startswith(key + ".")]
        if members:
            raise ConfigError(f"{key} is a group of settings; set its members: {', '.join(members)}.")
        if key not in known:
            raise ConfigError(
                f"Unknown setting {key!r}{did_you_mean(key, known)}\nSettings ({where}): {', '.join(sorted(known))}."
            )
    try:
        merged = OmegaConf.merge(OmegaConf.structured(schema), base, changes)
        settings = OmegaConf.to_object(merged)
    except OmegaConfBaseException as error:
        reason = str(error).strip().splitlines()[0]
        raise ConfigError(f"{error.full_key or where}: {reason} ({where}).") from error
    except ValueError as error:
        raise ConfigError(f"{error} ({where}).") from error
    assert isinstance(settings, schema)
    return settings


def settings_hash(identity: Mapping[str, Any]) -> str:
    """Return 16 hexadecimal digits that change with any of the settings."""
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:16]


def differences(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[str]:
    """Name the leaves in which two nested settings differ, as ``key: first instead of second``."""
    left, right = _leaves(first), _leaves(second)
    return [
        f"{key}: {left.get(key)} instead of {right.get(key)}"
        for key in dict.fromkeys([*left, *right])
        if left.get(key) != right.get(key)
    ]


def _leaves(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            leaves.update(_leaves(value, f"{prefix}{key}."))
        else:
            leaves[f"{prefix}{key}"] = list(value) if isinstance(value, tuple) else value
    return leaves


def _leaf_names(tree: Any) -> list[str]:
    return list(_leaves(tree))
