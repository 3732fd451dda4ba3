"""Fuzzy networks trained by Bayesian regularisation, on samples or on a controller's outputs.

The papers' last step: a rule-table controller is sampled over its universes, and a network learns
its outputs without a validation set. Groups (joints) are trained one after another.
"""

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from nfriction.fuzzy import Anfis, AnfisRBF, RBFNetwork
from nfriction.papers.controller.mamdani import MamdaniController
from nfriction.papers.nffem.evidence import (
    EvidenceOptions,
    EvidenceResult,
    EvidenceState,
    bayesian_regularisation,
)
from nfriction.papers.nffem.jacobian import trainable
from nfriction.papers.nffem.projection import (
    LINEAR,
    FuzzyNetwork,
    Scaling,
    one_group,
    project,
    to_own_units,
)

GAUSSIAN = ("gaussian", "left_shoulder", "right_shoulder")
# Size of the random perturbation for another start, in units of scaled inputs or of logarithms.
SHAKE = 0.3
# The few samples of the search place the sets almost where all samples would.
REFINING_STEPS, PROJECTED_STEPS = 10, 3
# Steps times samples of the regularisation that ranks a start by its evidence: precisions are first
# estimated after one step and are good enough for a ranking after another, but few samples need
# many steps, which cost little.
RANKING_EFFORT = 120_000


@dataclass(frozen=True)
class TrainingOptions(EvidenceOptions):
    """Settings of a training; those of Bayesian regularisation are in scaled units.

    Sets (or units) are first optimised from several starts with the output layer eliminated, on few
    samples and then briefly on all; the start with the largest evidence is regularised.

    Attributes:
        seed: for the samples of controllers, and for starts after the first: perturbed sets, or
            another k-means.
        search_samples, search_steps: numbers of evenly thinned samples and of steps for comparing
            starts. Without regularisation these steps overfit if there are hardly more samples
            than parameters; `search_steps=0` then often ends at a larger evidence.
        max_steps: limit on steps of Bayesian regularisation on all samples.

    Raises:
        ValueError: if there is no start or no sample; see also `EvidenceOptions`.
    """

    max_steps: int = 30
    seed: int = 0
    starts: int = 1
    search_samples: int = 4000
    search_steps: int = 50

    def __post_init__(self) -> None:
        super().__post_init__()
        if min(self.starts, self.search_samples) < 1 or min(self.max_steps, self.search_steps) < 0:
            raise ValueError(
                "`starts` and `search_samples` must be at least 1, and `max_steps` and "
                f"`search_steps` not negative, got {self.starts}, {self.search_samples}, "
                f"{self.max_steps}, {self.search_steps}."
            )


DEFAULTS = TrainingOptions()


def recorded_losses(
    names: Sequence[str],
) -> tuple[dict[str, list[float]], Callable[[EvidenceState], None]]:
    """Mean squared error after every step by group name, and the callback that records it."""
    losses: dict[str, list[float]] = {}

    def keep(state: EvidenceState) -> None:
        losses.setdefault(names[state.network], []).append(0.5 / state.beta)

    return losses, keep


def controller_targets(
    controller: MamdaniController, samples: int = 40_000, seed: int = 0
) -> tuple[Tensor, Tensor]:
    """Inputs drawn evenly over a controller's universes, and its outputs, (samples, ...) in SI."""
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
    options: TrainingOptions = DEFAULTS,
) -> list[EvidenceResult]:
    """Train a network, in place, on the outputs of fuzzy controllers: the papers' last step.

    An ANFIS starts from a controller's own sets if it has as many, otherwise from an even grid over
    the universes; a radial basis network starts from units chosen by orthogonal least squares.

    Args:
        network: from inputs in SI to outputs in SI, with one group per controller.
        samples: see `controller_targets`; group g draws with seed + g.

    Returns:
        The result of each group in scaled units, inputs and outputs on [-1, 1]; fewer if an
        interrupt or the callback ended the training.

    References:
        TLRIP paper, neuro-fuzzy friction estimation (40,000 samples per joint, 2-10-2 network).
    """
    given = [controllers] if isinstance(controllers, MamdaniController) else list(controllers)
    if len(given) != network.groups or any(
        (c.inputs, c.outputs) != (network.inputs, network.outputs) for c in given
    ):
        raise ValueError(
            f"the network needs {network.groups} controllers of {network.inputs} inputs and "
            f"{network.outputs} outputs, got {[(c.inputs, c.outputs) for c in given]}."
        )
    drawn = [controller_targets(c, samples, options.seed + g) for g, c in enumerate(given)]
    x, y = (torch.stack(parts, 1) for parts in zip(*drawn, strict=True))
    if isinstance(network, RBFNetwork):
        # Units at samples, each where it best explains the residual of the others.
        network.init_ols(x, y, width=0.5)
    else:
        _take_sets(network.anfis if isinstance(network, AnfisRBF) else network, given)
    return train_network(network, x, y, options)


def train_network(
    network: FuzzyNetwork, x: Tensor, y: Tensor, options: TrainingOptions = DEFAULTS
) -> list[EvidenceResult]:
    """Train a network in place on samples by Bayesian regularisation, each group separately.

    Every kind of parameter has its own prior: for centres, widths and the like, around the values
    of the best start; for output layers, around zero (in scaled units).

    Args:
        network: with initial sets (or units); the output layer needs no initial values.
        x: inputs, shape (samples, groups, inputs).
        y: targets, shape (samples, groups, outputs).

    Returns:
        The result of each group in scaled units, inputs and outputs on [-1, 1]; fewer if an
        interrupt or the callback ended the training. Later groups then have the
        least-squares output layer for their initial sets.

    Raises:
        TypeError: if network and samples are not in double precision.
        ValueError: if samples do not match the network, are not finite or span over ten times the
            range of its sets or units, or an input never varies.
    """
    _check(network, x, y)
    scaling = Scaling.of(x, y)
    _check_range(network, x)
    x, y = scaling.inputs(x), scaling.outputs(y)
    groups = [NetworkGroup(network, g, scaling, x, y) for g in range(network.groups)]
    # All groups get a usable network before the long part, which may be interrupted.
    for group in groups:
        group.solve_linear(options.search_samples)
    fits: list[EvidenceResult] = []
    for group in groups:
        try:
            result = group.regularise(group.search(options), options)
        except KeyboardInterrupt:
            break
        group.write_back()
        fits.append(result)
        if result.status == "stopped":
            break
    return fits


@torch.no_grad()
def _take_sets(anfis: Anfis, controllers: Sequence[MamdaniController]) -> None:
    """Use the controllers' own sets if Gaussian and equally many, otherwise even grids."""
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
    centres, widths = [], []
    for i in range(anfis.inputs):
        # (group, set, parameter), centre and width first.
        own = [[term.parameters[:2] for term in inputs[i].sets] for inputs in variables]
        factor = torch.stack([c.si_factor[i] for c in controllers])[:, None]
        centre, width = lower.new_tensor(own).unbind(-1)
        centres.append(centre * factor)
        widths.append(width * factor)
    anfis.init_from_sets(centres, widths, lower=lower, upper=upper)


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
    if {x.dtype, y.dtype, *(p.dtype for p in network.parameters())} != {torch.float64}:
        raise TypeError(
            "a network is trained in double precision: `network.double()`, `x.double()`."
        )


def _check_range(network: FuzzyNetwork, x: Tensor) -> None:
    # A new network has its sets or units within [-1, 1].
    lower, upper = _reach(network.anfis if isinstance(network, AnfisRBF) else network)
    least, most = x.amin(0), x.amax(0)
    covered = torch.minimum(upper, most) - torch.maximum(lower, least)
    if (covered < 0.1 * (most - least)).any():
        raise ValueError(
            "the network's sets or units cover less than a tenth of the range of an input; drop "
            "outliers, or place them first: `init_grid(x.amin(0), x.amax(0))`, `init_kmeans(x)`."
        )


def _reach(layer: Anfis | RBFNetwork) -> tuple[Tensor, Tensor]:
    """Range in which sets or units of each input exceed about 1 %, each (group, input)."""
    if isinstance(layer, RBFNetwork):
        centres, reach = layer.centres, 3 * layer.log_widths.exp()
        return (centres - reach).amin(1), (centres + reach).amax(1)
    centres, widths = (values.split(layer.terms, 1) for values in layer.sets())
    pairs = [(c, 3 * w) for c, w in zip(centres, widths, strict=True)]
    return (
        torch.stack([(c - w).amin(1) for c, w in pairs], 1),
        torch.stack([(c + w).amax(1) for c, w in pairs], 1),
    )


class NetworkGroup:
    """One group (joint) of a network in training, in scaled units; `x`, `y` are of all groups."""

    def __init__(
        self, network: FuzzyNetwork, group: int, scaling: Scaling, x: Tensor, y: Tensor
    ) -> None:
        rows = slice(group, group + 1)
        self.network, self.group = network, group
        self.x, self.y = x[:, rows].contiguous(), y[:, rows].contiguous()
        self.scaling = Scaling(*(part[rows] for part in vars(scaling).values()))
        self.layer = one_group(network, group)
        to_own_units(self.layer, self.scaling.inverse())

    @property
    def carrier(self) -> Anfis | RBFNetwork:
        """The layer that is placed first; a head follows."""
        return self.layer.anfis if isinstance(self.layer, AnfisRBF) else self.layer

    def solve_linear(self, samples: int) -> None:
        """Write the least-squares output layer for the current sets into the network."""
        x, y = self._thinned(samples)
        if isinstance(self.carrier, Anfis):
            self.carrier.solve_consequents(x, y)
        else:
            self.carrier.solve_output(x, y)
        if isinstance(self.layer, AnfisRBF):
            # The layer alone is usable; a randomly initialised head would spoil it.
            nn.init.zeros_(self.layer.head.output_weight)
            nn.init.zeros_(self.layer.head.output_bias)
        self.write_back()

    def search(self, options: TrainingOptions) -> dict[str, Tensor]:
        """Set the carrier to the start with the largest evidence; return its initial sets."""
        few = self._thinned(options.search_samples)
        refining = REFINING_STEPS if options.starts == 1 else PROJECTED_STEPS
        ranking = max(3, min(options.max_steps, RANKING_EFFORT // len(self.x)))
        # The prior is centred on where the sets started, not on where the search moved them.
        best, prior = -float("inf"), _moving(self.carrier)
        found = deepcopy(self.carrier.state_dict())
        for number in range(options.starts):
            trial = deepcopy(self.carrier)
            if number > 0:
                _restart(trial, few[0], options.seed + number)
            start = _moving(trial)
            project(trial, *few, options.search_steps)
            if len(few[0]) < len(self.x):
                # The thinned samples placed the sets; all samples only refine them.
                project(trial, self.x, self.y, refining)
            evidence = 0.0
            if options.starts > 1:
                # On all samples: with few, a start that overfits them would win.
                ranked = EvidenceOptions(max_steps=ranking)
                evidence = _regularised(trial, self.x, self.y, start, ranked).log_evidence
            if evidence > best:
                best, prior, found = evidence, start, deepcopy(trial.state_dict())
        self.carrier.load_state_dict(found)
        return prior

    def regularise(self, prior: dict[str, Tensor], options: TrainingOptions) -> EvidenceResult:
        """Bayesian regularisation on all samples, after placing the head if there is one."""
        if isinstance(self.layer, AnfisRBF):
            self.layer.init_head(self.x, options.seed)
            self.layer.solve_head(self.x, self.y)
            prior = {f"anfis.{name}": value for name, value in prior.items()}
            prior |= {f"head.{name}": value for name, value in _moving(self.layer.head).items()}
        if (callback := options.callback) is not None:
            options = replace(options, callback=lambda s: callback(replace(s, network=self.group)))
        return _regularised(self.layer, self.x, self.y, prior, options)

    def _thinned(self, most: int) -> tuple[Tensor, Tensor]:
        """At most `most` samples, evenly spaced."""
        # Rounded up, so that the limit is respected.
        every = -(-len(self.x) // most)
        return self.x[::every].contiguous(), self.y[::every].contiguous()

    @torch.no_grad()
    def write_back(self) -> None:
        """Copy the layer into its group of the network, in the samples' own units."""
        # Training continues in scaled units.
        own = deepcopy(self.layer)
        to_own_units(own, self.scaling)
        # The parameters themselves, as writing to copies would leave the network unchanged.
        ours = self.network.state_dict(keep_vars=True)
        for name, value in own.state_dict().items():
            ours[name][self.group : self.group + 1] = value


def _regularised(
    layer: FuzzyNetwork, x: Tensor, y: Tensor, prior: dict[str, Tensor], options: EvidenceOptions
) -> EvidenceResult:
    """Bayesian regularisation with a separate prior for each kind of parameter."""
    # Frozen parameters have no prior.
    wanted = {name: prior[name] for name in trainable(layer) if name in prior}
    return bayesian_regularisation(layer, x, y, kind=_kind, prior=wanted, options=options)


def _kind(name: str) -> str:
    """Group of a parameter: each kind has its own scale, determined by the evidence."""
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
    """Another start: units from a new k-means, or perturbed sets."""
    if isinstance(layer, RBFNetwork):
        layer.init_kmeans(x, seed)
        return
    random = torch.Generator().manual_seed(seed)
    for name, value in layer.named_parameters():
        if value.requires_grad and not name.endswith(LINEAR):
            drawn = torch.randn(value.shape, generator=random, dtype=torch.float64)
            # Centres lie on [-1, 1]; other parameters are logarithms, which may vary more.
            size = 0.5 * SHAKE if name.endswith("centres") else SHAKE
            value.add_(size * drawn.to(value))
