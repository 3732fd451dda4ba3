"""One group (joint) of a fuzzy network on its way through the training, in scaled units."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn

from nfriction.fuzzy import Anfis, AnfisRBF, RBFNetwork
from nfriction.optim.evidence import EvidenceOptions, EvidenceResult
from nfriction.optim.jacobian import trainable
from nfriction.optim.regularisation import bayesian_regularisation
from nfriction.papers.nffem.projection import LINEAR, project
from nfriction.papers.nffem.scaling import FuzzyNetwork, Scaling, to_own_units

# What moves a start away from the given one, in units of the scaled inputs or of logarithms.
SHAKE = 0.3
# The few samples of the search leave the sets almost where all samples want them.
REFINING_STEPS, PROJECTED_STEPS = 10, 3
# Steps times samples that a start is regularised for, to be ranked by its evidence: the precisions
# are first estimated after one step and good for a ranking after another, but few samples need
# many steps and cost little.
RANKING_EFFORT = 120_000


class NetworkGroup:
    """One group's network, samples and targets.

    Args:
        network: of any number of groups; written to by `write_back` only.
        group: which of them.
        scaling: of all groups.
        x, y: its samples, scaled, shapes (samples, 1, inputs) and (samples, 1, outputs).
    """

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

    def search(
        self, seed: int, starts: int, samples: int, steps: int, max_steps: int
    ) -> dict[str, Tensor]:
        """Give the carrier the start of the largest evidence; return where its sets started."""
        ranking = max(3, min(max_steps, RANKING_EFFORT // len(self.x)))
        best, prior = -float("inf"), _moving(self.carrier)
        found = deepcopy(self.carrier.state_dict())
        for number in range(starts):
            trial = deepcopy(self.carrier)
            if number > 0:
                _restart(trial, _thinned(self.x, samples), seed + number)
            start = _moving(trial)
            self._place(trial, samples, steps, REFINING_STEPS if starts == 1 else PROJECTED_STEPS)
            evidence = 0.0
            if starts > 1:
                # On all samples: on few, the start that overfits them would win.
                result = regularise(trial, self.x, self.y, start, max_steps=ranking)
                evidence = result.log_evidence
            if evidence > best:
                best, prior, found = evidence, start, deepcopy(trial.state_dict())
        self.carrier.load_state_dict(found)
        return prior

    def _place(self, trial: Anfis | RBFNetwork, samples: int, steps: int, refining: int) -> None:
        """Move a trial's sets on few samples, then a little on all."""
        x, y = _thinned(self.x, samples), _thinned(self.y, samples)
        project(trial, x, y, steps)
        if len(x) < len(self.x):
            project(trial, self.x, self.y, refining)

    def regularise(self, prior: dict[str, Tensor], seed: int, **options: Any) -> EvidenceResult:
        """Bayesian regularisation on all samples, after placing a head where there is one."""
        if isinstance(self.layer, AnfisRBF):
            self.layer.init_head(self.x, seed)
            self.layer.solve_head(self.x, self.y)
            prior = {f"anfis.{name}": value for name, value in prior.items()}
            prior |= {f"head.{name}": value for name, value in _moving(self.layer.head).items()}
        return regularise(self.layer, self.x, self.y, prior, **options)

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


def regularise(
    layer: FuzzyNetwork, x: Tensor, y: Tensor, prior: dict[str, Tensor], **options: Any
) -> EvidenceResult:
    """Bayesian regularisation with a prior of its own for each kind of parameter."""
    parameters = trainable(layer)
    groups: dict[str, list[str]] = {}
    for name in parameters:
        groups.setdefault(_kind(name), []).append(name)
    wanted = {name: value for name, value in prior.items() if name in parameters}
    return bayesian_regularisation(
        layer, x, y, groups=groups, prior=wanted, options=EvidenceOptions(**options)
    )


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


def _thinned(values: Tensor, most: int) -> Tensor:
    """At most `most` rows, evenly spaced."""
    return values[:: -(-len(values) // most)].contiguous()
