import numpy as np
import pytest
import torch

from npdr_ppl.embeddings import (
    AllSteps,
    BayesSimStatistic,
    Differences,
    Embedding,
    LastStep,
    Masked,
    Recurrent,
    Strided,
    embedding_by_name,
)
from npdr_ppl.errors import DataError, ModelError, ShapeError
from npdr_ppl.rollouts import Rollouts

torch.set_num_threads(1)

BATCH = 3


@pytest.fixture(scope="module")
def rollouts():
    rng = np.random.default_rng(0)
    lengths = (11, 7)
    return Rollouts.from_arrays(
        [rng.normal(size=(n + 1, 3)) for n in lengths],
        [rng.normal(size=(n, 2)) for n in lengths],
        channel_names=("x", "y", "z"),
        action_names=("u", "v"),
        time_step=0.1,
    )


@pytest.fixture(scope="module")
def inputs(rollouts):
    """Segments of 4, 4, 3 and 4, 3 steps."""
    return rollouts.inputs(4, "recorded")


@pytest.fixture(scope="module")
def trajectory(inputs):
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(BATCH, 5, 4, 3, generator=generator, dtype=torch.float64)
    return torch.where(inputs.mask[..., None], values, 0.0)


def segments(trajectory, inputs):
    """Yields rollout, states with the start and actions of each segment, in plain numpy."""
    for s in range(inputs.num_segments):
        steps = int(inputs.mask[s].sum())
        start = inputs.initial_readings[s].expand(BATCH, 1, -1)
        states = torch.cat([start, trajectory[:, s, :steps]], dim=1)
        yield int(inputs.rollout[s]), states.numpy(), inputs.actions[s, :steps].numpy()


def test_bayessim_statistic_by_hand(trajectory, inputs):
    features = BayesSimStatistic().features(trajectory, inputs).numpy()
    assert features.shape == (BATCH, 2 * (2 * 3 + 2 * 3))
    for b in range(BATCH):
        expected = []
        for rollout in (0, 1):
            pieces = [p for p in segments(trajectory, inputs) if p[0] == rollout]
            differences = np.concatenate([np.diff(states[b], axis=0) for _, states, _ in pieces])
            actions = np.concatenate([a for _, _, a in pieces])
            expected += list((actions.T @ differences).ravel())
            expected += list(differences.mean(0)) + list(differences.var(0))
        np.testing.assert_allclose(features[b], expected, rtol=1e-12)


def test_bayessim_statistic_of_one_segment_is_the_papers(rollouts):
    """S without its last row, its differences D, and actions on the same rows."""
    inputs = rollouts[0].inputs(None, "recorded")
    features = BayesSimStatistic().features(rollouts[0].observation(inputs)[None], inputs)[0]
    states, actions = rollouts.readings[0], rollouts.actions[0]
    differences = states[1:] - states[:-1]
    expected = [*(actions.T @ differences).ravel(), *differences.mean(0), *differences.var(0)]
    np.testing.assert_allclose(features.numpy(), expected, rtol=1e-12)


def test_readings_by_hand(trajectory, inputs):
    everything = AllSteps().features(trajectory, inputs).numpy()
    differences = Differences().features(trajectory, inputs).numpy()
    last = LastStep().features(trajectory, inputs).numpy()
    pieces = [states for _, states, _ in segments(trajectory, inputs)]
    for b in range(BATCH):
        np.testing.assert_array_equal(
            everything[b], np.concatenate([p[b, 1:].ravel() for p in pieces])
        )
        np.testing.assert_array_equal(
            differences[b], np.concatenate([np.diff(p[b], axis=0).ravel() for p in pieces])
        )
        np.testing.assert_array_equal(last[b], np.concatenate([p[b, -1] for p in pieces]))


def test_stride_by_hand(trajectory, inputs):
    features = embedding_by_name("all/2").features(trajectory, inputs).numpy()
    kept = []
    for _, states, _ in segments(trajectory, inputs):
        kept.append(states[:, 2::2].reshape(BATCH, -1))
    np.testing.assert_array_equal(features, np.concatenate(kept, axis=1))
    differences = embedding_by_name("differences/3").features(trajectory, inputs).numpy()
    kept = [
        np.diff(s[:, ::3], axis=1).reshape(BATCH, -1) for _, s, _ in segments(trajectory, inputs)
    ]
    np.testing.assert_array_equal(differences, np.concatenate(kept, axis=1))
    statistic = embedding_by_name("bayessim/2").features(trajectory, inputs)[0].numpy()
    pieces = [p for p in segments(trajectory, inputs) if p[0] == 0]
    d = np.concatenate([np.diff(s[0, ::2], axis=0) for _, s, _ in pieces])
    a = np.concatenate([a[::2][: len(s[0, ::2]) - 1] for _, s, a in pieces])
    np.testing.assert_allclose(statistic[:6], (a.T @ d).ravel(), rtol=1e-12)


def test_channels_and_steps_by_hand(trajectory, inputs):
    features = embedding_by_name("all[z,x]").features(trajectory, inputs).numpy()
    kept = [s[:, 1:, [2, 0]].reshape(BATCH, -1) for _, s, _ in segments(trajectory, inputs)]
    np.testing.assert_array_equal(features, np.concatenate(kept, axis=1))
    window = Masked(Differences(), first_step=1, last_step=3)
    kept = [
        np.diff(s, axis=1)[:, 1:3].reshape(BATCH, -1) for _, s, _ in segments(trajectory, inputs)
    ]
    np.testing.assert_array_equal(
        window.features(trajectory, inputs).numpy(), np.concatenate(kept, axis=1)
    )


def test_block_means_by_hand(trajectory, inputs):
    features = embedding_by_name("all~3").features(trajectory, inputs).numpy()
    kept = []
    for _, states, _ in segments(trajectory, inputs):
        readings = states[:, 1:]
        for start in range(0, readings.shape[1], 3):
            kept.append(readings[:, start : start + 3].mean(1))
    np.testing.assert_allclose(features, np.concatenate(kept, axis=1), rtol=1e-12)


WORDS = (
    "bayessim", "last", "all", "differences", "gru", "conv", "linear",
    "all/2", "all~2", "gru[x]/2", "gru~2", "conv/4",
)  # fmt: skip


@pytest.mark.parametrize("word", WORDS)
def test_contract(word, trajectory, inputs):
    """Every embedding: rows are independent, padding is ignored, float32 and chunks work."""
    embedding = embedding_by_name(word)
    features = embedding.features(trajectory, inputs)
    assert len(features) == BATCH and torch.isfinite(features).all()
    assert torch.equal(embedding.features(trajectory[1:2], inputs)[0], features[1])
    padded = torch.where(inputs.mask[..., None], trajectory, torch.nan)
    assert torch.equal(embedding.features(padded, inputs), features)
    single = embedding.features(trajectory.float(), inputs)
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), features, rtol=1e-4, atol=1e-4)
    network = embedding.network(features.shape[1:])
    assert (network is not None) == embedding.is_trained
    if network is None:
        assert features.ndim == 2
    else:
        output = network(features.float())
        assert output.ndim == 2 and len(output) == BATCH
        output.square().sum().backward()
        assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in network.parameters())


@pytest.mark.parametrize("word", WORDS)
def test_a_failed_simulation_does_not_spoil_the_others(word, trajectory, inputs):
    failed = trajectory.clone()
    failed[1, 0, 1:] = torch.nan
    features = embedding_by_name(word).features(failed, inputs)
    assert torch.isfinite(features[[0, 2]]).all() and not torch.isfinite(features[1]).all()


@pytest.mark.parametrize("word", ["gru", "conv", "linear"])
def test_networks_tell_segments_apart(word):
    """Averaging must not mix segments up: swapping two of them changes the output."""
    torch.manual_seed(0)
    network = embedding_by_name(word).network(torch.Size((3, 9, 2)))
    assert network is not None
    x = torch.randn(1, 3, 9, 2)
    assert not torch.allclose(network(x), network(x[:, [1, 0, 2]]), atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("word", ["gru", "conv", "linear"])
def test_networks_learn(word):
    """A frequency is read off noisy sines: far below the error of guessing the mean."""
    torch.manual_seed(0)
    frequency = torch.rand(256, 1) * 2 + 0.5
    time = torch.linspace(0, 3, 24)
    x = torch.stack([torch.sin(frequency * time), torch.cos(frequency * time)], dim=-1)[:, None]
    encoder = embedding_by_name(word).network(x.shape[1:])
    assert encoder is not None
    model = torch.nn.Sequential(encoder, torch.nn.LazyLinear(1))
    model(x)
    optimiser = torch.optim.Adam(model.parameters(), 3e-3)
    for _ in range(150):
        loss = (model(x + 0.02 * torch.randn_like(x)) - frequency).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert loss < 0.05 * frequency.var()


def test_words():
    for word in ("bayessim", "last", "all", "differences", "gru", "conv", "linear"):
        assert isinstance(embedding_by_name(word), Embedding)
    assert embedding_by_name("all/10") == Strided(AllSteps(), 10)
    assert embedding_by_name("gru[x, y]/3") == Strided(Masked(Recurrent(), ("x", "y")), 3)
    for word in ("", "al", "all/", "all/0", "all/-1", "all[]", "all/2[x]", "all/2/3", "ALL"):
        with pytest.raises(ModelError, match="there is no embedding"):
            embedding_by_name(word)


def test_what_does_not_fit_is_refused(trajectory, inputs):
    with pytest.raises(ShapeError, match=r"takes \(B, 5, 4, 3\), got \(3, 5, 4, 2\)"):
        AllSteps().features(trajectory[..., :2], inputs)
    with pytest.raises(DataError, match="no channel w to embed; there are x, y, z"):
        embedding_by_name("all[w]").features(trajectory, inputs)
    with pytest.raises(ShapeError, match="a stride of 5 leaves nothing"):
        embedding_by_name("all/5").features(trajectory, inputs)
    with pytest.raises(ShapeError, match="no last measurement"):
        embedding_by_name("last/4").features(trajectory, inputs)
    with pytest.raises(ShapeError, match="no segment has steps from 4"):
        Masked(AllSteps(), first_step=4).features(trajectory, inputs)
    with pytest.raises(ModelError, match="stride is at least 1"):
        Strided(AllSteps(), 0)
    with pytest.raises(ModelError, match="0 <= first < last"):
        Masked(AllSteps(), first_step=2, last_step=2)
    with pytest.raises(ShapeError, match="reads \\(segments, steps, channels\\)"):
        Recurrent().network(torch.Size((4,)))
