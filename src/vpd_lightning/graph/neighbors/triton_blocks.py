"""Exact search on the GPU: blocks of Morton-sorted points with boxes, static shapes, no wait for the host.

So torch.compile and CUDA graphs can hold it. Such a search cannot raise an error about its input's values: where the
other backends raise ``NonFiniteError``, this one lets the mistake through in a form that cannot be overlooked (see
``TritonSearch.knn``).
"""

import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor

from vpd_lightning.errors import ConfigError
from vpd_lightning.graph.neighbors.contract import Neighbors, no_neighbors, require_finite
from vpd_lightning.graph.neighbors.reference import ReferenceSearch
from vpd_lightning.graph.ordering import build_blocks

BLOCK_QUERIES = 32
"""Queries per program: consecutive samples of a ray, which need the same blocks."""

BLOCK_POINTS = 32
"""Points per block."""

BLOCKS_PER_GROUP = 16
"""Blocks that one larger box covers."""

NUM_WARPS = 2

MAX_NEIGHBORS = 32
"""Lists up to this long fit into registers; longer ones are left to the plain search."""

_SLACK = 1.0 + 1e-6
"""Squares are searched a little beyond the radius, so that no rounding of a root or a square loses a neighbour."""


class TritonSearch:
    """Holds the points in Morton order with their boxes; queries are searched in blocks, in the order they come in.

    Raises:
        ConfigError: when Triton is not installed, or for tensors on the CPU outside Triton's interpreter.
    """

    def __init__(self, points: Float[Tensor, "point 3"], mask: Bool[Tensor, " point"] | None = None) -> None:
        try:
            import triton

            from vpd_lightning.graph.neighbors import triton_loops
        except ImportError as error:
            raise ConfigError(
                "neighbors_backend=triton needs the package triton, which is not installed.\n"
                "It comes with PyTorch for CUDA; use neighbors_backend=auto without it."
            ) from error
        self._kernel = triton_loops.knn_kernel
        if not points.is_cuda and isinstance(self._kernel, triton.JITFunction):
            raise ConfigError(
                f"neighbors_backend=triton needs a GPU, but the points are on {points.device.type}.\n"
                "Use neighbors_backend=auto, or set TRITON_INTERPRET=1 before Python starts (tests only: it is slow)."
            )
        self._dtype = torch.float64 if points.dtype == torch.float64 else torch.float32
        self._points, self._mask = points, mask
        valid = torch.ones(len(points), dtype=torch.bool, device=points.device) if mask is None else mask
        finite = torch.isfinite(points).all(dim=1)
        usable = valid & finite
        self._has_points, broken = usable.any(), valid & ~finite
        self._has_broken, self._first_broken = broken.any(), broken.int().argmax()
        blocks = build_blocks(points.to(self._dtype), BLOCK_POINTS, usable)
        self._order = blocks.order
        self._num_groups = -(-len(blocks.box_min) // BLOCKS_PER_GROUP)
        missing = self._num_groups * BLOCKS_PER_GROUP - len(blocks.box_min)
        low = torch.nn.functional.pad(blocks.box_min, (0, 0, 0, missing), value=torch.inf)
        high = torch.nn.functional.pad(blocks.box_max, (0, 0, 0, missing), value=-torch.inf)
        grouped = (self._num_groups, BLOCKS_PER_GROUP, 3)
        self._blocks = torch.cat([low, high], dim=1).t().contiguous()
        groups = [low.view(grouped).amin(dim=1), high.view(grouped).amax(dim=1)]
        self._groups = torch.cat(groups, dim=1).t().contiguous()
        padding = len(low) * BLOCK_POINTS - len(points)
        self._columns = torch.nn.functional.pad(blocks.points, (0, 0, 0, padding), value=torch.inf).t().contiguous()

    def knn(self, queries: Float[Tensor, "query 3"], k: int, max_radius: float | None) -> Neighbors:
        """Return the ``k`` nearest points; equal distances come in any order.

        A query that is not finite gets distances NaN and some point as its neighbours, so that what is computed from
        them is NaN as well. If a point is not finite, all distances are NaN, and it is everybody's first neighbour.
        """
        if k > MAX_NEIGHBORS:
            return ReferenceSearch(self._points, self._mask).knn(queries, k, max_radius)
        count = min(k, len(self._points))
        # Comparisons with NaN would go either way; what these rows find is replaced below.
        searched = queries.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0).to(self._dtype).contiguous()
        squared, place = self._search(searched, count, max_radius)
        distance = squared.sqrt_().to(queries.dtype)
        mask = place >= 0
        if max_radius is not None:
            mask &= distance <= max_radius
        index = self._order[place.clamp_(min=0).long()].masked_fill_(~mask, 0)
        distance = distance.masked_fill_(~mask, torch.inf)
        index, distance, mask = self._spoiled(queries, index, distance, mask)
        nothing = no_neighbors(queries, k - count)
        return Neighbors(
            index=torch.cat([index, nothing.index], dim=1),
            distance=torch.cat([distance, nothing.distance], dim=1),
            mask=torch.cat([mask, nothing.mask], dim=1),
        )

    def radius(
        self, queries: Float[Tensor, "query 3"], max_radius: float
    ) -> tuple[Int64[Tensor, " edge"], Int64[Tensor, " edge"]]:
        """Return all pairs by brute force: their number is not known beforehand, so the host has to wait anyway.

        Raises:
            NonFiniteError: when a coordinate is not finite, as the other backends do.
        """
        require_finite("points", self._points if self._mask is None else self._points[self._mask])
        require_finite("queries", queries)
        return ReferenceSearch(self._points, self._mask).radius(queries, max_radius)

    def _search(
        self, queries: Float[Tensor, "query 3"], count: int, max_radius: float | None
    ) -> tuple[Float[Tensor, "query found"], Int32[Tensor, "query found"]]:
        squared = queries.new_empty(len(queries), count)
        place = torch.empty(squared.shape, dtype=torch.int32, device=queries.device)
        info = torch.finfo(self._dtype)
        limit = info.max if max_radius is None else min(max_radius * max_radius * _SLACK + info.tiny, info.max)
        self._kernel[(-(-len(queries) // BLOCK_QUERIES),)](
            self._columns,
            self._blocks,
            self._groups,
            queries,
            squared,
            place,
            # A tensor, because a plain number would be rounded to float32 on its way to the kernel.
            torch.full((1,), limit, dtype=self._dtype, device=queries.device),
            len(queries),
            self._blocks.shape[1],
            self._num_groups,
            count,
            BLOCK_Q=BLOCK_QUERIES,
            BLOCK_P=BLOCK_POINTS,
            GROUP=BLOCKS_PER_GROUP,
            K=1 << (count - 1).bit_length(),
            num_warps=NUM_WARPS,
            enable_fp_fusion=False,
        )
        return squared, place

    def _spoiled(
        self,
        queries: Float[Tensor, "query 3"],
        index: Int64[Tensor, "query found"],
        distance: Float[Tensor, "query found"],
        mask: Bool[Tensor, "query found"],
    ) -> tuple[Int64[Tensor, "query found"], Float[Tensor, "query found"], Bool[Tensor, "query found"]]:
        """Make input that is not finite show in the result, without looking at it on the host."""
        broken = ~torch.isfinite(queries).all(dim=1, keepdim=True) & self._has_points
        index, mask = torch.where(broken, self._order[0], index), mask | broken
        distance = distance.masked_fill(broken | self._has_broken, torch.nan)
        is_first = torch.arange(index.shape[1], device=index.device) == 0
        shown = is_first & self._has_broken
        return torch.where(shown, self._first_broken, index), distance, mask | shown
