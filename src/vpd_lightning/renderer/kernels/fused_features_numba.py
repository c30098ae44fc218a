"""Annular features on the CPU, compiled: distances, kernels and sums of a few queries at a time, in first-level cache.

Floor for 49,152 queries of 16 neighbours under 4 kernels of 16 features, float32, one core: 50 million multiply-adds
(16 per instruction with two 256-bit units: 3.1 million cycles), 3.1 million exponentials (8 at a time, about 14
instructions: 2 million cycles), 12.6 MB written and 10 MB of indices and queries read: 2 to 3 ms at 2.6 GHz. Gathers
and the loops around them were expected to double that; measured were 6 to 8 ms, the definition took 95 to 110 ms.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor

from vpd_lightning.renderer.kernels.fused_loops_numba import KERNELS, LANES, add_gradients, sum_features
from vpd_lightning.threads import in_threads

_FORWARD_SLICE = 4096
"""Queries of one task; a query's result does not depend on it."""
_MAX_BACKWARD_SLICES = 8


def runs_on(device: torch.device) -> bool:
    """Whether the compiled loops can read what lies on ``device``."""
    return device.type == "cpu"


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

    Raises:
        IndexError: when ``index`` names a particle that is not there.
    """
    num_sets, num_queries, _ = queries.shape
    num_kernels, width = len(kernel_radii), features.shape[-1]
    kernels = _padded_kernels(kernel_radii, kernel_bandwidths, queries.dtype)
    padded = _padded(features)
    out = queries.new_empty(num_sets, num_queries, len(kernels[0]), padded.shape[-1])
    table = index.new_empty(index.shape, dtype=torch.int32)
    arrays = [_array(tensor) for tensor in (queries, positions, padded, index, mask, table, out)]
    tasks = [
        (member, slice(start, start + _FORWARD_SLICE))
        for member in range(num_sets)
        for start in range(0, num_queries, _FORWARD_SLICE)
    ]

    def work(member: int, part: slice) -> bool:
        q, p, z, i, m, t, o = (array[member] for array in arrays)
        return sum_features(q[part], p, z, i[part], m[part], t[part], o[part], *kernels)

    if not all(in_threads(lambda task: work(*task), tasks)):
        raise IndexError(f"A neighbour's index is outside of the {positions.shape[-2]} particles.")
    return out[..., :num_kernels, :width], table


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

    Particles' gradients are summed into one buffer per slice of queries, and the buffers in the order of the slices:
    the same digits with any number of threads.
    """
    num_sets, num_queries, k = table.shape
    num_particles, width = features.shape[-2:]
    kernels = _padded_kernels(kernel_radii, kernel_bandwidths, queries.dtype)
    padded, grad = _padded(features), _padded(grad, len(kernels[0]) - grad.shape[-2])
    # A slice's buffer costs about as much as eight references to each particle; with few references there is one.
    num_slices = min(max(num_queries * k // (8 * max(num_particles, 1)), 1), _MAX_BACKWARD_SLICES)
    grad_queries = torch.empty_like(queries, memory_format=torch.contiguous_format)
    grad_positions = positions.new_zeros(num_sets, num_slices, num_particles, 3)
    grad_features = positions.new_zeros(num_sets, num_slices, *padded.shape[1:])
    arrays = [_array(tensor) for tensor in (queries, positions, padded, table, grad, grad_queries)]
    buffers = [_array(tensor) for tensor in (grad_positions, grad_features)]
    cuts = [num_queries * number // num_slices for number in range(num_slices + 1)]
    tasks = [(member, number) for member in range(num_sets) for number in range(num_slices)]

    def work(member: int, number: int) -> None:
        q, p, z, t, g, gq = (array[member] for array in arrays)
        part = slice(cuts[number], cuts[number + 1])
        add_gradients(
            q[part], p, z, t[part], g[part], gq[part], *(buffer[member, number] for buffer in buffers), *kernels
        )

    in_threads(lambda task: work(*task), tasks)
    return grad_queries, _summed(grad_positions), _summed(grad_features)[..., :width]


def _summed(parts: Float[Tensor, "set slice particle width"]) -> Float[Tensor, "set particle width"]:
    total = parts[:, 0]
    for number in range(1, parts.shape[1]):
        total += parts[:, number]
    return total


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


def _padded(rows: Tensor, missing_kernels: int = 0) -> Tensor:
    missing = -rows.shape[-1] % LANES
    # Padding by nothing would copy.
    return torch.nn.functional.pad(rows, (0, missing, 0, missing_kernels)) if missing or missing_kernels else rows


def _padded_kernels(
    kernel_radii: Sequence[float], kernel_bandwidths: Sequence[float], dtype: torch.dtype
) -> tuple[np.ndarray, np.ndarray]:
    """Return radii and inverse bandwidths, zero-padded to a multiple of ``KERNELS``."""
    missing = -len(kernel_radii) % KERNELS
    real = np.float64 if dtype == torch.float64 else np.float32
    radii = np.array([*kernel_radii, *[0.0] * missing], real)
    return radii, (1.0 / np.array([*kernel_bandwidths, *[1.0] * missing])).astype(real)
