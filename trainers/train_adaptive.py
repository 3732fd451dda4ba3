"""Train a model with coefficients by class of acceleration: the first paper's adaptive models.

    python trainers/train_adaptive.py run1.csv run2.csv --rig rig.json --model ALFM
    python trainers/train_adaptive.py --twin tlrip --model ANLFM --method pattern

`--resume` after a Ctrl-C or a kill: the constant fit that comes first is read where it was
finished, a pattern search goes on from its last iteration, the other methods begin their stage
anew. Each way the result is that of a run that nobody ended.
"""

import sys
from collections.abc import Sequence

from nfriction.evaluation.results import model_info
from nfriction.fitting.fit import fit
from nfriction.friction.registry import model_by_name
from nfriction.papers.afem.fit_adaptive import fit_adaptive
from nfriction.papers.afem.fit_by_search import fit_by_search
from nfriction.papers.reproduction import training


def train(argv: Sequence[str] | None) -> str:
    parser = training.parser(__doc__.splitlines()[0])
    parser.add_argument("--model", choices=("ANCFM", "ALFM", "ANLFM"), default="ALFM")
    parser.add_argument("--method", choices=("gauss-newton", "pattern", "sqp"),
                        default="gauss-newton")  # fmt: skip
    parser.add_argument("--max-evaluations", type=int, default=5000, help="of a search")
    given = parser.parse_args(argv)
    training_run = training.Training(given)
    data = training_run.data()
    settings = {
        "motions": data.motions, "windows": given.windows, "max_steps": given.max_steps,
        "fit_plant": given.plant == "fit",
    }  # fmt: skip
    law = model_by_name(given.model.removeprefix("A"))(data.plant.joints)
    constant = training_run.stage("constant", data, lambda tell: fit(
        law, data.plant, data.train, callback=tell, **settings
    ))  # fmt: skip
    model = model_by_name(given.model)(data.plant.joints)
    if given.method == "gauss-newton":
        found = training_run.stage("adaptive", data, lambda tell: fit_adaptive(
            model, data.plant, data.train, start=constant, callback=tell, **settings
        ))  # fmt: skip
    else:
        found = training_run.stage("adaptive", data, lambda tell: fit_by_search(
            model, data.plant, data.train, method=given.method, start=constant,
            motions=data.motions, horizon=given.windows[-1], seed=given.seed,
            max_evaluations=given.max_evaluations, state=training_run.search_state(),
            callback=training_run.keep_search(tell),
        ))  # fmt: skip
    return training_run.finish(data, found.model, model_info(found, data.train), found.plant)


def main(argv: Sequence[str] | None = None) -> int:
    print(training.run(train, argv))
    return 0


if __name__ == "__main__":
    sys.exit(main())
