"""The transformer encoder that both the slot predictor and the rollouter are built of."""

from jaxtyping import Float
from torch import Tensor, nn


class SlotTransformer(nn.Module):
    """Pre-norm encoder layers with ReLU and full attention, and no normalisation after the last one.

    These are PyTorch's own layers, as in the released SlotFormer; their dropout draws from the global generator, which
    a system seeds around its forward pass (see ``seeded_dropout``).
    """

    # Paper: the released code copies one initialised layer; here each layer has initial weights of its own.

    def __init__(self, *, model_dim: int, num_layers: int, num_heads: int, ffn_dim: int, dropout: float):
        super().__init__()
        if num_layers < 1:
            raise ValueError(f"num_layers must be at least 1, got {num_layers}")
        if num_heads < 1 or model_dim % num_heads:
            raise ValueError(f"num_heads must divide the model width {model_dim}, got {num_heads}")
        if not 0 <= dropout < 1:
            raise ValueError(f"dropout must be at least 0 and below 1, got {dropout}")
        self.layers = nn.ModuleList(
            nn.TransformerEncoderLayer(
                d_model=model_dim,
                nhead=num_heads,
                dim_feedforward=ffn_dim,
                dropout=dropout,
                activation="relu",
                norm_first=True,
                batch_first=True,
            )
            for _ in range(num_layers)
        )

    def forward(self, tokens: Float[Tensor, "batch token dim"]) -> Float[Tensor, "batch token dim"]:
        """Let all tokens of a member attend to each other."""
        for layer in self.layers:
            tokens = layer(tokens)
        return tokens
