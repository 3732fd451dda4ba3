"""Draw the figure of the README from `nfriction demo`: a test recording and its simulations.

nfriction demo --out runs/demo
python docs/swing.py runs/demo
"""

import sys
from pathlib import Path

from nfriction import load, plots, score
from nfriction.papers import twin

MODEL, RECORDING, JOINT = "NFCVFM", "test_hanging", 0


def main(folder: str) -> None:
    """Write `swing.png` beside this file."""
    demo = twin.make("tlrip", seed=0, duration=twin.QUICK_DURATION)
    (recording,) = (r for r in demo.part("test") if r.name == RECORDING)
    model = load(Path(folder) / "models" / f"{MODEL}.json")
    simulated = {
        "simulated without friction": score(demo.plant, None, recording, limit=False),
        "simulated with the friction learnt": score(demo.plant, model, recording, limit=False),
    }
    figure = plots.motion(recording, simulated, joints=[JOINT])
    figure.set_size_inches(5.0, 2.4)  # readable on a phone, too
    figure.savefig(Path(__file__).with_name("swing.png"), dpi=200)


if __name__ == "__main__":
    main(sys.argv[1])
