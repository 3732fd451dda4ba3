"""Fits of slip elements to tables of friction torque, by non-negative least squares.

The widths of the elements come from a fine grid, from which non-negative weights select a few;
terms of the velocity are added if they lower the error on hold-out blocks.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from nfriction.fitting.options import DEFAULTS
from nfriction.fitting.result.paired_test import improves
from nfriction.friction.hysteresis import DROP, ELEMENTS, FIRST, OFFSET, SATURATING, VISCOUS
from nfriction.recording.torque_table import JointTorque

Array = NDArray[np.float64]

# Widths of elements over the range of the motion: narrower ones slip within a sample, wider ones
# are springs.
SPAN = (3e-5, 2.0)
COUNT = 30
# Motion before the first row over the range of the motion, estimated from the first torques.
PATHS = tuple(np.geomspace(1e-4, 2.0, 10))
# Path over which the excess of a long rest fades, over the range of the motion.
FADINGS = tuple(np.geomspace(1e-5, 0.1, 9))
# Velocities relative to the largest one.
VELOCITIES = (0.003, 0.01, 0.03, 0.1, 0.3, 0.6)
# Ridges relative to the information of the data: neighbouring widths are nearly equivalent.
RIDGES = (1e-2, 1e-3)
# Number of columns without a shaping velocity, and the index of a rest's excess among them.
PLAIN, REST = 3, 2
# Terms before the elements: the plain ones, one that saturates, and one that drops.
LINEAR = PLAIN + 2
# Relative difference of errors on hold-out blocks that is too small to matter.
TOLERANCE = 0.02
# Time from whose torque the initial deflection is estimated, as for simulations [s].
LEAD_IN = 0.2
# Rows from which the start is chosen; it is forgotten over the first strokes.
START_ROWS = 3000


@dataclass(frozen=True)
class MemoryFit:
    """A law with memory that was fitted to a joint."""

    coefficients: Array  # of the law, (coefficient,)
    errors: tuple[float, ...]  # root mean square error on each block left out [N m; N]
    torque: Array  # predicted at all rows, (row,)
    design: Array  # torque per unit of each fitted coefficient, (row, fitted)
    fitted: tuple[int, ...]  # indices of these among the coefficients
    presliding: bool = True  # False if no stiffness explains the rows better than a stiff joint
    without: Array | None = None  # torque predicted by the fit without each block, (block, row)


def path_of(joint: JointTorque) -> Array:
    """Displacement of every row from the previous row, (row,) [rad; m]."""
    assert joint.time is not None
    if joint.q is not None:
        return np.diff(joint.q, prepend=joint.q[0])
    return joint.qd * np.diff(joint.time, prepend=joint.time[0])


def range_of(joint: JointTorque) -> float:
    """Range of a joint's positions [rad; m]."""
    return float(np.ptp(np.cumsum(path_of(joint))))


def deflections(path: Array, widths: Array, start: Array, every: int = 1) -> Array:
    """Deflection over width of slip elements, (kept row, *start, width).

    Args:
        path: displacement of every row, (row,).
        widths: (width,).
        start: deflections over widths before the first row, (..., width).
        every: decimation of the rows.
    """
    moves = path[:, None] / widths
    found = np.empty((-(-len(path) // every), *start.shape))
    state = start
    for k, move in enumerate(moves):
        state = np.minimum(np.maximum(state + move, -1.0), 1.0)
        if k % every == 0:
            found[k // every] = state
    return found


def fit_slip(joint: JointTorque, blocks: Sequence[NDArray[np.intp]], *, loaded: bool) -> MemoryFit:
    """Fit the law `friction.hysteresis` to the rows of a joint in order of time.

    A term or a smaller ridge is used only if it lowers the error on held-out blocks by more than
    chance. Friction is proportional to the load if `loaded`.
    """
    path, grid = path_of(joint), range_of(joint) * np.geomspace(*SPAN, COUNT)
    every = max(1, len(joint) // START_ROWS)
    start, fading = _likeliest_start(joint, grid, every, loaded)

    def terms(widths: Array) -> _Dictionary:
        z = deflections(path, widths, np.clip(start / widths, -1.0, 1.0))
        return _Dictionary.of(joint, z, loaded, fading)

    fine = terms(grid)
    folds = fine.folds(blocks)
    choices = [fine.best(shape) for shape in _Shape.every()]
    left_out = [fine.left_out(choice, folds) for choice in choices]
    squares = torch.from_numpy(np.square(left_out))
    best = squares[int(squares.sum(1).argmin())]
    # The simplest choice over which the best is no better than by chance.
    chance = DEFAULTS.input_chance
    chosen = next(k for k, own in enumerate(squares) if not improves(best, own, chance))
    choice = choices[chosen]
    without = np.stack([fine.without(choice, fold) for fold in folds])
    # The merged elements, with the weights that suit them.
    widths = _merged(choice.weights[-len(grid) :], grid)
    few = terms(widths)
    found = few.result(few.at(choice), widths, left_out[chosen], start)
    return replace(found, without=without)


def _likeliest_start(
    joint: JointTorque, widths: Array, every: int, loaded: bool
) -> tuple[float, float]:
    """Path of the motion before the first row, and the fading, that explain the torque best."""
    reach = range_of(joint)
    paths = reach * np.array([0.0, *PATHS, *(-x for x in PATHS)])
    starts = np.clip(paths[:, None] / widths, -1.0, 1.0)
    coarse = np.moveaxis(deflections(path_of(joint), widths, starts, every), 1, 0)
    some = joint.rows(np.arange(0, len(joint), every))

    def cost(z: Array, fading: float) -> float:
        return _Dictionary.of(some, z, loaded, fading).best(plain).cost

    plain = _Shape(RIDGES[-1], rested=True)
    middle = reach * FADINGS[len(FADINGS) // 2]
    best = int(np.argmin([cost(z, middle) for z in coarse]))
    fadings = reach * np.array(FADINGS)
    return float(paths[best]), float(fadings[np.argmin([cost(coarse[best], d) for d in fadings])])


def _merged(forces: Array, widths: Array) -> Array:
    """Widths after merging adjacent elements with a force, narrowest first, at most `ELEMENTS`."""
    used = np.flatnonzero(forces > 1e-6 * forces.max(initial=0.0))
    groups = np.split(used, np.flatnonzero(np.diff(used) > 1) + 1) if len(used) else []
    found = [
        (float(forces[g].sum()), float(np.exp(np.average(np.log(widths[g]), weights=forces[g]))))
        for g in groups
    ]
    # The first element, whose friction drops with speed, is always the narrowest.
    rest = sorted((pair for pair in found if pair[1] > 1.01 * widths[0]), reverse=True)
    return np.array([widths[0], *sorted(width for _, width in rest[: ELEMENTS - 1])])


class _Shape(NamedTuple):
    """Ridge, and terms in addition to the elements, the offset and viscous friction."""

    ridge: float
    saturating: bool = False
    drop: bool = False
    rested: bool = False

    @classmethod
    def every(cls) -> "Iterator[_Shape]":
        """All shapes, simplest first."""
        for terms in itertools.product((False, True), repeat=3):
            for ridge in RIDGES:
                yield cls(ridge, *terms)


@dataclass(frozen=True)
class _Choice:
    """Weights of the columns with given indices, -1 for an omitted term."""

    shape: _Shape
    places: tuple[int, ...]
    weights: Array
    cost: float


class _Fold(NamedTuple):
    """Hold-out rows, and the products of the others' columns."""

    block: NDArray[np.intp]
    gram: Array
    right: Array


@dataclass(frozen=True, eq=False)
class _Dictionary:
    """Columns of all terms: offset, viscous, excess of a rest, velocities, and elements."""

    whole: Array  # (row, column)
    tau: Array  # torque, (row,)
    velocities: Array  # at which friction saturates or drops, (velocity,)
    gram: Array  # products of the columns with each other
    right: Array  # products of the columns with the torque
    lead: int  # number of rows of the lead-in
    fading: float  # path over which the excess of a rest fades [rad; m]

    @classmethod
    def of(cls, joint: JointTorque, z: Array, loaded: bool, fading: float) -> "_Dictionary":
        load = joint.load if loaded and joint.load is not None else np.ones_like(joint.qd)
        speeds = np.abs(joint.qd).max() * np.array(VELOCITIES)
        ratio = joint.qd[:, None] / speeds
        scaled = [np.tanh(ratio), z[:, :1] * np.exp(-(ratio**2)), z]
        # A rest adds to the friction that holds the joint, so it has the elements' sign.
        held = float(np.sign(z[0].sum())) or float(np.sign(joint.tau[0]))
        rest = held * np.exp(-np.cumsum(np.abs(path_of(joint))) / fading)
        plain = np.stack([np.ones_like(load), joint.qd, rest], 1)
        whole = np.concatenate([plain, *(load[:, None] * x for x in scaled)], 1)
        assert joint.time is not None
        lead = max(1, int(np.searchsorted(joint.time, joint.time[0] + LEAD_IN)))
        gram, right = whole.T @ whole, whole.T @ joint.tau
        return cls(whole, joint.tau, speeds, gram, right, lead, fading)

    def options(self, shape: _Shape) -> Iterator[tuple[int, ...]]:
        """Indices of the columns, for every choice of velocities."""
        n = len(self.velocities)
        first = PLAIN + 2 * n
        turns = range(PLAIN, PLAIN + n) if shape.saturating else (-1,)
        drops = range(PLAIN + n, first) if shape.drop else (-1,)
        rest = REST if shape.rested else -1
        for turn, drop in itertools.product(turns, drops):
            yield (0, 1, rest, turn, drop, *range(first, self.whole.shape[1]))

    def best(self, shape: _Shape) -> _Choice:
        """The choice of velocities with the smallest sum of squares."""
        found = (self._choice(shape, places) for places in self.options(shape))
        return min(found, key=lambda choice: choice.cost)

    def at(self, choice: _Choice) -> _Choice:
        """The same terms with the best weights for these elements."""
        first = PLAIN + 2 * len(self.velocities)
        places = (*choice.places[:LINEAR], *range(first, self.whole.shape[1]))
        return self._choice(choice.shape, places)

    def folds(self, blocks: Sequence[NDArray[np.intp]]) -> "list[_Fold]":
        """Blocks to hold out in turn, each with the products of the others."""
        parts = [(self.whole[b].T @ self.whole[b], self.whole[b].T @ self.tau[b]) for b in blocks]
        found = []
        for k, block in enumerate(blocks):
            # Summed anew: a difference would leave round-off in columns that only one block has.
            rest = [pair for i, pair in enumerate(parts) if i != k]
            gram, right = (np.sum(x, 0) for x in zip(*rest, strict=True))
            found.append(_Fold(block, gram, right))
        return found

    def left_out(self, choice: _Choice, folds: "Sequence[_Fold]") -> list[float]:
        """Root mean square errors on blocks that are held out in turn."""
        pairs = [(self.without(choice, fold, fold.block), self.tau[fold.block]) for fold in folds]
        return [float(np.sqrt(np.mean((torque - tau) ** 2))) for torque, tau in pairs]

    def without(
        self, choice: _Choice, fold: "_Fold", rows: NDArray[np.intp] | slice = slice(None)
    ) -> Array:
        """Torque at rows from the same terms fitted without a block.

        The excess of a preceding rest is that of the lead-in, as for any other table.
        """
        used = np.array([p for p in choice.places if p >= 0])
        law = used != REST
        found = weights(fold.gram[np.ix_(used, used)], fold.right[used], choice.shape.ridge)
        torque: Array = self.whole[rows][:, used[law]] @ found[law]
        if choice.shape.rested:
            error = self.tau[: self.lead] - self.whole[: self.lead][:, used[law]] @ found[law]
            left = self.whole[: self.lead, REST]
            torque = torque + left @ error / (left @ left) * self.whole[rows, REST]
        return torque

    def _choice(self, shape: _Shape, places: tuple[int, ...]) -> _Choice:
        used = [p for p in places if p >= 0]
        gram, right = self.gram[np.ix_(used, used)], self.right[used]
        solution = weights(gram, right, shape.ridge)
        every = np.zeros(len(places))
        every[[k for k, p in enumerate(places) if p >= 0]] = solution
        # But for the square of the torque, which is the same for all.
        return _Choice(shape, places, every, float((solution @ gram - 2 * right) @ solution))

    def result(
        self, choice: _Choice, widths: Array, errors: Sequence[float], start: float
    ) -> MemoryFit:
        """Coefficients of the law."""
        n, forces = len(self.velocities), choice.weights[LINEAR:]
        turn, drop = (
            self.velocities[p - first if p >= 0 else -1]
            for p, first in zip(choice.places[LINEAR - 2 : LINEAR], (PLAIN, PLAIN + n), strict=True)
        )
        offset, viscous, _, saturating, falling = choice.weights[:LINEAR]
        blank = [0.0] * (ELEMENTS - len(forces))
        # Elements without force get the largest width.
        wide = [float(widths[-1])] * len(blank)
        # Without an excess, an arbitrarily fast fading.
        fading = self.fading if choice.shape.rested else 1e-6 * float(widths[0])
        coefficients = np.array(
            [offset, viscous, saturating, turn, falling, drop, fading, start,
             *forces, *blank, *widths, *wide]
        )  # fmt: skip
        of = (OFFSET, VISCOUS, -1, SATURATING, DROP,
              *range(FIRST, FIRST + len(forces)))  # fmt: skip
        kept = [k for k, w in enumerate(choice.weights) if w != 0.0]
        design = self.whole[:, [choice.places[k] for k in kept]]
        torque = design @ choice.weights[kept]
        own = [i for i, k in enumerate(kept) if of[k] >= 0]
        fitted = tuple(of[kept[i]] for i in own)
        return MemoryFit(coefficients, tuple(errors), torque, design[:, own], fitted)


def weights(gram: Array, right: Array, ridge: float, signed: int = 1) -> Array:
    """Weights of columns with these products, by least squares with a ridge.

    Only those of the first `signed` columns, by default the offset, may be negative.
    """
    from scipy.optimize import nnls  # slow to import

    scale = np.sqrt(np.diag(gram))
    scale[scale <= 0] = 1.0
    root = np.linalg.cholesky(gram / scale[:, None] / scale + ridge * np.eye(len(right))).T
    target = np.linalg.solve(root.T, right / scale)
    # The signed columns are added once more with opposite sign.
    both, _ = nnls(np.c_[root, -root[:, :signed]], target, maxiter=50 * len(right))
    found: Array = both[: len(right)]
    found[:signed] -= both[len(right) :]
    return found / scale
