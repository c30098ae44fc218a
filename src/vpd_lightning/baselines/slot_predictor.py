"""SAVi's predictor: the slots of one frame to the first guess of the next frame's slots."""

from jaxtyping import Float
from torch import Tensor, nn

from vpd_lightning.baselines.slot_state import SlotState
from vpd_lightning.baselines.slot_transformer import SlotTransformer


class SlotPredictor(nn.Module):
    """A transformer over the slots, then an LSTM along time for each slot, then a linear map; no skip connection.

    The recurrent state is passed in and out: nothing is kept between calls.
    """

    def __init__(self, *, slot_dim: int, num_layers: int, num_heads: int, ffn_dim: int, lstm_dim: int, dropout: float):
        super().__init__()
        self.transformer = SlotTransformer(
            model_dim=slot_dim, num_layers=num_layers, num_heads=num_heads, ffn_dim=ffn_dim, dropout=dropout
        )
        self.lstm = nn.LSTMCell(slot_dim, lstm_dim)
        self.projection = nn.Linear(lstm_dim, slot_dim)

    def start(self, slots: Float[Tensor, "batch slot dim"]) -> SlotState:
        """Return the state after the first frame of a video, whose slots are given."""
        zeros = slots.new_zeros(*slots.shape[:2], self.lstm.hidden_size)
        return SlotState(slots=slots, hidden=zeros, cell=zeros)

    def forward(self, state: SlotState) -> SlotState:
        """Return the predicted slots with the recurrent state that belongs to them."""
        shape = state.slots.shape[:2]
        features = self.transformer(state.slots).flatten(0, 1)
        hidden, cell = self.lstm(features, (state.hidden.flatten(0, 1), state.cell.flatten(0, 1)))
        return SlotState(
            slots=self.projection(hidden).unflatten(0, shape),
            hidden=hidden.unflatten(0, shape),
            cell=cell.unflatten(0, shape),
        )
