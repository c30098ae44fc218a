"""The paper's sizes of SAVi and SlotFormer, and small ones."""

import torch

from vpd_lightning.baselines.rollouter import SlotRollouter
from vpd_lightning.baselines.savi import SAVi
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import ViewBatch

PAPER_SAVI = {
    "resolution": 128,
    "num_slots": 4,
    "slot_dim": 128,
    "encoder_channels": [64, 64, 64, 64],
    "encoder_kernel_size": 5,
    "encoder_first_stride": 2,
    "token_dim": 128,
    "num_iterations": 2,
    "mlp_dim": 256,
    "attention_epsilon": 1e-6,
    "kernel_head": True,
    "predictor_num_layers": 2,
    "predictor_num_heads": 4,
    "predictor_ffn_dim": 512,
    "lstm_dim": 256,
    "dropout": 0.1,
    "decoder_channels": [128, 64, 64, 64, 64],
    "decoder_kernel_size": 5,
    "decoder_start_resolution": 8,
}
KUBRIC_SAVI = {**PAPER_SAVI, "resolution": 64, "num_slots": 8, "encoder_first_stride": 1}

SMALL_SAVI = {
    **PAPER_SAVI,
    "resolution": 16,
    "num_slots": 3,
    "slot_dim": 16,
    "encoder_channels": [8, 8],
    "encoder_first_stride": 1,
    "token_dim": 16,
    "mlp_dim": 32,
    "predictor_num_layers": 1,
    "predictor_ffn_dim": 32,
    "lstm_dim": 32,
    "decoder_channels": [16, 8, 8],
    "decoder_start_resolution": 8,
}

PAPER_ROLLOUTER = {
    "slot_dim": 128,
    "num_history": 6,
    "model_dim": 128,
    "num_layers": 4,
    "num_heads": 8,
    "ffn_dim": 512,
    "dropout": 0.1,
}
SMALL_ROLLOUTER = {**PAPER_ROLLOUTER, "slot_dim": 16, "model_dim": 16, "num_layers": 2, "num_heads": 4, "ffn_dim": 32}


def savi(sizes=SMALL_SAVI, **changes):
    return SAVi(**{**sizes, **changes})


def rollouter(sizes=SMALL_ROLLOUTER, **changes):
    return SlotRollouter(**{**sizes, **changes})


def count(*modules):
    return sum(parameter.numel() for module in modules for parameter in module.parameters())


def images(batch=2, time=3, size=16, seed=0):
    """Random images in [-1, 1] as SAVi takes them."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(batch, time, 3, size, size, generator=generator) * 2 - 1


def view_batch(batch=2, time=3, size=16, slots=None, num_history=6, seed=0, step=0):
    """One bright square that moves over a dark ground, in a colour of each clip's own."""
    generator = torch.Generator().manual_seed(seed)
    frames = torch.full((batch, time, size, size, 3), 30, dtype=torch.uint8)
    for member in range(batch):
        color = torch.randint(100, 256, (3,), generator=generator, dtype=torch.uint8)
        for t in range(time):
            left = (2 * t + 3 * member) % (size - 5)
            frames[member, t, 4:10, left : left + 6] = color
    return ViewBatch(frames, slots, num_history, RandomKeys(0, step, list(range(batch))), clips=["clip"] * batch)
