"""Train a model with constant coefficients on recordings of 40 s, or as the second paper did.

    python trainers/train_constant.py run1.csv run2.csv --rig rig.json --model NLFM
    python trainers/train_constant.py --twin rtip --model NCFM --method sqp
    python trainers/train_constant.py --twin rtip --model LFM --method pattern

The last two are the second paper's estimation (80 s): NCFM by sequential quadratic programming,
LFM and NLFM by pattern search of the simulated position. `--resume` after a Ctrl-C or a kill: a
pattern search goes on from its last iteration; the other methods, which take seconds to minutes,
begin anew. Each way the result is that of a run that nobody ended.
"""

import sys
from collections.abc import Sequence

from nfriction.evaluation.results import model_info
from nfriction.fitting.fit import fit
from nfriction.friction.registry import model_by_name
from nfriction.papers.afem.fit_by_search import fit_by_search
from nfriction.papers.reproduction import training


def train(argv: Sequence[str] | None) -> str:
    parser = training.parser(__doc__.splitlines()[0])
    parser.add_argument("--model", choices=("NCFM", "LFM", "NLFM", "Stribeck"), default="NLFM")
    parser.add_argument("--method", choices=("trajectory", "pattern", "sqp"), default="trajectory")
    parser.add_argument("--horizon", type=float, default=5.0,
                        help="length of the windows that a search simulates [s]")  # fmt: skip
    parser.add_argument("--max-evaluations", type=int, default=5000, help="of a search")
    given = parser.parse_args(argv)
    training_run = training.Training(given)
    data = training_run.data()
    model = model_by_name(given.model)(data.plant.joints)
    if given.method == "trajectory":
        found = training_run.stage("constant", data, lambda tell: fit(
            model, data.plant, data.train, motions=data.motions, windows=given.windows,
            max_steps=given.max_steps, fit_plant=given.plant == "fit", callback=tell,
        ))  # fmt: skip
    else:
        found = training_run.stage("constant", data, lambda tell: fit_by_search(
            model, data.plant, data.train, method=given.method, motions=data.motions,
            horizon=given.horizon, max_evaluations=given.max_evaluations, seed=given.seed,
            state=training_run.search_state(), callback=training_run.keep_search(tell),
        ))  # fmt: skip
    return training_run.finish(data, found.model, model_info(found, data.train), found.plant)


def main(argv: Sequence[str] | None = None) -> int:
    print(training.run(train, argv))
    return 0


if __name__ == "__main__":
    sys.exit(main())
