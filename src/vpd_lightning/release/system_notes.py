"""Names and notes of each system for reports and model cards: one entry for each, in the order of the paper's table."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SystemCard:
    """What a system is, in a sentence or two, its colour in plots (None: a spare one), and what it can do."""

    note: str
    color: str | None = None
    reads_depth: bool = True
    renders_any_camera: bool = True


SYSTEM_CARDS = {
    "slotformer": SystemCard(
        note=(
            "SlotFormer (Wu et al., ICLR 2023) on slots of SAVi (Kipf et al., ICLR 2022): pictures become slots, a "
            "transformer predicts the next slots, and a decoder draws them. It reads no depth and has no "
            "cameras: it predicts each camera's video from that camera's own frames, and cannot render a new view."
        ),
        color="#d55e00",
        reads_depth=False,
        renders_any_camera=False,
    ),
    "savi": SystemCard(
        note=(
            "SAVi (Kipf et al., ICLR 2022): pictures become slots that follow objects through a video, and a "
            "decoder draws them again. The first of SlotFormer's two trainings; by itself it predicts that nothing "
            "moves."
        ),
        color="#e6ab02",
        reads_depth=False,
        renders_any_camera=False,
    ),
    "global": SystemCard(
        note=(
            "One latent vector for the whole scene, after NeRF-dy (Li et al., 2021) as the VPD paper compares with "
            "it: the input pictures and cameras become a vector, a network predicts the next vector, and a "
            "radiance field that is conditioned on it is rendered. It reads no depth."
        ),
        color="#009e73",
        reads_depth=False,
    ),
    "sequential": SystemCard(
        note=(
            "The stages of Visual Particle Dynamics, trained one after the other: encoder and renderer first as an "
            "auto-encoder, then the dynamics alone, on the renderer's features (the paper's comparison of that "
            "name)."
        ),
        color="#cc79a7",
    ),
    "vpd": SystemCard(
        note=(
            "Visual Particle Dynamics (Whitney et al., ICLR 2024): two posed RGB-D frames become latent particles, "
            "a graph network predicts where they go, and a particle-based renderer draws what any camera will see."
        ),
        color="#0072b2",
    ),
    "vpd_predicted_depth": SystemCard(
        note=(
            "Visual Particle Dynamics that predicts the depth of its input pictures instead of reading it (a "
            "variant of the paper)."
        ),
        reads_depth=False,
    ),
    "inertial": SystemCard(
        note=(
            "Visual Particle Dynamics with dynamics that measure the first velocity by matching the two frames, "
            "carry it, keep bodies out of each other and of what stands still, and learn forces and what bodies "
            "are made of. The paper has no such dynamics."
        ),
        color="#8c6d1f",
    ),
    "persistence": SystemCard(
        note=(
            "The encoder and renderer of Visual Particle Dynamics with particles that stay where they are: what "
            "drawing well achieves without predicting anything."
        ),
        color="#56b4e9",
    ),
}
"""By the configuration's ``system``. A plug-in's system has none; a variant of VPD without one is called a variant."""

COLORS = {name: card.color for name, card in SYSTEM_CARDS.items() if card.color is not None}


def describe_system(system: str) -> str:
    """Return what a system is; a variant of Visual Particle Dynamics without a note of its own is called one."""
    if system in SYSTEM_CARDS:
        return SYSTEM_CARDS[system].note
    variant = f"{SYSTEM_CARDS['vpd'].note} This is its variant `{system}`."
    return variant if system.startswith("vpd_") else f"The system `{system}`."


def reads_depth(system: str) -> bool:
    """Tell whether a system needs depth at its inputs, as far as is known."""
    return system not in SYSTEM_CARDS or SYSTEM_CARDS[system].reads_depth


def renders_any_camera(system: str) -> bool:
    """Tell whether a system predicts what cameras see that are not its inputs."""
    return system not in SYSTEM_CARDS or SYSTEM_CARDS[system].renders_any_camera
