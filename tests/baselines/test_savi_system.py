import pytest
import torch

from tests.baselines.sizes import savi, view_batch
from vpd_lightning.baselines.savi_system import SAViSystem
from vpd_lightning.geometry.resizing import resize_images
from vpd_lightning.types import Cameras, RGBDFrames


def system(**changes):
    return SAViSystem(savi=savi(**changes), num_context_frames=2)


def video(time=5, views=3, size=16, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (time, views, size, size, 3), generator=generator, dtype=torch.uint8)


def test_the_output_is_the_reconstruction_in_unit_colours():
    model, batch = system().eval(), view_batch()

    output = model(batch)

    assert batch.rgbs.shape == output.rendered.rgbs.shape == (2, 3, 256, 3)
    assert output.rendered.depths.isnan().all() and output.rendered.opacities.shape == (2, 3, 256)
    assert list(output.states) == [] and output.auxiliary == {}
    frames = batch.images.float().movedim(-1, 2) / 255 * 2 - 1
    slots, _ = model.savi.encode(frames, None)
    expected = model.savi.decoder(slots).images
    assert torch.allclose(output.rendered.rgbs[1, 2, 16 * 5 + 7], (expected[1, 2, :, 5, 7] + 1) / 2, atol=1e-6)
    network_error = (expected - frames).square().mean()
    assert torch.allclose((output.rendered.rgbs - batch.rgbs).square().mean() * 4, network_error, atol=1e-6)


def test_all_weights_lie_under_savi():
    assert {name.split(".")[0] for name in system().state_dict()} == {"savi"}


def test_dropout_follows_the_keys_alone_and_leaves_the_global_generator_alone():
    model = system(dropout=0.3).train()
    first = model(view_batch()).rendered.rgbs
    before = torch.get_rng_state()
    again = model(view_batch()).rendered.rgbs

    assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(again, first)
    assert not torch.equal(model(view_batch(step=1)).rendered.rgbs, first)
    assert torch.equal(model.eval()(view_batch(step=1)).rendered.rgbs, model(view_batch()).rendered.rgbs)


def test_the_state_of_the_generator_comes_back_after_an_error():
    model, before = system().train(), torch.get_rng_state()

    with pytest.raises(ValueError, match="16 pixels"):
        model(view_batch(size=32))

    assert torch.equal(torch.get_rng_state(), before)


def test_views_are_encoded_each_by_itself_and_in_any_number_of_pieces(monkeypatch):
    model, rgb = system(), video()
    slots = model.encode_views(rgb)

    assert slots.shape == (3, 5, 3, 16) and not slots.requires_grad
    alone, _ = model.savi.encode(rgb[:, 1:2].transpose(0, 1).float().movedim(-1, 2) / 255 * 2 - 1, None)
    assert torch.allclose(slots[1:2], alone, atol=1e-5)
    assert torch.allclose(model.encode_views(rgb.float() / 255), slots, atol=1e-5)
    for size in (1, 4, 7):
        monkeypatch.setattr("vpd_lightning.baselines.view_system._IMAGES_AT_ONCE", size)
        assert torch.allclose(model.encode_views(rgb), slots, atol=1e-5)
        assert torch.allclose(model.decode(slots), system_decode(model, slots), atol=1e-5)


def system_decode(model, slots):
    return ((model.savi.decoder(slots).images.movedim(2, -1) + 1) / 2).clamp(0, 1)


def test_larger_images_are_resized_as_the_training_images_are():
    model, rgb = system(), video(size=32)

    assert torch.equal(model.encode_views(rgb), model.encode_views(resize_images(rgb, 16)))


def test_decoded_images_are_clamped_and_as_large_as_the_system():
    model = system()
    with torch.no_grad():
        model.savi.decoder.to_layers.weight.mul_(100)

    decoded = model.decode(torch.randn(2, 4, 3, 16))

    assert decoded.shape == (2, 4, 16, 16, 3)
    assert decoded.min() == 0 and decoded.max() == 1


def test_it_predicts_that_nothing_moves():
    model, rgb = system(), video(time=2, size=32)
    cameras = Cameras(torch.eye(3).expand(4, 3, 3, 3), torch.eye(4).expand(4, 3, 4, 4), 32, 32)
    context = RGBDFrames(rgb, torch.full(rgb.shape[:-1], float("nan")), cameras[:2])

    predicted = model.train().predict_frames(context, cameras)

    assert predicted.shape == (4, 3, 32, 32, 3) and 0 <= predicted.min() <= predicted.max() <= 1
    last = model.decode(model.encode_views(rgb)[:, -1])
    assert torch.allclose(predicted[3], resize_images(last, 32), atol=1e-6)
    with pytest.raises(ValueError, match="3 views, cameras 2"):
        model.predict_frames(context, cameras[:, :2])
    with pytest.raises(ValueError, match="2 frames, got 1"):
        model.predict_frames(context[:1], cameras)


def test_half_precision_gives_finite_gradients_and_full_outputs():
    model, batch = system(), view_batch()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        output = model(batch)

    assert output.rendered.rgbs.dtype == torch.float32
    output.rendered.rgbs.square().mean().backward()
    assert torch.isfinite(model.savi.initial_slots.grad).all()


def test_tiny_overfit_finds_more_than_the_mean_colour():
    model, batch = system(dropout=0.0), view_batch()
    target = batch.rgbs
    optimizer = torch.optim.Adam(model.parameters(), lr=2e-3)
    values = []
    for _ in range(100):
        optimizer.zero_grad()
        loss = 4 * (model(batch).rendered.rgbs - target).square().mean()
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(model.parameters(), 0.05)
        assert torch.isfinite(norm)
        optimizer.step()
        values.append(loss.item())

    mean_color = 4 * (target - target.mean(dim=(0, 1, 2))).square().mean().item()
    assert values[-1] < 0.3 * values[0] and values[-1] < mean_color
