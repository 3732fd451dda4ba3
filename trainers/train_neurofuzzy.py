"""Train a neuro-fuzzy model, our way or by the first paper's own procedure.

    python trainers/train_neurofuzzy.py run1.csv run2.csv --rig rig.json --model NFLFM
    python trainers/train_neurofuzzy.py --twin tlrip --model NFNLFM --procedure papers

Both fit the constant law, then coefficients by class of acceleration. Ours corrects these by an
ANFIS layer with a radial basis head, on trajectories. The papers span a fuzzy controller with them
and teach a radial basis network what it says on 40,000 samples a joint. `--resume` after a Ctrl-C
or a kill reads the stages that were finished and begins the one that was not anew, with the same
result.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from nfriction.evaluation.results import model_info
from nfriction.fitting.fit import fit
from nfriction.friction.registry import model_by_name
from nfriction.papers.afem.fit_adaptive import fit_adaptive
from nfriction.papers.nffem.refine_adaptive import refine_adaptive
from nfriction.papers.reproduction import training
from nfriction.papers.reproduction.procedure import papers_neuro_fuzzy


def train(argv: Sequence[str] | None) -> str:
    parser = training.parser(__doc__.splitlines()[0])
    parser.add_argument("--model", choices=("NFNCFM", "NFLFM", "NFNLFM"), default="NFLFM")
    parser.add_argument("--procedure", choices=("ours", "papers"), default="ours")
    parser.add_argument("--samples", type=int, default=40_000,
                        help="of the papers' controller, a joint")  # fmt: skip
    given = parser.parse_args(argv)
    training_run = training.Training(given)
    data = training_run.data()
    settings = {
        "motions": data.motions, "windows": given.windows, "max_steps": given.max_steps,
        "fit_plant": given.plant == "fit",
    }  # fmt: skip
    name, joints = given.model.removeprefix("NF"), data.plant.joints
    constant = training_run.stage("constant", data, lambda tell: fit(
        model_by_name(name)(joints), data.plant, data.train, callback=tell, **settings
    ))  # fmt: skip
    adaptive = training_run.stage("adaptive", data, lambda tell: fit_adaptive(
        model_by_name(f"A{name}")(joints), data.plant, data.train, start=constant,
        callback=tell, **settings
    ))  # fmt: skip
    if given.procedure == "ours":
        options: dict[str, Any] = {"network": "by_class"}
        found = training_run.stage("neuro-fuzzy", data, lambda tell: refine_adaptive(
            model_by_name(given.model)(joints, **options), adaptive, data.train,
            length=given.windows[-1], max_steps=given.max_steps, callback=tell
        ))  # fmt: skip
        return training_run.finish(data, found.model, model_info(found, data.train), found.plant)
    model = papers_neuro_fuzzy(
        adaptive.model, data.motions, samples=given.samples, seed=given.seed,
        progress=sys.stderr.isatty(),
    )  # fmt: skip
    info = replace(model_info(adaptive, data.train), fit={"status": "by the papers' procedure"})
    return training_run.finish(data, model, info, adaptive.plant)


def main(argv: Sequence[str] | None = None) -> int:
    print(training.run(train, argv))
    return 0


if __name__ == "__main__":
    sys.exit(main())
