"""What a model card says about each system, in a sentence or two."""

SYSTEM_NOTES = {
    "vpd": (
        "Visual Particle Dynamics (Whitney et al., ICLR 2024): two posed RGB-D frames become latent particles, a graph "
        "network predicts where they go, and a particle-based renderer draws what any camera will see."
    ),
    "inertial": (
        "Visual Particle Dynamics with dynamics that measure the first velocity by matching the two frames, carry it, "
        "keep bodies out of each other and of what stands still, and learn forces and what bodies are made of. The "
        "paper has no such dynamics."
    ),
    "global": (
        "One latent vector for the whole scene, after NeRF-dy (Li et al., 2021) as the VPD paper compares with it: the "
        "input pictures and cameras become a vector, a network predicts the next vector, and a radiance field that is "
        "conditioned on it is rendered. It reads no depth."
    ),
    "sequential": (
        "The stages of Visual Particle Dynamics, trained one after the other: encoder and renderer first as an "
        "auto-encoder, then the dynamics alone, on the renderer's features (the paper's comparison of that name)."
    ),
    "slotformer": (
        "SlotFormer (Wu et al., ICLR 2023) on slots of SAVi (Kipf et al., ICLR 2022): pictures become slots, a "
        "transformer predicts the next slots, and a decoder draws them. It reads no depth and knows no cameras: it "
        "predicts each camera's video from that camera's own frames, and cannot render a new view."
    ),
    "savi": (
        "SAVi (Kipf et al., ICLR 2022): pictures become slots that follow objects through a video, and a decoder draws "
        "them again. The first of SlotFormer's two trainings; by itself it predicts that nothing moves."
    ),
    "persistence": (
        "The encoder and renderer of Visual Particle Dynamics with particles that stay where they are: what drawing "
        "well achieves without predicting anything."
    ),
    "vpd_predicted_depth": (
        "Visual Particle Dynamics that predicts the depth of its input pictures instead of reading it (a variant of "
        "the paper)."
    ),
}
"""By the configuration's ``system``; a plug-in's system has none."""

_PREDICTS_VIEWS = ("slotformer", "savi")


def describe_system(system: str) -> str:
    """Return what a system is; a variant of Visual Particle Dynamics without a note of its own is called one."""
    variant = f"{SYSTEM_NOTES['vpd']} This is its variant `{system}`."
    return SYSTEM_NOTES.get(system, variant if system.startswith("vpd_") else f"The system `{system}`.")


def reads_depth(system: str) -> bool:
    """Tell whether a system needs depth at its inputs, as far as is known."""
    return system not in (*_PREDICTS_VIEWS, "global", "vpd_predicted_depth")


def renders_any_camera(system: str) -> bool:
    """Tell whether a system predicts what cameras see that are not its inputs."""
    return system not in _PREDICTS_VIEWS
