import pytest
import torch

from tests.baselines.sizes import KUBRIC_SAVI, PAPER_ROLLOUTER, count, rollouter, savi, view_batch
from vpd_lightning.baselines.savi_system import SAViSystem
from vpd_lightning.baselines.slotformer_system import SlotFormerSystem
from vpd_lightning.types import Cameras, RGBDFrames


def system(**changes):
    return SlotFormerSystem(savi=savi(), rollouter=rollouter(**changes))


def batch_for(model, time=9, step=0):
    images = view_batch(time=time).images
    slots = model.encode_views(images.transpose(0, 1)).clone()  # the members of a batch as views of one video
    return view_batch(time=time, slots=slots, step=step)


def test_the_output_holds_predicted_and_stored_slots_and_the_images_of_the_predicted():
    model = system()
    batch = batch_for(model)

    output = model.eval()(batch)

    assert output.rendered.rgbs.shape == batch.rgbs.shape == (2, 3, 256, 3)
    predicted, target = output.auxiliary["predicted_slots"], output.auxiliary["target_slots"]
    assert torch.equal(target, batch.slots[:, 6:])
    assert torch.allclose(predicted, model.rollout_views(batch.slots[:, :6], 3), atol=1e-5)
    expected = model.savi.decoder(predicted).images
    assert torch.allclose(output.rendered.rgbs[1, 2, 16 * 5 + 7], (expected[1, 2, :, 5, 7] + 1) / 2, atol=1e-6)
    assert output.rendered.depths.isnan().all() and list(output.states) == []


def test_only_the_rollouter_learns_and_the_papers_sizes_are_right():
    model = SlotFormerSystem(savi=savi(KUBRIC_SAVI), rollouter=rollouter(PAPER_ROLLOUTER))

    assert sum(p.numel() for p in model.parameters() if p.requires_grad) == 826_112
    assert count(model.savi.decoder) == 513_156
    assert model.num_context_frames == 6
    assert {name.split(".")[0] for name in model.state_dict()} == {"savi", "rollouter"}


def test_savi_stays_in_evaluation_whatever_mode_the_system_is_in():
    model = system().train()

    assert model.rollouter.training and not any(module.training for module in model.savi.modules())
    assert not model.eval().rollouter.training


def test_training_steps_leave_savi_bitwise_alone_and_reach_the_rollouter_through_the_decoder():
    model = system(dropout=0.0)
    batch = batch_for(model)
    before = {name: value.clone() for name, value in model.savi.state_dict().items()}
    optimizer = torch.optim.Adam([p for p in model.parameters() if p.requires_grad], lr=1e-3)
    model.train()
    values = []
    for _ in range(5):
        optimizer.zero_grad()
        loss = (model(batch).rendered.rgbs - batch.rgbs).square().mean()  # of the images alone
        loss.backward()
        assert all(p.grad is None for p in model.savi.parameters())
        assert all(p.grad.abs().max() > 0 for p in model.rollouter.parameters())
        optimizer.step()
        values.append(loss.item())

    assert values[-1] < values[0]
    assert all(torch.equal(value, before[name]) for name, value in model.savi.state_dict().items())


def test_savis_weights_fit_by_name_and_decode_stored_slots_as_savi_does():
    torch.manual_seed(1)
    first = SAViSystem(savi=savi(), num_context_frames=6).eval()
    second = system()
    assert set(first.state_dict()) <= set(second.state_dict())
    second.load_state_dict({**second.state_dict(), **first.state_dict()})
    batch = view_batch(time=4)

    slots = first.encode_views(batch.images.transpose(0, 1))

    reconstruction = first(batch).rendered.rgbs.clamp(0, 1)
    assert torch.allclose(second.decode(slots).flatten(2, 3), reconstruction, atol=1e-5)


def test_the_history_alone_gives_the_slots_that_the_whole_video_gives():
    model = system()
    rgb = view_batch(time=12).images.transpose(0, 1)

    assert torch.allclose(model.encode_views(rgb[:6]), model.encode_views(rgb)[:, :6], atol=1e-5)


def test_predicted_frames_are_the_decoded_rollout_of_each_view():
    model = system()
    rgb = view_batch(time=6).images.transpose(0, 1)
    cameras = Cameras(torch.eye(3).expand(8, 2, 3, 3), torch.eye(4).expand(8, 2, 4, 4), 16, 16)
    context = RGBDFrames(rgb, torch.full(rgb.shape[:-1], float("nan")), cameras[:6])

    predicted = model.train().predict_frames(context, cameras)

    slots = model.rollout_views(model.encode_views(rgb), 8)
    assert predicted.shape == (8, 2, 16, 16, 3) and slots.shape == (2, 8, 3, 16)
    assert torch.allclose(predicted.transpose(0, 1), model.decode(slots), atol=1e-6)
    assert torch.allclose(predicted[:5], model.predict_frames(context, cameras[:5]), atol=1e-6)
    with pytest.raises(ValueError, match="6 frames, got 5"):
        model.predict_frames(context[:5], cameras)


def test_dropout_follows_the_keys():
    model = system(dropout=0.3)
    batch, next_batch = batch_for(model), batch_for(model, step=1)
    model.train()
    first = model(batch).rendered.rgbs
    torch.rand(3)

    assert torch.equal(model(batch).rendered.rgbs, first)
    assert not torch.equal(model(next_batch).rendered.rgbs, first)


def test_a_batch_without_slots_is_refused():
    with pytest.raises(ValueError, match="stored slots"):
        system()(view_batch(time=9))
