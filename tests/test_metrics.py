from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats

from npdr_ppl import metrics
from npdr_ppl.errors import ShapeError
from npdr_ppl.rollouts import Rollouts, stitch

torch.set_num_threads(1)

RECORDING = (
    Path(__file__).resolve().parents[1].parent / "shared/data/quanser_qube/swing_up_500hz_5s.csv"
)


@pytest.fixture(scope="module")
def reference_dtw():
    """The recursion of the docstring, entry by entry."""

    def distance(query, reference):
        local = np.linalg.norm(query[:, None] - reference[None], axis=-1)
        total = np.full(local.shape, np.inf)
        for i, j in np.ndindex(local.shape):
            before = [total[i - 1, j - 1] + 2 * local[i, j]] if i and j else []
            before += [total[i - 1, j] + local[i, j]] if i else []
            before += [total[i, j - 1] + local[i, j]] if j else []
            total[i, j] = min(before, default=local[i, j])
        last = total[-1]
        return last[np.argmin(last / (len(query) + 1 + np.arange(len(last))))]

    return distance


def nominal_furuta(inputs):
    """The paper's equations and data sheet, constant acceleration over each step of 2 ms."""
    columns = {name: i for i, name in enumerate(inputs.channel_names)}
    names = ("arm_angle", "pole_angle", "arm_velocity", "pole_velocity")
    theta, alpha, d_theta, d_alpha = (inputs.initial_values[:, columns[n]] for n in names)
    gravity, resistance, motor = 9.81, 8.4, 0.042
    arm_mass, arm, mass, pole = 0.095, 0.085, 0.024, 0.129
    dt, readings = inputs.time_step, []
    c0, c1 = arm_mass * arm**2 / 12 + mass * arm**2, mass * pole**2 / 4
    c2, c3, c4 = mass * pole * arm / 2, mass * pole**2 / 12 + c1, mass * pole * gravity / 2
    for k in range(inputs.num_steps):
        sine, cosine = alpha.sin(), alpha.cos()
        m11, m12 = c0 + c1 * sine**2, c2 * cosine
        x = motor * (inputs.actions[:, k, 0] - motor * d_theta) / resistance - 5e-6 * d_theta
        x = x - 2 * c1 * sine * cosine * d_theta * d_alpha + c2 * sine * d_alpha**2
        y = c1 * sine * cosine * d_theta**2 - c4 * sine - 1e-6 * d_alpha
        determinant = m11 * c3 - m12**2
        dd_theta, dd_alpha = (c3 * x - m12 * y) / determinant, (m11 * y - m12 * x) / determinant
        theta = theta + dt * d_theta + dt**2 / 2 * dd_theta
        alpha = alpha + dt * d_alpha + dt**2 / 2 * dd_alpha
        d_theta, d_alpha = d_theta + dt * dd_theta, d_alpha + dt * dd_alpha
        readings.append(torch.stack([theta, alpha, d_theta, d_alpha], dim=-1))
    return torch.stack(readings, dim=1)


@pytest.mark.slow
def test_the_nominal_column_of_the_papers_table():
    """Table 2: RMSE 0.384 ± 0.003, DTW 1430 ± 30."""
    if not RECORDING.is_file():
        pytest.skip(f"measured data are not at {RECORDING}")
    rollouts = Rollouts.load(RECORDING)
    inputs = rollouts.inputs(200, "recorded")
    simulated, measured = stitch(nominal_furuta(inputs), inputs), rollouts.series()
    rmse = metrics.summarise(metrics.rmse(simulated, measured))
    assert rmse["mean"] == pytest.approx(0.3844, abs=5e-5)
    assert rmse["std"] == pytest.approx(0.0035, abs=5e-5)
    distances = metrics.dtw(simulated, measured)
    assert metrics.summarise(distances)["mean"] == pytest.approx(1431.2, abs=0.05)
    assert metrics.summarise(distances)["std"] == pytest.approx(25.7, abs=0.05)


@pytest.mark.parametrize("length", [1, 2, 3, 17, 60])
def test_dtw_is_the_recursion_it_names(length, reference_dtw):
    rng = np.random.default_rng(length)
    measured = [torch.tensor(rng.normal(size=(length, 3)).cumsum(0)) for _ in range(2)]
    simulated = [torch.tensor(rng.normal(size=(2, 2, length, 3)).cumsum(2)) for _ in range(2)]
    distances = metrics.dtw(simulated, measured)
    assert tuple(distances.shape) == (2, 2, 2)
    for index in np.ndindex(2, 2, 2):
        y = measured[index[2]]
        scale = y.abs().amax(0)
        x = simulated[index[2]][index[0], index[1]]
        expected = reference_dtw((y / scale).numpy(), (x / scale).numpy())
        assert float(distances[index]) == pytest.approx(expected, rel=1e-12, abs=1e-12)


def test_dtw_of_a_batch_is_that_of_its_elements():
    torch.manual_seed(0)
    measured, simulated = [torch.randn(20, 2)], [torch.randn(7, 20, 2)]
    whole = metrics.dtw(simulated, measured)
    single = [metrics.dtw([element], measured) for element in simulated[0]]
    assert torch.equal(torch.stack(single), whole)


def test_dtw_of_equal_and_delayed_series():
    time = torch.linspace(0, 6, 200)[:, None]
    series, late = torch.sin(time), torch.sin(time - 0.1)
    assert metrics.dtw([series], [series]).item() == 0
    pointwise = 2 * (series - late).abs().sum()
    assert metrics.dtw([late], [series]).item() < 0.3 * pointwise


def test_dtw_of_a_long_series_is_that_of_every_third_step_and_a_little_larger(monkeypatch):
    time = torch.linspace(0, 6, 600)[:, None]
    series, late = torch.sin(time), 1.1 * torch.sin(time - 0.3)
    exact = metrics.dtw([late], [series]).item()
    monkeypatch.setattr(metrics, "MOST_ALIGNED", 200)
    assert exact < metrics.dtw([late], [series]).item() < 1.25 * exact


def test_failed_simulations_score_nan():
    measured = [torch.ones(5, 2)]
    simulated = torch.zeros(2, 5, 2)
    simulated[1, 3, 0] = torch.nan
    for metric in (metrics.dtw, metrics.rmse):
        scores = metric([simulated], measured)
        assert torch.isfinite(scores[0]).all() and torch.isnan(scores[1]).all()


def test_rmse_by_hand():
    measured = [torch.tensor([[1.0, 10.0], [-2.0, 0.0]]), torch.tensor([[0.0, 4.0]])]
    simulated = [torch.tensor([[2.0, 10.0], [-2.0, 5.0]]), torch.tensor([[3.0, 0.0]])]
    # Channel ranges 2 and 10; a channel that is always zero is not scaled.
    first = (np.sqrt(0.5**2 / 2) + np.sqrt(0.5**2 / 2)) / 2
    expected = torch.tensor([first, (3 + 1) / 2], dtype=torch.float32)
    torch.testing.assert_close(metrics.rmse(simulated, measured), expected)


def test_summaries_use_the_population_deviation():
    assert metrics.summarise(torch.tensor([1.0, 3.0])) == {"mean": 2.0, "std": 1.0}
    assert metrics.summarise(torch.tensor([5.0])) == {"mean": 5.0, "std": 0.0}


def test_shapes_are_checked():
    with pytest.raises(ShapeError, match="1 simulated and 2 measured"):
        metrics.rmse([torch.zeros(3, 2)], [torch.zeros(3, 2)] * 2)
    with pytest.raises(ShapeError, match=r"rollout 0 was measured with shape \(4, 2\)"):
        metrics.dtw([torch.zeros(3, 2)], [torch.zeros(4, 2)])
    with pytest.raises(ShapeError, match="one more dimension in front"):
        metrics.crps(torch.zeros(5, 3), torch.zeros(4))
    with pytest.raises(ShapeError, match="needs two samples"):
        metrics.crps(torch.zeros(1, 3), torch.zeros(3), is_fair=True)


@pytest.mark.parametrize("is_fair", [False, True])
def test_crps_is_the_double_sum(is_fair):
    torch.manual_seed(0)
    samples, observation = torch.randn(11, 4, 3).double(), torch.randn(4, 3).double()
    pairs = (samples[:, None] - samples).abs().sum((0, 1))
    expected = (samples - observation).abs().mean(0) - pairs / (2 * 11 * (10 if is_fair else 11))
    torch.testing.assert_close(metrics.crps(samples, observation, is_fair=is_fair), expected)


def test_crps_of_a_normal_ensemble_has_its_closed_form():
    """Gneiting and Raftery (2007), eq. 5: y (2 Φ(y) − 1) + 2 φ(y) − 1/√π."""
    torch.manual_seed(0)
    samples = torch.randn(200_000, 1).double().expand(-1, 3)
    y = np.array([-1.0, 0.0, 2.5])
    expected = y * (2 * stats.norm.cdf(y) - 1) + 2 * stats.norm.pdf(y) - 1 / np.sqrt(np.pi)
    # The standard error of the mean of |x − y| is below 1/√200000; 4 of them fail once in 16 000.
    torch.testing.assert_close(
        metrics.crps(samples, torch.tensor(y)), torch.tensor(expected), atol=4 / 447, rtol=0
    )


def test_fair_crps_is_unbiased_in_the_ensembles_size():
    """The mean over ensembles of two equals that of a large one; the plain form's does not."""
    torch.manual_seed(0)
    pairs, y = torch.randn(2, 100_000).double(), torch.randn(100_000).double()
    fair, plain = metrics.crps(pairs, y, is_fair=True), metrics.crps(pairs, y)
    exact = 1 / np.sqrt(np.pi)  # E|x − y| − E|x − x'|/2 with all standard normal
    error = float(fair.std()) / np.sqrt(100_000)
    assert abs(float(fair.mean()) - exact) < 4 * error
    assert float(plain.mean()) - exact > 40 * error


def test_crps_by_step_averages_over_the_segments_that_exist():
    mask = torch.tensor([[True, True], [True, False]])
    observation = torch.zeros(2, 2, 1)
    samples = torch.tensor([[[1.0], [2.0]], [[3.0], [torch.nan]]])[None]
    result = metrics.crps_by_step(samples, observation, mask)
    assert result.tolist() == [[2.0], [2.0]]


def test_pit_is_uniform_with_ties_and_coverage_is_nominal():
    """Poisson counts: many ties. Kolmogorov-Smirnov at a false-alarm rate of 1e-4."""
    generator = torch.Generator().manual_seed(0)
    rate = torch.full((51, 20_000), 2.0)
    draws = torch.poisson(rate, generator=generator)
    values = metrics.pit(draws[1:], draws[0], generator)
    assert stats.kstest(values.numpy(), "uniform").pvalue > 1e-4
    levels = (0.0, 0.5, 0.9, 1.0)
    covered = metrics.coverage(values, levels)
    for level, fraction in zip(levels, covered.tolist(), strict=True):
        assert abs(fraction - level) <= 4 * np.sqrt(level * (1 - level) / 20_000)


def test_pit_by_hand_and_masked_coverage():
    samples = torch.tensor([1.0, 2.0, 2.0, 3.0])[:, None].expand(-1, 4)
    observation = torch.tensor([0.0, 2.0, 2.5, 9.0])
    values = metrics.pit(samples, observation)
    torch.testing.assert_close(values, torch.tensor([0.1, 0.5, 0.7, 0.9]))
    mask = torch.tensor([True, True, False, False])
    assert metrics.coverage(values, [0.1, 0.8], mask).tolist() == pytest.approx([0.5, 1.0])


@pytest.mark.slow
def test_c2st_is_half_for_equals_and_one_for_strangers():
    torch.manual_seed(0)
    first, second = torch.randn(500, 2), torch.randn(500, 2)
    # The accuracy of a coin over 1000 labels: four standard deviations.
    assert abs(metrics.c2st(first, second) - 0.5) < 4 * 0.5 / 1_000**0.5
    assert metrics.c2st(first, second + 10) > 0.99
    with pytest.raises(ShapeError, match="c2st compares"):
        metrics.c2st(first, second[:, :1])
