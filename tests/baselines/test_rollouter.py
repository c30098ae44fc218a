import math

import pytest
import torch

from tests.baselines.sizes import PAPER_ROLLOUTER, count, rollouter
from vpd_lightning.baselines.rollouter import temporal_positions


def history(batch=2, time=6, num_slots=3, dim=16, seed=0):
    return torch.randn(batch, time, num_slots, dim, generator=torch.Generator().manual_seed(seed))


def test_the_papers_sizes():
    model = rollouter(PAPER_ROLLOUTER).eval()

    assert count(model) == 826_112
    assert (count(model.input), count(model.output)) == (16_512, 16_512)
    assert [count(layer) for layer in model.transformer.layers] == [198_272] * 4
    with torch.no_grad():
        for num_slots, num_steps in [(4, 1), (8, 10), (4, 32)]:
            assert model(history(1, 6, num_slots, 128), num_steps).shape == (1, num_steps, num_slots, 128)


def test_positions_count_backwards_with_all_sines_before_all_cosines():
    found = temporal_positions(6, 128)

    for frame in range(6):
        for i in range(64):
            angle = (5 - frame) * 10000 ** (-2 * i / 128)
            assert abs(found[frame, i].item() - math.sin(angle)) < 1e-6
            assert abs(found[frame, 64 + i].item() - math.cos(angle)) < 1e-6
    assert torch.equal(found[-1], torch.cat([torch.zeros(64), torch.ones(64)]))


def test_each_step_is_the_transformers_output_for_the_newest_frame_of_the_window():
    model, slots = rollouter().eval(), history()
    window, expected = slots, []
    for _ in range(3):
        tokens = model.input(window)
        for frame in range(6):
            tokens[:, frame] += temporal_positions(6, 16)[frame]
        predicted = model.output(model.transformer(tokens.reshape(2, 18, 16))[:, 15:])
        expected.append(predicted)
        window = torch.cat([window[:, 1:], predicted[:, None]], dim=1)

    assert torch.allclose(model(slots, 3), torch.stack(expected, dim=1), atol=1e-6)


def test_one_layer_normalises_first_and_has_no_normalisation_behind():
    model, tokens = rollouter(num_layers=1, dropout=0.0), torch.randn(2, 5, 16)
    layer = model.transformer.layers[0]

    normal = layer.norm1(tokens)
    middle = tokens + layer.self_attn(normal, normal, normal, need_weights=False)[0]
    expected = middle + layer.linear2(torch.relu(layer.linear1(layer.norm2(middle))))

    assert torch.allclose(model.transformer(tokens), expected, atol=1e-5)


def test_permuted_slots_permute_the_prediction():
    model, slots, order = rollouter().eval(), history(), torch.tensor([2, 0, 1])
    predicted = model(slots, 4)

    assert torch.allclose(model(slots[:, :, order], 4), predicted[:, :, order], atol=1e-5)


def test_the_order_of_slots_in_older_frames_does_not_matter_and_that_of_the_newest_is_followed():
    model, slots, order = rollouter().eval(), history(), torch.tensor([2, 0, 1])
    predicted = model(slots, 3)
    older, newest = slots.clone(), slots.clone()
    older[:, 2] = slots[:, 2, order]
    newest[:, -1] = slots[:, -1, order]

    assert torch.allclose(model(older, 3), predicted, atol=1e-5)
    assert torch.allclose(model(newest, 3), predicted[:, :, order], atol=1e-5)
    assert not torch.allclose(model(newest, 3), predicted, atol=1e-2)


def test_the_order_of_frames_matters():
    model, slots = rollouter().eval(), history()
    swapped = slots[:, [1, 0, 2, 3, 4, 5]]  # the newest frame stays, so that only the position code can tell

    assert not torch.allclose(model(swapped, 1), model(slots, 1), atol=1e-4)


def test_a_rollout_in_two_parts_equals_the_whole():
    model, slots = rollouter().eval(), history()
    whole = model(slots, 10)

    first = model(slots, 4)
    second = model(torch.cat([slots, first], dim=1)[:, -6:], 6)

    assert torch.equal(torch.cat([first, second], dim=1), whole)


def test_the_last_step_pulls_at_all_earlier_frames_and_all_parameters():
    model, slots = rollouter().eval(), history().requires_grad_()

    model(slots, 10)[:, -1].square().sum().backward()

    assert (slots.grad.abs().amax(dim=(0, 2, 3)) > 0).all()
    assert all(parameter.grad is not None for parameter in model.parameters())


def test_a_history_of_another_length_is_refused():
    with pytest.raises(ValueError, match="6 frames, got 5"):
        rollouter()(history(time=5), 1)
    with pytest.raises(ValueError, match="num_steps"):
        rollouter()(history(), 0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"num_history": 0}, "num_history"), ({"model_dim": 15, "num_heads": 5}, "even"), ({"num_heads": 5}, "num_heads")],
)
def test_wrong_settings_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        rollouter(**changes)


def test_tiny_overfit_beats_repeating_the_last_frame():
    generator = torch.Generator().manual_seed(0)
    shape = (4, 1, 3, 32)
    frequency, phase = (torch.rand(shape, generator=generator) for _ in range(2))
    times = torch.arange(16.0)[None, :, None, None]
    slots = torch.sin((0.2 + 0.6 * frequency) * times + 6.28 * phase)
    given, target = slots[:, :6], slots[:, 6:]
    model = rollouter(slot_dim=32, model_dim=32, ffn_dim=64, dropout=0.0)
    optimizer = torch.optim.Adam(model.parameters(), lr=3e-3)
    values = []
    for _ in range(100):
        optimizer.zero_grad()
        loss = (model(given, 10) - target).square().mean()
        loss.backward()
        optimizer.step()
        values.append(loss.item())

    copied = (given[:, -1:] - target).square().mean().item()
    assert values[-1] < 0.5 * values[0] and values[-1] < copied
