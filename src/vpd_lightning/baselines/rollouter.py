"""SlotFormer's dynamics (Wu et al. 2023): the slots of the last frames to those of the next, again and again."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from vpd_lightning.baselines.slot_transformer import SlotTransformer


class SlotRollouter(nn.Module):
    """A transformer over all slots of ``num_history`` frames; the newest frame's outputs are the next frame's slots.

    The prediction is direct, without a residual. Frames have a fixed positional encoding that counts backwards
    (newest 0); slots have no code, so that a slot is followed by the place it has in the newest frame alone.
    """

    def __init__(
        self,
        *,
        slot_dim: int,
        num_history: int,
        model_dim: int,
        num_layers: int,
        num_heads: int,
        ffn_dim: int,
        dropout: float,
    ):
        super().__init__()
        if num_history < 1:
            raise ValueError(f"num_history must be at least 1 frame, got {num_history}")
        self.num_history = num_history
        self.input = nn.Linear(slot_dim, model_dim)
        self.transformer = SlotTransformer(
            model_dim=model_dim, num_layers=num_layers, num_heads=num_heads, ffn_dim=ffn_dim, dropout=dropout
        )
        self.output = nn.Linear(model_dim, slot_dim)
        self.register_buffer("positions", temporal_positions(num_history, model_dim), persistent=False)

    def forward(
        self, history: Float[Tensor, "batch time slot dim"], num_steps: int
    ) -> Float[Tensor, "batch step slot dim"]:
        """Predict the slots of the next ``num_steps`` frames; gradients flow through all of them."""
        if history.shape[1] != self.num_history:
            raise ValueError(f"the history must have {self.num_history} frames, got {history.shape[1]}")
        if num_steps < 1:
            raise ValueError(f"num_steps must be at least 1, got {num_steps}")
        window = list(history.unbind(dim=1))
        for _ in range(num_steps):
            window.append(self._next(torch.stack(window[-self.num_history :], dim=1)))
        return torch.stack(window[self.num_history :], dim=1)

    def _next(self, history: Float[Tensor, "batch time slot dim"]) -> Float[Tensor, "batch slot dim"]:
        tokens = self.input(history) + self.positions[:, None]
        return self.output(self.transformer(tokens.flatten(1, 2))[:, -history.shape[2] :]).to(history.dtype)


def temporal_positions(num_frames: int, dim: int) -> Float[Tensor, "frame dim"]:
    """Return the sinusoids of the frames, oldest first, at positions ``num_frames - 1`` down to 0.

    The first half of the channels are sines, the second half cosines, of frequencies 10000^(-2i / dim).
    """
    if dim % 2:
        raise ValueError(f"the width of a position code must be even, got {dim}")
    positions = torch.arange(num_frames - 1, -1, -1, dtype=torch.float64)
    frequencies = 10000.0 ** (-torch.arange(0, dim, 2, dtype=torch.float64) / dim)
    angles = positions[:, None] * frequencies
    return torch.cat([angles.sin(), angles.cos()], dim=-1).to(torch.get_default_dtype())
