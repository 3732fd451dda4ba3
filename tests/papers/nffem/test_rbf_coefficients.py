"""The papers' network as a schedule: values, rollouts, files and artefacts."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from nfriction import export, load, rigs, rollout, save
from nfriction.friction.neurofuzzy import NFLFM, NFNLFM
from nfriction.fuzzy import RBFNetwork
from nfriction.papers.nffem.rbf_coefficients import RBFCoefficients

JOINTS = 3


LOWER = torch.tensor([0.0, -100.0, -4e3, -3e5], dtype=torch.float64)
UPPER = torch.tensor([10.0, 100.0, 4e3, 3e5], dtype=torch.float64)
BOTH = pytest.mark.parametrize("acceleration", ["signed", "along_motion"])
ORDERS = pytest.mark.parametrize("derivatives", [0, 1, 2])


def network(derivatives: int = 0, seed: int = 0) -> tuple[RBFNetwork, Tensor, Tensor]:
    """A network with its universes; some of its outputs exceed theirs."""
    random = torch.Generator().manual_seed(seed)
    inputs = 2 + derivatives
    made = RBFNetwork(JOINTS, inputs, 10, 2).requires_grad_(False)
    made.init_range(LOWER[:inputs], UPPER[:inputs], seed)
    weight = torch.randn(made.output_weight.shape, generator=random, dtype=torch.float64)
    made.output_weight.copy_(0.01 * weight)
    made.output_bias.fill_(0.02)
    ends = torch.stack([LOWER[:inputs], UPPER[:inputs]])
    outputs = torch.tensor([[0.01, 0.005], [0.03, 0.04]], dtype=torch.float64)
    return made, ends[:, None].expand(2, JOINTS, inputs), outputs[:, None].expand(2, JOINTS, 2)


def model(acceleration: str = "signed", derivatives: int = 0) -> NFLFM:
    made = NFLFM(JOINTS, network="rbf", acceleration=acceleration, derivatives=derivatives)
    schedule(made.requires_grad_(False)).set_network(*network(derivatives))
    return made


def schedule(of: NFLFM) -> RBFCoefficients:
    assert isinstance(of.schedule, RBFCoefficients)
    return of.schedule


def motions(count: int = 50, seed: int = 0) -> tuple[Tensor, Tensor]:
    random = torch.Generator().manual_seed(seed)
    qd, qdd = torch.randn(2, count, JOINTS, generator=random, dtype=torch.float64)
    return 6.0 * qd, 60.0 * qdd


def test_untrained_model_equals_the_constant_law() -> None:
    values = torch.tensor([[0.01, 0.02, 0.03, 0.04, 1.0]] * 2, dtype=torch.float64)
    made = NFNLFM(2, values, network="rbf")
    qd = torch.linspace(-5, 5, 20, dtype=torch.float64).reshape(10, 2)
    torch.testing.assert_close(made.coefficients(qd, 10 * qd), values.expand(10, 2, 5))


def test_coefficients_are_the_network_clamped_to_its_universe() -> None:
    made, (own, _, outputs) = model(), network()
    qd, qdd = motions()
    inside = torch.stack([qd.abs().clamp(max=10.0), qdd.clamp(-100.0, 100.0)], -1)
    expected = own(inside).clamp(outputs[0], outputs[1])
    torch.testing.assert_close(made.coefficients(qd, qdd), expected)
    assert not torch.equal(own(inside), expected)  # the clamp is active


def test_acceleration_along_the_motion_is_direction_independent() -> None:
    made = model("along_motion")
    qd, qdd = motions()
    torch.testing.assert_close(made.coefficients(-qd, -qdd), made.coefficients(qd, qdd))
    signed = model()
    assert not torch.allclose(signed.coefficients(-qd, -qdd), signed.coefficients(qd, qdd))


@ORDERS
def test_compiled_rollouts_equal_eager_ones(derivatives: int) -> None:
    plant, made = rigs.tlrip(), model(derivatives=derivatives)
    q0 = torch.tensor([1.0, 0.2, 0.3], dtype=torch.float64)
    runs = [
        rollout(plant, made, q0, 0 * q0, sample_time=1e-3, steps=200, backend=backend).q
        for backend in ("auto", "torch")
    ]
    # Sums taken in another order, over 200 steps.
    torch.testing.assert_close(*runs, rtol=0, atol=1e-12)


@ORDERS
def test_files_and_artefacts_keep_the_model(tmp_path: Path, derivatives: int) -> None:
    made = model("along_motion", derivatives)
    again = load(save(made, tmp_path / "model.json"))
    for a, b in zip(made.state_dict().values(), again.state_dict().values(), strict=True):
        assert torch.equal(a, b)
    # Each is compared with the model before it is written.
    assert export.torchscript(again, tmp_path / "model.pt").exists()
    assert export.c(again, tmp_path)


def test_jerk_and_snap_are_smoothed_derivatives_of_the_acceleration() -> None:
    made = schedule(model(derivatives=2))
    time = torch.arange(400, dtype=torch.float64)[:, None].expand(-1, JOINTS) / 1000
    qdd = 50.0 * torch.sin(6.0 * time)
    found = made.states(time, qdd)
    one_by_one = [made.initial_state(time[0], qdd[0])]
    for v, a in zip(time[1:], qdd[1:], strict=True):
        one_by_one.append(made.advance(v, a, one_by_one[-1]))
    torch.testing.assert_close(torch.stack(one_by_one), found)
    # Each filter lags by its time constant, and the differences by half a sample.
    lag = made.smoothing
    late = slice(100, None)
    for column, value, filters in (
        (0, 50.0 * torch.sin(6.0 * (time - lag)), 1),
        (1, 300.0 * torch.cos(6.0 * (time - lag)), 1),
        (2, -1800.0 * torch.sin(6.0 * (time - 2 * lag)), 2),
    ):
        error = (found[late, :, column] - value[late]).abs().max() / value.abs().max()
        assert error < 0.01 * filters


def test_jerk_and_snap_change_the_coefficients() -> None:
    made = schedule(model(derivatives=2))
    qd, qdd = motions()
    state = made.initial_state(qd, qdd)
    still = made.coefficients_from(qd, qdd, state)
    for column in (1, 2):
        moved = state.clone()
        moved[..., column] = UPPER[1 + column] / 2
        assert not torch.allclose(made.coefficients_from(qd, qdd, moved), still)


@BOTH
@ORDERS
def test_sensitivities_equal_finite_differences(acceleration: str, derivatives: int) -> None:
    made = schedule(model(acceleration, derivatives))
    qd, qdd = motions(8)
    state = made.initial_state(qd, qdd)
    if derivatives:
        state[..., 1:] = 0.3 * UPPER[2 : 2 + derivatives]
    found = made.sensitivities_from(qd, qdd, state)
    own = made.parameter_vector()
    by_vector = torch.zeros(len(qd), JOINTS, 2, len(own), dtype=torch.float64)
    for p in range(len(own)):
        step = torch.zeros_like(own)
        step[p] = 1e-6
        ends = []
        for vector in (own + step, own - step):
            made.set_parameter_vector(vector)
            ends.append(made.coefficients_from(qd, qdd, state))
        by_vector[..., p] = (ends[0] - ends[1]) / 2e-6
    made.set_parameter_vector(own)
    acts = torch.nn.functional.one_hot(found.joint, JOINTS).T.to(own)
    expected = found.parameters[:, None] * acts[None, :, None]
    # Central differences with a step of 1e-6 are accurate to about nine digits.
    torch.testing.assert_close(by_vector, expected, rtol=1e-6, atol=1e-8)
    h = 1e-6
    for slope, (a, b) in ((found.qd, (h, 0.0)), (found.qdd, (0.0, h))):
        up, down = (made.coefficients_from(qd + s * a, qdd + s * b, state) for s in (1, -1))
        numeric = (up - down) / (2 * h)
        torch.testing.assert_close(numeric, slope, rtol=1e-5, atol=1e-9)


def test_bad_networks_are_refused() -> None:
    made = schedule(model())
    own, inputs, outputs = network()
    with pytest.raises(ValueError, match="units=10"):
        made.set_network(RBFNetwork(JOINTS, 2, 5, 2), inputs, outputs)
    with pytest.raises(ValueError, match="lower <= upper"):
        made.set_network(own, inputs.flip(0), outputs)
    with pytest.raises(ValueError, match="positive by physics"):
        made.set_network(own, inputs, outputs - 0.02)
    with pytest.raises(ValueError, match="network"):
        NFLFM(JOINTS, network="other")
    with pytest.raises(ValueError, match="acceleration"):
        NFLFM(JOINTS, network="rbf", acceleration="other")
    with pytest.raises(ValueError, match="jerk"):
        NFLFM(JOINTS, network="rbf", derivatives=3)
