"""The papers' fuzzy controller: rule table, min and max, centroid; differentiable and batched."""

from importlib import resources
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn

from nfriction.papers.controller.rules import ANY, SI_FACTOR, RuleBase, parse_rules

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_CELLS = 81  # cells of a map along each axis
_SAMPLES_AT_ONCE = 512  # their clipped output sets fit into a core's cache


class MamdaniController(nn.Module):
    """Mamdani inference: AND = min, implication = min, aggregation = max, centroid.

    Inputs outside their universe are clamped to its edge; NaN stays NaN. If no rule fires (sets
    with gaps), an output is the middle of its universe.

    Args:
        points: number of evenly spaced points of each output universe, including both ends.
        centroid: "trapezoid" (integral by the trapezoid rule) or "sum" (plain sum over the points,
            as in MATLAB).

    References:
        Mamdani and Assilian (1975). TLRIP paper, Tables 4 and 5.
    """

    lower: Tensor
    upper: Tensor
    si_factor: Tensor
    antecedents: Tensor
    rules_of_term: Tensor
    weights: Tensor
    output_sets: Tensor
    moments: Tensor
    middle: Tensor

    def __init__(self, rules: RuleBase, *, points: int = 101, centroid: str = "trapezoid") -> None:
        super().__init__()
        if not 2 <= points <= 100_000:
            raise ValueError(f"`points` must be 2 to 100000, got {points}.")
        if centroid not in ("trapezoid", "sum"):
            raise ValueError(f'`centroid` is "trapezoid" or "sum", got {centroid!r}.')
        self.rule_base = rules
        self.inputs, self.outputs = len(rules.inputs), len(rules.outputs)
        float64 = torch.float64
        universes = torch.tensor([variable.universe for variable in rules.inputs], dtype=float64)
        self.register_buffer("lower", universes[:, 0].clone())
        self.register_buffer("upper", universes[:, 1].clone())
        factors = [SI_FACTOR[variable.unit] for variable in rules.inputs]
        self.register_buffer("si_factor", torch.tensor(factors, dtype=float64))
        antecedents, rules_of_term = _rule_indices(rules)
        self.register_buffer("antecedents", antecedents)
        self.register_buffer("rules_of_term", rules_of_term)
        weights = torch.tensor([rule.weight for rule in rules.rules], dtype=float64)
        self.register_buffer("weights", weights.unsqueeze(1))
        ends = torch.tensor([variable.universe for variable in rules.outputs], dtype=float64)
        shapes, moments = _output_sets(rules, ends, points, centroid)
        self.register_buffer("output_sets", shapes)
        self.register_buffer("moments", moments)
        self.register_buffer("middle", ends.mean(1))

    def forward(self, qd_abs: Tensor, qdd: Tensor) -> Tensor:
        """Outputs of a two-input controller, with inputs in SI units.

        Args:
            qd_abs: |joint velocity| [rad/s], any shape.
            qdd: joint acceleration [rad/s^2], same shape.
        Returns:
            Outputs (B [N m s/rad] and C [N m] in the papers), shape (*batch, outputs).
        """
        return self.infer(torch.stack([qd_abs, qdd], -1) / self.si_factor)

    def infer(self, x: Tensor) -> Tensor:
        """Outputs (*batch, outputs) of inputs (*batch, inputs) in the rule base's own units."""
        strengths = self._rule_strengths(x)
        # Each term's set is clipped once, at the strength of its strongest rule, which is a fifth
        # of the work of clipping it for every rule. Terms with fewer rules point to a zero row.
        padded = torch.cat([strengths, torch.zeros_like(strengths[:1])])
        strengths = padded[self.rules_of_term].amax(2)
        blocks = strengths.split(_SAMPLES_AT_ONCE, -1)
        y = torch.cat([self._defuzzify(block) for block in blocks], 0)
        return y.reshape(x.shape[:-1] + self.middle.shape)

    def _rule_strengths(self, x: Tensor) -> Tensor:
        """Strengths (rules, samples): smallest membership of a rule's terms, times its weight."""
        clamped = torch.clamp(x.reshape(-1, self.inputs), self.lower, self.upper)
        strengths = self.weights
        for i, variable in enumerate(self.rule_base.inputs):
            held = [term(clamped[:, i]) for term in variable.sets]
            # A row of ones for rules that do not use this input.
            asked = torch.stack([*held, torch.ones_like(held[0])])[self.antecedents[i]]
            strengths = asked if i == 0 else torch.minimum(strengths, asked)
        return strengths * self.weights

    def _defuzzify(self, strengths: Tensor) -> Tensor:
        """Centroids (samples, outputs) of the clipped sets."""
        clipped = torch.minimum(strengths.unsqueeze(2), self.output_sets.unsqueeze(3))
        moments = torch.bmm(self.moments, clipped.amax(1))
        area, moment = moments[:, 0], moments[:, 1]
        # If no rule fires: the middle of the universe, without division by zero in the gradient.
        empty = area == 0
        offset = torch.where(empty, 0.0, moment / torch.where(empty, 1.0, area))
        return offset.T + self.middle


def paper_controller(
    joint: int, *, points: int = 101, centroid: str = "trapezoid"
) -> MamdaniController:
    """The TLRIP paper's controller of B and C for its joint 2, 3 or 4 (linear friction model).

    The rules are printed for joint 2 and used for all three; the C terms of NM x VF and ZE x VF
    (both L) are our best reading of the print.

    References:
        TLRIP paper, Table 4 (sets) and Table 5 (rules).
    """
    if joint not in (2, 3, 4):
        raise ValueError(f"the paper has controllers for joints 2, 3 and 4, got {joint}.")
    file = resources.files("nfriction.papers.controller") / "data" / f"joint{joint}.json"
    rules = parse_rules(file.read_text(encoding="utf-8"), file.name)
    return MamdaniController(rules, points=points, centroid=centroid)


def _rule_indices(rules: RuleBase) -> tuple[Tensor, Tensor]:
    """Term of each input by rule (inputs, rules), and rules by output term, padded."""
    antecedents = [
        [
            # "Any" points past the terms, to a row of ones.
            len(variable.terms) if rule.given[i] == ANY else variable.terms.index(rule.given[i])
            for rule in rules.rules
        ]
        for i, variable in enumerate(rules.inputs)
    ]
    speaking = [
        [
            [number for number, rule in enumerate(rules.rules) if rule.then[o] == term]
            for term in variable.terms
        ]
        for o, variable in enumerate(rules.outputs)
    ]
    terms = max(len(output) for output in speaking)
    most = max(len(numbers) for output in speaking for numbers in output)
    # Padding points past the rules, to a row of zeros, which does not affect a maximum.
    padded = torch.full((len(speaking), terms, most), len(rules.rules))
    for o, output in enumerate(speaking):
        for t, numbers in enumerate(output):
            padded[o, t, : len(numbers)] = torch.tensor(numbers, dtype=torch.long)
    return torch.tensor(antecedents), padded


def _output_sets(
    rules: RuleBase, ends: Tensor, points: int, centroid: str
) -> tuple[Tensor, Tensor]:
    """Output sets on their universes (outputs, terms, points), and weights of area and moment."""
    terms = max(len(variable.sets) for variable in rules.outputs)
    shapes = torch.zeros(len(rules.outputs), terms, points, dtype=ends.dtype)
    moments = torch.empty(len(rules.outputs), 2, points, dtype=ends.dtype)
    for o, variable in enumerate(rules.outputs):
        universe = torch.linspace(*variable.universe, points, dtype=ends.dtype)
        shapes[o, : len(variable.sets)] = torch.stack([term(universe) for term in variable.sets])
        weights = torch.ones_like(universe)
        if centroid == "trapezoid":
            # The spacing cancels out in the centroid.
            weights[0] = weights[-1] = 0.5
        # About the middle, so that no digits are lost if the universe is far from zero.
        offset = universe - 0.5 * (universe[0] + universe[-1])
        moments[o] = torch.stack([weights, weights * offset])
    return shapes, moments


def controller_surface(controller: MamdaniController) -> "Figure":
    """Maps of a controller's outputs over its two inputs in SI, one per output.

    Raises:
        ValueError: if the controller does not have two inputs.
    """
    from nfriction.plots import style  # matplotlib is slow to import
    from nfriction.plots.neurofuzzy import draw_map

    rules = controller.rule_base
    if len(rules.inputs) != 2:
        raise ValueError(f"a map needs two inputs, the controller has {len(rules.inputs)}.")
    grids = [np.linspace(*variable.universe, _CELLS) for variable in rules.inputs]
    with torch.no_grad():
        values = controller.infer(torch.as_tensor(np.stack(np.meshgrid(*grids), -1))).numpy()
    x, y = (grid * float(si) for grid, si in zip(grids, controller.si_factor, strict=True))
    # The controller converts degrees to radians; dimensionless inputs are unchanged.
    labels = [
        f"{variable.name} [{variable.unit.replace('deg', 'rad').replace('^2', '²')}]"
        for variable in rules.inputs
    ]
    figure, axes = style.panels(1, len(rules.outputs), style.PAGE, 2.5, sharey=True)
    for k, (ax, output) in enumerate(zip(axes[0], rules.outputs, strict=True)):
        draw_map(ax, (x, y), values[..., k], label=(output.name, output.unit))
        ax.set_xlabel(labels[0])
    axes[0, 0].set_ylabel(labels[1])
    return figure
