"""Fits of Dahl, LuGre, elasto-plastic and gear friction to tables of friction torque.

If all forces are scaled by one factor, the deflections of a bristle stay the same. So they depend
only on the ratio of stiffness to Coulomb friction, and on the Stribeck excess and velocity, or the
growth of a gear's friction with the load. For values of these on a grid, all simulated at once, the
torque is linear in the Coulomb friction, damping and viscous friction; the grid is then narrowed
around the best.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfriction.fitting.hysteresis import TOLERANCE, MemoryFit, path_of, range_of, weights
from nfriction.friction.laws import Law
from nfriction.friction.memory import states_along
from nfriction.recording.torque_table import JointTorque

Array = NDArray[np.float64]

# Coulomb friction over stiffness, relative to the range of the motion: the presliding displacement,
# from one that is passed within a sample to one that never slides.
PRESLIDING = (1e-5, 1.0)
# Excess of static over Coulomb friction, and the Stribeck velocity, relative to the largest one.
EXCESS, STRIBECK = (0.03, 3.0), (1e-3, 0.5)
POINTS = {"sigma_0": 9, "F_d": 4, "v_s": 5, "mu_d": 5, "mu_b": 5}
# Increase of a gear's friction at the largest load, relative to that without load.
GROWTH = (0.03, 30.0)
NARROWINGS = 3
# Steps of the search from the best grid point, and the finite difference of logarithms.
MOST_STEPS, DIFFERENCE = 15, 1e-4
# Shapes times rows that are simulated at once.
MOST_NUMBERS = 2_000_000


def fit_bristles(law: Law, joint: JointTorque, blocks: Sequence[NDArray[np.intp]]) -> MemoryFit:
    """Fit a law of one bristle to the rows of a joint in order of time.

    Shapes and forces are fitted to the rows outside of each block in turn. The law has coefficients
    F_c and sigma_0, and perhaps F_d, v_s, sigma_1, F_v or sigma_2, mu_d and mu_b.
    """
    reach, fastest = range_of(joint), float(np.abs(joint.qd).max())
    limits = {
        "sigma_0": np.log([1 / (high * reach) for high in reversed(PRESLIDING)]),
        "F_d": np.log(EXCESS),
        "v_s": np.log(np.array(STRIBECK) * fastest),
    }
    growth = np.log(np.array(GROWTH) / max(float(load_of(joint).abs().max()), 1e-12))
    limits |= {"mu_d": growth, "mu_b": growth}
    shaping = [name for name in POINTS if name in law.names]
    spans = {name: limits[name] for name in shaping}
    bundle: _Bundle | None = None
    stiffest = np.inf
    for _ in range(NARROWINGS):
        axes = {name: np.linspace(spans[name][0], spans[name][1], POINTS[name]) for name in shaping}
        grid = np.exp(np.array(list(itertools.product(*axes.values()))))
        found = _Bundle.of(law, joint, shaping, grid, blocks)
        costs = found.costs(found.whole)
        if bundle is None:
            stiff = grid[:, shaping.index("sigma_0")] >= np.exp(spans["sigma_0"][1]) * 0.999
            stiffest = float(costs[stiff].min())
        bundle = found if bundle is None else bundle.extended(found)
        best = np.log(grid[int(costs.argmin())])
        for name, middle in zip(shaping, best, strict=True):
            step = axes[name][1] - axes[name][0]
            low, high = middle - step, middle + step
            spans[name] = np.array([max(low, limits[name][0]), min(high, limits[name][1])])
    assert bundle is not None
    return bundle.result(law, joint, blocks, stiffest)


@dataclass(frozen=True, eq=False)
class _Bundle:
    """Shapes of a bristle, and the products of their unit torques by block.

    `parts` are, for each block, products of the unit torques with each other (block, shape, column,
    column), with the torque (block, shape, column), and of the torque (block,).
    """

    shaping: list[str]  # names
    shapes: Array  # (shape, name), for a Coulomb friction of 1
    places: tuple[int, ...]  # indices of the linear coefficients, the Coulomb friction first
    parts: tuple[Array, Array, Array]

    @classmethod
    def of(
        cls, law: Law, joint: JointTorque, shaping: list[str], shapes: Array,
        blocks: Sequence[NDArray[np.intp]],
    ) -> "_Bundle":  # fmt: skip
        grams, rights = [], []
        # A few shapes at a time, because tables may be long.
        for some in np.array_split(shapes, -(-len(shapes) * len(joint) // MOST_NUMBERS)):
            places, units = unit_torques(law, joint, shaping, some)
            parts = [units[:, block] for block in blocks]
            pairs = list(zip(parts, blocks, strict=True))
            grams.append(np.stack([np.einsum("srp,srq->spq", x, x) for x in parts]))
            rights.append(np.stack([np.einsum("srp,r->sp", x, joint.tau[b]) for x, b in pairs]))
        squares = np.array([float(joint.tau[block] @ joint.tau[block]) for block in blocks])
        products = np.concatenate(grams, 1), np.concatenate(rights, 1), squares
        return cls(shaping, shapes, places, products)

    def extended(self, other: "_Bundle") -> "_Bundle":
        gram, right, square = (
            np.concatenate([a, b], 1) if a.ndim > 1 else a
            for a, b in zip(self.parts, other.parts, strict=True)
        )
        shapes = np.concatenate([self.shapes, other.shapes])
        return _Bundle(self.shaping, shapes, self.places, (gram, right, square))

    @property
    def whole(self) -> tuple[Array, Array, float]:
        gram, right, square = (x.sum(0) for x in self.parts)
        return gram, right, float(square)

    def costs(self, products: tuple[Array, Array, float]) -> Array:
        """Sum of squares of every shape with its best forces, (shape,)."""
        gram, right, square = products
        return np.array([square + _forces(g, r)[1] for g, r in zip(gram, right, strict=True)])

    def result(
        self, law: Law, joint: JointTorque, blocks: Sequence[NDArray[np.intp]], stiffest: float
    ) -> MemoryFit:
        whole = self.whole
        errors = []
        for k, block in enumerate(blocks):
            own = [x[k] for x in self.parts]
            rest = (whole[0] - own[0], whole[1] - own[1], whole[2] - float(own[2]))
            best = int(self.costs(rest).argmin())
            forces, _ = _forces(rest[0][best], rest[1][best])
            left = own[2] + (forces @ own[0][best] - 2 * own[1][best]) @ forces
            errors.append(float(np.sqrt(max(left, 0.0) / len(block))))
        costs = self.costs(whole)
        best = int(costs.argmin())
        forces, _ = _forces(whole[0][best], whole[1][best])
        coefficients = np.array([c.initial_grid[0] if c.initial_grid else 0.0
                                 for c in law.coefficients])  # fmt: skip
        for name, value in zip(self.shaping, self.shapes[best], strict=True):
            scaled = value if name == "v_s" else value * forces[0]
            coefficients[law.names.index(name)] = scaled
        coefficients[list(self.places)] = forces
        coefficients, torque, slopes, fitted = refined(law, joint, coefficients)
        return MemoryFit(
            coefficients, tuple(errors), torque, slopes, tuple(fitted),
            bool(costs[best] * (1 + TOLERANCE) ** 2 < stiffest),
        )  # fmt: skip


def load_of(joint: JointTorque) -> Tensor:
    """Load of every row, 1 if the table has none, (row,)."""
    return torch.tensor(np.ones_like(joint.qd) if joint.load is None else joint.load)


def unit_torques(
    law: Law, joint: JointTorque, shaping: list[str], shapes: Array
) -> tuple[tuple[int, ...], Array]:
    """Indices of the linear coefficients, and their unit torques (shape, row, coefficient).

    The damping is that far below its limit.
    """
    linear: list[str] = [n for n in ("F_c", "sigma_1", "F_v", "sigma_2") if n in law.names]
    places = tuple(law.names.index(name) for name in linear)
    # Coefficients that are not set below keep their initial value.
    base = np.tile([c.initial_grid[0] if c.initial_grid else 0.0 for c in law.coefficients],
                   (len(shapes), 1))  # fmt: skip
    base[:, places[1:]] = 0.0
    base[:, places[0]] = 1.0
    base[:, [law.names.index(name) for name in shaping]] = shapes
    along = _states(law, joint, base)
    columns = [_torques(law, joint, along, base)]
    for place in places[1:]:
        small = base.copy()
        small[:, place] = 1e-6
        columns.append((_torques(law, joint, along, small) - columns[0]) / 1e-6)
    return places, np.stack(columns, -1)


def _states(law: Law, joint: JointTorque, coefficients: Array) -> Tensor:
    """Deflections along the rows, (set, row, 1, state), of sets of coefficients (set, name)."""
    assert law.memory is not None
    assert joint.time is not None
    step = torch.tensor(np.diff(joint.time, prepend=joint.time[0] - joint.step))
    moved = torch.tensor(path_of(joint)) / step
    load = load_of(joint)[:, None]
    given = torch.tensor(coefficients)[:, None]
    start = given.new_zeros((*given.shape[:-1], law.memory.size))
    along = states_along(
        law.memory, start, moved[:, None], load, given.expand(len(moved), -1, -1, -1), step
    )
    return along.transpose(0, 1)


def _torques(law: Law, joint: JointTorque, along: Tensor, coefficients: Array) -> Array:
    """Torque at deflections along the rows, (set, row), of sets of coefficients (set, name)."""
    assert law.memory is not None
    shape = along.shape[:-1]
    qd = torch.tensor(joint.qd)[:, None].expand(shape)
    held = torch.tensor(coefficients)[:, None, None].expand(*shape, -1)
    found: Array = law.memory.torque(along, qd, torch.ones(shape).double(), held)[..., 0].numpy()
    return found


def torques(law: Law, joint: JointTorque, coefficients: Array) -> Array:
    """Torque along the rows, (set, row), of sets of coefficients (set, coefficient)."""
    return _torques(law, joint, _states(law, joint, coefficients), coefficients)


def refined(law: Law, joint: JointTorque, start: Array) -> tuple[Array, Array, Array, list[int]]:
    """Coefficients at the minimum nearest to a start.

    Returns:
        Coefficients; their torque, (row,); its derivatives in the fitted ones, (row, fitted); the
        indices of these.
    """
    # In logarithms, so that all stay positive; coefficients that the grid found to be zero stay so.
    places = [k for k, c in enumerate(law.coefficients) if c.fitted and start[k] > 0]
    x, damping = start, 1e-3
    torque, slopes = _linearised(law, joint, x, places)
    for _ in range(MOST_STEPS):
        error = torque - joint.tau
        gram = slopes.T @ slopes
        # The minimum-norm step, because rows that only slide leave some coefficients undetermined.
        damped = gram + damping * np.diag(np.diag(gram))
        step = np.linalg.lstsq(damped, -slopes.T @ error, rcond=None)[0]
        trial = x.copy()
        trial[places] *= np.exp(np.clip(step, -0.5, 0.5))
        there, slopes_there = _linearised(law, joint, trial, places)
        before, after = float(error @ error), float(np.sum((there - joint.tau) ** 2))
        if after < before:
            x, torque, slopes, damping = trial, there, slopes_there, damping / 10
            if before - after < 1e-6 * before:
                break
        else:
            damping *= 10
    return x, torque, slopes / x[places], places


def _linearised(
    law: Law, joint: JointTorque, coefficients: Array, places: list[int]
) -> tuple[Array, Array]:
    """Torque, and its derivatives in the logarithms of the coefficients with these indices."""
    sets = np.repeat(coefficients[None], 1 + 2 * len(places), 0)
    for k, place in enumerate(places):
        sets[1 + k, place] *= np.exp(DIFFERENCE)
        sets[1 + len(places) + k, place] *= np.exp(-DIFFERENCE)
    found = torques(law, joint, sets)
    up, down = found[1 : 1 + len(places)], found[1 + len(places) :]
    return found[0], (up - down).T / (2 * DIFFERENCE)


def _forces(gram: Array, right: Array) -> tuple[Array, float]:
    """Non-negative forces, and the sum of squares without that of the torque."""
    solution = weights(gram, right, 1e-9, signed=0)
    return solution, float((solution @ gram - 2 * right) @ solution)
