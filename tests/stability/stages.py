"""The stages as conf/ builds them, at a small size, with noisy weights, and the states that they are tried on."""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from tests import composed_options
from tests.stability.hard_scenes import MODES, Mode
from vpd_lightning.config import build
from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.encoder.base import AbstractEncoder
from vpd_lightning.renderer.base import AbstractRenderer
from vpd_lightning.testing import FAR, FEATURE_DIM, NEAR, NUM_VIEWS, WORKSPACE_MAX, WORKSPACE_MIN
from vpd_lightning.testing.particle_sets import mapped
from vpd_lightning.types import Cameras, Particles, Rays

BASES = {"encoder": AbstractEncoder, "dynamics": AbstractDynamics, "renderer": AbstractRenderer}
SMALL = {
    "channels": [6, 8, 6, 8, FEATURE_DIM],
    "num_particles": 30,
    "num_views": NUM_VIEWS,
    "height": 16,
    "width": 16,
    "hidden_dim": 12,
    "message_passing_steps": 2,
    "num_abstract_nodes": 12,
    "net_depth": 3,
    "net_width": 12,
    "skip_layer": 1,
    "net_width_condition": 8,
    "num_coarse_samples": 8,
    "num_fine_samples": 8,
    "background_width": 8,
    "ray_chunk_size": 10,
}
LENGTHS = (  # options in metres, which grow with the world
    "kernel_radii", "kernel_bandwidths", "near", "far", "footprint", "surface_scale", "r_s", "r_a_s",
    "location_scale", "force_scale", "contact_range", "contact_reach", "max_contact_depth", "shadow_scales",
    "workspace_min", "workspace_max", "max_radius",
)  # fmt: skip


VARIANTS: dict[str, dict[str, dict[str, Any]]] = {  # switches that change how an option computes
    "point_nerf": {
        "all_switches_off": {"sort_particles": False, "reuse_coarse": False, "features_backend": "torch"},
        "bounded": {"max_radius": 0.4},
        "recomputed": {"checkpoint_chunks": True},
    },
    "surface": {"brute_force": {"candidate_backend": "torch"}},
    "splat": {"brute_force": {"candidate_backend": "torch"}},
    "inertial": {"substeps": {"num_contact_substeps": 4}},
    "hierarchical_gnn": {
        "static_shapes": {"edge_capacity": 512},
        "nearest_abstract_nodes": {"max_abstract_edges_per_node": 4},
        "as_vpd_staged": {
            "normalized_edges": True,
            "edge_gain": 3.0,
            "aggregation": "mean",
            "update_features": False,
        },
    },
}


def variants(group: str) -> list[tuple[str, str]]:
    """Return every option as it is, and again with each of its variants."""
    return [(name, kind) for name in options(group) for kind in ("", *VARIANTS.get(name, {}))]


def matrix(group: str) -> list[Any]:
    """Return every option in every precision, and its variants in float32, as pytest's parameters."""
    return [
        pytest.param(choice, mode, id=f"{'-'.join(filter(None, choice))}-{mode.name}")
        for choice in variants(group)
        for mode in MODES
        if not choice[1] or mode.name == "float32"
    ]


def variant(group: str, choice: tuple[str, str], mode: Mode, device: torch.device, scale: float = 1.0) -> nn.Module:
    """Build one of ``variants``."""
    option, kind = choice
    return stage(group, option, mode, device, scale, **(VARIANTS[option][kind] if kind else {}))


def options(group: str) -> list[str]:
    """Return the options of a group; a ``_small`` one is its namesake at another size, and sizes are set here."""
    return [name for name in composed_options.options(group) if not name.endswith("_small")]


def _composed(group: str, option: str) -> Any:
    scene = [
        "scene=demo", f"feature_dim={FEATURE_DIM}", f"scene.near={NEAR}", f"scene.far={FAR}",
        f"scene.workspace_min={list(WORKSPACE_MIN)}", f"scene.workspace_max={list(WORKSPACE_MAX)}",
        "data.folder=nowhere", "run.folder=nowhere",
    ]  # fmt: skip
    return composed_options.option_section(group, option, tuple(BASES), scene)


def _changed(section: Any, scale: float, changes: dict[str, Any]) -> Any:
    if not isinstance(section, Mapping):
        return section
    result = {}
    for key, value in section.items():
        value = _changed(changes.get(key, SMALL.get(key, value)), scale, changes)
        if key in LENGTHS and value is not None and scale != 1.0:
            value = [item * scale for item in value] if isinstance(value, list) else value * scale
        result[key] = value
    return result


def stage(group: str, option: str, mode: Mode, device: torch.device, scale: float = 1.0, **changes: Any) -> nn.Module:
    """Build an option in the precision under test; ``scale`` multiplies every length in its settings.

    Thousands of cases want the same few hundred modules, so each is built once and then copied.
    """
    key = repr((group, option, mode.dtype, device, scale, sorted(changes.items())))
    if key not in _BUILT:
        _BUILT[key] = _built(group, option, mode, device, scale, changes)
    return deepcopy(_BUILT[key])


_BUILT: dict[str, nn.Module] = {}


def _built(
    group: str, option: str, mode: Mode, device: torch.device, scale: float, changes: dict[str, Any]
) -> nn.Module:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        built = build(_changed(_composed(group, option), scale, changes), BASES[group], group).to(device, mode.dtype)
        with torch.no_grad():  # layers that start at zero hide what lies behind them
            for parameter in built.parameters():
                parameter.add_(0.05 * torch.randn_like(parameter))
    return built


def particles_at(positions: Tensor, mode: Mode, device: torch.device, seed: int = 0, **changes: Any) -> Particles:
    """Return a batch of one with all optional observations; every second particle may move.

    The others face up, tilted by some ten degrees: a normal that its neighbours do not share is trusted by no contact.
    """
    generator = torch.Generator().manual_seed(seed)
    count = len(positions)
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    normals[1::2] = torch.nn.functional.normalize(up + 0.2 * normals[1::2], dim=-1)
    particles = Particles(
        positions=positions[None],
        features=torch.rand(1, count, FEATURE_DIM, generator=generator, dtype=torch.float64),
        colors=torch.rand(1, count, 3, generator=generator, dtype=torch.float64),
        moving=(torch.arange(count) % 2 == 0)[None],
        normals=normals[None],
    )
    particles = mapped(particles, lambda value: value.to(device, mode.dtype) if value.is_floating_point() else value)
    return replace(mapped(particles, lambda value: value.to(device)), **changes)


def moved_rays(rays: Rays, mode: Mode, device: torch.device, scale: float = 1.0, shift: Tensor | None = None) -> Rays:
    """Return rays of the ordinary scene in a scaled and shifted world."""
    origins = rays.origins * scale + (0.0 if shift is None else shift)
    return Rays(origins.to(device, mode.dtype), rays.directions.to(device, mode.dtype))


def cast_cameras(cameras: Cameras, mode: Mode, device: torch.device) -> Cameras:
    return cameras.to(device, mode.dtype)


def weights_and(module: nn.Module, *inputs: Tensor) -> list[Tensor]:
    return [*inputs, *(p for p in module.parameters() if p.requires_grad)]
