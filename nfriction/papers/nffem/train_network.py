"""Fuzzy networks trained by Bayesian regularisation, on samples or on what a controller says.

The papers' last step: a rule-table controller is sampled over its universes, and a network learns
its outputs, without a validation set. Groups (joints) are trained one after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from nfriction.fuzzy import Anfis, AnfisRBF, RBFNetwork
from nfriction.optim.evidence import EvidenceResult, EvidenceState
from nfriction.papers.controller.mamdani import MamdaniController
from nfriction.papers.nffem.network_group import NetworkGroup
from nfriction.papers.nffem.scaling import FuzzyNetwork, Scaling

Callback = Callable[[EvidenceState], "bool | None"]

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
            Without regularisation these steps overfit where samples are hardly more than
            parameters; `search_steps=0` then often ends at a larger evidence.
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
        NetworkGroup(
            network, g, scaling, x[:, g : g + 1].contiguous(), y[:, g : g + 1].contiguous()
        )
        for g in range(network.groups)
    ]
    # All groups get a usable network before the long part, which an interrupt may end.
    for task in tasks:
        task.solve_linear(search_samples)
    fits: list[NetworkFit] = []
    for task in tasks:
        try:
            prior = task.search(seed, starts, search_samples, search_steps, max_steps)
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
