"""The papers' joint-2 controller learnt from 40,000 samples: error and time beside the peers.

Run from the repository's root: `python benchmarks/controller_task.py`, on one thread.
Samples are uniform over the universes (|velocity| 0-1000 deg/s, acceleration -6000-8000 deg/s^2),
10,000 others test. The error is the RMS in % of the output's range, mean over B and C, in two
definitions: of the range that the controller's output takes on the test samples (the stricter
one), and of the output's universe. Where several starts are made the evidence chooses, never the
test error. Peers that are not installed (scikit-learn, simpful, scikit-fuzzy) are named and
skipped.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from nfriction.fuzzy import Anfis, AnfisRBF, RBFNetwork
from nfriction.papers.controller.mamdani import MamdaniController, paper_controller
from nfriction.papers.nffem.train_network import (
    TrainingOptions,
    controller_targets,
    train_on_controller,
)

Predictor = Callable[[Tensor], Tensor]


def trained(
    build: Callable[[], nn.Module], controller: MamdaniController, samples: int, **options
) -> Predictor:
    network = build()
    chosen = TrainingOptions(**options)
    train_on_controller(network, controller, samples=samples, options=chosen)
    return lambda x: network(x.unsqueeze(1))[:, 0]


def perceptron(controller: MamdaniController, samples: int) -> Predictor:
    """scikit-learn's multilayer perceptron on standardised data."""
    from sklearn.neural_network import MLPRegressor

    x, y = controller_targets(controller, samples, 0)
    x_mean, x_std, y_mean, y_std = x.mean(0), x.std(0), y.mean(0), y.std(0)
    net = MLPRegressor(hidden_layer_sizes=(10,), activation="tanh", solver="lbfgs",
                       max_iter=500, max_fun=10**6, alpha=1e-6, tol=1e-7,
                       random_state=0)  # fmt: skip
    net.fit(((x - x_mean) / x_std).numpy(), ((y - y_mean) / y_std).numpy())

    def predict(x: Tensor) -> Tensor:
        return torch.as_tensor(net.predict(((x - x_mean) / x_std).numpy())) * y_std + y_mean

    return predict


def trees(controller: MamdaniController, samples: int) -> Predictor:
    """scikit-learn's gradient-boosted histograms, one for each output."""
    from sklearn.ensemble import HistGradientBoostingRegressor

    x, y = (part.numpy() for part in controller_targets(controller, samples, 0))
    fits = [HistGradientBoostingRegressor(random_state=0).fit(x, column) for column in y.T]
    return lambda x: torch.as_tensor(np.stack([f.predict(x.numpy()) for f in fits], 1))


def learning(controller: MamdaniController, samples: int) -> dict[str, Callable[[], Predictor]]:
    def ours(build: Callable[[], nn.Module], **options: int) -> Callable[[], Predictor]:
        return partial(trained, build, controller, **{"samples": samples, **options})

    def layer(terms: int, **options: object) -> Callable[[], nn.Module]:
        return lambda: Anfis(1, 2, [terms, terms], 2, **options)

    five = {"starts": 5, "search_steps": 15, "max_steps": 8}
    rbf = {"search_steps": 100, "max_steps": 30}
    rows = {
        "ANFIS 5x5, 4,000 samples": ours(layer(5), samples=4000, search_steps=15, max_steps=2),
        "ANFIS 5x5, one start": ours(layer(5), max_steps=15),
        "ANFIS 5x5, best of 5 by evidence": ours(layer(5), **five),
        "ANFIS 5x5, constant consequents": ours(layer(5, order=0), max_steps=15),
        "ANFIS 5x5, interpretable": ours(layer(5, interpretable=True), max_steps=15),
        "ANFIS 7x7": ours(layer(7), max_steps=10),
        "ANFIS 5x5 + RBF head": ours(lambda: AnfisRBF(1, 2, [5, 5], 2), max_steps=10),
        "RBF 2-10-2, one start": ours(lambda: RBFNetwork(1), **rbf),
        "RBF 2-10-2, best of 5 by evidence": ours(lambda: RBFNetwork(1), starts=5, **rbf),
    }
    if importlib.util.find_spec("sklearn") is None:
        print("scikit-learn is not installed: its rows are left out")
        return rows
    return rows | {
        "scikit-learn perceptron 2-10-2": partial(perceptron, controller, samples),
        "scikit-learn boosted trees": partial(trees, controller, samples),
    }


def simpful_controller(controller: MamdaniController) -> Callable[[np.ndarray], np.ndarray]:
    """The same controller in simpful (plain sum over 101 points), sample by sample."""
    import simpful

    rules, system = controller.rule_base, simpful.FuzzySystem(show_banner=False)
    for variable in (*rules.inputs, *rules.outputs):
        # Within the universe a shoulder at its end is the Gaussian's one half.
        sets = [
            simpful.FuzzySet(function=simpful.Gaussian_MF(*term.parameters), term=term.name)
            for term in variable.sets
        ]
        universe = list(variable.universe)
        system.add_linguistic_variable(
            variable.name, simpful.LinguisticVariable(sets, universe_of_discourse=universe)
        )
    names = [v.name for v in rules.inputs], [v.name for v in rules.outputs]
    for rule in rules.rules:
        given = " AND ".join(f"({n} IS {t})" for n, t in zip(names[0], rule.given, strict=True))
        for name, term in zip(names[1], rule.then, strict=True):
            system.add_rules([f"IF {given} THEN ({name} IS {term})"])

    def infer(x: np.ndarray) -> np.ndarray:
        rows = []
        for sample in x:
            for name, value in zip(names[0], sample, strict=True):
                system.set_variable(name, float(value))
            said = system.Mamdani_inference(names[1], subdivisions=101)
            rows.append([said[name] for name in names[1]])
        return np.array(rows)

    return infer


def skfuzzy_controller(controller: MamdaniController) -> Callable[[np.ndarray], np.ndarray]:
    """The same controller in scikit-fuzzy's control system, sample by sample."""
    from skfuzzy import control

    rules, parts = controller.rule_base, {}
    for kind, variables in (
        (control.Antecedent, rules.inputs),
        (control.Consequent, rules.outputs),
    ):
        for variable in variables:
            # At a resolution at which interpolating the inputs' sets costs no accuracy.
            grid = np.linspace(*variable.universe, 101 if kind is control.Consequent else 1001)
            part = kind(grid, variable.name)
            for term in variable.sets:
                part[term.name] = term(torch.as_tensor(grid)).numpy()
            parts[variable.name] = part
    listed = []
    for rule in rules.rules:
        given = [parts[v.name][t] for v, t in zip(rules.inputs, rule.given, strict=True)]
        then = [parts[v.name][t] for v, t in zip(rules.outputs, rule.then, strict=True)]
        listed.append(control.Rule(given[0] & given[1], then))
    simulation = control.ControlSystemSimulation(control.ControlSystem(listed), cache=False)

    def infer(x: np.ndarray) -> np.ndarray:
        rows = []
        for sample in x:
            for variable, value in zip(rules.inputs, sample, strict=True):
                simulation.input[variable.name] = float(value)
            simulation.compute()
            rows.append([simulation.output[v.name] for v in rules.outputs])
        return np.array(rows)

    return infer


def evaluation(controller: MamdaniController, samples: int) -> None:
    """Time of evaluating the controller itself; peers on fewer samples, scaled up."""
    x, y = controller_targets(controller, samples, 0)
    own = x / controller.si_factor
    times = []
    for _ in range(5):
        start = time.process_time()
        controller.infer(own)
        times.append(time.process_time() - start)
    print(f"{'controller':34} {'seconds':>9}   {'deviation from ours [% of universe]':>12}")
    print(f"{'nfriction':34} {sorted(times)[2]:9.3f}")
    span = np.array([np.ptp(v.universe) for v in controller.rule_base.outputs])
    few = 20
    for module, build in (("simpful", simpful_controller), ("skfuzzy", skfuzzy_controller)):
        if importlib.util.find_spec(module) is None:
            print(f"{module:34} is not installed: left out")
            continue
        infer = build(controller)
        start = time.perf_counter()
        said = infer(own[:few].numpy())
        seconds = (time.perf_counter() - start) * samples / few
        deviation = 100 * np.abs((said - y[:few].numpy()) / span).max()
        print(f"{f'{module} (from {few} samples)':34} {seconds:9.1f}   {deviation:12.2e}")


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=40_000, help="to train on")
    parser.add_argument("--only", default="", help="rows whose name contains this")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    controller = paper_controller(2)
    evaluation(controller, options.samples)
    x, y = controller_targets(controller, 10_000, 1_000_000)
    observed = y.amax(0) - y.amin(0)
    universe = torch.tensor([np.ptp(v.universe) for v in controller.rule_base.outputs])
    print(f"\nobserved range of B and C over their universe: {(observed / universe).tolist()}")
    print(f"{'network':34} {'CPU s':>7} {'wall s':>7} {'% of observed':>14} {'% of universe':>14}")
    for name, train in learning(controller, options.samples).items():
        if options.only not in name:
            continue
        start, work = time.perf_counter(), time.process_time()
        predict = train()
        seconds, work = time.perf_counter() - start, time.process_time() - work
        with torch.no_grad():
            rmse = (predict(x) - y).square().mean(0).sqrt()
        shares = [100 * float((rmse / span).mean()) for span in (observed, universe)]
        print(
            f"{name:34} {work:7.2f} {seconds:7.2f} {shares[0]:14.3f} {shares[1]:14.3f}", flush=True
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
