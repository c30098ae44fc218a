"""Slot attention (Locatello et al. 2020): slots compete for the tokens of one image."""

import torch
from jaxtyping import Float
from torch import Tensor, nn


class SlotAttention(nn.Module):
    """Refines slots by ``num_iterations`` rounds of attention, a GRU and an MLP of hidden width ``mlp_dim``.

    ``epsilon`` is added to the attention before it is normalised over the tokens. No token or slot has a place of its
    own: permuted tokens change nothing, permuted slots come out permuted.
    """

    def __init__(self, *, token_dim: int, slot_dim: int, mlp_dim: int, num_iterations: int, epsilon: float):
        super().__init__()
        if num_iterations < 1:
            raise ValueError(f"num_iterations must be at least 1, got {num_iterations}")
        if epsilon <= 0:
            raise ValueError(f"epsilon must be positive, got {epsilon}")
        self.num_iterations, self.epsilon = num_iterations, epsilon
        self.norm_tokens = nn.LayerNorm(token_dim)
        self.to_key = nn.Linear(token_dim, slot_dim, bias=False)
        self.to_value = nn.Linear(token_dim, slot_dim, bias=False)
        self.norm_slots = nn.LayerNorm(slot_dim)
        self.to_query = nn.Linear(slot_dim, slot_dim, bias=False)
        self.gru = nn.GRUCell(slot_dim, slot_dim)
        self.norm_mlp = nn.LayerNorm(slot_dim)
        self.mlp = nn.Sequential(nn.Linear(slot_dim, mlp_dim), nn.ReLU(), nn.Linear(mlp_dim, slot_dim))

    def forward(
        self, tokens: Float[Tensor, "batch token feature"], slots: Float[Tensor, "batch slot dim"]
    ) -> Float[Tensor, "batch slot dim"]:
        """Return the refined slots. Gradients flow through all iterations."""
        tokens = self.norm_tokens(tokens)
        keys, values = self.to_key(tokens), self.to_value(tokens)
        for _ in range(self.num_iterations):
            updates = self.attention(keys, slots) @ values
            slots = self.gru(updates.flatten(0, 1), slots.flatten(0, 1)).unflatten(0, slots.shape[:2])
            slots = slots + self.mlp(self.norm_mlp(slots))
        return slots

    def attention(
        self, keys: Float[Tensor, "batch token dim"], slots: Float[Tensor, "batch slot dim"]
    ) -> Float[Tensor, "batch slot token"]:
        """Return the weights of the tokens in each slot's update; they sum to 1 over the tokens.

        The softmax runs over the slots, so that they compete for each token.
        """
        queries = self.to_query(self.norm_slots(slots))
        logits = queries @ keys.transpose(1, 2) * keys.shape[-1] ** -0.5
        shares = torch.softmax(logits, dim=1) + self.epsilon
        return shares / shares.sum(dim=-1, keepdim=True)
