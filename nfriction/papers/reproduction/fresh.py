"""Fresh releases of the TLRIP twin, used to rank models.

With two releases the ranking is left to chance, as one is from upright, where the motion amplifies
every error. These ten are predictable.
"""

import numpy as np
import torch
from numpy.typing import NDArray

from nfriction.evaluation.score import RMSE
from nfriction.friction.models import FrictionModel
from nfriction.papers.twin.dataset import QUICK_DURATION, RATE, sample_count, specification
from nfriction.papers.twin.mechanics import Links, simulate
from nfriction.plant import Plant
from nfriction.simulation.rollout import rollout
from nfriction.simulation.validate import required_substeps

Array = NDArray[np.float64]

# Joint angles [deg], released at rest. Drawn as in the family of twins, and selected only by the
# truth: starting one encoder count off at every joint, they stay within 16 counts for 10 s.
POSES = (
    (147.7, 37.5, 50.8), (159.0, -3.5, 27.4), (116.4, 53.5, -7.8), (204.9, -1.4, 13.2),
    (107.0, -50.7, -1.2), (117.1, 5.4, 30.0), (248.2, -41.7, -42.6), (147.5, 34.2, 47.5),
    (135.6, 19.1, -28.2), (218.5, -22.4, 58.6),
)  # fmt: skip


def true_positions(seconds: float) -> Array:
    """True positions along the releases [rad], at most 10 s, (release, sample, joint)."""
    specified, samples = specification("tlrip"), sample_count(min(seconds, QUICK_DURATION))
    links = Links.of(specified.rig())
    starts = np.deg2rad(POSES).tolist()
    return np.stack(
        [
            simulate(links, specified.friction, (a, b, c), samples=samples, rate=RATE).q
            for a, b, c in starts
        ]
    )


def free_run_errors(plant: Plant, model: FrictionModel, true: Array) -> list[list[float | None]]:
    """RMSE of free runs by release and joint [rad]; None if a simulation diverges."""
    start = torch.tensor(true[:, 0])
    run = rollout(
        plant, model, start, torch.zeros_like(start), sample_time=1 / RATE,
        steps=true.shape[1] - 1, substeps=required_substeps(plant, model, 1 / RATE),
        gradients=False,
    )  # fmt: skip
    return [RMSE.of(error).to_dict()["joints"] for error in run.q.numpy() - true]
