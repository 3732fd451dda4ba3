"""The cache of compiled rollouts: a structure compiles once, and is never used for another."""

import functools
import sys
import types

import numpy as np
import pytest
import torch

from nfriction import LFM, NFLFM, PendulumChain, codegen, rollout
from nfriction.friction.coefficients import Constant
from nfriction.friction.laws import LINEAR, Law, linear
from nfriction.friction.models import FrictionModel
from nfriction.simulation import compiled

F64 = torch.float64
CHAIN, LINK = PendulumChain([0.3, 0.2], [0.2, 0.15]), PendulumChain([0.3], [0.2])
Q0 = torch.tensor([2.2, 0.6], dtype=F64)
QD0 = torch.tensor([3.0, -2.0], dtype=F64)


@pytest.fixture
def compilations(monkeypatch):
    """An empty cache, and a list that grows with every compilation."""
    made = []

    def check(rollout, eager):
        made.append(rollout)
        original(rollout, eager)

    original = codegen.CompiledRollout.check
    monkeypatch.setattr(codegen.CompiledRollout, "check", check)
    for name in ("_known", "_compiled_graphs", "_warned"):
        monkeypatch.setattr(compiled, name, type(getattr(compiled, name))())
    return made


def both(model, plant=CHAIN, **settings):
    """Compiled and eager end of a short run, which must agree."""
    start = Q0[: plant.joints], QD0[: plant.joints]
    ends = [
        rollout(plant, model, *start, steps=40, gradients=False, backend=b, **settings).q
        for b in ("auto", "torch")
    ]
    torch.testing.assert_close(*ends, rtol=0, atol=1e-12)
    return ends[0]


def test_structure_compiles_once_and_uses_current_values(compilations):
    model = LFM(2, [1e-3, 2e-3], v_smooth=0.05)
    first = both(model)
    model.schedule.set_coefficients([2e-2, 1e-2])
    changed = both(model)
    other = both(LFM(2, [1e-3, 2e-3], v_smooth=0.05), PendulumChain([0.1, 0.2], [0.3, 0.1]))
    assert len(compilations) == 1
    assert not torch.allclose(first, changed, atol=1e-6)
    assert not torch.allclose(first, other, atol=1e-6)
    # The first model's values are used again, although another was simulated in between.
    model.schedule.set_coefficients([1e-3, 2e-3])
    torch.testing.assert_close(both(model), first, rtol=0, atol=1e-15)
    assert len(compilations) == 1


def test_replaced_buffers_are_used(compilations):
    model = LFM(2, [1e-3, 2e-3], v_smooth=0.05)
    first = both(model)
    lighter = both(model, CHAIN.replace(gravity_moment=0.5 * CHAIN.gravity_moment))
    assert len(compilations) == 1
    assert not torch.allclose(first, lighter, atol=1e-4)
    # Zero drag is omitted from the code, so nonzero drag needs separate code.
    both(model, CHAIN.replace(drag_quadratic=torch.tensor([0.5, 0.5], dtype=F64)))
    assert len(compilations) == 2


def half(qd, load, coefficients, v_smooth):
    return 0.5 * linear(qd, load, coefficients, v_smooth)


def scaled(qd, load, coefficients, v_smooth, factor):
    return factor * linear(qd, load, coefficients, v_smooth)


def test_changed_constants_recompile(compilations):
    def model(torque, v_smooth=0.05):
        law = Law("user", LINEAR.coefficients, torque)
        return FrictionModel(law, Constant(law, 2, [1e-2, 1e-2]), v_smooth)

    ends = [
        both(model(linear)),
        both(model(linear, 0.5)),
        both(model(half, 0.5)),
        both(model(functools.partial(scaled, factor=0.25), 0.5)),
        both(model(functools.partial(scaled, factor=4.0), 0.5)),
    ]
    assert len(compilations) == len(ends)
    for i, a in enumerate(ends):
        for b in ends[i + 1 :]:
            assert not torch.allclose(a, b, rtol=0, atol=1e-8)


EXPONENT = 2.0
GAINS = types.ModuleType("gains")
GAINS.damping = 1e-2


class Grease:
    """Attributes used by a law."""

    scale = 1.0

    def __init__(self):
        self.viscosity = {"cold": [2e-2]}
        self.table = np.full(5_000, 1e-2)
        self.memo = iter([1e-2])  # cannot be compared

    def at(self, i):
        return float(self.table[i])


def shaped(qd):
    return qd * qd.abs() ** (EXPONENT - 1.0)


def by_global(qd, load, coefficients, v_smooth):
    return coefficients[..., 0] * shaped(qd)


def by_module(qd, load, coefficients, v_smooth):
    return coefficients[..., 0] * GAINS.damping * qd


def by_closure(grease):
    settings = {"gain": 2e-2}

    def torque(qd, load, coefficients, v_smooth):
        return coefficients[..., 0] * settings["gain"] * qd

    return torque, lambda: settings.update(gain=1.0)


def by_attribute(grease):
    def torque(qd, load, coefficients, v_smooth):
        return coefficients[..., 0] * grease.viscosity["cold"][0] * qd

    return torque, lambda: grease.viscosity["cold"].__setitem__(0, 1.0)


def by_array(grease):
    def torque(qd, load, coefficients, v_smooth):
        return coefficients[..., 0] * grease.at(2_500) * qd

    return torque, lambda: grease.table.__setitem__(2_500, 1.0)


def by_class(grease):
    def torque(qd, load, coefficients, v_smooth):
        return coefficients[..., 0] * (grease.viscosity["cold"][0] * grease.scale) * qd

    return torque, lambda: setattr(Grease, "scale", 30.0)


@pytest.mark.parametrize("comparable", [True, False])
@pytest.mark.parametrize("case", ["global", "module", "closure", "attribute", "array", "class"])
def test_changed_constants_of_a_user_defined_law_are_used(
    case, comparable, compilations, monkeypatch, caplog
):
    """Wherever Python stores a constant, a changed one is simulated, and a restored one is
    recognised."""
    monkeypatch.setattr(Grease, "scale", 1.0)
    grease = Grease()
    if comparable:
        del grease.memo
    if case in ("global", "module"):
        torque = {"global": by_global, "module": by_module}[case]
        name, owner = {"global": ("EXPONENT", sys.modules[__name__]),
                       "module": ("damping", GAINS)}[case]  # fmt: skip
        change = functools.partial(monkeypatch.setattr, owner, name, 1.0)
    else:
        torque, change = globals()[f"by_{case}"](grease)
    law = Law("user", LINEAR.coefficients, torque)
    model = FrictionModel(law, Constant(law, 1, [1e-2, 1e-2]))
    model.grease = grease
    before = both(model, LINK)
    both(model, LINK)
    assert len(compilations) == 1
    change()
    after = both(model, LINK)
    assert not torch.allclose(before, after, rtol=0, atol=1e-5)
    # Also for a new model of the same law.
    same = FrictionModel(law, Constant(law, 1, [1e-2, 1e-2]))
    torch.testing.assert_close(both(same, LINK), after, rtol=0, atol=1e-15)
    assert len(compilations) == 2
    assert ("list_iterator" in caplog.text) != comparable
    assert caplog.text.count("traced again in every call") == (not comparable)


def test_tables_that_are_no_buffers_are_distinguished(compilations):
    class Table(torch.nn.Module):
        joints = 2

        def __init__(self, *entries):
            super().__init__()
            self.table = [torch.tensor(entries, dtype=F64)]

        def coefficients(self, qd, qdd):
            return self.table[0].expand(2, 2)

        def torque(self, qd, load, coefficients):
            return coefficients[..., 0] * qd + coefficients[..., 1] * torch.tanh(qd)

        def zero_velocity_damping(self):
            return self.table[0].sum().expand(2)

    model = Table(1e-3, 1e-3)
    both(model)
    both(Table(1e-3, 1e-3))
    assert len(compilations) == 1
    model.table[0].mul_(10.0)  # in place: the same object, other values
    both(model)
    assert len(compilations) == 2


def test_motion_dependent_models_with_other_terms_are_distinguished(compilations):
    both(NFLFM(2, terms=(2, 2), head_units=2))
    both(NFLFM(2, terms=(3, 2), head_units=2))
    both(NFLFM(2, terms=(2, 2), head_units=2, acceleration="signed"))
    assert len(compilations) == 3


def test_old_structures_are_evicted(compilations, monkeypatch):
    monkeypatch.setattr(compiled, "KEPT", 1)
    both(LFM(2, v_smooth=0.1))
    both(LFM(2, v_smooth=0.2))
    both(LFM(2, v_smooth=0.1))
    assert len(compilations) == 3
    assert len(compiled._known) == len(compiled._compiled_graphs) == 1


def test_the_error_lists_valid_backends():
    with pytest.raises(ValueError, match=r"'auto', 'compiled', 'torch'"):
        rollout(CHAIN, LFM(2, v_smooth=0.05), Q0, QD0, steps=5, backend="numba")


def test_operation_without_scalar_form_uses_the_eager_fallback(compilations, caplog):
    def torque(qd, load, coefficients, v_smooth):
        return coefficients[..., 0] * torch.special.i0(qd * 0.1) * torch.tanh(qd)

    law = Law("bessel", LINEAR.coefficients, torque)
    model = FrictionModel(law, Constant(law, 2, [1e-3, 1e-3]))
    both(model)
    both(model)
    assert caplog.text.count("eager torch") == 1
    with pytest.raises(codegen.UnsupportedOperation, match="i0"):
        rollout(CHAIN, model, Q0, QD0, steps=5, gradients=False, backend="compiled")


def test_single_precision_and_plain_objects_run_in_torch(compilations):
    both(LFM(2, v_smooth=0.05).float())

    class Nothing:
        joints = 2

        def coefficients(self, qd, qdd):
            return torch.zeros(2, 1, dtype=F64)

        def torque(self, qd, load, coefficients):
            return torch.zeros_like(qd)

        def zero_velocity_damping(self):
            return torch.zeros(2, dtype=F64)

    torch.testing.assert_close(both(Nothing()), both(None), rtol=0, atol=1e-12)
    assert len(compilations) == 1
    for model in (LFM(2, v_smooth=0.05).float(), Nothing()):
        with pytest.raises(codegen.CodegenError, match="compiled"):
            rollout(CHAIN, model, Q0, QD0, steps=5, gradients=False, backend="compiled")


def test_batch_of_plants_is_simulated(compilations):
    """Buffers with a batch dimension broadcast with the states, compiled or not."""
    factor = torch.tensor([0.5, 1.0], dtype=F64)[:, None]
    plant = CHAIN.replace(gravity_moment=factor * CHAIN.gravity_moment)
    together = both(LFM(2, v_smooth=0.05), plant)
    assert together.shape == (2, 41, 2)
    torch.testing.assert_close(together[1], both(LFM(2, v_smooth=0.05)), rtol=0, atol=1e-12)
