"""The papers' own neuro-fuzzy procedure: coefficients by class → fuzzy controller → network."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from nfriction.friction import model_by_name, model_names
from nfriction.friction.laws import Law
from nfriction.friction.models import V_SMOOTH, FrictionModel
from nfriction.friction.neurofuzzy import NeuroFuzzyModel
from nfriction.fuzzy import FuzzySet, RBFNetwork, sets_from_ranges
from nfriction.papers.afem.adaptive import Adaptive
from nfriction.papers.controller.mamdani import MamdaniController, paper_controller
from nfriction.papers.controller.rules import Rule, RuleBase, Variable
from nfriction.papers.controller.samples import ControllerSamples, sampled
from nfriction.papers.nffem.evidence import EvidenceResult
from nfriction.papers.nffem.rbf_coefficients import RBFCoefficients
from nfriction.papers.nffem.train_network import DEFAULTS, TrainingOptions, train_network
from nfriction.signals import Motion

Ranges = list[tuple[float, float]]

# If classes agree, the universe of an output would be empty; it then has this relative width.
NARROWEST = 0.01


def papers_neuro_fuzzy(
    adaptive: FrictionModel,
    motions: Sequence[Motion],
    *,
    samples: int = 40_000,
    units: int = 10,
    options: TrainingOptions = DEFAULTS,
) -> tuple[NeuroFuzzyModel, list[EvidenceResult]]:
    """The neuro-fuzzy model of an adaptive one, by the papers' procedure.

    The coefficients by class define the output ranges of a fuzzy controller with the papers' rules,
    and the motion its input ranges; one radial basis network per joint is then trained on the
    controller's outputs along the measured motion, by Bayesian regularisation.

    Args:
        adaptive: fitted, with coefficients for each class of acceleration.
        motions: of the recordings that it was fitted to, in joint coordinates.
        samples: largest number per joint, evenly thinned from the motions.

    Returns:
        A model of the same law with the network as its schedule, without gradients, and the fit of
        each joint's network.

    Raises:
        ValueError: if the model is not adaptive, its law has no neuro-fuzzy model, or `samples` is
            not positive.

    References:
        TLRIP paper, neuro-fuzzy friction estimation (NFFEM).
    """
    if not isinstance(adaptive.schedule, Adaptive):
        raise ValueError(
            f"the papers' procedure starts from an adaptive model, got {type(adaptive).__name__}."
        )
    if samples < 1:
        raise ValueError(f"`samples` must be at least 1, got {samples}.")
    # Concatenated: the times are not used here.
    time, q, qd, qdd = (
        np.concatenate([getattr(m, key) for m in motions]) for key in ("time", "q", "qd", "qdd")
    )
    controllers = controllers_from_classes(adaptive.law, adaptive.schedule.values, qd, qdd)
    # Rounded up, so that the limit is respected.
    measured = sampled(
        controllers,
        Motion(time, q, qd, qdd),
        joint_names=[f"joint {k + 1}" for k in range(adaptive.joints)],
        every=-(-len(qd) // samples),
    )
    return train_on_samples(
        adaptive.law, controllers, measured, units=units, options=options,
        v_smooth=adaptive.v_smooth,
    )  # fmt: skip


def train_on_samples(
    law: Law,
    controllers: Sequence[MamdaniController],
    samples: ControllerSamples,
    *,
    units: int = 10,
    options: TrainingOptions = DEFAULTS,
    v_smooth: float = V_SMOOTH,
) -> tuple[NeuroFuzzyModel, list[EvidenceResult]]:
    """A model whose coefficients are radial basis networks trained on controllers' samples.

    Returns it, without gradients, and the fit of each joint's network. Each joint has a controller,
    in whose universe the model stays.

    Raises:
        ValueError: if the law has no neuro-fuzzy model.

    References:
        TLRIP paper, neuro-fuzzy friction estimation (2-10-2 networks, 40,000 samples per joint).
    """
    kinds = (model_by_name(name) for name in model_names())
    kind = next((k for k in kinds if issubclass(k, NeuroFuzzyModel) and k.definition is law), None)
    if kind is None:
        raise ValueError(f"there is no neuro-fuzzy model of the law {law.name!r}.")
    joints = len(controllers)
    network = RBFNetwork(joints, 2, units, len(law.names))
    # Units at samples, each where it best explains the residual of the others.
    network.init_ols(samples.x, samples.y, width=0.5)
    fits = train_network(network, samples.x, samples.y, options)
    model = kind(
        joints,
        samples.y.mean(0),
        v_smooth=v_smooth,
        head_units=units,
        acceleration="signed",
        network="rbf",
    )
    assert isinstance(model.schedule, RBFCoefficients)
    ends = [torch.stack([c.lower, c.upper]) * c.si_factor for c in controllers]
    inputs = torch.stack(ends, 1)
    outputs = torch.tensor([[v.universe for v in c.rule_base.outputs] for c in controllers])
    model.schedule.set_network(network, inputs, outputs.to(inputs).permute(2, 0, 1))
    return model.requires_grad_(False), fits


def controllers_from_classes(
    law: Law, coefficients: Tensor, qd: np.ndarray, qdd: np.ndarray
) -> list[MamdaniController]:
    """One fuzzy controller per joint, with the papers' rules and sets shaped as in their Table 4.

    The sets are those of Table 4 (joints 2, 3, 4; further joints use those of joint 2), stretched:
    for |velocity| to its largest value, for acceleration to its smallest and largest value with
    zero fixed, for each coefficient to the span of its classes. The papers' controllers raise a
    coefficient with the velocity; if ours is smaller for high acceleration than for low, its sets
    are mirrored. Viscous coefficients follow the rules of B, all others those of C.

    Args:
        law: whose coefficients these are.
        coefficients: low, medium, high, shape (joint, 3, coefficient).
        qd, qdd: the motion that defines the input ranges, (sample, joint).

    References:
        TLRIP paper, Tables 4 and 5.
    """
    controllers = []
    for joint in range(len(coefficients)):
        # The papers number these joints 2 to 4.
        paper = paper_controller(joint + 2 if joint < 3 else 2).rule_base
        velocity, acceleration = paper.inputs
        fastest = float(np.abs(qd[:, joint]).max())
        lowest, highest = float(qdd[:, joint].min()), float(qdd[:, joint].max())
        inputs = (
            _variable("velocity", "rad/s", velocity.terms, _stretched(velocity, 0.0, fastest)),
            _variable(
                "acceleration", "rad/s^2", acceleration.terms,
                _stretched(acceleration, lowest, highest),
            ),
        )  # fmt: skip
        # Viscous coefficients follow the rules of B, all others those of C.
        kinds = [0 if c.unit.startswith("N m s") else 1 for c in law.coefficients]
        outputs = []
        for k, (kind, coefficient) in enumerate(zip(kinds, law.coefficients, strict=True)):
            classes = coefficients[joint, :, k].tolist()
            terms, ranges = _spanned(paper.outputs[kind], classes, coefficient.positive)
            outputs.append(_variable(coefficient.name, coefficient.unit, terms, ranges))
        rules = tuple(
            Rule(rule.given, tuple(rule.then[kind] for kind in kinds)) for rule in paper.rules
        )
        name = f"{law.name} law, joint {joint + 1}, spanned by its classes"
        controllers.append(MamdaniController(RuleBase(name, inputs, tuple(outputs), rules)))
    return controllers


def _variable(name: str, unit: str, terms: Sequence[str], ranges: Ranges) -> Variable:
    universe = (ranges[0][0], ranges[-1][1])
    return Variable(name, unit, universe, sets_from_ranges(terms, ranges))


def _range(term: FuzzySet) -> tuple[float, float]:
    """The range in Table 4 that corresponds to a set, see `sets_from_ranges`."""
    centre, sigma = term.parameters
    reach = {"left_shoulder": (0.0, 2.0), "gaussian": (-2.0, 2.0), "right_shoulder": (-2.0, 0.0)}[
        term.shape
    ]
    return centre + reach[0] * sigma, centre + reach[1] * sigma


def _stretched(variable: Variable, low: float, high: float) -> Ranges:
    """Ranges of a variable's sets, with its universe stretched to [low, high] and zero fixed."""
    below, above = variable.universe
    # Velocity enters as a magnitude, so its universe begins at zero.
    down = low / below if below < 0 else 1.0
    up = high / above
    if not (down > 0 and up > 0):
        raise ValueError(
            f"the motion spans {variable.name} only from {low:g} to {high:g}; a controller needs "
            "it on both sides of zero."
        )
    return [
        (a * (down if a < 0 else up), b * (down if b < 0 else up))
        for a, b in map(_range, variable.sets)
    ]


def _spanned(
    variable: Variable, classes: Sequence[float], positive: bool
) -> tuple[list[str], Ranges]:
    """Terms and ranges of an output whose universe spans the coefficients by class."""
    low, high = min(classes), max(classes)
    # With equal classes, the universe would be empty.
    width = max(high - low, NARROWEST * max(abs(low), abs(high)), 1e-9)
    middle = 0.5 * (low + high)
    start = max(0.0, middle - 0.5 * width) if positive else middle - 0.5 * width
    below, above = variable.universe
    shares = [((a - below) / (above - below), (b - below) / (above - below))
              for a, b in map(_range, variable.sets)]  # fmt: skip
    terms = variable.terms
    # Terms keep their meaning: "high" denotes the larger coefficient.
    if classes[-1] < classes[0]:
        shares = [(1.0 - b, 1.0 - a) for a, b in reversed(shares)]
        terms = terms[::-1]
    return terms, [(start + width * a, start + width * b) for a, b in shares]
