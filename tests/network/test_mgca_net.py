"""The whole network: laws of its answer, every switch, small inputs."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from networks import TINY, sign_free_difference, tiny_network, two_view_batch
from torch import Tensor

from mgca_filter.network import PRESETS, MGCANet, NetworkConfig
from mgca_filter.network.eight_point import residual_channel
from mgca_filter.network.essential_refinement import refine_essential
from mgca_filter.network.mgca_net import REFINED_FLOOR, Head, better_half
from mgca_filter.network.weights import count_parameters

FULL = dataclasses.replace(TINY, stages=3)
SWITCHES = {
    "channels": 12,
    "clusters": 6,
    "stages": 2,
    "neighbours": 3,
    "graph_expansion": 2,
    "attention": "point",
    "positional": False,
    "cga": False,
    "csmgc": False,
    "final_consensus": False,
    "pooled_branches": False,
    "squeeze_excitation": False,
    "refined_feedback": True,
    "attributes": False,
}


@pytest.fixture(scope="module")
def network() -> MGCANet:
    return tiny_network()


@pytest.mark.parametrize("config", [TINY, dataclasses.replace(TINY, attention="point", stages=3, graph_expansion=2)])
def test_permuted_matches_permute_logits_and_keep_the_geometry(config):
    network = tiny_network(config)
    order = torch.randperm(60, generator=torch.Generator().manual_seed(0))
    held = 0
    for seed in range(5):
        correspondences, attributes = two_view_batch(60, batch=2, seed=seed)
        once, again = network(correspondences, attributes), network(correspondences[:, order], attributes[:, order])
        alike = torch.isclose(again.logits, once.logits[:, order], atol=1e-2, rtol=1e-2).all(1)
        for pair in range(2):
            E, other = again.essential[pair : pair + 1], once.essential[pair : pair + 1]
            held += bool(alike[pair]) and sign_free_difference(E, other) < 1e-2
    # Of a pair now and then rounding swaps two neighbours, on every processor of another one.
    assert held >= 7, f"the law held for {held} of 10 pairs"


def test_a_batch_is_its_pairs(network):
    correspondences, attributes = two_view_batch(50, batch=3)
    together = network(correspondences, attributes)
    for pair in range(3):
        alone = network(correspondences[pair : pair + 1], attributes[pair : pair + 1])
        torch.testing.assert_close(alone.logits[0], together.logits[pair], atol=1e-3, rtol=1e-3)
        assert sign_free_difference(alone.essential, together.essential[pair : pair + 1]) < 1e-2


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 33])
def test_any_number_of_matches_works(network, count):
    correspondences, attributes = two_view_batch(count, batch=2)
    output = network(correspondences, attributes)
    assert output.logits.shape == (2, count)
    assert output.essential.shape == (2, 3, 3)
    assert torch.isfinite(output.logits).all()
    torch.testing.assert_close(output.essential.norm(dim=(1, 2)), torch.ones(2), atol=1e-4, rtol=0)


def test_below_eight_matches_the_prior_alone_speaks(network):
    for count in (1, 4, 7):
        correspondences, attributes = two_view_batch(count)
        torch.testing.assert_close(network(correspondences, attributes).logits, network.prior(attributes))
    correspondences, attributes = two_view_batch(8)
    assert (network(correspondences, attributes).logits - network.prior(attributes)).abs().max() > 1e-3


def test_the_prior_is_added_to_every_head():
    plain, shifted = tiny_network(FULL), tiny_network(FULL)
    shifted.prior.output.bias += 100.0
    correspondences, attributes = two_view_batch(40)
    heads = zip(plain(correspondences, attributes).heads[:1], shifted(correspondences, attributes).heads[:1])
    for one, other in heads:  # the first head: later ones see the shift in their input as well
        torch.testing.assert_close(other.logits, one.logits + 100.0, atol=1e-3, rtol=0)
    assert all((head.logits > 50).all() for head in shifted(correspondences, attributes).heads)


@pytest.mark.parametrize(("stages", "heads"), [(1, 1), (2, 3), (3, 4)])
def test_every_stage_and_the_final_consensus_have_a_head(stages, heads):
    network = tiny_network(dataclasses.replace(TINY, stages=stages))
    correspondences, attributes = two_view_batch(20)
    output = network(correspondences, attributes)
    assert len(output.heads) == heads
    assert output.heads[-1].logits is output.logits
    refined = refine_essential(correspondences, output.logits, output.heads[-1].essential)
    torch.testing.assert_close(output.essential, refined)
    network.train()
    output = network(correspondences, attributes)
    assert output.essential is output.heads[-1].essential


def test_all_switches_are_covered():
    assert set(SWITCHES) == {field.name for field in dataclasses.fields(NetworkConfig)}


@pytest.mark.parametrize("name", list(SWITCHES))
def test_every_switch_changes_the_network(name):
    changed = tiny_network(dataclasses.replace(FULL, **{name: SWITCHES[name]}))
    reference = tiny_network(FULL)
    shapes, other_shapes = (
        {key: tuple(tensor.shape) for key, tensor in net.state_dict().items()} for net in (reference, changed)
    )
    batch = two_view_batch(40)
    output = changed(*batch)
    assert output.logits.shape == (1, 40)
    difference = float((output.logits - reference(*batch).logits).abs().max())
    assert shapes != other_shapes or difference > 1e-3


def test_neighbours_change_the_answer_of_equal_parameters():
    three, six = (tiny_network(dataclasses.replace(TINY, neighbours=k)) for k in (3, 6))
    shared = {name: tensor for name, tensor in three.state_dict().items() if "annular.join" not in name}
    six.load_state_dict({**six.state_dict(), **shared})
    batch = two_view_batch(40)
    assert (three(*batch).logits - six(*batch).logits).abs().max() > 1e-3


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"channels": 6}, "channels"),
        ({"channels": 0}, "channels"),
        ({"neighbours": 4}, "neighbours"),
        ({"stages": 4}, "stages"),
        ({"clusters": 0}, "clusters"),
        ({"graph_expansion": 0}, "graph_expansion"),
        ({"attention": "both"}, "attention"),
    ],
)
def test_config_refuses_what_cannot_be_built(values, message):
    with pytest.raises(ValueError, match=message):
        NetworkConfig(**values)


def test_config_survives_json():
    config = NetworkConfig(channels=16, attention="point", cga=False)
    assert NetworkConfig.from_json(config.to_json()) == config
    assert NetworkConfig.from_dict({"preset": "paper", "stages": 2}) == dataclasses.replace(PRESETS["paper"], stages=2)
    with pytest.raises(ValueError, match="chanels"):
        NetworkConfig.from_dict({"chanels": 8})


@pytest.mark.parametrize(("preset", "millions"), [("small", (0.5, 1.0)), ("paper", (5.0, 8.0))])
def test_presets_have_the_size_they_are_said_to_have(preset, millions):
    with torch.device("meta"):
        count = count_parameters(MGCANet(PRESETS[preset]))
    assert millions[0] <= count / 1e6 <= millions[1]


def test_without_attributes_they_are_not_looked_at():
    network = tiny_network(dataclasses.replace(TINY, attributes=False))
    correspondences, attributes = two_view_batch(40)
    output = network(correspondences, attributes)
    torch.testing.assert_close(network(correspondences, -attributes).logits, output.logits, atol=0, rtol=0)
    assert network.prior is None
    few = network(correspondences[:, :5], attributes[:, :5])
    torch.testing.assert_close(few.logits, torch.zeros(1, 5))  # a prior that knows nothing


def test_with_attributes_they_matter(network):
    correspondences, attributes = two_view_batch(40)
    reference = network(correspondences, attributes).logits
    for column in range(8):
        changed = attributes.clone()
        changed[..., column] = 0.5 - changed[..., column]
        assert (network(correspondences, changed).logits - reference).abs().max() > 1e-3


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 40])
@pytest.mark.parametrize("config", [FULL, dataclasses.replace(FULL, attention="point", squeeze_excitation=False)])
def test_training_gives_finite_losses_gradients_and_statistics(config, count):
    torch.manual_seed(0)
    network = MGCANet(config).train()
    output = network(*two_view_batch(count, batch=2))
    total = sum(head.logits.square().mean() + head.essential.sum() for head in output.heads)
    total.backward()
    assert torch.isfinite(total)
    assert all(torch.isfinite(p.grad).all() for p in network.parameters() if p.grad is not None)
    assert all(torch.isfinite(buffer).all() for buffer in network.buffers())


def test_equal_matches_give_finite_answers():
    for mode in (True, False):
        torch.manual_seed(0)
        network = MGCANet(FULL).train(mode)
        output = network(torch.zeros(2, 40, 4), torch.zeros(2, 40, 8))
        assert all(torch.isfinite(head.logits).all() for head in output.heads)
        assert all(torch.isfinite(head.essential).all() for head in output.heads)
        assert all(torch.isfinite(buffer).all() for buffer in network.buffers())


def test_every_parameter_is_trained():
    torch.manual_seed(0)
    network = MGCANet(FULL).train()
    output = network(*two_view_batch(40, batch=2))
    sum(head.logits.square().mean() + head.essential[:, 0].sum() for head in output.heads).backward()
    # A bias in front of a norm over matches has no effect; everything else must learn.
    idle = [name for name, p in network.named_parameters() if p.grad is None]
    assert idle == []


def test_feedback_of_a_stage_is_cut_from_the_gradient(network):
    seen: list[Tensor] = []
    hook = network.stages[1].register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    correspondences, attributes = two_view_batch(40)
    output = network(correspondences, attributes)
    few, _ = two_view_batch(15)
    network(few, attributes[:, :15])
    hook.remove()
    first = output.heads[0]
    torch.testing.assert_close(seen[0][..., :12], torch.cat([correspondences, attributes], -1))
    torch.testing.assert_close(seen[0][..., 12], residual_channel(correspondences, first.essential))
    torch.testing.assert_close(seen[0][..., 13], torch.relu(torch.tanh(first.logits)))
    assert not seen[0].requires_grad
    assert (seen[1][..., 12] == 0).all()  # below 16 matches E is arbitrary
    assert (seen[0][..., 12] != 0).any()


def test_refined_feedback_shows_the_third_stage_residuals_of_the_refined_geometry():
    network = tiny_network(dataclasses.replace(FULL, refined_feedback=True))
    seen: list[Tensor] = []
    for stage in network.stages:
        stage.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    correspondences, attributes = two_view_batch(40)
    first, second = network(correspondences, attributes).heads[:2]
    torch.testing.assert_close(seen[1][..., 12], residual_channel(correspondences, first.essential))
    refined = refine_essential(correspondences, second.logits, second.essential)
    torch.testing.assert_close(seen[2][..., 12], residual_channel(correspondences, refined, REFINED_FLOOR))
    assert sign_free_difference(refined, second.essential) > 1e-3
    assert not seen[2].requires_grad


@pytest.mark.parametrize(("count", "kept"), [(1, 1), (9, 9), (16, 16), (31, 16), (32, 16), (33, 17), (100, 50)])
def test_the_better_half_and_never_fewer_than_sixteen(count, kept):
    logits = torch.randn(2, count, generator=torch.Generator().manual_seed(count))
    half = better_half(logits)
    assert half.sum(1).tolist() == [kept, kept]
    worst = torch.where(half, logits, torch.inf).amin(1)
    best_left = torch.where(half, -torch.inf, logits).amax(1)
    assert (worst > best_left).all()
    assert better_half(torch.zeros(1, count)).all()  # equal logits: all count


def test_the_worse_half_has_no_say_in_the_geometry():
    torch.manual_seed(0)
    head = Head(8).requires_grad_(False)
    correspondences, _ = two_view_batch(60)
    features, prior = torch.randn(1, 60, 8), torch.zeros(1, 60)
    reference = head(features, prior, correspondences)
    half = better_half(reference.logits)
    moved = torch.where(half.unsqueeze(-1), correspondences, correspondences + 0.3)
    assert sign_free_difference(head(features, prior, moved).essential, reference.essential) < 1e-5
    moved = torch.where(half.unsqueeze(-1), correspondences * 1.3, correspondences)
    assert sign_free_difference(head(features, prior, moved).essential, reference.essential) > 1e-3
