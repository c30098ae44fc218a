"""SAVi (Kipf et al. 2022): a video to slots that stay with their objects, and slots back to images."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from vpd_lightning.baselines.savi_decoder import SAViDecoder
from vpd_lightning.baselines.savi_encoder import SAViEncoder
from vpd_lightning.baselines.slot_attention import SlotAttention
from vpd_lightning.baselines.slot_predictor import SlotPredictor
from vpd_lightning.baselines.slot_state import SlotState


class SAVi(nn.Module):
    """Encoder, slot attention, predictor and decoder, with a learned first guess per slot (not sampled).

    ``kernel_head`` puts an MLP between each guess and slot attention, as the released SlotFormer has it. Its last layer
    is twice as wide as a slot: the second half would be a variance, which nothing uses, and never gets a gradient.
    """

    # Paper: names "slot mlp size" once; the released code uses it for slot attention's MLP (mlp_dim) and the LSTM
    # (lstm_dim). It also has an MLP for a prior that nothing uses; that is left out.

    def __init__(
        self,
        *,
        resolution: int,
        num_slots: int,
        slot_dim: int,
        encoder_channels: Sequence[int],
        encoder_kernel_size: int,
        encoder_first_stride: int,
        token_dim: int,
        num_iterations: int,
        mlp_dim: int,
        attention_epsilon: float,
        kernel_head: bool,
        predictor_num_layers: int,
        predictor_num_heads: int,
        predictor_ffn_dim: int,
        lstm_dim: int,
        dropout: float,
        decoder_channels: Sequence[int],
        decoder_kernel_size: int,
        decoder_start_resolution: int,
    ):
        super().__init__()
        if num_slots < 1:
            raise ValueError(f"num_slots must be at least 1, got {num_slots}")
        if decoder_channels[0] != slot_dim:
            raise ValueError(f"decoder_channels must start with slot_dim {slot_dim}, got {list(decoder_channels)}")
        self.resolution, self.num_slots, self.slot_dim = resolution, num_slots, slot_dim
        self.initial_slots = nn.Parameter(torch.randn(1, num_slots, slot_dim))
        self.encoder = SAViEncoder(
            resolution=resolution,
            channels=encoder_channels,
            kernel_size=encoder_kernel_size,
            first_stride=encoder_first_stride,
            token_dim=token_dim,
        )
        self.kernel_head = (
            nn.Sequential(
                nn.Linear(slot_dim, 2 * slot_dim),
                nn.LayerNorm(2 * slot_dim),
                nn.ReLU(),
                nn.Linear(2 * slot_dim, 2 * slot_dim),
            )
            if kernel_head
            else None
        )
        self.slot_attention = SlotAttention(
            token_dim=token_dim,
            slot_dim=slot_dim,
            mlp_dim=mlp_dim,
            num_iterations=num_iterations,
            epsilon=attention_epsilon,
        )
        self.predictor = SlotPredictor(
            slot_dim=slot_dim,
            num_layers=predictor_num_layers,
            num_heads=predictor_num_heads,
            ffn_dim=predictor_ffn_dim,
            lstm_dim=lstm_dim,
            dropout=dropout,
        )
        self.decoder = SAViDecoder(
            resolution=resolution,
            channels=decoder_channels,
            kernel_size=decoder_kernel_size,
            start_resolution=decoder_start_resolution,
        )

    def encode(
        self, images: Float[Tensor, "batch time 3 height width"], state: SlotState | None
    ) -> tuple[Float[Tensor, "batch time slot dim"], SlotState]:
        """Return the corrected slots of every frame and what the next frame needs; images in [-1, 1].

        ``state`` is None at the start of a video. A frame's slots depend on no later frame.
        """
        if images.shape[-2:] != (self.resolution, self.resolution):
            raise ValueError(f"images must be {self.resolution} pixels square, got {tuple(images.shape[-2:])}")
        batch_size, num_frames = images.shape[:2]
        tokens = self.encoder(images.flatten(0, 1)).unflatten(0, (batch_size, num_frames))
        slots = []
        # Slots, which are fed back frame after frame and stored, keep the precision of the parameters; next to the
        # convolutions they cost little.
        with torch.autocast(tokens.device.type, enabled=False):
            tokens = tokens.to(self.initial_slots.dtype)
            for time in range(num_frames):
                state = self._step(tokens[:, time], state)
                slots.append(state.slots)
        assert state is not None, "a video has at least one frame"
        return torch.stack(slots, dim=1), state

    def _step(self, tokens: Float[Tensor, "batch token feature"], state: SlotState | None) -> SlotState:
        if state is None:
            guess = self.initial_slots.expand(tokens.shape[0], -1, -1)
            return self.predictor.start(self._correct(guess, tokens))
        predicted = self.predictor(state)
        return replace(predicted, slots=self._correct(predicted.slots, tokens))

    def _correct(
        self, guess: Float[Tensor, "batch slot dim"], tokens: Float[Tensor, "batch token feature"]
    ) -> Float[Tensor, "batch slot dim"]:
        if self.kernel_head is not None:
            guess = self.kernel_head(guess)[..., : self.slot_dim]
        return self.slot_attention(tokens, guess)
