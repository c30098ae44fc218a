"""Samples along rays in front-to-back order, whose features are looked up or computed only where they are asked for."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vpd_lightning.renderer.features.sample_features import SampleFeatures


class MergedSamples:
    """Samples at ``points`` in front-to-back order; the features of some may be known already.

    ``order`` says which of the samples before they were sorted each one is; the first of those are the ``known`` ones.
    """

    def __init__(
        self,
        features: SampleFeatures,
        points: Float[Tensor, "batch ray sample 3"],
        order: Int64[Tensor, "batch ray sample"] | None,
        known: Float[Tensor, "batch ray known feature"] | None,
    ) -> None:
        self._features = features
        self._batch_size, self._num_rays = points.shape[:2]
        self._points = points.flatten(0, 1)
        self._order = None if order is None else order.flatten(0, 1)
        self._known = None if known is None else known.flatten(0, 1)

    def features(self, rays: Int64[Tensor, " some"], part: slice) -> Float[Tensor, "some sample feature"]:
        """Return the features of a part of the samples of some rays (ascending; counted through the whole batch)."""
        points = self._points[rays, part]
        shape = points.shape[:2]
        members = (rays // max(1, self._num_rays))[:, None].expand(shape).flatten()
        points = points.flatten(0, 1)
        if self._known is None or self._order is None:
            return self._computed(points, members).unflatten(0, shape)
        num_known = self._known.shape[1]
        source = self._order[rays, part]
        is_new = (source >= num_known).flatten()
        new, old = is_new.nonzero()[:, 0], (~is_new).nonzero()[:, 0]
        known_row = (rays[:, None] * num_known + source).flatten().index_select(0, old)
        rows = torch.cat(
            [
                self._known.flatten(0, 1).index_select(0, known_row),
                self._computed(points.index_select(0, new), members.index_select(0, new)),
            ]
        )
        place = torch.cat([old, new])
        back = torch.empty_like(place).index_copy_(0, place, torch.arange(len(place), device=place.device))
        return rows.index_select(0, back).unflatten(0, shape)

    def _computed(self, points: Float[Tensor, "row 3"], members: Int64[Tensor, " row"]) -> Float[Tensor, "row feature"]:
        counts = torch.bincount(members, minlength=self._batch_size).tolist()
        return self._features.of_rows(points, counts)
