"""Fuzzy networks trained by Bayesian regularisation, on samples or on what a controller says.

The papers' last step: a rule-table controller is sampled over its universes, and a network learns
its outputs, without a validation set. Groups (joints) are trained one after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from nfriction.fitting.layer_equations import LINEAR, LayerEquations
from nfriction.fitting.scaling import FuzzyNetwork, Scaling, to_own_units
from nfriction.fuzzy import Anfis, AnfisRBF, MamdaniController, RBFNetwork
from nfriction.solve import (
    EvidenceResult,
    EvidenceState,
    LevenbergMarquardt,
    bayesian_regularisation,
    maximise_evidence,
)
from nfriction.solve.evidence import group_index
from nfriction.solve.jacobian import flatten, trainable

Callback = Callable[[EvidenceState], "bool | None"]

# What moves a start away from the given one, in units of the scaled inputs or of logarithms.
SHAKE = 0.3
# The few samples of the search leave the sets almost where all samples want them.
REFINING_STEPS, RANKING_STEPS = 10, 3
GAUSSIAN = ("gaussian", "left_shoulder", "right_shoulder")


@dataclass(frozen=True, eq=False)
class NetworkFit:
    """How one group was trained.

    Args:
        evidence: result in scaled units (inputs and outputs on [-1, 1]); log evidences of fits to
            the same samples can be compared.
        scaling: between these and the samples' own units, of one group.
    """

    evidence: EvidenceResult
    scaling: Scaling

    def predictive_std(self, x: Tensor, noise: bool = True) -> Tensor:
        """Standard deviation of the outputs that parameters and noise leave open, in own units.

        Args:
            x: inputs of this group, shape (samples, inputs).
            noise: include that of a new sample, or only that of the function.
        Returns:
            Shape (samples, outputs).
        """
        scaled = self.scaling.inputs(x.unsqueeze(1))
        return self.evidence.predictive_std(scaled, noise)[:, 0] * self.scaling.y_half[0]


def controller_targets(
    controller: MamdaniController, samples: int = 40_000, seed: int = 0
) -> tuple[Tensor, Tensor]:
    """Inputs drawn evenly over a controller's universes, and what it says to them.

    Args:
        controller: as the papers', of |velocity| and acceleration, or any other.
        samples: how many; the paper takes 40,000.
        seed: of the draw.
    Returns:
        x, shape (samples, inputs), in SI (rad/s, rad/s^2), and y, shape (samples, outputs).
    """
    if samples < 1:
        raise ValueError(f"`samples` must be at least 1, got {samples}.")
    lower = controller.lower
    random = torch.Generator().manual_seed(seed)
    drawn = torch.rand(samples, controller.inputs, generator=random, dtype=torch.float64)
    own = lower + (controller.upper - lower) * drawn.to(lower)
    return own * controller.si_factor, controller.infer(own)


def train_on_controller(
    network: FuzzyNetwork,
    controllers: MamdaniController | Sequence[MamdaniController],
    *,
    samples: int = 40_000,
    seed: int = 0,
    starts: int = 1,
    search_samples: int = 4000,
    search_steps: int = 50,
    max_steps: int = 30,
    tolerance: float = 1e-3,
    noise_floor: float = 0.0,
    callback: Callback | None = None,
    progress: bool = False,
) -> list[NetworkFit]:
    """Teach a network, in place, what fuzzy controllers say: the papers' neuro-fuzzy step.

    An ANFIS starts from a controller's own sets where it has as many, else from an even grid over
    the universes; a radial basis network from units chosen by orthogonal least squares.

    Args:
        network: from inputs in SI to outputs in SI, a group for each controller.
        controllers: one for each group.
        samples, seed: see `controller_targets`; group g draws with seed + g.
        starts, search_samples, search_steps: see `train_network`.
        max_steps, tolerance, noise_floor, callback, progress: likewise.
    Returns:
        A fit for each group; fewer if an interrupt or the callback ended the training.
    References:
        TLRIP paper, neuro-fuzzy friction estimation (40,000 samples a joint, 2-10-2 network).
    """
    given = [controllers] if isinstance(controllers, MamdaniController) else list(controllers)
    if len(given) != network.groups or any(
        (c.inputs, c.outputs) != (network.inputs, network.outputs) for c in given
    ):
        raise ValueError(
            f"the network needs {network.groups} controllers of {network.inputs} inputs and "
            f"{network.outputs} outputs, got {[(c.inputs, c.outputs) for c in given]}."
        )
    drawn = [controller_targets(c, samples, seed + g) for g, c in enumerate(given)]
    x, y = (torch.stack(parts, 1) for parts in zip(*drawn, strict=True))
    if isinstance(network, RBFNetwork):
        network.init_ols(x, y, width=0.5)
    else:
        _take_sets(network.anfis if isinstance(network, AnfisRBF) else network, given)
    return train_network(
        network,
        x,
        y,
        seed=seed,
        starts=starts,
        search_samples=search_samples,
        search_steps=search_steps,
        max_steps=max_steps,
        tolerance=tolerance,
        noise_floor=noise_floor,
        callback=callback,
        progress=progress,
    )


def train_network(
    network: FuzzyNetwork,
    x: Tensor,
    y: Tensor,
    *,
    seed: int = 0,
    starts: int = 1,
    search_samples: int = 4000,
    search_steps: int = 50,
    max_steps: int = 30,
    tolerance: float = 1e-3,
    noise_floor: float = 0.0,
    callback: Callback | None = None,
    progress: bool = False,
) -> list[NetworkFit]:
    """Train a network in place on samples by Bayesian regularisation, each group for itself.

    Sets (or units) are first moved with the output layer eliminated, from several starts, on few
    samples and then a little on all; the start with the largest evidence goes on. Every kind of
    parameter has its own prior: centres, widths and their like around where that start placed
    them, output layers around zero (in scaled units).

    Args:
        network: as its sets (or units) should start; of the output layer no start is needed.
        x: inputs, shape (samples, groups, inputs).
        y: targets, shape (samples, groups, outputs).
        seed: of the starts after the first: shaken sets, or k-means anew.
        starts: how many.
        search_samples, search_steps: evenly thinned samples, and steps, to compare starts with.
        max_steps: limit of the steps of Bayesian regularisation on all samples.
        tolerance, noise_floor, callback, progress: see `maximise_evidence`; in scaled units.
    Returns:
        A fit for each group; fewer if an interrupt or the callback ended the training. The groups
        that come after it then stand at the least-squares output layer for their first sets.
    Raises:
        ValueError: if samples do not fit the network, are not finite, or an input never varies.
    """
    _check(network, x, y)
    if starts < 1 or search_samples < 1:
        raise ValueError(
            f"`starts` and `search_samples` must be at least 1, got {starts}, {search_samples}."
        )
    scaling = Scaling.of(x, y)
    x, y = scaling.inputs(x), scaling.outputs(y)
    tasks = [
        _Group(network, g, scaling, x[:, g : g + 1].contiguous(), y[:, g : g + 1].contiguous())
        for g in range(network.groups)
    ]
    # All groups get a usable network before the long part, which an interrupt may end.
    for task in tasks:
        task.solve_linear(search_samples)
    fits: list[NetworkFit] = []
    for task in tasks:
        try:
            prior = task.search(seed, starts, search_samples, search_steps)
            result = task.regularise(
                prior,
                seed,
                max_steps=max_steps,
                tolerance=tolerance,
                noise_floor=noise_floor,
                callback=callback,
                progress=progress,
            )
        except KeyboardInterrupt:
            break
        task.write_back()
        fits.append(NetworkFit(result, task.scaling))
        if result.status == "stopped":
            break
    return fits


class _Group:
    """One group's network, samples and targets, all in scaled units."""

    def __init__(
        self, network: FuzzyNetwork, group: int, scaling: Scaling, x: Tensor, y: Tensor
    ) -> None:
        self.network, self.group, self.x, self.y = network, group, x, y
        rows = slice(group, group + 1)
        self.scaling = Scaling(*(part[rows] for part in vars(scaling).values()))
        self.layer = one_group(network, group)
        to_own_units(self.layer, self.scaling.inverse())

    @property
    def carrier(self) -> Anfis | RBFNetwork:
        """The layer that is placed first; a head comes after."""
        return self.layer.anfis if isinstance(self.layer, AnfisRBF) else self.layer

    def solve_linear(self, samples: int) -> None:
        """Least-squares output layer for the present sets, written into the network."""
        x, y = _thinned(self.x, samples), _thinned(self.y, samples)
        if isinstance(self.carrier, Anfis):
            self.carrier.solve_consequents(x, y)
        else:
            self.carrier.solve_output(x, y)
        if isinstance(self.layer, AnfisRBF):
            nn.init.zeros_(self.layer.head.output_weight)
            nn.init.zeros_(self.layer.head.output_bias)
        self.write_back()

    def search(self, seed: int, starts: int, samples: int, steps: int) -> dict[str, Tensor]:
        """Give the carrier the start of the largest evidence; return where its sets started."""
        x, y = _thinned(self.x, samples), _thinned(self.y, samples)
        best, prior = -float("inf"), _moving(self.carrier)
        found = deepcopy(self.carrier.state_dict())
        for number in range(starts):
            trial = deepcopy(self.carrier)
            if number > 0:
                _restart(trial, x, seed + number)
            start = _moving(trial)
            project(trial, x, y, steps)
            if len(x) < len(self.x):
                project(trial, self.x, self.y, REFINING_STEPS if starts == 1 else RANKING_STEPS)
            evidence = 0.0
            if starts > 1:
                # On all samples: on few, the start that overfits them would win. The precisions
                # are first estimated after one step, and good for a ranking after another.
                evidence = _regularise(trial, self.x, self.y, start, max_steps=3).log_evidence
            if evidence > best:
                best, prior, found = evidence, start, deepcopy(trial.state_dict())
        self.carrier.load_state_dict(found)
        return prior

    def regularise(self, prior: dict[str, Tensor], seed: int, **options: Any) -> EvidenceResult:
        """Bayesian regularisation on all samples, after placing a head where there is one."""
        if isinstance(self.layer, AnfisRBF):
            self.layer.init_head(self.x, seed)
            self.layer.solve_head(self.x, self.y)
            prior = {f"anfis.{name}": value for name, value in prior.items()}
            prior |= {f"head.{name}": value for name, value in _moving(self.layer.head).items()}
        return _regularise(self.layer, self.x, self.y, prior, **options)

    @torch.no_grad()
    def write_back(self) -> None:
        """Copy the layer into its group of the network, in the samples' own units."""
        own = deepcopy(self.layer)
        to_own_units(own, self.scaling)
        ours = self.network.state_dict(keep_vars=True)
        for name, value in own.state_dict().items():
            ours[name][self.group : self.group + 1] = value


def one_group(network: FuzzyNetwork, group: int) -> FuzzyNetwork:
    """A network of its own with the values of one group of `network`."""
    single: FuzzyNetwork = deepcopy(network)
    for module in single.modules():
        if isinstance(module, Anfis | AnfisRBF | RBFNetwork):
            module.groups = 1
        for name, value in list(module.named_parameters(recurse=False)):
            part = value.detach()[group : group + 1].clone()
            setattr(module, name, nn.Parameter(part, requires_grad=value.requires_grad))
        for name, buffer in list(module.named_buffers(recurse=False)):
            setattr(module, name, buffer[group : group + 1].clone())
    return single


def project(layer: Anfis | RBFNetwork, x: Tensor, y: Tensor, steps: int) -> None:
    """Place the sets (or units) by least squares with the output layer eliminated, in place.

    Args:
        layer: of one group; left alone if its output layer or all of its sets are frozen.
        x, y: samples, shapes (samples, 1, inputs) and (samples, 1, outputs).
        steps: limit of Levenberg-Marquardt's steps.
    Raises:
        KeyboardInterrupt: if interrupted; the best sets so far are in the layer.
    """
    equations = LayerEquations(layer, x, y)
    if not equations.separable:
        return
    start = equations.w[equations.moving]
    solver = LevenbergMarquardt(max_steps=steps, cost_tolerance=1e-6)
    result = solver.minimise(equations.projected, start, cost=equations.projected_cost)
    equations.projected_cost(result.x)
    if result.status == "stopped":
        raise KeyboardInterrupt


def _regularise(
    layer: FuzzyNetwork,
    x: Tensor,
    y: Tensor,
    prior: dict[str, Tensor],
    **options: Any,
) -> EvidenceResult:
    """Bayesian regularisation with a prior of its own for each kind of parameter."""
    parameters = trainable(layer)
    groups: dict[str, list[str]] = {}
    for name in parameters:
        groups.setdefault(_kind(name), []).append(name)
    wanted = {name: value for name, value in prior.items() if name in parameters}
    if isinstance(layer, AnfisRBF):
        return bayesian_regularisation(layer, x, y, groups=groups, prior=wanted, **options)
    equations = LayerEquations(layer, x, y)
    names, index = group_index(parameters, groups)
    centre = {n: wanted.get(n, torch.zeros_like(value)) for n, value in parameters.items()}
    # Errors within the rounding of the targets are no information about anything.
    rounding = torch.finfo(y.dtype).eps * float(y.square().mean().sqrt())
    options["noise_floor"] = max(options.get("noise_floor", 0.0), rounding)
    result = maximise_evidence(
        equations.normal_equations,
        equations.w,
        samples=y.numel(),
        squares=equations.squares,
        groups=index,
        names=names,
        prior=flatten(centre),
        **options,
    )
    equations.assign(result.w)
    return replace(result, model=layer, parameters=trainable(layer))


def _kind(name: str) -> str:
    """Which prior a parameter belongs to."""
    part = {"spacings": "centres", "log_widths": "widths", "log_slopes": "slopes"}
    last = name.rsplit(".", 1)[-1]
    kind = "outputs" if last.startswith("output_") else part.get(last, last)
    return f"head {kind}" if name.startswith("head.") else kind


def _moving(layer: nn.Module) -> dict[str, Tensor]:
    """Copies of the parameters that place sets or units."""
    return {
        name: value.detach().clone()
        for name, value in layer.named_parameters()
        if not name.endswith(LINEAR)
    }


@torch.no_grad()
def _restart(layer: Anfis | RBFNetwork, x: Tensor, seed: int) -> None:
    """Another start: units by k-means anew, sets shaken."""
    if isinstance(layer, RBFNetwork):
        layer.init_kmeans(x, seed)
        return
    random = torch.Generator().manual_seed(seed)
    for name, value in layer.named_parameters():
        if value.requires_grad and not name.endswith(LINEAR):
            drawn = torch.randn(value.shape, generator=random, dtype=torch.float64)
            size = 0.5 * SHAKE if name.endswith("centres") else SHAKE
            value.add_(size * drawn.to(value))


@torch.no_grad()
def _take_sets(anfis: Anfis, controllers: Sequence[MamdaniController]) -> None:
    """The controllers' own sets where they are Gaussian and as many, else even grids."""
    lower = torch.stack([c.lower * c.si_factor for c in controllers])
    upper = torch.stack([c.upper * c.si_factor for c in controllers])
    variables = [c.rule_base.inputs for c in controllers]
    alike = anfis.kind == "gaussian" and all(
        [len(v.sets) for v in inputs] == list(anfis.terms)
        and all(term.shape in GAUSSIAN for v in inputs for term in v.sets)
        for inputs in variables
    )
    if not alike:
        anfis.init_grid(lower, upper)
        return
    given: list[list[Tensor]] = []
    for number in (0, 1):
        given.append(
            [
                torch.tensor(
                    [[term.parameters[number] for term in inputs[i].sets] for inputs in variables],
                    dtype=torch.float64,
                ).to(lower)
                * torch.stack([c.si_factor[i : i + 1] for c in controllers])
                for i in range(anfis.inputs)
            ]
        )
    anfis.init_from_sets(*given, lower=lower, upper=upper)


def _thinned(values: Tensor, most: int) -> Tensor:
    """At most `most` rows, evenly spaced."""
    return values[:: -(-len(values) // most)].contiguous()


def _check(network: nn.Module, x: Tensor, y: Tensor) -> None:
    if not isinstance(network, Anfis | AnfisRBF | RBFNetwork):
        raise TypeError(
            f"`network` must be an Anfis, AnfisRBF or RBFNetwork, got {type(network).__name__}."
        )
    wanted = ((network.groups, network.inputs), (network.groups, network.outputs))
    if x.ndim != 3 or y.ndim != 3 or (x.shape[1:], y.shape[1:]) != wanted or len(x) != len(y):
        raise ValueError(
            f"`x` and `y` must be (samples, {network.groups}, {network.inputs}) and (samples, "
            f"{network.groups}, {network.outputs}), got {tuple(x.shape)} and {tuple(y.shape)}."
        )
    if len(x) == 0 or not (torch.isfinite(x).all() and torch.isfinite(y).all()):
        raise ValueError("`x` and `y` need samples, all finite; drop those with NaN or infinity.")
