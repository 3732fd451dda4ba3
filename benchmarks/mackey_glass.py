"""Chaotic Mackey-Glass series, predicted six steps ahead from four values (Jang 1993).

Run from the repository's root: `python benchmarks/mackey_glass.py [--starts 3]`, on one thread.
Series: tau = 17, x(0) = 1.2, x(t) = 0 before, Runge-Kutta 4 with step 0.1. Inputs x(t-18),
x(t-12), x(t-6), x(t), output x(t+6), t = 118 ... 1117; the first 500 pairs train, the other 500
test. NDEI is the error's RMS over the standard deviation of the targets; Jang's hybrid learning of
two bell sets an input reaches 0.007. Peers that are not installed (scikit-learn) are named and
skipped.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import time
from collections.abc import Callable

import torch
from torch import Tensor

from nfriction.fuzzy import Anfis
from nfriction.papers.nffem.train_network import TrainingOptions, train_network

Predictor = Callable[[Tensor], Tensor]


def mackey_glass(last: int, tau: int = 17, step: float = 0.1) -> Tensor:
    """x(0), x(1), ... x(last) of dx/dt = 0.2 x(t - tau) / (1 + x(t - tau)^10) - 0.1 x(t).

    The series is chaotic, so that its second half is another one if the integration is not of
    fourth order: the delayed value half a step on is taken from Hermite's cubic, and it jumps from
    0 to 1.2 between two steps, not within one. Halving the step moves no value by 1e-6.
    """
    per_unit = round(1 / step)
    x, slopes = [1.2], []  # slopes: at the start and at the end of each step

    def slope(value: float, delayed: float) -> float:
        return 0.2 * delayed / (1 + delayed**10) - 0.1 * value

    for n in range(last * per_unit):
        past = n - tau * per_unit
        before = middle = after = 0.0
        if past >= 0:
            before, after = x[past], x[past + 1]
            rising, falling = slopes[past]
            middle = 0.5 * (before + after) + step / 8 * (rising - falling)
        k1 = slope(x[n], before)
        k2 = slope(x[n] + 0.5 * step * k1, middle)
        k3 = slope(x[n] + 0.5 * step * k2, middle)
        k4 = slope(x[n] + step * k3, after)
        x.append(x[n] + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4))
        slopes.append((k1, slope(x[-1], after)))
    return torch.tensor(x[::per_unit], dtype=torch.float64)


def pairs(series: Tensor) -> tuple[Tensor, Tensor]:
    """Inputs (1000, 4) and outputs (1000, 1) for t = 118 ... 1117."""
    t = torch.arange(118, 1118)
    x = torch.stack([series[t - lag] for lag in (18, 12, 6, 0)], 1)
    return x, series[t + 6].unsqueeze(1)


def by_evidence(x: Tensor, y: Tensor, terms: int, starts: int, steps: int) -> Predictor:
    """ANFIS with `terms` sets an input; the training pairs' evidence chooses among the fits.

    Tried are Gaussian and bell sets, from even grids or shaken ones, moved or not by least squares
    before they are regularised.
    """
    best, chosen, found = -float("inf"), None, ""
    for kind in ("gaussian", "bell"):
        for search_steps in (0, 10):
            anfis = Anfis(1, 4, [terms] * 4, 1, kind=kind)
            anfis.init_grid(x.amin(0), x.amax(0))
            fit = train_network(
                anfis, x.unsqueeze(1), y.unsqueeze(1),
                TrainingOptions(starts=starts, search_steps=search_steps, max_steps=steps),
            )[0]  # fmt: skip
            if fit.log_evidence > best:
                best, chosen = fit.log_evidence, anfis
                found = f"{kind}, {search_steps} search steps, {fit.status}"
    assert chosen is not None
    print(f"  chosen by evidence ({best:.0f} nats): {found}")
    return lambda inputs: chosen(inputs.unsqueeze(1))[:, 0]


def perceptron(x: Tensor, y: Tensor) -> Predictor:
    """scikit-learn's multilayer perceptron, 20 tanh units, L-BFGS."""
    from sklearn.neural_network import MLPRegressor

    net = MLPRegressor(hidden_layer_sizes=(20,), activation="tanh", solver="lbfgs",
                       max_iter=20_000, max_fun=10**6, alpha=1e-8, tol=1e-12,
                       random_state=0)  # fmt: skip
    x_mean, x_std, y_mean, y_std = x.mean(0), x.std(0), y.mean(), y.std()
    net.fit(((x - x_mean) / x_std).numpy(), ((y[:, 0] - y_mean) / y_std).numpy())

    def predict(inputs: Tensor) -> Tensor:
        said = net.predict(((inputs - x_mean) / x_std).numpy())
        return torch.as_tensor(said).unsqueeze(1) * y_std + y_mean

    return predict


def gaussian_process(x: Tensor, y: Tensor) -> Predictor:
    """scikit-learn's Gaussian process with a width for each input."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel

    kernel = ConstantKernel(10.0, (1e-2, 1e5)) * RBF([1.0] * 4, (1e-2, 1e3))
    net = GaussianProcessRegressor(kernel, alpha=1e-9, normalize_y=True)
    net.fit(x.numpy(), y[:, 0].numpy())
    return lambda inputs: torch.as_tensor(net.predict(inputs.numpy())).unsqueeze(1)


def ndei(predicted: Tensor, wanted: Tensor) -> float:
    return float((predicted - wanted).square().mean().sqrt() / wanted.std(correction=0))


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=300, help="of Bayesian regularisation")
    parser.add_argument("--starts", type=int, default=3, help="that the evidence chooses from")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    x, y = pairs(mackey_glass(1123))
    x_train, y_train, x_test, y_test = x[:500], y[:500], x[500:], y[500:]
    runs: dict[str, Callable[[], Predictor]] = {
        "ANFIS, 2^4 rules, Bayesian": lambda: by_evidence(
            x_train, y_train, 2, options.starts, options.steps
        ),
        "ANFIS, 3^4 rules, Bayesian": lambda: by_evidence(
            x_train, y_train, 3, options.starts, options.steps
        ),
    }
    if importlib.util.find_spec("sklearn") is None:
        print("scikit-learn is not installed: its rows are left out")
    else:
        runs["scikit-learn perceptron"] = lambda: perceptron(x_train, y_train)
        runs["scikit-learn Gaussian process"] = lambda: gaussian_process(x_train, y_train)
    print(f"{'method':32} {'seconds':>8} {'NDEI train':>11} {'NDEI test':>11}")
    for name, run in runs.items():
        start = time.perf_counter()
        predict = run()
        seconds = time.perf_counter() - start
        with torch.no_grad():
            errors = ndei(predict(x_train), y_train), ndei(predict(x_test), y_test)
        print(f"{name:32} {seconds:8.2f} {errors[0]:11.5f} {errors[1]:11.5f}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
