"""Train a model with constant coefficients on recordings, or as the RTIP paper did.

    python trainers/train_constant.py run1.csv run2.csv --rig rig.json --model NLFM
    python trainers/train_constant.py --twin rtip --model NCFM --method sqp --horizon 80
    python trainers/train_constant.py --twin rtip --model LFM --method pattern --horizon 80

The last two repeat the RTIP paper's estimation over 80 s: NCFM by sequential quadratic programming,
LFM and NLFM by pattern search on the simulated position. After Ctrl-C or a kill, `--resume`
continues a pattern search from its last iteration; the other methods, which take seconds to
minutes, start again. The result is that of an uninterrupted run.
"""

from collections.abc import Sequence

import common

from nfriction.cli.inputs import positive
from nfriction.papers.reproduction.stages import fit_from_start, fit_searched

MODELS = ("NCFM", "CFM", "CVFM", "LFM", "NLFM", "Stribeck")


def train(argv: Sequence[str] | None) -> str:
    parser = common.parser(__doc__.splitlines()[0])
    parser.add_argument("--model", choices=MODELS, default="NLFM")
    parser.add_argument(
        "--method", choices=("output-error", "pattern", "sqp"), default="output-error"
    )
    parser.add_argument("--horizon", type=positive, default=5.0,
                        help="length of the windows that a search simulates [s]")  # fmt: skip
    parser.add_argument(
        "--max-evaluations", type=common.natural, default=5000, help="limit for a search"
    )
    given = parser.parse_args(argv)
    bench = common.read(given)
    workspace = common.start(given, bench, search_evaluations=given.max_evaluations)
    if given.method == "output-error":
        found = fit_from_start(workspace, bench, given.model)
    else:
        found = fit_searched(workspace, bench, given.model, given.method, given.horizon)
    return common.finish(given, bench, found)


if __name__ == "__main__":
    common.run(train)
