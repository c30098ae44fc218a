"""Only our own classes can be built from a configuration, and what does not fit them is said by name."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import pytest

from vpd_lightning.config import build, build_simulator, check_targets, compose
from vpd_lightning.config.building import fits
from vpd_lightning.config.plugins import load_plugins
from vpd_lightning.encoder.base import AbstractEncoder
from vpd_lightning.errors import ConfigError
from vpd_lightning.losses.base import AbstractLoss

PIXEL = {"_target_": "vpd_lightning.losses.pixel.PixelLoss", "weight": 1.0, "coarse_weight": 1.0}


def test_section_becomes_an_object():
    loss = build(PIXEL, AbstractLoss, "loss")

    assert (loss.name, loss.weight) == ("pixel", 1.0)


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "subprocess.Popen",
        "builtins.eval",
        "pathlib.Path.unlink",
        "torch.load",
        "torch.hub.load",
        "vpd_lightning",
        "vpd_lightning_evil.Thing",
        # Allowed packages import other modules: the path begins well and leads elsewhere.
        "vpd_lightning.runs.environment.subprocess.Popen",
        "vpd_lightning.config.run_folders.Path",
        "lightning.pytorch.trainer.trainer.os.system",
        "torch.optim.optimizer.torch.nn.Linear",
        # Functions are not classes.
        "vpd_lightning.training.checkpoint_io.write_checkpoint",
        "vpd_lightning.loading.load",
        "",
        3,
        None,
    ],
)
def test_class_from_elsewhere_is_refused_before_anything_runs(target: Any):
    with pytest.raises(ConfigError, match="may not be built|does not exist"):
        build({"_target_": target}, None, "loss.pixel")


def test_a_plug_in_that_is_not_installed_is_named_and_no_stranger_recommended():
    with pytest.raises(ConfigError, match="the plug-in their_lab is not installed here") as raised:
        build({"_target_": "their_lab.dynamics.DriftDynamics"}, None, "dynamics")

    assert "pip install -e FOLDER" in str(raised.value) and "pip install their_lab" not in str(raised.value)


@pytest.mark.parametrize("target", ["torch.optim.Adam", "lightning.pytorch.callbacks.ModelCheckpoint"])
def test_a_system_is_built_of_our_own_classes_only(target: str):
    config = compose("train", ["experiment=tiny"])
    config["encoder"]["background"] = {"_target_": target}

    with pytest.raises(ConfigError, match=r"encoder.background._target_=.* may not be built"):
        build_simulator(config)


PAYLOAD = "${oc.create:{_target_:pathlib.Path.touch,self:{_target_:pathlib.Path,_args_:[FILE]}}}"


@pytest.mark.parametrize("reference", [PAYLOAD, "${oc.env:HOME}", "a ${b", "\\${c}"])
def test_references_are_refused_before_anything_follows_them(tmp_path, reference: str):
    reference = reference.replace("FILE", str(tmp_path / "hacked"))
    whole = {"_target_": "vpd_lightning.losses.pixel.PixelLoss", "weight": 1.0, "coarse_weight": 1.0}
    for section in (
        {**whole, "weight": reference},
        {**whole, "weight": [1.0, {"a": (reference,)}]},
        {**whole, "weight": {reference: 1.0}},
        {**whole, reference: 1.0},
    ):
        with pytest.raises(ConfigError, match="holds a reference"):
            build(section, None, "loss.pixel")
        with pytest.raises(ConfigError, match="holds a reference"):
            check_targets(section, "loss.pixel")
    assert not (tmp_path / "hacked").exists()


def test_nested_class_from_elsewhere_is_refused():
    config = compose("train", ["experiment=tiny"])
    config["encoder"]["background"] = {"_target_": "os.system", "command": "true"}

    with pytest.raises(ConfigError, match=r"encoder.background._target_=os.system may not be built"):
        build_simulator(config)


@pytest.mark.parametrize("key", ["_partial_", "_args_", "_convert_", "_recursive_"])
def test_hydras_own_switches_are_refused(key: str):
    with pytest.raises(ConfigError, match=f"loss.{key} is not allowed"):
        build({**PIXEL, key: True}, AbstractLoss, "loss")


def test_allowed_class_of_another_kind_is_refused():
    with pytest.raises(ConfigError, match="must be a kind of AbstractEncoder"):
        build(PIXEL, AbstractEncoder, "encoder")


def test_stage_of_another_kind_is_refused():
    config = compose("train", ["experiment=tiny"])
    config["renderer"] = config["dynamics"]

    with pytest.raises(ConfigError, match="renderer._target_.*\n.*AbstractRenderer"):
        build_simulator(config)


def test_misspelt_class_gets_a_suggestion():
    with pytest.raises(ConfigError, match=r"Did you mean vpd_lightning.losses.pixel.PixelLoss\?"):
        build({**PIXEL, "_target_": "vpd_lightning.losses.pixel.PixelLos"}, AbstractLoss, "loss")


def test_unknown_argument_gets_a_suggestion():
    with pytest.raises(ConfigError, match=r"no key loss.wieght.*\nDid you mean loss.weight\?"):
        check_targets({"_target_": PIXEL["_target_"], "wieght": 1.0, "coarse_weight": 1.0}, "loss")


def test_missing_argument_is_named():
    with pytest.raises(ConfigError, match="loss lacks coarse_weight"):
        check_targets({"_target_": PIXEL["_target_"], "weight": 1.0}, "loss")


def test_argument_of_the_wrong_type_is_named():
    with pytest.raises(ConfigError, match=r"loss.weight has the wrong type.\nGiven: 'much'. PixelLoss wants a number"):
        check_targets({**PIXEL, "weight": "much"}, "loss")


def test_value_that_a_constructor_refuses_becomes_a_configuration_error():
    with pytest.raises(ConfigError, match=r"loss cannot be built.\n.*must not be negative, got weight=-1"):
        build({**PIXEL, "weight": -1.0}, AbstractLoss, "loss")


@pytest.mark.parametrize(
    ("value", "hint", "expected"),
    [
        (1, int, True),
        (True, int, False),
        (1, float, True),
        ("1", float, False),
        (None, int | None, True),
        (None, int, False),
        ([1, 2], Sequence[int], True),
        ([1, "a"], Sequence[int], False),
        ("ab", Sequence[str], False),
        ({"a": 1.0}, Mapping[str, float], True),
        ([1], Mapping[str, float], False),
        ("relu", Literal["relu", "softplus"], True),
        ("gelu", Literal["relu", "softplus"], False),
        (object(), Any, True),
        ([0.9, 0.999], tuple[float, float], True),
    ],
)
def test_plain_value_fits_a_hint_or_not(value: Any, hint: Any, expected: bool):
    assert fits(value, hint) is expected


def test_plugin_that_cannot_be_imported_is_named(monkeypatch: pytest.MonkeyPatch):
    from importlib.metadata import EntryPoint

    entry = EntryPoint("broken", "no_such_package.plugin", "vpd_lightning.plugins")
    monkeypatch.setattr("vpd_lightning.config.plugins.entry_points", lambda group: [entry])
    load_plugins.cache_clear()
    try:
        with pytest.raises(ConfigError, match="plug-in broken .* cannot be loaded"):
            load_plugins()
    finally:
        load_plugins.cache_clear()


def test_plugin_brings_its_own_options_and_classes(tmp_path, monkeypatch: pytest.MonkeyPatch):
    from importlib.metadata import EntryPoint

    package = tmp_path / "our_plugin"
    (package / "conf" / "loss").mkdir(parents=True)
    (package / "__init__.py").write_text(
        "from pathlib import Path\nfrom vpd_lightning.losses.pixel import PixelLoss\n"
        "config_folder = Path(__file__).parent / 'conf'\nclass DoubleLoss(PixelLoss):\n    name = 'double'\n"
    )
    (package / "conf" / "loss" / "double.yaml").write_text(
        "double: {_target_: our_plugin.DoubleLoss, weight: 2.0, coarse_weight: 0.0}\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    entry = EntryPoint("ours", "our_plugin", "vpd_lightning.plugins")
    monkeypatch.setattr("vpd_lightning.config.plugins.entry_points", lambda group: [entry])
    load_plugins.cache_clear()
    try:
        config = compose("train", ["experiment=tiny", "loss=double"])
        assert build(config["loss"]["double"], AbstractLoss, "loss.double").weight == 2.0
    finally:
        load_plugins.cache_clear()
