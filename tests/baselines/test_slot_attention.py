import pytest
import torch

from vpd_lightning.baselines.slot_attention import SlotAttention

SIZES = {"token_dim": 6, "slot_dim": 4, "mlp_dim": 10, "num_iterations": 2, "epsilon": 1e-3}


def module(**changes):
    torch.manual_seed(0)
    return SlotAttention(**{**SIZES, **changes}).double()


def inputs(num_slots=3, num_tokens=7, batch=2):
    generator = torch.Generator().manual_seed(1)
    return (
        torch.randn(batch, num_tokens, 6, generator=generator, dtype=torch.float64),
        torch.randn(batch, num_slots, 4, generator=generator, dtype=torch.float64),
    )


def normed(vector, norm):
    deviation = vector - vector.mean()
    return deviation / (deviation.square().mean() + norm.eps).sqrt() * norm.weight + norm.bias


def reference(model, tokens, slots):
    """Slot attention written out with loops over tokens and slots, for one batch member."""
    keys, values = [], []
    for token in tokens:
        token = normed(token, model.norm_tokens)
        keys.append(model.to_key.weight @ token)
        values.append(model.to_value.weight @ token)
    slots = list(slots)
    for _ in range(model.num_iterations):
        queries = [model.to_query.weight @ normed(slot, model.norm_slots) for slot in slots]
        shares = []  # of each token: how much of it every slot gets
        for key in keys:
            powers = torch.stack([(key @ query / len(query) ** 0.5).exp() for query in queries])
            shares.append(powers / powers.sum() + model.epsilon)
        for i, slot in enumerate(slots):
            total = sum(share[i] for share in shares)
            update = sum(share[i] / total * value for share, value in zip(shares, values, strict=True))
            from_input = model.gru.weight_ih @ update + model.gru.bias_ih
            from_slot = model.gru.weight_hh @ slot + model.gru.bias_hh
            (reset_i, gate_i, new_i), (reset_s, gate_s, new_s) = from_input.chunk(3), from_slot.chunk(3)
            gate = torch.sigmoid(gate_i + gate_s)
            new = torch.tanh(new_i + torch.sigmoid(reset_i + reset_s) * new_s)
            slot = (1 - gate) * new + gate * slot
            first, last = model.mlp[0], model.mlp[2]
            hidden = (first.weight @ normed(slot, model.norm_mlp) + first.bias).clamp_min(0)
            slots[i] = slot + last.weight @ hidden + last.bias
    return torch.stack(slots)


def test_slot_attention_equals_loops_over_tokens_and_slots():
    model, (tokens, slots) = module(), inputs()

    found = model(tokens, slots)

    for member in range(2):
        assert torch.allclose(found[member], reference(model, tokens[member], slots[member]), rtol=0, atol=1e-12)


def test_the_order_of_tokens_does_not_matter_and_that_of_slots_is_kept():
    model, (tokens, slots) = module(), inputs()
    found = model(tokens, slots)

    assert torch.allclose(model(tokens[:, torch.randperm(7)], slots), found, rtol=0, atol=1e-12)
    order = torch.tensor([2, 0, 1])
    assert torch.allclose(model(tokens, slots[:, order]), found[:, order], rtol=0, atol=1e-12)
    assert not torch.allclose(found[:, order], found, atol=1e-3)


def test_attention_sums_to_one_over_tokens_and_slots_compete():
    model, (tokens, slots) = module(), inputs()
    keys = model.to_key(model.norm_tokens(tokens))

    weights = model.attention(keys, slots)

    assert weights.shape == (2, 3, 7) and (weights >= 0).all()
    assert torch.allclose(weights.sum(-1), torch.ones(2, 3, dtype=torch.float64), rtol=0, atol=1e-12)
    # Two equal slots share every token half and half, and then attend to all alike; a softmax over tokens would not.
    twice = model.attention(keys, torch.cat([slots[:, :1], slots[:, :1]], dim=1))
    assert torch.allclose(twice, torch.full_like(twice, 1 / 7), rtol=0, atol=1e-12)
    assert not torch.allclose(weights, torch.full_like(weights, 1 / 7), atol=1e-3)


def test_constant_tokens_give_every_slot_the_same_update():
    model, (tokens, slots) = module(), inputs()
    tokens = tokens[:, :1].expand(-1, 7, -1)
    keys, values = (linear(model.norm_tokens(tokens)) for linear in (model.to_key, model.to_value))

    updates = model.attention(keys, slots) @ values

    assert torch.allclose(updates, values[:, :1].expand(-1, 3, -1), rtol=0, atol=1e-12)


@pytest.mark.parametrize(("changes", "message"), [({"num_iterations": 0}, "iterations"), ({"epsilon": 0.0}, "epsilon")])
def test_wrong_settings_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        module(**changes)
