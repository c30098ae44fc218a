"""Command-line arguments without effect: they are refused, so that no result is attributed to them."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from vpd_lightning.config.building import ALLOWED_PACKAGES, resolve_class
from vpd_lightning.config.explaining import parsed
from vpd_lightning.errors import ConfigError

# Values that other sections refer to: whoever does not refer to one cannot depend on it.
_SHARED = ("feature_dim", "color_features", "scenery", "actions", "checkpoint_dynamics")
# Read by the program itself: the views that a trained model is shown, and the scene's name in reports.
_READ_ANYWHERE = ("scene.name", "scene.input_views")
# Settings that count beside a certain value of another one only: the other one, and what it has to be.
_ONLY_WITH: dict[str, tuple[str, Callable[[Any], bool], str]] = {
    "renderer.normalization_epsilon": ("renderer.kernel_normalization", lambda value: value == "eps", "eps"),
    "data.moving_ray_margin": ("data.moving_ray_fraction", bool, "more than 0"),
    "data.moving_color_threshold": ("data.moving_ray_fraction", bool, "more than 0"),
    "data.sensor_percent": ("data.sensor", lambda name: name != "none", "not none"),
    "data.moving_depth_threshold": ("data.moving_ray_fraction", bool, "more than 0"),
    "data.num_validation_steps": ("data.num_validation_clips", bool, "more than 0"),
    "data.validation_views": ("data.num_validation_clips", bool, "more than 0"),
    "callbacks.time_budget.clock": ("callbacks.time_budget.minutes", bool, "a time"),
    "pretraining.share": ("callbacks.time_budget.minutes", bool, "a time"),
    "generate.preset": ("generate.scene", bool, "the name of a scene"),
    "generate.seed": ("generate.scene", bool, "the name of a scene"),
    "generate.when_missing": ("generate.scene", bool, "the name of a scene"),
    "renderer.elliptic_footprints": ("renderer.has_scenery", bool, "true"),
    "renderer.far_pixels": ("renderer.has_scenery", bool, "true"),
    "renderer.seen_through": ("renderer.has_scenery", bool, "true"),
    "renderer.unseen_ground": ("renderer.has_scenery", bool, "true"),
    "dynamics.guess_hidden": ("dynamics.keep_shape", bool, "true"),
    "renderer.num_scenery_candidates": ("renderer.has_scenery", bool, "true"),
    "light_fit.num_pairs": ("renderer.num_lights", bool, "more than 0"),
    "light_fit.num_updates": ("renderer.num_lights", bool, "more than 0"),
    "renderer.num_occluders": ("renderer.num_lights", bool, "more than 0"),
    "renderer.shadow_softness": ("renderer.num_lights", bool, "more than 0"),
    "protocol.long_start_frame": ("protocol.num_long_steps", bool, "more than 0"),
}
_MOST_NAMED = 4
_REFERENCE = re.compile(r"\$\{([\w.]+)\}")


def refuse_idle_words(
    config: Any, resolved: Mapping[str, Any], overrides: Sequence[str], folders: Sequence[Path]
) -> None:
    """Refuse words that set a key which nothing in this configuration reads.

    Args:
        config: configuration of ``vpd-train`` with its references.
        resolved: the same without.
        overrides: words as on the command line.
        folders: where options are looked for, to name those that would read the key.

    Raises:
        ConfigError: there is such a word.
    """
    raw = OmegaConf.to_container(config, resolve=False)
    assert isinstance(raw, dict)
    given = list(_given_keys(overrides))
    shared = [key for key in given if key in _SHARED or key.startswith("scene.")]
    read = {*_references({name: part for name, part in raw.items() if name != "scene"}), *_READ_ANYWHERE}
    for key in shared:
        if key not in read:
            readers = ", ".join(_readers(key, folders)[:_MOST_NAMED])
            raise ConfigError(
                f"{key} has no effect here: nothing in this configuration reads it.\n"
                f"Remove it, or choose an option that reads it, such as {readers or '(there is none)'}."
            )
    for key in given:
        reason = _reason(key, resolved)
        if reason is not None:
            raise ConfigError(f"{key} has no effect here: {reason}.\nRemove it, or change that.")


def _given_keys(overrides: Sequence[str]) -> Iterator[str]:
    """Yield the keys that words set; where a word sets a section, those in its value."""
    for override in parsed(overrides):
        yield from _leaves(override.key_or_group, override.value())


def _leaves(key: str, value: Any) -> Iterator[str]:
    if isinstance(value, dict) and value:
        for name, item in value.items():
            yield from _leaves(f"{key}.{name}", item)
    else:
        yield key


def _references(node: Any) -> Iterator[str]:
    if isinstance(node, str):
        yield from _REFERENCE.findall(node)
    elif isinstance(node, Mapping):
        for value in node.values():
            yield from _references(value)
    elif isinstance(node, list):
        for value in node:
            yield from _references(value)


def _readers(key: str, folders: Sequence[Path]) -> list[str]:
    """Return the options, as GROUP=OPTION, whose own file refers to a key."""
    files = [path for folder in folders for path in sorted(folder.glob("*/*.yaml"))]
    return [f"{path.parent.name}={path.stem}" for path in files if f"${{{key}}}" in path.read_text(encoding="utf-8")]


def _reason(key: str, resolved: Mapping[str, Any]) -> str | None:
    """Return why a setting changes nothing beside the others: by the table above, or because its class says so."""
    if key in _ONLY_WITH:
        other, is_fitting, wanted = _ONLY_WITH[key]
        value = _at(resolved, other)
        if not is_fitting(value):
            return f"{other} is {'null' if value is None else value}; it has an effect only if that is {wanted}"
    section, _, name = key.partition(".")
    settings = resolved.get(section)
    if not name or not isinstance(settings, Mapping) or not isinstance(settings.get("_target_"), str):
        return None
    target = resolve_class(settings["_target_"], section, ALLOWED_PACKAGES)
    ask = getattr(target, "settings_without_effect", None)
    found: Mapping[str, str] = {} if ask is None else ask(settings)
    return found.get(name.partition(".")[0])


def _at(section: Any, key: str) -> Any:
    for name in key.split("."):
        section = section.get(name) if isinstance(section, Mapping) else None
    return section
