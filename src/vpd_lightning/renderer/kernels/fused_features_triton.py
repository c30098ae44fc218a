"""Annular features on the GPU: one pass over the neighbours, sums in registers; static shapes, no wait for the host.

Bytes per query of 16 neighbours, 4 kernels, 16 features: 64 of indices, 12 of position, 1,216 gathered (from the
second-level cache: 16,384 particles are 1.2 MB), 256 written. The definition also writes and reads the gathered rows.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import torch
import triton
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor

from vpd_lightning.renderer.kernels import fused_loops_triton as loops

_TILE = 2048
"""Numbers per tile ``[query, kernel, feature]``: 16 registers in each of 128 threads."""

OPTIONS = {"num_warps": 4, "enable_fp_fusion": True}
"""One rounding for ``a * b + c``; named here because Triton's own default is about to change."""


def runs_on(device: torch.device) -> bool:
    """Whether Triton compiles for ``device`` or interprets (``TRITON_INTERPRET=1``, set before it is imported)."""
    return device.type == "cuda" or not isinstance(loops.sum_features, triton.JITFunction)


def forward(
    queries: Float[Tensor, "set query 3"],
    positions: Float[Tensor, "set particle 3"],
    features: Float[Tensor, "set particle feature"],
    index: Int64[Tensor, "set query neighbor"],
    mask: Bool[Tensor, "set query neighbor"],
    kernel_radii: Sequence[float],
    kernel_bandwidths: Sequence[float],
) -> tuple[Float[Tensor, "set query kernel feature"], Int32[Tensor, "set query neighbor"]]:
    """Return the sums of every query, and the neighbours in half of the bytes (-1 where there is none).

    Indices are trusted: to look at them on the host would wait for the GPU.
    """
    queries, positions, features = queries.contiguous(), positions.contiguous(), features.contiguous()
    table = index.masked_fill(~mask, -1).int().contiguous()
    num_kernels, width = len(kernel_radii), features.shape[-1]
    out = queries.new_empty(*queries.shape[:2], num_kernels, width)
    if out.numel():
        kernels = _kernels(tuple(kernel_radii), tuple(kernel_bandwidths), queries.dtype, queries.device)
        sizes = tile_sizes(num_kernels, width)
        grid = (triton.cdiv(queries.shape[1], sizes["BLOCK"]), queries.shape[0])
        counts = (queries.shape[1], positions.shape[1], table.shape[2])
        with torch.cuda.device_of(queries):
            loops.sum_features[grid](queries, positions, features, table, *kernels, out, *counts, **sizes, **OPTIONS)
    return out, table


def backward(
    grad: Float[Tensor, "set query kernel feature"],
    queries: Float[Tensor, "set query 3"],
    positions: Float[Tensor, "set particle 3"],
    features: Float[Tensor, "set particle feature"],
    table: Int32[Tensor, "set query neighbor"],
    kernel_radii: Sequence[float],
    kernel_bandwidths: Sequence[float],
) -> tuple[Float[Tensor, "set query 3"], Float[Tensor, "set particle 3"], Float[Tensor, "set particle feature"]]:
    """Return the gradients of queries, positions and features; weights are computed again.

    Particles' gradients are added by atomic operations, or, under ``torch.use_deterministic_algorithms(True)``, summed
    in a fixed order after sorting the references by particle.
    """
    grad = grad.contiguous()
    queries, positions, features = queries.contiguous(), positions.contiguous(), features.contiguous()
    num_sets, num_queries, k = table.shape
    num_kernels, width = grad.shape[-2:]
    is_deterministic = torch.are_deterministic_algorithms_enabled()
    new = torch.empty_like if is_deterministic else torch.zeros_like
    grad_queries, grad_positions, grad_features = torch.empty_like(queries), new(positions), new(features)
    kernels = _kernels(tuple(kernel_radii), tuple(kernel_bandwidths), queries.dtype, queries.device)
    sizes = tile_sizes(num_kernels, width)
    with torch.cuda.device_of(queries):
        if queries.numel():
            grid = (triton.cdiv(num_queries, sizes["BLOCK"]), num_sets)
            loops.add_gradients[grid](
                queries, positions, features, table, *kernels, grad, grad_queries, grad_positions, grad_features,
                num_queries, positions.shape[1], k, **sizes, SCATTER=not is_deterministic, **OPTIONS,
            )  # fmt: skip
        if is_deterministic:
            order, starts = _sorted_references(table, positions.shape[1])
            loops.gather_gradients[(num_sets * positions.shape[1],)](
                queries, positions, features, *kernels, grad, order, starts, grad_positions, grad_features, k,
                **sizes, **OPTIONS,
            )  # fmt: skip
    return grad_queries, grad_positions, grad_features


def _sorted_references(
    table: Int32[Tensor, "set query neighbor"], num_particles: int
) -> tuple[Int64[Tensor, " reference"], Int64[Tensor, " start"]]:
    """Return the references sorted by particle (equal ones in their order), and where those of each particle start."""
    num_sets = len(table)
    offsets = num_particles * torch.arange(num_sets, device=table.device)[:, None, None]
    # Those that refer to no particle come last.
    keys = torch.where(table >= 0, table + offsets, num_sets * num_particles).flatten()
    keys, order = keys.sort(stable=True)
    return order, torch.searchsorted(keys, torch.arange(num_sets * num_particles + 1, device=table.device))


def tile_sizes(num_kernels: int, width: int) -> dict[str, Any]:
    """Return the kernels' compile-time sizes: powers of two, and few enough queries to fit into registers."""
    kernels, lanes = triton.next_power_of_2(num_kernels), triton.next_power_of_2(width)
    block = min(max(_TILE // (kernels * lanes), 1), 64)
    return {"NUM_KERNELS": num_kernels, "WIDTH": width, "BLOCK": block, "KERNELS": kernels, "LANES": lanes}


@lru_cache(maxsize=16)
def _kernels(
    kernel_radii: tuple[float, ...], kernel_bandwidths: tuple[float, ...], dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Return radii and inverse bandwidths on the device, where they stay: a copy would wait, and break a CUDA graph."""
    missing = triton.next_power_of_2(len(kernel_radii)) - len(kernel_radii)
    radii = torch.tensor([*kernel_radii, *[0.0] * missing], dtype=dtype, device=device)
    return radii, 1.0 / torch.tensor([*kernel_bandwidths, *[1.0] * missing], dtype=dtype, device=device)
