"""Train a neuro-fuzzy model by our method or by the TLRIP paper's own procedure.

    python trainers/train_neurofuzzy.py run1.csv run2.csv --rig rig.json --model NFLFM
    python trainers/train_neurofuzzy.py --twin tlrip --model NFNLFM --procedure papers

Both fit the constant law first. Our method corrects it by an ANFIS layer with a radial basis head,
fitted to trajectories. The papers fit coefficients by class of acceleration, use them as the output
ranges of a fuzzy controller, and train a radial basis network on its outputs for 40,000 samples per
joint. After Ctrl-C or a kill, `--resume` reads the finished stages and restarts the others, with
the same result.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace

import common

from nfriction.evaluation.results import model_info
from nfriction.papers.reproduction.stages import (
    fit_by_class,
    fit_network,
    network_by_controller,
)

MODELS = ("NFNCFM", "NFCFM", "NFCVFM", "NFLFM", "NFNLFM", "NFStribeck")
# Its law has no adaptive model.
WITHOUT_CLASSES = "NFStribeck"


def train(argv: Sequence[str] | None) -> str:
    parser = common.parser(__doc__.splitlines()[0])
    parser.add_argument("--model", choices=MODELS, default="NFLFM")
    parser.add_argument("--procedure", choices=("ours", "papers"), default="ours")
    parser.add_argument("--samples", type=common.natural, default=40_000,
                        help="of the papers' controller, per joint")  # fmt: skip
    parser.add_argument("--terms", type=common.natural, nargs=2, default=[5, 5], metavar="SETS",
                        help="fuzzy sets of velocity and of acceleration (our method)")  # fmt: skip
    parser.add_argument(
        "--units", type=common.natural, default=10, help="of the radial basis network"
    )
    given = parser.parse_args(argv)
    if given.model == WITHOUT_CLASSES and given.procedure == "papers":
        raise ValueError(f"{given.model} has no classes; give --procedure ours.")
    bench = common.read(given)
    workspace = common.start(
        given,
        bench,
        controller_samples=given.samples,
        terms=tuple(given.terms),
        head_units=given.units,
        network_units=given.units,
    )
    if given.procedure == "ours":
        return common.finish(given, bench, fit_network(workspace, bench, given.model))
    law = given.model.removeprefix("NF")
    adaptive = fit_by_class(workspace, bench, f"A{law}")
    model, ended = network_by_controller(workspace, bench, law, progress=sys.stderr.isatty())
    info = replace(model_info(adaptive, bench.train), fit=ended)
    return common.write(given, bench, model, info, adaptive.plant)


if __name__ == "__main__":
    common.run(train)
