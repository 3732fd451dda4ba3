"""Parts of real recordings left out, and simulated by what the rest taught."""

import math
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from single_shooting import single_shooting

from nfriction import Recording, rigs
from nfriction.evaluation.compare import LIMIT, NO_FRICTION, Comparison
from nfriction.evaluation.cross_validation import TimeBlock, blocked_k_fold
from nfriction.evaluation.parallel import dependency_levels, warm_starts
from nfriction.evaluation.score import Score, score
from nfriction.fitting.data.inputs import apply_encoder_offsets
from nfriction.fitting.fit import fit
from nfriction.fitting.options import EncoderReference
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction import model_by_name, model_name
from nfriction.friction.coefficients import Constant
from nfriction.friction.models import FrictionModel
from nfriction.plant import Plant

State = tuple[NDArray[np.float64], NDArray[np.float64]]


class Set(NamedTuple):
    """Recordings of one mechanism: folder, files, plant, what is aimed at, unit in the table.

    `target` is the free run's error and that of 5 s windows; of recordings kept apart, which the
    folder does not hold. `encoder_reference` is that of the fit: encoders of recordings that all
    begin at rest at 0 were zeroed at the start of each.
    """

    folder: str
    names: tuple[str, ...]
    plant: Callable[[], Plant]
    target: tuple[float, float] = (math.nan, math.nan)
    unit: str = "mrad"
    encoder_reference: EncoderReference = "shared"


SETS = {
    "single": Set("multiarm_pendulum", ("single_b0", "single_b2", "single_b4"),
                  rigs.multiarm_single, (7.5, math.nan)),
    "double": Set("multiarm_pendulum", ("double_b0", "double_b2", "double_b4", "double_b6"),
                  rigs.multiarm_double, (3.5, 1.8)),
    "triple": Set("multiarm_pendulum", ("triple_b0", "triple_b2"), rigs.multiarm_triple,
                  (0.9, 0.65)),
    "C1": Set("dfki_double_pendulum", ("C1_143339", "C1_143601", "C1_143747", "C1_144003"),
              lambda: rigs.dfki("C1"), (46.0, math.nan), encoder_reference="per_recording"),
    "C0": Set("dfki_double_pendulum", ("C0_00", "C0_02", "C0_04", "C0_06"),
              lambda: rigs.dfki("C0"), (28.0, math.nan), encoder_reference="per_recording"),
    "A0": Set("dfki_double_pendulum", ("A0_00", "A0_02", "A0_12"), lambda: rigs.dfki("A0"),
              (45.0, math.nan), encoder_reference="per_recording"),
    "emps": Set("emps", ("emps_first",), rigs.emps, (3.0, math.nan), "mm"),
    "xl330": Set("xl330_servo_pendulum", ("drop_kp100", "drop_kp400"), rigs.xl330,
                 (15.0, math.nan)),
}  # fmt: skip


def read(data: Path, of: Set) -> list[Recording]:
    """The recordings of a set; a lone one is halved in time."""
    found = []
    for name in of.names:
        (path,) = (p for p in (data / of.folder).glob(f"{name}.csv*"))
        recording = Recording.read(path, unit="m" if of.unit == "mm" else "rad", name=name)
        found.append(recording)
    if len(found) == 1:
        half = len(found[0]) // 2
        found = [found[0][: half + 1], found[0][half:]]
    return found


class Left(NamedTuple):
    """A recording left out, and the state that its free run starts from; None for its own."""

    recording: Recording
    initial_state: State | None


class Fold(NamedTuple):
    """Recordings to fit, and those left out; with blocks, one of every recording that is fitted."""

    fitted: list[Recording]
    left: list[Left] | list[TimeBlock]


def folds(data: Path, of: Set, blocks: int) -> list[Fold]:
    """One recording left out at a time, or with blocks one block in time of every recording."""
    recordings = read(data, of)
    if blocks == 1:
        return [
            Fold([*recordings[:k], *recordings[k + 1 :]],
                 [Left(left, first_state(data, of, left))])
            for k, left in enumerate(recordings)
        ]  # fmt: skip
    splits = [blocked_k_fold(of.plant(), r, blocks) for r in recordings]
    return [
        Fold([row[k].train.recording for row in splits], [row[k].test for row in splits])
        for k in range(blocks)
    ]


def nothing_left_out(data: Path, of: Set) -> Fold:
    """All recordings fitted, and simulated all the same."""
    recordings = read(data, of)
    return Fold(recordings, [Left(r, first_state(data, of, r)) for r in recordings])


def first_state(data: Path, of: Set, recording: Recording) -> State | None:
    """Initial state of a whole recording as its card gives it."""
    table = pd.read_csv(data / of.folder / "recordings.csv").set_index("id")
    if len(of.names) == 1 or recording.name not in table.index:
        return None
    row = table.loc[recording.name]
    q, qd = (
        np.array([row[f"{key}_{k + 1}"] for k in range(recording.joints)], dtype=float)
        for key in ("q0", "qd0")
    )
    return q, qd


def real(
    data: Path,
    only: Sequence[str],
    models: Sequence[str],
    blocks: int = 1,
    peer: bool = False,
    recorded_zeros: bool = False,
    seen: bool = False,
    **settings: Any,
) -> None:
    """Print the error of every model on what was left out of its recordings.

    Args:
        data: holds a folder to each set.
        only: sets by name.
        models: by name, each fitted from the fit of another as in `compare`.
        blocks: in time, of which one is left out of every recording; 1 leaves out recordings.
        peer: also fit every constant model by single shooting with SciPy.
        recorded_zeros: take encoders for true that were zeroed in a pose held by stiction.
        seen: also fit all recordings at once, and print the free runs' error on these.
        settings: of the fits.
    """
    aimed = f"{'aim':>5}  met"
    print(
        f"{'set':7} {'model':20} unit  free run {aimed} {'5 s':>9} {aimed}"
        f"{'      seen' if seen else ''}  cpu [s]  one by one"
    )
    for name in only:
        contest = Contest(data, SETS[name], models, peer, recorded_zeros, settings)
        contest.judge(folds(data, contest.of, blocks))
        if seen:
            contest.judge([nothing_left_out(data, contest.of)], contest.train)
        for row in contest.rows():
            print(f"{name:7} {row}", flush=True)


@dataclass(frozen=True)
class Contest:
    """Models, and peers if asked for, on the recordings of one set; see `real`.

    Scores are by model, of what was left out and of what was fitted; `fits` are the last ones, and
    `spent` the processor time of all [s].
    """

    data: Path
    of: Set
    models: Sequence[str]
    peer: bool
    recorded_zeros: bool
    settings: dict[str, Any]
    test: dict[str, list[Score]] = field(default_factory=lambda: defaultdict(list))
    train: dict[str, list[Score]] = field(default_factory=lambda: defaultdict(list))
    fits: dict[str, FitResult] = field(default_factory=dict)
    spent: dict[str, float] = field(default_factory=lambda: defaultdict(float))

    def judge(self, folds: Sequence[Fold], into: dict[str, list[Score]] | None = None) -> None:
        """Score every contestant on all folds: into `test`, unless given."""
        into = self.test if into is None else into
        for fold in folds:
            # Without a fit, the encoders of a block are taken for true.
            self._score(NO_FRICTION, self.of.plant(), None, fold, fold.left, into)
            self._judge_models(fold, into)
            if self.peer:
                self._judge_peers(fold, into)

    def rows(self) -> list[str]:
        """Lines of the table, those of models not fit for use marked, and the limit."""
        plant = self.of.plant()
        comparison = Comparison(
            self.fits, self.train, self.test, unit=plant.unit, joint_names=tuple(plant.joint_names)
        )
        # Recordings may be too short for windows of 5 s.
        columns = [None, *({"5"} & set(comparison.horizons("test")))]
        errors = {m: [math.nan, math.nan] for m in (*self.test, LIMIT)}
        for k, horizon in enumerate(columns):
            for m, error in comparison.table(horizon)["all"].items():
                errors[m][k] = 1e3 * error
            errors[LIMIT][k] = 1e3 * (comparison.limit(horizon) or math.nan)
        known = comparison.table(part="train")["all"] if self.train else {}
        unfit, lines = comparison.unfit(), []
        for m, pair in errors.items():
            aims = self.of.target if m in self.fits else (math.nan, math.nan)
            judged = " ".join(beside(e, t) for e, t in zip(pair, aims, strict=True))
            in_all = f"{1e3 * known.get(m, math.nan):10.2f}" if self.train else ""
            each = "  ".join(f"{1e3 * s.free_run.all:.3g}" for s in self.test.get(m, ()))
            mark = f"  not fit for use: {unfit[m]}" if m in unfit else ""
            line = f"{m:20} {self.of.unit:4} {judged}{in_all} {self.spent[m]:8.0f}  {each}{mark}"
            lines.append(line.replace("nan", "  -").rstrip())
        return lines

    def _judge_models(self, fold: Fold, into: dict[str, list[Score]]) -> None:
        plant = self.of.plant()
        origin = warm_starts(list(dict.fromkeys(map(model_name, self.models))))
        fits: dict[str | None, FitResult] = {}
        for m in chain.from_iterable(dependency_levels(origin)):
            start = time.process_time()
            before = fits.get(origin[m])
            fits[m] = found = fit(
                m, plant, fold.fitted, start=before,
                motions=before.motions if before else None,
                encoder_reference=self.of.encoder_reference, **self.settings,
            )  # fmt: skip
            self.spent[m] += time.process_time() - start
            self.fits[m] = found
            left = fold.left
            if in_blocks(fold):
                offsets = found.encoder_offsets
                moved = apply_encoder_offsets(offsets, found.plant, *zip(*left, strict=True))
                left = [TimeBlock(*pair) for pair in zip(*moved, strict=True)]
            left = [one._replace(recording=found.aligned(one.recording)) for one in left]
            self._score(m, found.plant, found.model, fold, left, into)

    def _judge_peers(self, fold: Fold, into: dict[str, list[Score]]) -> None:
        plant = self.of.plant()
        # The peer knows no gaps and one zero for all.
        whole = [r[a : b + 1] for r in fold.fitted for a, b in r.segments]
        states = [None if in_blocks(fold) else first_state(self.data, self.of, r) for r in whole]
        for m in filter(is_constant, dict.fromkeys(map(model_name, self.models))):
            start, peer = time.process_time(), f"{m}, SciPy"
            model = model_by_name(m)(plant.joints)
            found = single_shooting(model, plant, whole, states)
            self.spent[peer] += time.process_time() - start
            self.fits[peer] = self.fits[m]  # as large
            self._score(peer, found, model, fold, fold.left, into)

    def _score(
        self,
        name: str,
        plant: Plant,
        model: FrictionModel | None,
        fold: Fold,
        left: Sequence[Left] | Sequence[TimeBlock],
        into: dict[str, list[Score]],
    ) -> None:
        # Blocks have the zeros that the rest of their recordings show.
        known = in_blocks(fold) or self.recorded_zeros
        zeroed = not known and self.of.encoder_reference == "per_recording"
        for one in left:
            given = one.initial_state if isinstance(one, Left) else None
            found = score(plant, model, one.recording, initial_state=given, zeroed=zeroed)
            into[name].append(found)
            # A fold can take many minutes.
            error = f"{1e3 * found.free_run.all:.3g} {self.of.unit}"
            print(f"{name}: free run of {one.recording.name} {error}", file=sys.stderr, flush=True)


def in_blocks(fold: Fold) -> bool:
    """True if blocks were left out, rather than recordings."""
    return isinstance(fold.left[0], TimeBlock)


def is_constant(name: str) -> bool:
    return isinstance(model_by_name(name)(1).schedule, Constant)


def beside(error: float, target: float) -> str:
    """An error with what is aimed at on recordings kept apart, and whether it would be met."""
    if not math.isfinite(target):
        return f"{error:9.2f}     -    -"
    return f"{error:9.2f} {target:5.3g}  {'yes' if error <= target else ' no'}"
