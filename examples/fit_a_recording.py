"""Fit two friction models to a recording, test them on another one, save the better one."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from nfriction import LFM, NCFM, Recording, fit, model_info, save, score_fit
from nfriction.papers import twin


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="two seconds instead of ten")
    parser.add_argument("--out", type=Path, default=Path("runs/fit_a_recording"))
    arguments = parser.parse_args(argv)

    # A simulated rig instead of yours; its files look like an encoder log.
    simulated = twin.make("tlrip", duration=2.0 if arguments.quick else 10.0)
    files = {}
    for part in ("train", "test"):
        recording = simulated.part(part)[-1]
        files[part] = arguments.out / f"{recording.name}.csv.gz"
        files[part].parent.mkdir(parents=True, exist_ok=True)
        recording.write(files[part])

    rig = simulated.plant  # for your own rig: rigs.read("rig.json")
    train, test = (Recording.read(files[part]) for part in ("train", "test"))
    errors = {}
    for model in (NCFM(rig.joints), LFM(rig.joints)):
        name = type(model).__name__
        found = fit(model, rig, train, fit_plant=False, windows=(0.5,))
        print(f"{name}: {found.status}")
        for interval in found.intervals:
            print(f"  {interval.name}: {interval.value:.4g} ({interval.low:.4g} to "
                  f"{interval.high:.4g})")  # fmt: skip
        errors[name] = score_fit(found, test).free_run.all
        print(f"  position error on {test.name}: {1e3 * errors[name]:.3g} mrad")
        save(found.model, arguments.out / f"{name}.json", model_info(found, train))
    best = min(errors, key=lambda name: errors[name])
    print(f"best: {best}, in {arguments.out / best}.json")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
