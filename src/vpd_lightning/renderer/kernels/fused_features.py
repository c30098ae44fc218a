"""Annular features in one pass, backend by backend: the rows of ``[query, neighbor, feature]`` are never materialised.

``annular_features`` is the definition; every backend here has its shapes, its conventions and its gradients. Kept for
the backward pass are the inputs and the neighbours' indices in 4 bytes each (the definition keeps 19 numbers per
neighbour of 16 features, and their weights); weights are computed again.
"""

import math
from collections.abc import Sequence
from functools import cache
from importlib.util import find_spec
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.errors import ConfigError
from vpd_lightning.graph.neighbors import Neighbors
from vpd_lightning.renderer.features.point_features import annular_features
from vpd_lightning.renderer.field.precision import at_least_float32
from vpd_lightning.types import Particles

FEATURE_BACKENDS = ("torch", "numba", "triton")
"""``torch``: the definition, any device. ``numba``: compiled for the CPU. ``triton``: for GPUs.

``auto`` takes numba for the CPU and triton for CUDA where they are installed: numba was faster at every number of
queries from 1 up, 13 to 16 times forward and 10 to 15 times with backward at 49,152. What it compiles, for some seconds
when a machine first meets a type of numbers, is kept on disk.
"""


def fused_annular_features(
    queries: Float[Tensor, "*batch query 3"],
    particles: Particles,
    neighbors: Neighbors,
    kernel_radii: Float[Tensor, " kernel"] | Sequence[float],
    kernel_bandwidths: Float[Tensor, " kernel"] | Sequence[float],
    backend: str,
) -> Float[Tensor, "*batch query kernel_feature"]:
    """Return ``annular_features`` by ``backend``: ``auto`` or one of ``FEATURE_BACKENDS``.

    Equal to the definition up to the order of summation and the rounding of the exponential; float32 weights below
    1.2e-38 count as 0. Gradients reach positions, features and queries (once: not gradients of gradients), and not the
    kernels' parameters, except by ``torch``, which ``auto`` therefore takes where they ask for some.

    Raises:
        ConfigError: when the package of ``backend`` is not installed, or does not work on this device.
        IndexError: when an index is not that of a particle (on the CPU; the GPU trusts them).
        ValueError: when ``backend`` is unknown, or has no gradient for kernels that ask for one.
    """
    chosen = _chosen(backend, queries, kernel_radii, kernel_bandwidths)
    if chosen == "torch" or particles.num_particles == 0:
        return annular_features(queries, particles, neighbors, kernel_radii, kernel_bandwidths)
    positions = at_least_float32(particles.positions)
    features = at_least_float32(particles.features).to(positions.dtype)
    queries = at_least_float32(queries).to(positions.dtype)
    *batch, num_queries, k = neighbors.index.shape
    num_sets, (num_particles, width) = math.prod(batch), features.shape[-2:]
    kernels = tuple(float(r) for r in kernel_radii), tuple(float(b) for b in kernel_bandwidths)
    summed = _FusedFeatures.apply(
        queries.reshape(num_sets, num_queries, 3),
        positions.reshape(num_sets, num_particles, 3),
        features.reshape(num_sets, num_particles, width),
        neighbors.index.reshape(num_sets, num_queries, k),
        neighbors.mask.reshape(num_sets, num_queries, k),
        kernels,
        chosen,
    )
    return summed.reshape(*batch, num_queries, len(kernels[0]) * width)


class _FusedFeatures(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, queries: Tensor, positions: Tensor, features: Tensor, *rest: Any) -> Tensor:
        index, mask, kernels, backend = rest
        summed, table = _module(backend).forward(queries, positions, features, index, mask, *kernels)
        ctx.save_for_backward(queries, positions, features, table)
        ctx.kernels, ctx.backend = kernels, backend
        return summed

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        return (*_module(ctx.backend).backward(grad, *ctx.saved_tensors, *ctx.kernels), None, None, None, None)


def _module(backend: str) -> Any:
    # Imported where it is used: neither compiler is needed by who uses neither.
    if backend == "numba":
        from vpd_lightning.renderer.kernels import fused_features_numba

        return fused_features_numba
    from vpd_lightning.renderer.kernels import fused_features_triton

    return fused_features_triton


def _chosen(backend: str, queries: Tensor, *kernels: Any) -> str:
    if backend not in ("auto", *FEATURE_BACKENDS):
        raise ValueError(f"The features' backend must be auto or one of {FEATURE_BACKENDS}, got {backend!r}.")
    if backend == "torch":
        return backend
    needs_kernels = any(isinstance(values, Tensor) and values.requires_grad for values in kernels)
    if backend == "auto":
        found = {"cpu": "numba", "cuda": "triton"}.get(queries.device.type)
        return found if found is not None and _installed(found) and not needs_kernels else "torch"
    if needs_kernels:
        raise ValueError(f"The features' backend {backend} has no gradients for the kernels' parameters; torch has.")
    if not _installed(backend):
        raise ConfigError(
            f"The features' backend {backend} needs the package {backend}, which is not installed.\n"
            f"Use features_backend=auto, or: pip install {backend}"
        )
    if not _module(backend).runs_on(queries.device):
        raise ConfigError(
            f"The features' backend {backend} does not work on {queries.device}; use features_backend=auto.\n"
            "numba works on the CPU, triton on GPUs (and on the CPU with TRITON_INTERPRET=1 from the start, slowly)."
        )
    return backend


@cache
def _installed(package: str) -> bool:
    return find_spec(package) is not None
