"""Many fits on a Dask cluster: one per recording, and a comparison of models.

Needs `pip install nfriction[dask]`, also on the workers. Without --scheduler, the cluster is this
machine.
"""

import argparse
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import joblib
import pandas as pd
import torch
from dask.distributed import Client, LocalCluster

from nfriction import LFM, Plant, Recording, compare, fit
from nfriction.papers import twin

QUICK = {"fit_plant": False, "windows": (0.5,), "max_steps": 1}


def coefficients(rig: Plant, recording: Recording, settings: dict) -> dict[str, float]:
    """Estimates from the fit of one recording, run on one of the workers."""
    torch.set_num_threads(1)  # a worker has one, and small tensors need no more
    found = fit(LFM(rig.joints), rig, recording, **settings)
    return {"converged": found.converged} | {i.name: i.value for i in found.intervals}


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a second instead of ten")
    parser.add_argument("--out", type=Path, default=Path("runs/many_fits_on_dask"))
    parser.add_argument("--scheduler", help="address of a cluster, tcp://HOST:8786")
    arguments = parser.parse_args(argv)
    settings = QUICK if arguments.quick else {"fit_plant": False}
    simulated = twin.make("tlrip", duration=1.0 if arguments.quick else 10.0)
    rig, train, test = simulated.plant, simulated.part("train"), simulated.part("test")
    if arguments.quick:
        train, test = train[:2], test[:1]
    arguments.out.mkdir(parents=True, exist_ok=True)

    with ExitStack() as stack:
        cluster = arguments.scheduler
        if cluster is None:
            # One thread per worker: fits share nothing, and compiled code has its own threads.
            cluster = stack.enter_context(
                LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
            )
        client = stack.enter_context(Client(cluster))
        # In this block, joblib runs everything on the cluster, including calls from nfriction.
        stack.enter_context(joblib.parallel_config(backend="dask"))

        fits = joblib.Parallel()(
            joblib.delayed(coefficients)(rig, recording, settings) for recording in train
        )
        table = pd.DataFrame(fits, index=[recording.name for recording in train])
        table.to_csv(arguments.out / "coefficients.csv")
        print(f"LFM fitted to each recording alone\n{table.T}\n")

        models = ["NCFM", "LFM"] if arguments.quick else ["NCFM", "LFM", "NLFM", "NFLFM"]
        comparison = compare(rig, models, train, test, jobs=-1, **settings)
        comparison.to_frame().to_csv(arguments.out / "comparison.csv", index=False)
        print(comparison)
        print(f"fitted on {len(client.scheduler_info()['workers'])} workers")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
