"""Properties of the chain's equations of motion, in any pose and for any masses."""

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from nfriction.plant import Arm, PendulumChain, dynamics, rigs

FULL_TENSOR = [
    [0.002, 0.0388, 0.04, 0.0004, 0.00032, -0.00024],
    [0.0025, 0.0485, 0.05, 0.0005, 0.0004, -0.0003],
    [0.0025, 0.0485, 0.05, 0.0005, 0.0004, -0.0003],
]
ARMS: list[Any] = ["fixed", "free"]


def states(joints: int, batch: tuple[int, ...] = (20,), seed: int = 0) -> tuple[Tensor, ...]:
    generator = torch.Generator().manual_seed(seed)
    q, qd, tau = torch.randn(3, *batch, joints, dtype=torch.float64, generator=generator)
    return 3 * q, 5 * qd, tau


def every_kind(arm: Any) -> PendulumChain:
    """Offsets, gains, rotors, full tensors and, with a fixed arm, drag: all existing terms."""
    rig = rigs.tlrip(arm, FULL_TENSOR)
    joints, links = torch.linspace(0.1, 0.2, rig.joints).double(), torch.ones(3).double()
    drag = {} if rig.first_link else {"drag_linear": 0.02 * links, "drag_quadratic": 0.03 * links}
    return rig.replace(
        armature=joints / 10, angle_offset=joints, torque_gain=1.0 + 2.0 * joints,
        gear_loss=joints, torque_offset=-joints, **drag,
    )  # fmt: skip


def with_encoders(rig: PendulumChain) -> PendulumChain:
    """The same chain with eccentric encoders."""
    joints = torch.linspace(0.01, 0.02, rig.joints).double()
    return rig.replace(encoder_cosine=joints, encoder_sine=-joints)


@st.composite
def chains(draw: Callable[[Any], Any]) -> PendulumChain:
    links = draw(st.integers(1, 4))

    def values(low: float, high: float) -> list[float]:
        return draw(st.lists(st.floats(low, high), min_size=links, max_size=links))

    mass, length = values(0.05, 10), values(0.05, 2)
    com = [share * size for share, size in zip(values(0.1, 1.2), length, strict=True)]
    # Slender rods: the inertia of a body of that length about its mass centre.
    inertia = [f * m * s**2 for f, m, s in zip(values(0, 0.2), mass, length, strict=True)]
    arm = draw(st.sampled_from([None, Arm(0.1, 0.3), Arm(2.0, 1.0)]))
    armature = draw(st.sampled_from([None, [0.01] * (links + (arm is not None))]))
    return PendulumChain(mass, length, com, inertia, arm=arm, armature=armature)


@given(rig=chains(), seed=st.integers(0, 1000))
def test_mass_matrix_is_symmetric_positive_definite(rig: PendulumChain, seed: int) -> None:
    q, _, _ = states(rig.joints, (50,), seed)
    mass = rig.mass_matrix(q)
    assert torch.equal(mass, mass.mT)
    assert (torch.linalg.eigvalsh(mass) > 0).all()


@given(rig=chains(), seed=st.integers(0, 1000))
def test_inverse_dynamics_inverts_forward_dynamics(rig: PendulumChain, seed: int) -> None:
    q, qd, tau = states(rig.joints, seed=seed)
    qdd = rig(q, qd, tau)
    # The error of a solve grows with the condition number, and is small relative to each term.
    scale = (rig.mass_matrix(q).abs() @ qdd.abs()[..., None])[..., 0] + rig.bias(q, qd).abs()
    condition = torch.linalg.cond(rig.mass_matrix(q)).amax()
    error = (rig.inverse_dynamics(q, qd, qdd) - tau).abs()
    assert (error <= 1e-14 * condition * (1 + scale.amax(-1, keepdim=True))).all()


@pytest.mark.parametrize("arm", ARMS)
def test_forward_dynamics_is_mass_matrix_and_bias(arm: Any) -> None:
    rig = every_kind(arm)
    q, qd, tau = states(rig.joints)
    loss = rig.gear_loss * tau.abs() * torch.tanh(qd / dynamics.SIGN_WIDTH)
    rhs = rig.torque_gain * (tau - loss) + rig.torque_offset - rig.bias(q, qd)
    expected = torch.linalg.solve(rig.mass_matrix(q), rhs)
    torch.testing.assert_close(rig(q, qd, tau), expected, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(rig.inverse_dynamics(q, qd, expected), tau, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("arm", ARMS)
def test_gravity_is_the_gradient_of_the_potential_and_the_bias_at_rest(arm: Any) -> None:
    rig = every_kind(arm)
    q = states(rig.joints)[0].requires_grad_()
    (gradient,) = torch.autograd.grad(rig.energy(q, torch.zeros_like(q))[1].sum(), q)
    torch.testing.assert_close(rig.gravity(q), gradient)
    torch.testing.assert_close(rig.bias(q, torch.zeros_like(q)), gradient)


@pytest.mark.parametrize("arm", ARMS)
def test_bias_follows_from_the_energies(arm: Any) -> None:
    """Lagrange: bias = d/dt(dT/dqd) at qdd = 0 - d(T - V)/dq, by differentiating the energies."""
    rig = rigs.tlrip(arm, FULL_TENSOR)
    rig = rig.replace(armature=torch.full((rig.joints,), 0.01).double())

    def momentum(q: Tensor, qd: Tensor) -> Tensor:
        return (rig.mass_matrix(q) @ qd[:, None])[:, 0]

    def lagrangian(q: Tensor, qd: Tensor) -> Tensor:
        kinetic, potential = rig.energy(q, qd)
        return kinetic - potential

    q, qd, _ = states(rig.joints, ())
    _, momentum_rate = torch.func.jvp(lambda x: momentum(x, qd), (q,), (qd,))
    expected = momentum_rate - torch.func.grad(lagrangian)(q, qd)
    torch.testing.assert_close(rig.bias(q, qd), expected, rtol=1e-11, atol=1e-11)
    torch.testing.assert_close(torch.func.grad(lagrangian, argnums=1)(q, qd), momentum(q, qd))


def test_load_at_rest_is_one_hanging_and_zero_horizontal() -> None:
    rig = rigs.tlrip("free")
    still = torch.zeros(4).double()
    torch.testing.assert_close(rig.load(still, still), torch.ones(4).double())
    level = torch.tensor([0.3, torch.pi / 2, 0, 0]).double()
    expected = torch.tensor([1.0, 0, 0, 0]).double()
    torch.testing.assert_close(rig.load(level, still), expected, atol=1e-7, rtol=0)
    # A swing through hanging adds m l qd^2: N / (m g) = 1 + l qd^2 / g.
    hanging, qd = torch.tensor([0, torch.pi, 0, 0]).double(), torch.tensor([9.0, 2, 0, 0]).double()
    swing = 1 + 0.2675 / 2 * 4 / 9.81
    assert rig.load(hanging, qd)[1].item() == pytest.approx(swing)


def test_damping_of_one_joint_gives_the_papers_stability_bounds() -> None:
    bound = 2.785 / (1e-3 * rigs.tlrip().decay_rate(torch.eye(3).double()))
    torch.testing.assert_close(bound, torch.tensor([247.0, 77, 77]).double(), rtol=0.01, atol=0)


@pytest.mark.parametrize("arm", ARMS)
def test_decay_rates_bound_random_poses(arm: Any) -> None:
    rig = every_kind(arm)
    q, _, _ = states(rig.joints, (2000,))
    damping = torch.rand(4, rig.joints, generator=torch.Generator().manual_seed(2)).double()
    damping = torch.cat([damping, torch.eye(rig.joints).double()])
    for slopes in damping:
        gear = rig.torque_gain * (1.0 + rig.gear_loss)
        found = torch.linalg.inv(rig.mass_matrix(q)) @ torch.diag(gear * slopes)
        fastest = torch.linalg.eigvals(found).real.amax()
        # The grid's steps of 15 degrees for three angles miss the maximum by at most one percent.
        assert fastest <= 1.01 * rig.decay_rate(slopes)
        assert fastest >= 0.8 * rig.decay_rate(slopes)
    together = rig.decay_rate(damping)
    torch.testing.assert_close(together, torch.stack([rig.decay_rate(d) for d in damping]))


def test_decay_rates_of_a_long_chain_use_few_poses() -> None:
    rig = PendulumChain([0.1] * 20, [0.1] * 20, inertia=[1e-4] * 20)
    damping = torch.ones(20).double()
    straight = torch.linalg.inv(rig.mass_matrix(torch.zeros(20).double()))
    assert rig.decay_rate(damping) >= torch.linalg.eigvalsh(straight).amax()


def test_decay_rates_depend_on_the_values_of_the_plant() -> None:
    rig, ones = rigs.multiarm_double(), torch.ones(2).double()
    before = rig.decay_rate(ones)
    rig.inertia_coupling *= 2.0
    torch.testing.assert_close(rig.decay_rate(ones), before / 2.0)
    heavy = rig.replace(inertia_coupling=4.0 * rig.inertia_coupling)
    torch.testing.assert_close(heavy.decay_rate(ones), before / 8.0)
    torch.testing.assert_close(rig.decay_rate(ones), before / 2.0)
    # With negative damping nothing decays, and NaN damping gives NaN.
    torch.testing.assert_close(rig.decay_rate(ones - torch.tensor([0.0, 3.0])),
                               rig.decay_rate(torch.tensor([1.0, 0.0]).double()))  # fmt: skip
    assert rig.decay_rate(ones * torch.nan).isnan()
    assert rig.decay_rate(ones * torch.inf).isinf()


@pytest.mark.parametrize("arm", [ARMS[0], pytest.param(ARMS[1], marks=pytest.mark.slow)])
def test_forward_and_reverse_gradients_agree(arm: Any) -> None:
    rig = with_encoders(every_kind(arm))
    names = ["inertia_coupling", "gravity_moment", "armature", "angle_offset", "torque_offset"]
    names += ["torque_gain", "gear_loss", "encoder_cosine", "encoder_sine"]
    names += ["arm_inertia", "arm_lever", "inertia_tensor"] if rig.first_link else []
    names += [] if rig.first_link else ["drag_linear", "drag_quadratic", "length"]
    values = [getattr(rig, name).clone() for name in names]

    def acceleration(q: Tensor, qd: Tensor, tau: Tensor, *buffers: Tensor) -> Tensor:
        return rig.replace(**dict(zip(names, buffers, strict=True)))(q, qd, tau)

    inputs = [x.requires_grad_() for x in (*states(rig.joints, (1,)), *values)]
    assert torch.autograd.gradcheck(acceleration, inputs, check_forward_ad=True)


@pytest.mark.parametrize("arm", ARMS)
def test_replaced_buffers_broadcast_over_the_batch(arm: Any) -> None:
    rig = every_kind(arm)
    scales = torch.tensor([0.9, 1.0, 1.2]).double()
    swapped = {
        name: torch.stack([scale * buffer for scale in scales])[:, None]
        for name, buffer in rig.named_buffers()
        if not (rig.first_link and name.startswith("drag"))
    }
    batched = rig.replace(**swapped)
    q, qd, tau = states(rig.joints, (3, 5))
    scales, rates = torch.rand(rig.joints, generator=torch.Generator().manual_seed(2)).double(), []
    for p in range(3):
        one = rig.replace(**{name: value[p, 0] for name, value in swapped.items()})
        at = q[p], qd[p], tau[p]
        torch.testing.assert_close(batched(q, qd, tau)[p], one(*at))
        torch.testing.assert_close(batched.mass_matrix(q)[p], one.mass_matrix(q[p]))
        torch.testing.assert_close(batched.gravity(q)[p], one.gravity(q[p]))
        torch.testing.assert_close(batched.bias(q, qd)[p], one.bias(q[p], qd[p]))
        torch.testing.assert_close(batched.load(q, qd)[p], one.load(q[p], qd[p]))
        torch.testing.assert_close(batched.energy(q, qd)[0][p], one.energy(q[p], qd[p])[0])
        rates.append(one.decay_rate(scales))
    torch.testing.assert_close(batched.decay_rate(scales), torch.stack(rates).amax())


def test_a_single_link_keeps_the_batch() -> None:
    rig = PendulumChain([1.0], [1.0])
    q, qd, tau = states(1, (2, 4))
    assert rig.mass_matrix(q).shape == (2, 4, 1, 1)
    assert rig(q, qd, tau).shape == rig.load(q, qd).shape == rig.gravity(q).shape == (2, 4, 1)
    assert rig.energy(q, qd)[0].shape == (2, 4)


def test_replace_keeps_the_original_and_refuses_unknown_names() -> None:
    rig = rigs.tlrip()
    before = {name: value.clone() for name, value in rig.named_buffers()}
    changed = rig.replace(torque_offset=torch.ones(3).double(), drag_linear=torch.ones(3).double())
    assert changed.has_drag
    assert not rig.has_drag
    assert changed.inertia_coupling is rig.inertia_coupling
    for name, value in rig.named_buffers():
        assert torch.equal(value, before[name])
    with pytest.raises(ValueError, match=r"no buffer `mass`.*gravity_moment"):
        rig.replace(mass=torch.ones(3))
    with pytest.raises(ValueError, match=r"\(\*batch, 3, 3\)"):
        rig.replace(inertia_coupling=torch.ones(3))
    with pytest.raises(TypeError, match="tensor"):
        rig.replace(armature=[1.0, 1, 1])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="only for a fixed arm"):
        rigs.tlrip("free").replace(drag_linear=torch.ones(3))


@pytest.mark.parametrize("arm", [ARMS[0], pytest.param(ARMS[1], marks=pytest.mark.slow)])
def test_export_traces_to_core_operations(arm: Any) -> None:
    rig = with_encoders(every_kind(arm))
    program = torch.export.export(rig, states(rig.joints, (7,), seed=1)).run_decompositions()
    other = states(rig.joints, (7,), seed=2)
    torch.testing.assert_close(program.module()(*other), rig(*other), rtol=1e-12, atol=1e-12)
    calls = [node.target for node in program.graph.nodes if node.op == "call_function"]
    core = [c for c in calls if torch.Tag.core in getattr(c, "tags", ())]
    plain = {c for c in calls if c not in core and "getitem" not in str(c)}
    assert not plain


def test_buffers_replaced_by_one_tensor_keep_their_names() -> None:
    rig, both = rigs.tlrip(), torch.full((3,), 0.02, dtype=torch.float64)
    names = {"drag_linear": both, "drag_quadratic": both}
    dragged = rig.replace(**names)
    assert list(dict(dragged.named_buffers())) == list(dict(rig.named_buffers()))
    apart = rig.replace(**{name: value.clone() for name, value in names.items()})
    assert dragged.to_dict() == apart.to_dict()
    assert dragged.replace(drag_linear=both).has_drag


def test_replace_keeps_gears_and_refuses_gears_that_generate_power() -> None:
    rig, loss = rigs.tlrip(), torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    at = states(3)
    lossy = rig.replace(gear_loss=loss)
    again = lossy.replace(angle_offset=torch.zeros(3, dtype=torch.float64))
    assert torch.equal(again(*at), lossy(*at))
    assert not torch.equal(again(*at), rig(*at))
    for name, bad in (("gear_loss", 1.0), ("gear_loss", -0.1), ("torque_gain", 0.0)):
        data = rig.to_dict() | {"buffers": {name: [bad] * 3}}
        with pytest.raises(ValueError, match=f"`{name}`.* must be"):
            PendulumChain.from_dict(data)
    with pytest.raises(ValueError, match="`torque_offset` must be finite"):
        PendulumChain.from_dict(rig.to_dict() | {"buffers": {"torque_offset": [float("nan")] * 3}})


def test_dtype_follows_the_buffers() -> None:
    rig = rigs.tlrip("free").float()
    q, qd, tau = (x.float() for x in states(4))
    assert rig(q, qd, tau).dtype == torch.float32
    exact = rigs.tlrip("free")(q.double(), qd.double(), tau.double())
    torch.testing.assert_close(rig(q, qd, tau).double(), exact, rtol=1e-3, atol=1e-2)


def test_round_trip_through_plain_numbers() -> None:
    for rig in (rigs.tlrip("free", FULL_TENSOR), every_kind("fixed"), rigs.multiarm_triple()):
        again = PendulumChain.from_dict(json.loads(json.dumps(rig.to_dict())))
        for (name, value), (_, other) in zip(
            rig.named_buffers(), again.named_buffers(), strict=True
        ):
            assert torch.equal(value, other), name
        assert repr(again) == repr(rig)
        assert ("buffers" in rig.to_dict()) == rig.has_drag
        assert again.joint_names == rig.joint_names
        assert again.convention == rig.convention


def test_chain_formula_of_the_multiarm_bench() -> None:
    """A_ii = I_i + m_i a_i^2 + later masses L_i^2, and so on, as in the source."""
    rig = rigs.multiarm_triple()
    m, a = np.array([0.258172, 0.279428, 0.118624]), np.array([0.16, 0.202939, 0.183709])
    length, inertia = np.array([0.1728, 0.2287, 0.0]), [1.00043e-4, 3.14160e-4, 1.68739e-4]
    for i in range(3):
        later = m[i + 1 :].sum()
        assert rig.inertia_coupling[i, i].item() == pytest.approx(
            inertia[i] + m[i] * a[i] ** 2 + later * length[i] ** 2, rel=1e-14
        )
        moment = 9.80834 * (m[i] * a[i] + later * length[i])
        assert rig.gravity_moment[i].item() == pytest.approx(moment, rel=1e-14)
        for j in range(i + 1, 3):
            beyond = m[j] * a[j] + m[j + 1 :].sum() * length[j]
            assert rig.inertia_coupling[i, j].item() == pytest.approx(length[i] * beyond, rel=1e-14)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"mass": [1.0, -1.0]}, "`mass` must be positive"),
        ({"mass": []}, "`mass` must be one or more numbers"),
        ({"mass": "heavy"}, "`mass` must be one or more numbers"),
        ({"length": [1.0]}, "`length` must be a list of 2"),
        ({"com": [float("nan"), 1.0]}, "`com` must be finite"),
        ({"com": [0.5, 0.0]}, "positive definite"),
        ({"inertia": [1.0, 1.0, 1.0]}, "`inertia` must be None"),
        ({"inertia": [0.0, -0.5]}, "positive definite"),
        ({"gravity": 0.0}, "`gravity` must be at least 1e-06.*write 1e-06 .*rotor"),
        ({"gravity": 5e-324}, "`gravity` must be at least 1e-06"),
        ({"armature": [0.0, -1.0]}, "`armature` must not be negative"),
        ({"convention": ("absolute", "down")}, "`convention` must be"),
        ({"joint_names": ["a", "a"]}, "different names"),
        ({"position_quantum": -1.0}, "`position_quantum` must be positive"),
    ],
)
@pytest.mark.filterwarnings("ignore:the inertia of link")
def test_bad_parameters_are_refused(kwargs: dict[str, Any], message: str) -> None:
    good: dict[str, Any] = {"mass": [1.0, 1.0], "length": [1.0, 1.0]}
    with pytest.raises(ValueError, match=message):
        PendulumChain(**(good | kwargs))


def test_impossible_inertia_warns_and_wrong_shapes_are_refused() -> None:
    with pytest.warns(UserWarning, match=r"link \[2\].*no rigid body"):
        rig = PendulumChain([1.0, 1.0], [1.0, 1.0], inertia=[0.1, -0.01])
    with pytest.raises(ValueError, match=r"`qd` must be \(\*batch, 2\)"):
        rig.bias(torch.zeros(2), torch.zeros(3))
    with pytest.raises(ValueError, match="`q` must be"):
        rig.mass_matrix(torch.tensor(1.0))
    with pytest.raises(ValueError, match="arm's inertia"):
        Arm(inertia=0.0, length=1.0)


def test_bearing_carries_all_outboard_links() -> None:
    """Newton's law of the mass centres, at the accelerations of the frictionless motion."""
    mass, length, com = [0.5, 0.4, 0.2], [0.3, 0.25, 0.2], [0.1, 0.2, 0.05]
    rig = PendulumChain(mass, length, com, [1e-3] * 3, normal_load="bearing")
    random = torch.Generator().manual_seed(3)
    q, qd = (torch.randn(3, generator=random, dtype=torch.float64) for _ in range(2))
    qdd = rig.forward_dynamics(q, qd, torch.zeros_like(q))

    def centres(time: torch.Tensor) -> torch.Tensor:
        angle = (q + time * qd + 0.5 * time**2 * qdd).cumsum(0)
        along = torch.stack([angle.sin(), angle.cos()], -1)
        reach = along * torch.tensor(length)[:, None]
        return reach.cumsum(0) - reach + along * torch.tensor(com)[:, None]

    turning = torch.func.jacfwd(torch.func.jacfwd(centres))(torch.zeros((), dtype=torch.float64))
    force = torch.tensor(mass)[:, None] * (turning + torch.tensor([0.0, 9.81]))
    carried, weight = (x.flip(0).cumsum(0).flip(0) for x in (force, 9.81 * torch.tensor(mass)))
    torch.testing.assert_close(rig.load(q, qd), carried.norm(dim=-1) / weight)
    still, hanging = torch.zeros(3).double(), torch.tensor([torch.pi, 0.0, 0.0]).double()
    torch.testing.assert_close(rig.load(hanging, still), torch.ones(3).double())
    again = PendulumChain.from_dict(json.loads(json.dumps(rig.to_dict())))
    assert torch.equal(again.load(q, qd), rig.load(q, qd))
    with pytest.raises(ValueError, match="normal_load"):
        PendulumChain([1.0], [1.0], arm=Arm(0.1, 0.2), normal_load="bearing")
