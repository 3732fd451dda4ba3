"""Identification put to the test: friction that is known, and recordings that were left out.

    python benchmarks/identification.py recovery [--seconds 10 20 40] [--seeds 1] [--peer mujoco]
    python benchmarks/identification.py real DATA [--only triple ...] [--models NCFM LFM NFLFM]
                                                 [--blocks N] [--peer scipy]
                                                 [--loss huber] [--fit-delay]
                                                 [--recorded-zeros] [--seen]
    python benchmarks/identification.py intervals DATA [--only triple ...] [--models CFM]
                                                      [--seconds 5]
    python benchmarks/identification.py own-rigs [--seeds 10] [--rigs 10]
    python benchmarks/identification.py within-limit [--releases 100]
    python benchmarks/identification.py presliding [--seeds 20] [--torque-noise 0] [--substeps 1]

Run from the repository's root, on one thread. `recovery` simulates the papers' three links with
viscous and Coulomb friction, reads them with encoders of 8192 counts at 1 kHz and fits friction
and plant with everything else unknown too. It prints the largest error of the six coefficients,
the share of 95 % intervals that hold the truth, their median half-width, seconds to a fit, and
what the fit says of itself. The model starts at three times the true friction (a fit of ours then
takes its own start from the torques), and a fit of ours is given a plant whose ratios, lengths and
zeros are off by as much as it expects. With `--peer mujoco` the toolbox of `mujoco[sysid]` gets
the same recordings and starts, and the true plant; it simulates them whole, or in short windows
from smoothed states.

`real` leaves one recording out at a time, fits the others and simulates the one left out from its
first state. Where encoders were zeroed at the start of each recording, its first second shows the
zero and is not judged; `--recorded-zeros` takes it as recorded. With `--blocks N` each recording
is cut in N, and one block of every recording is left out at a time, and simulated with the zeros
that the others of its recording showed where encoders were zeroed anew. `--seen` adds the error of
the same model fitted to all recordings at once: an aim below it is out of this model's reach. The
recordings of the single pendulum follow each other as it slows down, so the first one left out asks
for drag at twice the speed of the others. With `--peer scipy` every
constant law is also fitted by single shooting, as the baselines on the recordings' cards were,
which shows how hard these recordings are beside those that are kept apart. The first row is of no
friction, and the last the limit of these data; models that `compare` calls unfit are marked.
DATA holds a folder to each set, with a `recordings.csv` of initial states.

`intervals` fits pieces of recordings, each alone, and prints how often the difference of what two
of them say lies within its 95 % interval; and how often the intervals hold the truth where each
piece is simulated by its own fit, so that law and plant are right.

`own-rigs` fits rigs as a new user brings them, two recordings of 10 s at 500 Hz with 4096 counts
each, by default settings and on a plant that is off by as much as a fit expects: a driven flywheel
with Stribeck friction as an axis and as a chain, and random links, driven and free, with random
laws. It prints each coefficient's error, half its 95 % interval, and whether the error is within
3 %, or the fit said that it cannot tell (not identifiable, at a bound, not converged, or an
interval wider than 3 % that holds the truth), or neither: MISSED.

`within-limit` scores the true law on the true rig, on a recording each of as many of these random
rigs: 95 of 100 should be within the limit of their data. It prints errors and limits of the free
run and of windows of 1, 2 and 5 s.

`presliding` fits LuGre's six coefficients on a driven axis to a recording below breakaway and one
that slides, 10 s at 1 kHz with encoders of 14 bits; every seed has coefficients of its own. The
recorded torque has noise of the given standard deviation [N]; more substeps make the recordings
more accurate than the simulations of a fit.
"""

import argparse
import sys
from pathlib import Path

import torch
from left_out import SETS, real
from own_rigs import own_rigs, presliding, within_limit
from pieces import intervals
from recovery import RELEASES, recovery

from nfriction.cli.inputs import DEFAULT_MODELS
from nfriction.fitting.options import CHOICES


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(required=True, dest="command")
    known = commands.add_parser("recovery", help="simulated friction found again")
    known.add_argument("--seconds", type=float, nargs="+", default=[10.0, 20.0, 40.0])
    known.add_argument("--seeds", type=int, default=1)
    known.add_argument("--releases", nargs="+", default=list(RELEASES), choices=list(RELEASES))
    known.add_argument("--peer", choices=["mujoco"])
    given = commands.add_parser("real", help="recordings left out one by one")
    given.add_argument("data", type=Path)
    given.add_argument("--only", nargs="+", default=list(SETS), choices=list(SETS))
    given.add_argument("--models", nargs="+", default=DEFAULT_MODELS.split(","))
    given.add_argument("--blocks", type=int, default=1)
    given.add_argument("--peer", choices=["scipy"])
    given.add_argument("--loss", default="linear", choices=CHOICES["loss"])
    given.add_argument("--fit-delay", action="store_true")
    given.add_argument("--recorded-zeros", action="store_true")
    given.add_argument("--seen", action="store_true")
    apart = commands.add_parser("intervals", help="intervals held against pieces of recordings")
    apart.add_argument("data", type=Path)
    apart.add_argument("--only", nargs="+", default=list(SETS), choices=list(SETS))
    apart.add_argument("--models", nargs="+", default=["CFM"])
    apart.add_argument("--seconds", type=float, default=5.0)
    own = commands.add_parser("own-rigs", help="rigs of new users")
    own.add_argument("--seeds", type=int, default=10)
    own.add_argument("--rigs", type=int, default=10)
    limit = commands.add_parser("within-limit", help="scores of the truth against their limit")
    limit.add_argument("--releases", type=int, default=100)
    memory = commands.add_parser("presliding", help="LuGre friction found again")
    memory.add_argument("--seeds", type=int, default=20)
    memory.add_argument("--torque-noise", type=float, default=0.0)
    memory.add_argument("--substeps", type=int, default=1)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.command == "recovery":
        recovery(arguments.seconds, arguments.seeds, arguments.releases, arguments.peer)
    elif arguments.command == "intervals":
        intervals(arguments.data, arguments.only, arguments.models, arguments.seconds)
    elif arguments.command == "own-rigs":
        own_rigs(arguments.seeds, arguments.rigs)
    elif arguments.command == "within-limit":
        within_limit(arguments.releases)
    elif arguments.command == "presliding":
        presliding(arguments.seeds, arguments.torque_noise, arguments.substeps)
    else:
        peer = arguments.peer is not None
        real(
            arguments.data, arguments.only, arguments.models, arguments.blocks, peer,
            arguments.recorded_zeros, arguments.seen, loss=arguments.loss,
            fit_delay=arguments.fit_delay,
        )  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main())
