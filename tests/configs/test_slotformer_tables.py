"""The composed configuration of SAVi and SlotFormer, compared with the paper's two tables cell by cell.

Everything on the expected side is typed from the paper (appendix, "SlotFormer training"); the numbers of updates follow
from its epochs and the sizes of its data sets, and are written out.
"""

import functools
from typing import Any

import pytest

from vpd_lightning.config import check_targets, compose, pretraining_config

FAMILIES = {
    "mujoco_block": "MuJoCo",
    "deformable_block": "Deformable",
    "deformable_multi": "Deformable",
    "deformable_collision": "Deformable",
    "movi_a": "Kubric",
    "movi_b": "Kubric",
    "movi_c": "Kubric",
}
# Table "SAVi training hyperparameters": row -> (place, value). Four rows choose code rather than numbers, see below.
SAVI_TABLE: dict[str, tuple[str, Any]] = {
    "learning rate": ("optimizer.lr", 1e-4),
    "gradient clip": ("trainer.gradient_clip_val", 0.05),
    "history length": ("data.num_history", 6),
    "frame offset": ("data.frame_offset", 1),
    "batch size": ("data.batch_size", 64),
    "slot mlp size": ("model.savi.mlp_dim", 256),
    "num iterations": ("model.savi.num_iterations", 2),
    "encoder channels": ("model.savi.encoder_channels", [64, 64, 64, 64]),  # the table's first entry, 3, is the colours
    "encoder ks": ("model.savi.encoder_kernel_size", 5),
    "encoder out channels": ("model.savi.token_dim", 128),
    "decoder channels": ("model.savi.decoder_channels", [128, 64, 64, 64, 64]),
    "decoder resolution": ("model.savi.decoder_start_resolution", 8),
    "decoder ks": ("model.savi.decoder_kernel_size", 5),
    "pred_num_layers": ("model.savi.predictor_num_layers", 2),
    "pred_num_heads": ("model.savi.predictor_num_heads", 4),
    "pred_ffn_dim": ("model.savi.predictor_ffn_dim", 128 * 4),
    "post_recon_loss_w": ("loss.pixel.weight", 4 * 1),  # its images are in [-1, 1], ours in [0, 1]
}
# predictor type "transformer", pred_norm_first, pred_rnn and use_post_recon_loss are how SAVi is built here; with
# kld_method "none" its loss is zero, whatever kld_loss_w (1e-4) is.
SLOTFORMER_TABLE: dict[str, tuple[str, Any]] = {
    "learning rate": ("optimizer.lr", 2e-4),
    "history length": ("data.num_history", 6),
    "sample frames (10 rollout)": ("data.num_steps", 16 - 6),
    "frame offset": ("data.frame_offset", 1),
    "batch size": ("data.batch_size", 64),
    "slot size": ("model.savi.slot_dim", 128),
    "d_model": ("model.rollouter.model_dim", 128),
    "num layers": ("model.rollouter.num_layers", 4),
    "num heads": ("model.rollouter.num_heads", 8),
    "ffn_dim": ("model.rollouter.ffn_dim", 128 * 4),
    "decoder channels": ("model.savi.decoder_channels", [128, 64, 64, 64, 64]),
    "decoder resolution": ("model.savi.decoder_start_resolution", 8),
    "decoder ks": ("model.savi.decoder_kernel_size", 5),
    "rollout length": ("data.num_steps", 10),
    "slot_recon_loss_w": ("loss.slot.weight", 1.0),
    "img_recon_loss_w": ("loss.pixel.weight", 4 * 1),
}
# t_pe "sin" and norm_first are how the rollouter is built here; use_img_recon_loss is that there is a loss.pixel.
OF_THE_FAMILY: dict[str, dict[str, Any]] = {  # text below the first table; epochs 40, and 80, 80, 15
    "MuJoCo": {"resolution": 128, "slots": 4, "SAVi updates": 151_040, "SlotFormer updates": 250_880},
    "Deformable": {"resolution": 128, "slots": 4, "SAVi updates": 48_000, "SlotFormer updates": 83_200},
    "Kubric": {"resolution": 64, "slots": 8, "SAVi updates": 179_120, "SlotFormer updates": 59_790},
}
# Where the paper is silent: the released SlotFormer's values.
RELEASED_SAVI = {
    "model.savi.lstm_dim": 256,  # it has one number, "slot mlp size", for both
    "model.savi.slot_dim": 128,
    "model.savi.dropout": 0.1,
    "model.savi.attention_epsilon": 1e-6,
    "model.savi.kernel_head": True,
    "model.num_context_frames": 6,
    "optimizer.warmup_share": 0.025,
    "optimizer.end_share": 0.01,
    "data.use_slots": False,
    "loss.pixel.coarse_weight": 0.0,
}
RELEASED_SLOTFORMER = {
    "model.rollouter.dropout": 0.1,
    "model.rollouter.num_history": 6,
    "model.rollouter.slot_dim": 128,
    "optimizer.warmup_share": 0.05,
    "optimizer.end_share": 0.01,
    "trainer.gradient_clip_val": None,
    "data.use_slots": True,
    "loss.pixel.coarse_weight": 0.0,
}


def at(config: dict[str, Any], place: str) -> Any:
    for word in place.split("."):
        config = config[word]
    return config


@functools.cache
def composed(experiment: str, model: str) -> dict[str, Any]:
    """Not to be changed."""
    return compose("train", [f"experiment={experiment}", f"model={model}", "run.folder=nowhere"])


def first_training(experiment: str) -> dict[str, Any]:
    config = pretraining_config(composed(experiment, "slotformer"))
    assert config is not None
    return config


def savis(experiment: str) -> list[dict[str, Any]]:
    """SAVi by itself, and as SlotFormer's first training."""
    return [composed(experiment, "savi"), first_training(experiment)]


@pytest.mark.parametrize("experiment", FAMILIES)
def test_every_cell_of_savis_table(experiment: str) -> None:
    for config in savis(experiment):
        for row, (place, value) in SAVI_TABLE.items():
            assert at(config, place) == value, f"{row}: {place}"
        for place, value in RELEASED_SAVI.items():
            assert at(config, place) == value, place


@pytest.mark.parametrize("experiment", FAMILIES)
def test_every_cell_of_slotformers_table(experiment: str) -> None:
    config = composed(experiment, "slotformer")
    for row, (place, value) in SLOTFORMER_TABLE.items():
        assert at(config, place) == value, f"{row}: {place}"
    for place, value in RELEASED_SLOTFORMER.items():
        assert at(config, place) == value, place


@pytest.mark.parametrize("experiment", FAMILIES)
def test_resolution_slots_and_epochs_follow_the_data_set(experiment: str) -> None:
    family = OF_THE_FAMILY[FAMILIES[experiment]]
    slotformer = composed(experiment, "slotformer")
    for config in [slotformer, *savis(experiment)]:
        savi = config["model"]["savi"]
        assert config["data"]["resolution"] == savi["resolution"] == family["resolution"]
        assert savi["num_slots"] == family["slots"]
        assert savi["resolution"] // savi["encoder_first_stride"] == 64  # as released, whatever the resolution
    assert slotformer["trainer"]["max_steps"] == family["SlotFormer updates"]
    for config in savis(experiment):
        assert config["trainer"]["max_steps"] == family["SAVi updates"]


@pytest.mark.parametrize("experiment", ["mujoco_block", "deformable_multi", "movi_c"])
def test_first_training_is_savi_and_both_trainings_have_one_network(experiment: str) -> None:
    slotformer, first, savi = (
        composed(experiment, "slotformer"),
        first_training(experiment),
        composed(experiment, "savi"),
    )
    assert (slotformer["system"], savi["system"]) == ("slotformer", "savi")
    assert first["model"] == savi["model"]
    assert slotformer["model"]["savi"] == savi["model"]["savi"]
    assert first["optimizer"] == savi["optimizer"]
    assert {name: entry for name, entry in first["loss"].items() if entry} == savi["loss"]
    assert set(slotformer["loss"]) == {"slot", "pixel"}
    for config in (slotformer, first, savi):
        for section in ("model", "data", "loss", "optimizer", "trainer"):
            check_targets(config[section], section)


@pytest.mark.parametrize("model", ["savi", "slotformer"])
def test_scene_of_ones_own_has_the_smaller_number_of_slots(model: str) -> None:
    config = compose("train", [f"model={model}", "scene=tiny", "data.folder=mine", "run.folder=nowhere"])
    assert (config["model"]["savi"]["resolution"], config["model"]["savi"]["num_slots"]) == (128, 4)
