"""Evolutionary tuning of a fuzzy controller: ranges and rules, error against number of rules.

Differential evolution (SciPy) varies the universes of inputs and outputs and the term that each
rule gives, and omits rules. The paper names evolutionary algorithms as its future work.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfriction.friction.laws import Law
from nfriction.fuzzy import FuzzySet
from nfriction.io.files import parse_json, write_atomically
from nfriction.papers.controller.mamdani import MamdaniController
from nfriction.papers.controller.rules import Variable

Array = NDArray[np.float64]

# Universes may grow and shrink by this factor.
STRETCH = 3.0


@dataclass(frozen=True, eq=False)
class TorqueSamples:
    """Motion of one joint and the friction torque that it implies.

    The torque of a smoothed motion contains acceleration noise, which may exceed friction;
    averaging removes most of it.
    """

    qd: Tensor  # [rad/s], (sample,)
    qdd: Tensor  # [rad/s^2]
    load: Tensor  # normal load [-]
    torque: Tensor  # of friction [N m]
    block: int = 1  # consecutive samples over which errors are averaged


@dataclass(frozen=True)
class EvolutionOptions:
    """Settings of an evolution.

    Attributes:
        prices: price of all rules in each run, as a fraction of the error of the given controller.
        checkpoint: file that stores every finished generation; a run that finds one with the same
            settings resumes from it. None for no checkpoint.

    Raises:
        ValueError: if there is no price, or the population is below SciPy's minimum of 5.
    """

    prices: tuple[float, ...] = (0.0, 0.1, 0.3, 1.0)
    population: int = 20
    generations: int = 40
    seed: int = 0
    checkpoint: Path | None = None

    def __post_init__(self) -> None:
        if not self.prices or min(self.prices) < 0 or self.population < 5:
            raise ValueError(
                "`prices` must be one or more, none negative, and `population` at least 5, got "
                f"{self.prices} and {self.population}."
            )


@dataclass(frozen=True, eq=False)
class Candidate:
    """A controller with its error on the samples [N m] and its number of rules."""

    controller: MamdaniController
    error: float
    rules: int


def evolve(
    start: MamdaniController,
    law: Law,
    samples: TorqueSamples,
    *,
    v_smooth: float,
    options: EvolutionOptions = EvolutionOptions(),
    callback: Callable[[float, int], None] | None = None,
) -> list[Candidate]:
    """Pareto-optimal controllers in error and number of rules, fewest rules first.

    Args:
        start: of |velocity| and acceleration; its outputs are the coefficients of the law. It is a
            member of the first population of every run.
        law: whose torque is compared with the samples'.
        samples: to fit; test the result on others.
        v_smooth: of the law's smooth sign [rad/s].
        callback: called with price and generation after each generation.

    References:
        R. Storn and K. Price, J. Global Optimization 11 (1997) 341; the future work of the TLRIP
        paper.
    """
    from scipy.optimize import Bounds, differential_evolution  # slow to import

    found: list[Candidate] = []

    def judged(genes: Sequence[float]) -> Candidate:
        controller = _expressed(start, genes)
        error = torque_error(controller, law, samples, v_smooth)
        return Candidate(controller, error, len(controller.rule_base.rules))

    own = _genes_of(start)
    reference = judged(own.tolist())
    most = len(start.rule_base.rules)
    kept = _read(options)
    box = Bounds(np.zeros(len(own)), np.ones(len(own)))
    for price in options.prices:

        def cost(genes: Array, price: float = price) -> float:
            one = judged(genes.tolist())
            return one.error / reference.error + price * one.rules / most

        random = np.random.default_rng([options.seed, options.prices.index(price)])
        population = random.uniform(size=(options.population, len(own)))
        # A third of the initial candidates are near the given controller.
        near = options.population // 3
        population[:near] = np.clip(own + 0.05 * random.normal(size=(near, len(own))), 0.0, 1.0)
        population[0] = own
        done, population = kept.get(str(price), (0, population))
        for generation in range(done, options.generations):
            # One generation per call, so a checkpoint only needs the population between calls.
            ended = differential_evolution(
                cost, box, init=np.asarray(population), maxiter=1, polish=False, popsize=1,
                seed=np.random.default_rng([options.seed, generation]), tol=0.0,
            )  # fmt: skip
            population = ended.population
            kept[str(price)] = generation + 1, population
            if options.checkpoint is not None:
                rows = {p: (n, np.asarray(of).tolist()) for p, (n, of) in kept.items()}
                content = {"options": _described(options), "found": rows}
                write_atomically(options.checkpoint, json.dumps(content).encode())
            if callback is not None:
                callback(price, generation)
        found += [judged(np.asarray(genes).tolist()) for genes in population]
    return pareto([reference, *found])


def pareto(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Candidates that no other beats in both error and number of rules, fewest rules first."""
    front: list[Candidate] = []
    for one in sorted(candidates, key=lambda c: (c.rules, c.error)):
        if not front or one.error < front[-1].error:
            front.append(one)
    return front


@torch.no_grad()
def torque_error(
    controller: MamdaniController, law: Law, samples: TorqueSamples, v_smooth: float
) -> float:
    """Root mean square error [N m] of the torque, averaged over each block of samples."""
    coefficients = controller(samples.qd.abs(), samples.qdd)
    torque = law.torque(samples.qd, samples.load, coefficients, v_smooth)
    # The last block may not be full.
    whole = len(torque) // samples.block * samples.block
    errors = (torque - samples.torque)[:whole].reshape(-1, samples.block).mean(-1)
    return float(errors.square().mean().sqrt())


def _genes_of(controller: MamdaniController) -> Array:
    """Genes in [0, 1] of an unchanged controller: no stretch, its own terms, every rule."""
    rules = controller.rule_base
    scales = [0.5] * (len(rules.inputs) + 2 * len(rules.outputs))
    terms = [
        (variable.terms.index(term) + 0.5) / len(variable.terms)
        for rule in rules.rules
        for variable, term in zip(rules.outputs, rule.then, strict=True)
    ]
    return np.array([*scales, *terms, *[0.75] * len(rules.rules)])


def _expressed(start: MamdaniController, genes: Sequence[float]) -> MamdaniController:
    """The controller that genes describe."""
    base = start.rule_base
    inputs, outputs, count = len(base.inputs), len(base.outputs), len(base.rules)
    factors = [STRETCH ** (2.0 * g - 1.0) for g in genes[: inputs + 2 * outputs]]
    terms = np.reshape(genes[inputs + 2 * outputs : -count], (count, outputs))
    kept = [gate >= 0.5 for gate in genes[-count:]]
    # A controller needs a rule; keep the one closest to being kept.
    kept[int(np.argmax(genes[-count:]))] = True

    def said(row: Array) -> tuple[str, ...]:
        pairs = zip(base.outputs, row, strict=True)
        return tuple(v.terms[min(int(g * len(v.terms)), len(v.terms) - 1)] for v, g in pairs)

    rules = zip(base.rules, terms, kept, strict=True)
    changed = replace(
        base,
        inputs=tuple(_moved(v, 0.0, f) for v, f in zip(base.inputs, factors, strict=False)),
        outputs=tuple(map(_spread, base.outputs, factors[inputs::2], factors[inputs + 1 :: 2])),
        rules=tuple(replace(rule, then=said(row)) for rule, row, keep in rules if keep),
    )
    return MamdaniController(changed)


def _spread(variable: Variable, middle: float, width: float) -> Variable:
    """An output with the middle and the width of its universe multiplied by these factors."""
    low, high = variable.universe
    centre = 0.5 * (low + high)
    if low >= 0:
        # A positive coefficient stays positive.
        width = min(width, middle * centre / (centre - low))
    return _moved(variable, (middle - width) * centre, width)


def _moved(variable: Variable, offset: float, factor: float) -> Variable:
    """A variable with its universe and sets multiplied by a factor and moved by an offset."""

    def moved(term: FuzzySet) -> FuzzySet:
        centre, sigma = term.parameters
        return replace(term, parameters=(factor * centre + offset, factor * sigma))

    low, high = (factor * end + offset for end in variable.universe)
    return replace(variable, universe=(low, high), sets=tuple(map(moved, variable.sets)))


def _read(options: EvolutionOptions) -> dict[str, tuple[int, Array]]:
    """Number of finished generations and last population, by price."""
    path = options.checkpoint
    if path is None or not path.exists():
        return {}
    content = parse_json(path.read_bytes())
    if not isinstance(content, dict) or content.get("options") != _described(options):
        raise ValueError(f"{path}: no checkpoint of these options; repeat them or name a new file.")
    return {price: (done, np.array(rows)) for price, (done, rows) in content["found"].items()}


def _described(options: EvolutionOptions) -> dict[str, object]:
    """Options on which populations depend; with more generations, a run continues."""
    return {"prices": list(options.prices), "population": options.population, "seed": options.seed}
