"""Your own rules as a table, the resulting surface, and a network that learns them."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch

from nfriction.fuzzy import RBFNetwork
from nfriction.papers.controller.mamdani import MamdaniController, controller_surface
from nfriction.papers.controller.rules import parse_rules
from nfriction.papers.nffem.train_network import TrainingOptions, train_on_controller

RULES = """{
  "format": "nfriction-rules/1",
  "name": "my joint",
  "inputs": {
    "velocity": {"unit": "deg/s",
                 "sets": {"slow": [0, 300], "medium": [150, 650], "fast": [450, 1000]}},
    "acceleration": {"unit": "deg/s^2", "universe": [-6000, 6000],
                     "sets": {"braking": [-6000, 500], "driving": [-500, 6000]}}
  },
  "outputs": {
    "B": {"unit": "N m s/rad", "sets": {"low": [0, 6e-4], "high": [4e-4, 1e-3]}},
    "C": {"unit": "N m", "sets": {"low": [0, 3e-3], "high": [2e-3, 5e-3]}}
  },
  "table": {
    "columns": "velocity",
    "braking": [["high", "high"], ["high", "low"], ["low", "low"]],
    "driving": [["high", "high"], ["low", "low"], ["low", "low"]]
  }
}"""


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few samples")
    parser.add_argument("--out", type=Path, default=Path("runs/fuzzy_rules"))
    arguments = parser.parse_args(argv)
    arguments.out.mkdir(parents=True, exist_ok=True)

    controller = MamdaniController(parse_rules(RULES, "my rules"))
    for rule in controller.rule_base.rules:
        given, then = " AND ".join(rule.given), " AND ".join(rule.then)
        print(f"IF {given} THEN B, C are {then}")
    controller_surface(controller).savefig(arguments.out / "surface.png", dpi=150)

    # Few steps and samples suffice for a demonstration; the papers use 40,000 samples.
    network = RBFNetwork(1, 2, 10, 2)
    samples, steps = (500, 3) if arguments.quick else (4000, 30)
    options = TrainingOptions(max_steps=steps)
    train_on_controller(network, controller, samples=samples, options=options)
    x = torch.rand(2000, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(9))
    x = (controller.lower + (controller.upper - controller.lower) * x) * controller.si_factor
    wanted = controller(x[:, 0], x[:, 1])
    error = (network(x[:, None])[:, 0] - wanted).square().mean(0).sqrt().detach()
    span = wanted.amax(0) - wanted.amin(0)
    print(
        "error of the network on new points, in % of range:", *(100 * error / span).numpy().round(2)
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
