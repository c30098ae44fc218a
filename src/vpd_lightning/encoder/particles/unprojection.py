"""From pixels with a depth to particles: unproject, crop to the workspace, subsample (paper section 3.1)."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from vpd_lightning.encoder.base import AbstractBackground, AbstractEncoder
from vpd_lightning.encoder.particles.scenery import scenery_of
from vpd_lightning.errors import EmptyWorkspaceError
from vpd_lightning.finite import require_finite
from vpd_lightning.geometry import workspace
from vpd_lightning.geometry.cameras import unproject
from vpd_lightning.geometry.driven_pixels import nearest_pixels, shows_driven
from vpd_lightning.geometry.normals import depth_normals
from vpd_lightning.geometry.occluders import occluders_of
from vpd_lightning.geometry.workspace import inside_workspace
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles, Pictures, RGBDFrames

_EDGE_STEP = 0.05
"""Share of its depth by which a surface may leave its tangent plane in the outermost pixel of a picture."""


class UnprojectingEncoder(AbstractEncoder):
    """Base of encoders whose particles are pixels: it chooses and unprojects them. A subclass computes features.

    ``num_particles`` are chosen uniformly at random among the pixels inside the workspace. With ``moving_fraction``
    (and a ``background`` model) up to that share of them is chosen among pixels that may be moving. With
    ``color_features`` the first three features are the colours of the pixels, whatever the network predicts. With
    ``same_pixels`` the particles of both context frames are the same pixels, wherever these lie in the workspace. With
    ``has_scenery`` every pixel that stands still, in the workspace or not, is a point of the particles' ``scenery``.
    With ``has_driven`` pixels that show what is driven become neither: its own points get their features.
    """

    # Paper: moving_fraction, background, use_normals, color_features, same_pixels and has_driven are ours; the paper
    # has none of them (None, None and four times False). Its 2^14 particles are all pixels of a camera, or many of a
    # body's. If only a few are drawn, independently in both frames, the mean of a body's particles moves by chance
    # about as far as the body does in a step.

    # What the error message names where no pixel lies in the workspace.
    _empty_advice = "Check depth (metres), camera poses (camera to world, OpenCV axes) and scene.workspace_min/max."

    def __init__(
        self,
        *,
        network: nn.Module,
        feature_dim: int,
        num_particles: int,
        workspace_min: Sequence[float],
        workspace_max: Sequence[float],
        moving_fraction: float | None,
        background: AbstractBackground | None,
        use_normals: bool,
        color_features: bool,
        same_pixels: bool,
        has_scenery: bool,
        has_driven: bool,
    ):
        super().__init__()
        if num_particles < 1:
            raise ValueError(f"num_particles must be at least 1, got {num_particles}")
        if any(low >= high for low, high in zip(workspace_min, workspace_max, strict=True)):
            raise ValueError(f"workspace_min {list(workspace_min)} must lie below workspace_max {list(workspace_max)}")
        if moving_fraction is not None and background is None:
            raise ValueError("moving_fraction needs a background model; set encoder.background or moving_fraction=null")
        if has_scenery and background is None:
            raise ValueError("has_scenery needs a background model, which tells what stands still")
        if color_features and feature_dim < 3:
            raise ValueError(f"color_features needs a feature_dim of at least 3, got {feature_dim}")
        if moving_fraction is not None and not 0 < moving_fraction < 1:
            raise ValueError(f"moving_fraction must lie between 0 and 1, got {moving_fraction}")
        self.network = network
        self.feature_dim = feature_dim
        self.num_particles = num_particles
        self.workspace_min, self.workspace_max = list(workspace_min), list(workspace_max)
        self.moving_fraction = moving_fraction
        self.background = background
        self.use_normals = use_normals
        self.color_features = color_features
        self.same_pixels = same_pixels
        self.has_scenery, self.has_driven = has_scenery, has_driven
        # How what is driven looks where no camera sees it yet; a colour between black and white.
        self.unseen_driven = nn.Parameter(torch.full((feature_dim,), 0.5)) if has_driven else None

    @staticmethod
    def _colors(frames: RGBDFrames) -> Float[Tensor, "batch view height width 3"]:
        """Return the images in [0, 1].

        Raises:
            NonFiniteError: an image or a camera is not finite.
        """
        rgb = frames.rgb if frames.rgb.is_floating_point() else frames.rgb.to(frames.depth.dtype) / 255
        cameras = frames.cameras
        require_finite(
            "Encoder", rgb=rgb, cameras=torch.cat([cameras.intrinsics.flatten(), cameras.cam_to_world.flatten()])
        )
        return rgb

    @staticmethod
    def _activate(outputs: Tensor, dtype: torch.dtype) -> Tensor:
        # Kernel sums and positions downstream stay in full precision, whatever autocast did to the convolutions.
        return torch.nn.functional.softplus(outputs.to(dtype))

    def _particles(
        self, frames: RGBDFrames, features_at: Callable[[Tensor], Tensor], keys: RandomKeys, purpose: str
    ) -> Particles:
        """Return particles at pixels of the frames (axes ``batch view``), whose colours are in [0, 1].

        ``features_at`` gives the features of the chosen pixels; its argument (``batch particle``) counts over
        ``view height width`` of each member. Gradients reach the depth, where it has any.

        Raises:
            EmptyWorkspaceError: no pixel of a batch member lies in the workspace.
        """
        on_driven = self._on_driven(frames)
        judged, frames = self._restored(frames)
        points = unproject(frames.depth, frames.cameras).flatten(1, 3)
        measured = (torch.isfinite(frames.depth) & (frames.depth > 0)).flatten(1)
        driven_pixels, far, measured = measured & on_driven, ~measured & ~on_driven, measured & ~on_driven
        candidates = measured & inside_workspace(points, self.workspace_min, self.workspace_max)
        moving, still = None, measured
        if self.background is not None:
            dynamic_mask = self.background(_cropped(judged, candidates))
            trusted = self.background.trusted(judged, dynamic_mask).flatten(1)
            measured, candidates = measured & trusted, candidates & trusted
            moving, border = (pixels.flatten(1) for pixels in _with_border(dynamic_mask))
            candidates, still = candidates & ~border, measured & ~moving & ~border
            still = _going_on(still.view_as(frames.depth), frames.depth).flatten(1)
            far = far & ~border  # a mixture of a body and what is behind it
        index, valid = self._choose(candidates, moving, keys, purpose)
        normals = None
        if self.use_normals or self.has_scenery:
            normals = depth_normals(frames.depth, frames.cameras).flatten(1, 3)

        everywhere = points
        points = torch.where(candidates[..., None], points, torch.zeros_like(points))  # no NaN through padding

        def take(values: Tensor, index: Tensor = index) -> Tensor:
            return torch.gather(values, 1, index[..., None].expand(-1, -1, values.shape[-1]))

        driven = frames.driven if self.has_driven else None
        wanted = index
        if driven is not None:
            wanted, is_seen = nearest_pixels(driven, everywhere, driven_pixels)
            wanted = torch.cat([index, wanted], dim=1)
        colors, features = take(frames.rgb.flatten(1, 3), wanted), features_at(wanted)
        if self.color_features:
            features = torch.cat([colors.to(features), features[..., 3:]], dim=-1)
        if driven is not None:
            assert self.unseen_driven is not None
            looks = torch.where(is_seen[..., None], features[:, index.shape[1] :], self.unseen_driven)
            driven = replace(driven, features=looks * driven.mask[..., None])
            colors, features = colors[:, : index.shape[1]], features[:, : index.shape[1]]
        particles = Particles(
            positions=take(points) * valid[..., None],
            features=features * valid[..., None],
            mask=valid,
            colors=colors,
            moving=None if moving is None else torch.gather(moving, 1, index) & valid,
            normals=take(normals) if self.use_normals and normals is not None else None,
            driven=driven,
            pixels=index if self.use_normals else None,
            pictures=_pictures(frames) if self.use_normals else None,
        )
        # That of the current frame is drawn; the frame before it has no other.
        if not self.has_scenery or purpose == "previous":
            return particles
        assert normals is not None
        return replace(particles, scenery=scenery_of(frames, everywhere, normals, still, far, occluders_of(particles)))

    def _on_driven(self, frames: RGBDFrames) -> Bool[Tensor, "batch point"]:
        if not self.has_driven:
            return torch.zeros_like(frames.depth, dtype=torch.bool).flatten(1)
        return shows_driven(frames).flatten(1)

    def _restored(self, frames: RGBDFrames) -> tuple[RGBDFrames, RGBDFrames]:
        """Return the frames by which it is judged what moves, and those whose depth places the particles."""
        if self.background is None:
            return frames, frames
        judged, placed = self.background.restored(frames)
        return replace(frames, depth=judged), replace(frames, depth=placed)

    @torch.no_grad()
    def moving_pixels(
        self, frames: RGBDFrames
    ) -> tuple[Bool[Tensor, "batch view height width"], Bool[Tensor, "batch view height width"]]:
        """Return which pixels may move, and which have a depth in the workspace (the first are among these).

        Raises:
            ValueError: the encoder has no background model.
        """
        if self.background is None:
            raise ValueError("what may move is found by a background model; set encoder.background")
        return self._moving(*self._restored(frames))

    def _moving(self, judged: RGBDFrames, frames: RGBDFrames) -> tuple[Tensor, Tensor]:
        assert self.background is not None
        points = unproject(frames.depth, frames.cameras).flatten(1, 3)
        measured = (torch.isfinite(frames.depth) & (frames.depth > 0)).flatten(1)
        measured = measured & ~self._on_driven(frames)
        candidates = measured & inside_workspace(points, self.workspace_min, self.workspace_max)
        moving = self.background(_cropped(judged, candidates)) & candidates.view_as(frames.depth)
        return moving, candidates.view_as(frames.depth)

    @torch.no_grad()
    def observe(self, frames: RGBDFrames, keys: RandomKeys, purpose: str) -> dict[str, Tensor]:
        """Return a quarter as many points that may move as there are particles; nothing without a background."""
        if self.background is None:
            return {}
        # As measured: to restore every later frame would cost a short training most of its time.
        points = unproject(frames.depth, frames.cameras).flatten(1, 3)
        dynamic_mask = self._moving(frames, frames)[0].flatten(1)
        count = max(1, self.num_particles // 4)
        drawn = [
            workspace.choose(allowed, count, generator)
            for allowed, generator in zip(dynamic_mask, keys.generators(f"observed/{purpose}"), strict=True)
        ]
        index, mask = (torch.stack(parts) for parts in zip(*drawn, strict=True))
        rgb = self._colors(frames).flatten(1, 3)
        taken = [torch.gather(values, 1, index[..., None].expand(-1, -1, 3)) for values in (points, rgb)]
        positions, colors = (torch.where(mask[..., None], values, 0.0) for values in taken)
        return {"positions": positions, "colors": colors, "mask": mask}

    def _choose(
        self, candidates: Bool[Tensor, "batch point"], moving: Tensor | None, keys: RandomKeys, purpose: str
    ) -> tuple[Tensor, Tensor]:
        indices, valids = [], []
        choose = workspace.choose_same if self.same_pixels else workspace.choose
        for member, generator in enumerate(keys.generators(f"particles/{'all' if self.same_pixels else purpose}")):
            allowed = candidates[member]
            if not bool(allowed.any()):
                low, high = self.workspace_min, self.workspace_max
                raise EmptyWorkspaceError(
                    f"no measured pixel of batch member {member} lies in the workspace {low} to {high}.\n"
                    f"{self._empty_advice}"
                )
            if self.moving_fraction is None or moving is None:
                index, valid = choose(allowed, self.num_particles, generator)
            else:
                num_moving = round(self.moving_fraction * self.num_particles)
                moving_index, moving_valid = choose(allowed & moving[member], num_moving, generator)
                found = int(moving_valid.sum())  # padding comes last; what does not move takes the places left over
                index, valid = choose(allowed & ~moving[member], self.num_particles - found, generator)
                index, valid = torch.cat([moving_index[:found], index]), torch.cat([moving_valid[:found], valid])
            indices.append(index)
            valids.append(valid)
        return torch.stack(indices), torch.stack(valids)


def _pictures(frames: RGBDFrames) -> Pictures:
    depth = torch.nan_to_num(frames.depth.detach(), nan=0.0, posinf=0.0, neginf=0.0)
    return Pictures(frames.rgb, depth, frames.cameras)


def _cropped(frames: RGBDFrames, candidates: Bool[Tensor, "batch point"]) -> RGBDFrames:
    """Return the frames with depth at the candidates only: how wide a floor is must not depend on the horizon."""
    kept = candidates.view_as(frames.depth)
    return replace(frames, depth=torch.where(kept, frames.depth, 0.0))


def _going_on(still: Bool[Tensor, "batch view height width"], depth: Tensor) -> Bool[Tensor, "batch view height width"]:
    """Return what stands still without outermost pixels in which the surface beside them does not go on.

    They have no normal, so none of them is ever found to move: a body of which the picture's edge shows a sliver would
    hang in the air. The inverse depth of a plane is linear in the picture.
    """
    nearness = torch.where(still, 1 / depth, 0.0)  # 1/m
    still = still.clone()
    for axis in (-1, -2):
        size = still.shape[axis]
        if size < 3:
            continue
        outer, beside, inner = (torch.tensor([n, size - 1 - n], device=depth.device) for n in range(3))
        places = [nearness.index_select(axis, rows) for rows in (outer, beside, inner)]
        known = still.index_select(axis, beside) & still.index_select(axis, inner)
        goes_on = (places[0] - 2 * places[1] + places[2]).abs() < _EDGE_STEP * places[1]
        still.index_copy_(axis, outer, still.index_select(axis, outer) & known & goes_on)
    return still


def _with_border(moving: Bool[Tensor, "batch view height width"]) -> tuple[Tensor, Tensor]:
    """Return the moving pixels and those beside them that are not.

    Where a body stands on the floor its depth hardly differs from the floor's: such a pixel is neither surely moving
    nor surely static, and its normal, a mixture of both, would make it a false wall. It becomes no particle.
    """
    grown = torch.nn.functional.max_pool2d(moving.float(), 3, stride=1, padding=1) > 0
    return moving, grown & ~moving
