"""What SAVi and SlotFormer share as systems: they see each camera view as a video of its own."""

from abc import abstractmethod

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vpd_lightning.baselines.savi import SAVi
from vpd_lightning.geometry.resizing import resize_images
from vpd_lightning.system import AbstractSystem
from vpd_lightning.types import Cameras, Driven, RenderedRays, RGBDFrames

# Images at a time when nothing is trained: bounds the memory of a long video, and changes no result.
_IMAGES_AT_ONCE = 32


class AbstractViewSystem(AbstractSystem):
    """A system on the slots of ``savi``; a view is predicted from that view's own frames, without depth or cameras."""

    def __init__(self, *, savi: SAVi, num_context_frames: int):
        super().__init__()
        if num_context_frames < 1:
            raise ValueError(f"num_context_frames must be at least 1, got {num_context_frames}")
        self.savi, self.num_context_frames = savi, num_context_frames

    @property
    def resolution(self) -> int:
        """Height and width, in pixels, of the images that go in and come out."""
        return self.savi.resolution

    def _unit_colors(self, slots: Float[Tensor, "batch time slot dim"]) -> RenderedRays:
        """Decode slots to images as the losses see them: [0, 1], not clamped, and neither depth nor opacity.

        A squared error in these units is a quarter of the error in [-1, 1] in which SlotFormer states its losses.
        """
        rgbs = (self.savi.decoder(slots).images.flatten(3).transpose(2, 3) + 1) / 2
        nothing = rgbs.new_full((), float("nan")).expand(rgbs.shape[:-1])
        return RenderedRays(rgbs=rgbs, depths=nothing, opacities=nothing)

    # The face for evaluation: no gradients, no randomness.

    @torch.no_grad()
    def encode_views(
        self, rgb: Float[Tensor, "time view height width 3"] | UInt8[Tensor, "time view height width 3"]
    ) -> Float[Tensor, "view time slot dim"]:
        """Return the slots of every frame of every view; ``rgb`` is uint8, or float in [0, 1], of any size."""
        self.eval()
        parameter = next(self.parameters())
        num_views = rgb.shape[1]
        state, slots = None, []
        for some in rgb.split(max(1, _IMAGES_AT_ONCE // num_views)):
            images = resize_images(some.to(parameter.device), self.resolution)
            images = self.to_network(images.transpose(0, 1)).to(parameter.dtype)
            found, state = self.savi.encode(images, state)
            slots.append(found)
        return torch.cat(slots, dim=1)

    @abstractmethod
    def rollout_views(
        self, slots: Float[Tensor, "view time slot dim"], num_steps: int
    ) -> Float[Tensor, "view step slot dim"]:
        """Predict the slots of the frames behind the ``num_context_frames`` given ones."""

    @torch.no_grad()
    def decode(self, slots: Float[Tensor, "*shape slot dim"]) -> Float[Tensor, "*shape height width 3"]:
        """Return the images of the slots at the system's own resolution, in [0, 1] and clamped."""
        self.eval()
        flat = slots.reshape(-1, *slots.shape[-2:]).to(next(self.parameters()))
        images = torch.cat([self.savi.decoder(some).images for some in flat.split(_IMAGES_AT_ONCE)])
        return ((images.movedim(-3, -1) + 1) / 2).clamp(0, 1).reshape(*slots.shape[:-2], *images.shape[-2:], 3)

    @torch.no_grad()
    def predict_frames(
        self, context: RGBDFrames, cameras: Cameras, driven: Driven | None = None
    ) -> Float[Tensor, "step view height width 3"]:
        """Continue the views of ``context``, which must be those of ``cameras``; resized to the cameras' pixels."""
        num_views = context.rgb.shape[1]
        if cameras.shape[1] != num_views:
            raise ValueError(
                f"a view is predicted from its own frames: context has {num_views} views, cameras {cameras.shape[1]}"
            )
        predicted = self.rollout_views(self.encode_views(context.rgb), cameras.shape[0])
        return resize_images(self.decode(predicted).transpose(0, 1), (cameras.height, cameras.width))

    def _require_context(self, slots: Float[Tensor, "view time slot dim"]) -> None:
        if slots.shape[1] != self.num_context_frames:
            raise ValueError(f"needs the slots of {self.num_context_frames} frames, got {slots.shape[1]}")

    @staticmethod
    def to_network(
        rgb: Float[Tensor, "batch time height width 3"] | UInt8[Tensor, "batch time height width 3"],
    ) -> Float[Tensor, "batch time 3 height width"]:
        """Map colours (uint8, or float in [0, 1]) to [-1, 1], channels before rows."""
        unit = rgb if rgb.is_floating_point() else rgb.float() / 255
        return unit.movedim(-1, -3) * 2 - 1
