"""A word that changes nothing is refused; one that changes something is not."""

import functools

import pytest

from vpd_lightning.config import compose, config_folder, plain
from vpd_lightning.config.composing import compose_unresolved
from vpd_lightning.config.effects import refuse_idle_words
from vpd_lightning.config.schema import SceneConfig
from vpd_lightning.errors import ConfigError

PLACED = ("data.folder=nowhere", "run.folder=nowhere")

IDLE = {
    "scene.kernel_radii=[0.0,0.1,0.2,0.3]": ("experiment=demo",),  # the issue's own example
    "scene.surface_scale=0.2": ("model=vpd",),
    "scene.r_s=0.3": ("model=inertial",),
    "scene.force_scale=0.1": ("model=vpd",),
    "scene.near=0.2": ("model=slotformer",),
    "scene.location_noise=0.1": ("model=savi",),
    "scene={shadow_scales:[0.1]}": ("model=vpd",),
    "feature_dim=8": ("model=slotformer",),
    "color_features=true": ("model=global",),
    "checkpoint_dynamics=false": ("model=savi",),
    "data.rays_per_step=8": ("model=slotformer",),
    "data.num_steps=3": ("model=savi",),
    "data.moving_ray_margin=2": ("model=vpd",),
    "renderer.normalization_epsilon=1e-3": ("model=vpd",),
    "pretraining.share=0.3": ("model=slotformer",),
    "generate.seed=1": ("model=vpd",),
}
BUSY = {
    "scene.kernel_radii=[0.0,0.1,0.2,0.3]": ("model=vpd",),
    "scene.surface_scale=0.2": ("experiment=demo",),
    "scene.r_s=0.3": ("dynamics=sleeping",),
    "scene.location_noise=0.1": ("model=sequential",),
    "scene={shadow_scales:[0.1,0.2]}": ("model=inertial",),
    "scene.input_views=[1]": ("model=slotformer",),
    "color_features=true": ("renderer=splat",),
    "feature_dim=8": ("model=global",),
    "data.num_steps=3": ("model=slotformer",),
    "data.moving_ray_margin=2": ("experiment=demo",),
    "renderer.normalization_epsilon=1e-3": ("renderer=point_nerf_normalized_eps",),
    "pretraining.share=0.3": ("model=slotformer", "budget=minutes"),
    "generate.seed=1": ("experiment=movi_a",),
}


@pytest.mark.parametrize("word", IDLE)
def test_a_word_without_effect_is_refused(word: str) -> None:
    with pytest.raises(ConfigError, match=rf"{word.split('=')[0]}.* has no effect here: .*\nRemove it, or"):
        compose("train", [word, *IDLE[word], *PLACED])


@pytest.mark.parametrize("word", BUSY)
def test_the_same_word_is_taken_where_something_reads_it(word: str) -> None:
    words = [*BUSY[word], *PLACED]

    assert compose("train", [word, *words]) != compose("train", words)


def test_a_stage_of_a_model_without_stages_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"encoder has no effect here: this model has no such stage"):
        compose("train", ["model=slotformer", "encoder=unet", *PLACED])


def test_a_key_below_one_that_is_null_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"no key pretraining.ckpt here: pretraining is null"):
        compose("train", ["model=vpd", "pretraining.ckpt=1", *PLACED])


def test_the_error_names_options_that_would_read_the_key() -> None:
    with pytest.raises(ConfigError, match=r"renderer=point_nerf, renderer=surface"):
        compose("train", ["experiment=demo", "scene.kernel_radii=[1,2,3,4]", *PLACED])


def test_words_of_an_older_run_stay_as_they_are() -> None:
    config = compose("train", ["experiment=demo", "scene.r_s=0.3", "resume=somewhere", *PLACED])

    assert config["scene"]["r_s"] == 0.3


@functools.cache
def read_by(model: str) -> dict[str, str]:
    """Words that give a model the scene it has: those that are not refused as idle, by their value of the scene."""
    given = [f"model={model}", *PLACED]
    config = compose_unresolved("train", given)
    resolved = plain(config)
    taken = {}
    for name in SceneConfig.__dataclass_fields__:
        value = str(resolved["scene"][name]).replace("'", "").replace(" ", "")
        word = f"scene.{name}={value}"
        try:
            refuse_idle_words(config, resolved, [word], [config_folder()])
            taken[name] = word
        except ConfigError as error:
            assert "has no effect here" in str(error)
    assert compose("train", [*given, *taken.values()]) == resolved
    return taken


@pytest.mark.parametrize("name", SceneConfig.__dataclass_fields__)
def test_every_value_of_a_scene_is_read_by_some_model(name: str) -> None:
    """Not one of these is left over: a model or another refers to it."""
    assert any(name in read_by(model) for model in ("vpd", "inertial", "slotformer"))
