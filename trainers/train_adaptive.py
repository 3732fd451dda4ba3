"""Train a model with coefficients by class of acceleration: the TLRIP paper's adaptive models.

    python trainers/train_adaptive.py run1.csv run2.csv --rig rig.json --model ALFM
    python trainers/train_adaptive.py --twin tlrip --model ANLFM --method pattern

After Ctrl-C or a kill, `--resume` reads the constant fit, which comes first, if it was finished; a
pattern search continues from its last iteration, and the other methods restart their stage. The
result is that of an uninterrupted run.
"""

from collections.abc import Sequence

import common

from nfriction.papers.reproduction.stages import fit_by_class, fit_from_start, fit_searched

MODELS = ("ANCFM", "ACFM", "ACVFM", "ALFM", "ANLFM")


def train(argv: Sequence[str] | None) -> str:
    parser = common.parser(__doc__.splitlines()[0])
    parser.add_argument("--model", choices=MODELS, default="ALFM")
    parser.add_argument("--method", choices=("gauss-newton", "pattern", "sqp"),
                        default="gauss-newton")  # fmt: skip
    parser.add_argument(
        "--max-evaluations", type=common.natural, default=5000, help="limit for a search"
    )
    given = parser.parse_args(argv)
    bench = common.read(given)
    workspace = common.start(given, bench, search_evaluations=given.max_evaluations)
    if given.method == "gauss-newton":
        found = fit_by_class(workspace, bench, given.model)
    else:
        constant = fit_from_start(workspace, bench, given.model.removeprefix("A"))
        found = fit_searched(
            workspace, bench, given.model, given.method, given.windows[-1], start=constant
        )
    return common.finish(given, bench, found)


if __name__ == "__main__":
    common.run(train)
