"""Train the TLRIP paper's networks on the outputs of fuzzy controllers along a measured motion.

    python trainers/train_supervised.py
    python trainers/train_supervised.py --adaptive runs/papers/models/ANLFM.json --units 12
    python trainers/train_supervised.py --noise 0.1 --every 10

The data set is `tlrip_controller`: 40,000 samples per joint of velocity, acceleration and the
outputs of the papers' own controllers, coefficients B and C of the linear law. With `--adaptive`,
the controllers are instead spanned by the coefficients by class of an adaptive model of any law,
along the same motion. `--noise` adds noise to the outputs that the networks learn, and `--every`
thins the samples; errors are those on all samples without noise. Writes the model with its
TorchScript, a figure of the loss by step and one of the learnt outputs. A run takes about a minute;
after an interruption it starts again.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import common
import torch
from matplotlib.figure import Figure

from nfriction import datasets, load
from nfriction.cli.inputs import count, positive
from nfriction.export import torchscript
from nfriction.friction import model_names
from nfriction.friction.laws import LINEAR, Law
from nfriction.io.model_file import ModelInfo, save
from nfriction.papers.afem.adaptive import Adaptive
from nfriction.papers.controller.mamdani import MamdaniController, paper_controller
from nfriction.papers.controller.samples import ControllerSamples, sampled
from nfriction.papers.nffem.train_network import TrainingOptions, recorded_losses
from nfriction.papers.reproduction.procedure import controllers_from_classes, train_on_samples
from nfriction.plots import style
from nfriction.signals import Motion

MODELS = tuple(name for name in model_names() if name.startswith("NF"))
SHOWN_SECONDS = 12.0  # of the motion, which has almost stopped later


def train(argv: Sequence[str] | None) -> str:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--adaptive", type=Path, metavar="MODEL",
                        help="adaptive model file whose classes span the controllers")  # fmt: skip
    parser.add_argument("--units", type=common.natural, default=10, help="of each network")
    parser.add_argument(
        "--max-steps", type=common.natural, default=100, help="of Bayesian regularisation"
    )
    parser.add_argument(
        "--starts", type=common.natural, default=1,
        help="number of starts; the best by evidence is kept",
    )  # fmt: skip
    parser.add_argument("--seconds", type=positive, help="duration of the motion; default 40 s")
    parser.add_argument(
        "--noise", type=positive, default=0.0,
        help="standard deviation of noise on the outputs, as a share of their range",
    )  # fmt: skip
    parser.add_argument(
        "--every", type=common.natural, default=1, help="train on one of this many samples"
    )
    parser.add_argument("--seed", type=count, default=0, help="of encoders, noise and starts")
    parser.add_argument("--out", type=Path, default=Path("runs/supervised"), help="folder to write")
    given = parser.parse_args(argv)
    law, controllers, samples = _data(given)
    losses, keep = recorded_losses(samples.joint_names)
    options = TrainingOptions(
        max_steps=given.max_steps, seed=given.seed, starts=given.starts, callback=keep
    )
    span = samples.y.amax(0) - samples.y.amin(0)
    taught = _taught(samples, given.noise * span, given)
    model, fits = train_on_samples(law, controllers, taught, units=given.units, options=options)
    ended = [f"{n}: {f.message}" for n, f in zip(samples.joint_names, fits, strict=True)]
    converged = all(f.converged for f in fits)
    fastest, (braking, driving) = samples.x[..., 0].amax(0), samples.x[..., 1].aminmax(dim=0)
    info = ModelInfo(
        joint_names=samples.joint_names,
        input_ranges={"qd": torch.stack([-fastest, fastest], -1).tolist(),
                      "qdd": torch.stack([braking, driving], -1).tolist()},
        fit={"status": " ".join(ended), "converged": converged},
    )  # fmt: skip
    path = save(model, given.out / f"{type(model).__name__}.json", info)
    torchscript(model, path.with_suffix(".pt"), info)
    learnt = model.schedule(samples.x[..., 0], samples.x[..., 1])
    error = (learnt - samples.y).square().mean(0).sqrt() / span
    common.draw_losses(losses, given.out / f"{path.stem}-loss.png")
    _outputs(law, samples, learnt).savefig(given.out / f"{path.stem}-outputs.png", dpi=150)
    lines = [
        f"{path.stem}: {len(taught)} samples per joint, {given.units} units",
        *ended,
        *(
            f"{joint}: error of the network [% of the output's range] "
            + ", ".join(
                f"{n} {100 * e:.2f}" for n, e in zip(samples.output_names, row, strict=True)
            )
            for joint, row in zip(samples.joint_names, error.tolist(), strict=True)
        ),
        f"wrote {path}, its TorchScript and figures of loss and outputs",
    ]
    return "\n".join(lines)


def _data(
    given: argparse.Namespace,
) -> tuple[Law, list[MamdaniController], ControllerSamples]:
    """The law, its controllers and their samples."""
    samples = datasets.load("tlrip_controller", seed=given.seed, duration=given.seconds)
    assert isinstance(samples, ControllerSamples)
    if given.adaptive is None:
        return LINEAR, [paper_controller(joint) for joint in (2, 3, 4)], samples
    adaptive = load(given.adaptive)
    if not isinstance(adaptive.schedule, Adaptive) or adaptive.joints != len(samples.joint_names):
        raise ValueError(
            f"--adaptive needs an adaptive model of {len(samples.joint_names)} joints, "
            f"{given.adaptive} contains {type(adaptive).__name__} with {adaptive.joints} joints."
        )
    speed, acceleration = samples.x.unbind(-1)
    motion = Motion(samples.time, *(x.numpy() for x in (speed, speed, acceleration)))
    controllers = controllers_from_classes(
        adaptive.law, adaptive.schedule.values, motion.qd, motion.qdd
    )
    again = sampled(controllers, motion, joint_names=samples.joint_names)
    return adaptive.law, controllers, again


def _taught(
    samples: ControllerSamples, noise: torch.Tensor, given: argparse.Namespace
) -> ControllerSamples:
    """The samples to train on, with noise of a standard deviation for each joint and output."""
    draw = torch.Generator().manual_seed(given.seed)
    y = samples.y + noise * torch.randn(samples.y.shape, dtype=noise.dtype, generator=draw)
    part = slice(None, None, given.every)
    return replace(samples, time=samples.time[part], x=samples.x[part], y=y[part])


def _outputs(law: Law, samples: ControllerSamples, learnt: torch.Tensor) -> Figure:
    """Outputs of controller and network along the motion, one column per joint."""
    shown = samples.time <= SHOWN_SECONDS
    count = len(samples.output_names)
    units = {c.name: c.unit for c in law.coefficients}
    figure, axes = style.panels(
        count, len(samples.joint_names), style.PAGE, 0.6 + 1.3 * count, sharex=True
    )
    for row, name in zip(range(count), samples.output_names, strict=True):
        for column, joint in enumerate(samples.joint_names):
            ax = axes[row, column]
            (given,) = ax.plot(samples.time[shown], samples.y[shown, column, row], **style.MEASURED)
            (found,) = ax.plot(
                samples.time[shown], learnt[shown, column, row], color=style.COLOURS[0],
                linewidth=0.9,
            )  # fmt: skip
            if row == 0:
                style.title(ax, joint)
        axes[row, 0].set_ylabel(f"{name} [{units[name]}]")
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    style.legend(figure, [given, found], ["controller", "network"])
    return figure


if __name__ == "__main__":
    common.run(train)
