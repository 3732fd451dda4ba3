"""Friction laws on tables of friction torque: fits, comparison by hold-out blocks, prediction."""

from __future__ import annotations

import html
import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from nfriction.evaluation.cross_validation import Candidate, indistinguishable
from nfriction.evaluation.results import RESULTS
from nfriction.fitting import torque_table
from nfriction.fitting.options import DEFAULTS, FitOptions
from nfriction.fitting.recorded import recorded_inputs, ripple_shift
from nfriction.fitting.result.paired_test import improves
from nfriction.friction import model_by_name, model_name, plain_name
from nfriction.friction.hysteresis import LOAD_SLIP, SLIP, TERMS, Recorded, unused
from nfriction.friction.models import FrictionModel
from nfriction.io.files import parse_json
from nfriction.io.model_file import ModelInfo, load, load_info
from nfriction.recording import Array, Unit
from nfriction.recording.torque_table import (
    MINIMUM_ROWS,
    JointTorque,
    TorqueTable,
    as_table,
    blocks,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

logger = logging.getLogger(__name__)

FOLDS = 10
# Laws that are fitted by default: to any table, and to those with columns time, load or both.
LAWS = ("viscous", "coulomb", "coulomb-viscous", "arctan", "stribeck")
WITH_TIME = ("slip", "neuro-fuzzy:slip")
WITH_LOAD = ("load-coulomb",)
WITH_BOTH = ("load-slip",)
# Distance of the outer fences from the quartiles, in their distances from each other (J. W. Tukey,
# Exploratory Data Analysis, 1977): of 400,000 Gaussian errors one is beyond.
FENCE = 3.0
# Errors below this part of the median torque do not matter.
SMALL = 0.01
# Share of the largest torque that no sensor of 20 bits resolves.
UNRESOLVED = 1e-6
# Share of the largest load up to which a negative one is noise of an unloaded sensor.
NO_LOAD = 0.1
# Rows far off are single mistakes up to this share, or number, which are listed.
FEW, LISTED = 0.03, 3
# A drive holds a speed within this part of it.
SAME_SPEED = 0.02


class TorqueScore(NamedTuple):
    """Error of a predicted friction torque at one joint.

    Attributes:
        rmse: root mean square error [N m; N].
        nrmse: the same over the standard deviation of the torque [-].
    """

    joint: str
    model: str
    rmse: float
    nrmse: float


@dataclass(frozen=True, eq=False, repr=False)
class TorqueFits:
    """Friction models fitted to a table of friction torque, and the one to use at each joint.

    Attributes:
        fits: by name of the model, one per joint in the table's order.
        candidates: errors on hold-out blocks, by joint: root mean square torque [N m; N].
        choices: model to use and the reason, by joint.
        failed: models that could not be fitted, with the reason.
    """

    table: TorqueTable
    fits: Mapping[str, tuple[torque_table.JointFit, ...]]
    candidates: Mapping[str, tuple[Candidate, ...]]
    choices: Mapping[str, tuple[str, str]]
    failed: Mapping[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        return self.summary()

    @property
    def unit(self) -> str:
        """Unit of the torque."""
        return "N m" if self.table.unit == "rad" else "N"

    @property
    def chosen(self) -> dict[str, str]:
        """The model to use at each joint."""
        return {joint: name for joint, (name, _) in self.choices.items()}

    def model(self, name: str) -> FrictionModel:
        """A model of all joints, by either of its names.

        Raises:
            ValueError: if it was not fitted.
        """
        return torque_table.join([found.model for found in self.fits[self._known(name)]])

    def _known(self, name: str) -> str:
        """The name under which a model was fitted."""
        known = model_name(name)
        if known not in self.fits:
            raise ValueError(f"{name!r} was not fitted; there are {', '.join(self.fits)}.")
        return known

    def _names(self, model: str | None) -> list[str]:
        """The model of each joint: the given one, or the chosen ones."""
        if model is None:
            return list(self.chosen.values())
        return [self._known(model)] * len(self.table.joints)

    def _models(self, model: str | None) -> list[SavedModel]:
        """The model of each joint, as `_names`."""
        pairs = zip(self.table.joint_names, self._names(model), strict=True)
        unit = self.table.unit
        return [SavedModel(j, unit, self.fits[name][k].model, self._left_out(name)[j] or math.nan)
                for k, (j, name) in enumerate(pairs)]  # fmt: skip

    def _left_out(self, name: str) -> dict[str, float | None]:
        """Root mean square error of a model on hold-out blocks, by joint."""
        return {
            joint: _finite(next(c.error for c in of if c.name == self._known(name)))
            for joint, of in self.candidates.items()
        }

    def info(self, name: str) -> ModelInfo:
        """Entries of the model file of a model of all joints."""
        found = self.fits[self._known(name)]
        joints = self.table.joints
        steps = [joint.step for joint in joints if joint.time is not None]
        ranges = {
            key: [[float(x.min()), float(x.max())] for x in (getattr(j, key) for j in joints)]
            for key in ("qd", "qdd")
        }
        return ModelInfo(
            joint_names=self.table.joint_names,
            unit=self.table.unit,
            sample_time=max(steps) if steps else None,
            input_ranges=ranges,
            training_data={self.table.name or "table": self.table.digest()},
            fit={
                "status": "Converged: least squares of the torque."
                if all(one.converged for one in found)
                else "Not converged: the step limit was reached.",
                "intervals": {
                    i.name: [_finite(i.low), _finite(i.high)]
                    for one in found
                    for i in one.intervals
                },
                "blocks_left_out": self._left_out(name),
            },
        )

    def predict(self, table: Any, model: str | None = None) -> list[Array]:
        """Friction torque at the rows of another table, one array (row,) per joint [N m; N].

        Args:
            table: a `TorqueTable`, a path or a DataFrame, with the joints of the training table.
                Without torque, laws with memory start undeflected.
            model: by either of its names; by default the one chosen at each joint.

        Raises:
            ValueError: if its joints are others, or it lacks a load that a model needs.
        """
        given = as_table(table, unit=self.table.unit, torque=False)
        _check_joints(self.table.joint_names, given)
        pairs = zip(self._models(model), given.joints, strict=True)
        return [_predicted(one.model, joint) for one, joint in pairs]

    def score(self, table: Any, model: str | None = None) -> pd.DataFrame:
        """Errors by joint: model, rmse [N m; N], nrmse [-], and rmse on blocks left out."""
        return score_models(self._models(model), as_table(table, unit=self.table.unit))

    def to_frame(self) -> pd.DataFrame:
        """NRMSE on hold-out blocks by joint and model."""
        spread = {joint.name: float(joint.tau.std()) for joint in self.table.joints}
        rows = {
            joint: {c.name: c.error / spread[joint] for c in of}
            for joint, of in self.candidates.items()
        }
        return pd.DataFrame.from_dict(rows, orient="index").rename_axis("joint")

    def intervals(self, name: str | None = None) -> pd.DataFrame:
        """Coefficients of a model, by default of the chosen ones, with 95 % intervals.

        Slip elements and terms that were not selected are left out.
        """
        rows = []
        pairs = zip(self.table.joint_names, self._names(name), strict=True)
        for k, (joint, own) in enumerate(pairs):
            found = self.fits[own][k]
            unknown = {n for d in found.unidentifiable for n in d.split(" with ")}
            values = found.model.schedule.coefficient_sets()
            known = {i.name: i for i in found.intervals}
            for where, of in values.items():
                named = dict(zip(found.model.law.names, of[0].tolist(), strict=True))
                hidden = unused(named) if found.model.law in (SLIP, LOAD_SLIP) else set()
                for symbol, value in named.items():
                    if symbol in hidden:
                        continue
                    label = f"{symbol} of {joint}"
                    i = known.get(label)
                    note = "not identifiable" if label in unknown else ""
                    # Unbounded ends are left blank.
                    ends = (i.low, i.high) if i else (math.nan, math.nan)
                    low, high = (x if math.isfinite(x) else math.nan for x in ends)
                    label += "" if where == "always" else f", {where.replace('_', ' ')}"
                    rows.append((own, label, value, low, high, note))
        columns = ["model", "parameter", "value", "low", "high", "note"]
        return pd.DataFrame(rows, columns=columns).set_index("parameter")

    def _head(self) -> str:
        """The choice for each joint with its error, one line each."""
        lines = []
        for joint, (name, why) in self.choices.items():
            error = float(self.to_frame()[name][joint])
            lines.append(
                f"{joint}: {plain_name(name)}, NRMSE {error:.3f} on hold-out blocks; {why}"
            )
        return "\n".join(lines)

    def summary(self) -> str:
        """Choice, errors on hold-out blocks, coefficients with 95 % intervals, and remarks."""
        frames = (self.to_frame(), self.intervals())
        tables = [f.to_string(float_format=lambda x: f"{x:.4g}", na_rep="") for f in frames]
        return "\n\n".join([self._head(), *tables, *self.table.remarks])

    def _repr_html_(self) -> str:
        """The summary for a notebook."""
        frames = (self.to_frame(), self.intervals())
        tables = [f.to_html(float_format=lambda x: f"{x:.4g}", na_rep="") for f in frames]
        head = html.escape(self._head()).replace("\n", "<br>")
        return f"<p>{head}</p>{''.join(tables)}"

    def plot(self) -> Figure:
        """Friction torque over velocity with its 95 % band; see `plots.friction_curves`."""
        from nfriction import plots  # matplotlib is slow to import

        return plots.friction_curves(self)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON: choices, errors on hold-out blocks, coefficients and intervals."""
        return {
            "kind": "torque table",
            "unit": self.table.unit,
            "joints": list(self.table.joint_names),
            "chosen": {j: {"model": n, "reason": why} for j, (n, why) in self.choices.items()},
            "blocks_left_out": {
                joint: {c.name: _finite(c.error) for c in of}
                for joint, of in self.candidates.items()
            },
            "residual": {
                name: {j: _finite(one.residual) for j, one in zip(self.chosen, found, strict=True)}
                for name, found in self.fits.items()
            },
            "failed": dict(self.failed),
            "remarks": list(self.table.remarks),
        }


def fit_torque(
    table: Any,
    models: str | Sequence[str] | None = None,
    *,
    folds: int = FOLDS,
    options: FitOptions = DEFAULTS,
    progress: Callable[[str], object] | None = None,
    **reading: Any,
) -> TorqueFits:
    """Fit friction models to a table of friction torque over velocity, joint by joint.

    For constant-velocity tests, and for residual torques of any inverse dynamics. Constant
    coefficients come from least squares within bounds, a network from a search under its prior;
    the network is kept if it lowers the error on hold-out blocks. Models are compared on these
    blocks, contiguous in time; rows without time are assigned to blocks by their velocity. Laws
    with memory need rows in order of time; their initial deflection is estimated from the first 0.2
    s of a table, which are not scored.

    Args:
        table: a `TorqueTable`, or a path or DataFrame that makes one.
        models: names, comma-separated or in a list; by default all constant laws that the table's
            columns allow.
        folds: number of hold-out blocks, at least 2.
        progress: called with each stage.
        reading: `columns`, `degrees` and `unit`, see `TorqueTable.from_pandas`.

    Raises:
        ValueError: a missing column, a joint that does not move, too few rows, or no model that
            could be fitted; the message names the remedy.
    """
    given = as_table(table, **reading)
    time = all(joint.time is not None for joint in given.joints)
    load = all(joint.load is not None for joint in given.joints)
    laws = (*LAWS, *WITH_TIME * time, *WITH_LOAD * load, *WITH_BOTH * (time and load))
    names = [models] if isinstance(models, str) else list(models or laws)
    names = [name for text in names for name in text.split(",")]
    names = list(dict.fromkeys(map(model_name, names)))
    if folds < 2:
        raise ValueError(f"`folds` must be at least 2, got {folds}.")
    # One velocity for all joints, as a model file has one.
    v_smooth = torque_table.turning_velocity(given)
    remarks = list(given.remarks)
    for every in given.joints:
        moving = every.sliding
        if resting := len(every) - len(moving):
            remarks.append(
                f"{moving.name} is at rest in {resting} of {len(every)} rows, which are left "
                "out: there dry friction can have any value."
            )
        if copies := len(moving) - len(moving.distinct):
            remarks.append(
                f"{copies} of {len(moving)} rows of {moving.name} equal others in every column, "
                "each as often; as copies they would narrow the intervals, and are left out."
            )
    given = replace(given, joints=tuple(joint.sliding.distinct for joint in given.joints))
    fits: dict[str, tuple[torque_table.JointFit, ...]] = {}
    errors: dict[str, list[Candidate]] = {joint: [] for joint in given.joint_names}
    failed: dict[str, str] = {}
    for name in names:
        if progress is not None:
            progress(f"fit {plain_name(name)}")
        try:
            found = [_fit(name, joint, v_smooth, folds, options) for joint in given.joints]
        # A law that does not suit the table must not prevent the others.
        except ValueError as error:
            failed[name] = str(error)
            continue
        fits[name] = tuple(fit for fit, _ in found)
        for joint, (_, candidate) in zip(given.joint_names, found, strict=True):
            errors[joint].append(candidate)
    if not fits:
        raise ValueError(" ".join([*remarks, *failed.values()]))
    heated = any(joint.temperature is not None for joint in given.joints)
    if heated and not any(isinstance(of[0].model.schedule, Recorded) for of in fits.values()):
        remarks.append(
            "The column temperature is not used: only neuro-fuzzy:slip follows it, for rows in "
            "order of time."
        )
    remarks += _signed_loads(given, fits)
    choices = {}
    for k, (joint, of) in enumerate(errors.items()):
        speeds = _speeds(given.joints[k])
        shown = _determined(len(speeds), of)
        name, why = _choose(shown or of, UNRESOLVED * float(np.abs(given.joints[k].tau).max()))
        hidden = ", ".join(plain_name(c.name) for c in of if c not in shown)
        if not shown:
            why = "the speeds distinguish no laws"
            listed = ", ".join(f"{x:.3g}" for x in speeds)
            alike = "dry and viscous friction" if len(speeds) == 1 else "several laws"
            remarks.append(
                f"{joint} moves at {listed} {given.unit}/s only, where {alike} cannot be "
                f"distinguished; measure at more speeds to judge {hidden}."
            )
        elif hidden:
            why += f"; measure at more speeds to judge {hidden}"
        choices[joint] = name, f"{why}{fits[name][k].note}"
        remarks += _useless(given.joints[k], next(c for c in of if c.name == name))
        remarks += _doubts(given.joints[k], fits[name][k].model, given.unit)
    given = replace(given, remarks=tuple(remarks))
    return TorqueFits(given, fits, {j: tuple(of) for j, of in errors.items()}, choices, failed)


def _signed_loads(
    table: TorqueTable, fits: Mapping[str, Sequence[torque_table.JointFit]]
) -> Iterator[str]:
    """A sentence for each load that has a sign although laws take it for a normal force."""
    laws = [plain_name(n) for n, of in fits.items()
            if n != "Gear" and torque_table.reads_load(of[0].model)]  # fmt: skip
    for joint in table.joints if laws else ():
        load = np.zeros(1) if joint.load is None else joint.load
        if load.min() < -NO_LOAD * np.abs(load).max():
            yield (
                f"The load of {joint.name} is also negative, but laws of the load "
                f"({', '.join(laws)}) take it for a normal force; give its magnitude. Only gear "
                "needs its sign."
            )


def _useless(joint: JointTorque, chosen: Candidate) -> Iterator[str]:
    """A sentence if the mean torque predicts hold-out blocks as well as the chosen model does."""
    parts = blocks(joint, len(chosen.errors))
    means = [joint.tau[k] - np.delete(joint.tau, k).mean() for k in parts]
    old = torch.tensor([float(np.square(x).mean()) for x in means])
    # Of motion in one direction, dry friction is the mean.
    both = float(joint.moving.qd.min() * joint.moving.qd.max()) < 0.0
    if both and not improves(torch.tensor(chosen.errors) ** 2, old):
        yield (
            f"{plain_name(chosen.name)} predicts hold-out blocks of {joint.name} no better than "
            "the mean torque does. The table should contain friction only (subtract the torque of "
            "gravity and masses), few rows at rest and no mistakes, and the motion should recur "
            "from block to block."
        )


def _doubts(joint: JointTorque, model: FrictionModel, unit: str) -> Iterator[str]:
    """Causes of the error of the chosen law, a sentence each.

    An offset, direction or inertia; for rows in no order, since along a motion errors follow
    reversals and what precedes them, also the velocity or load, or rows far off the law.
    """
    torque = torque_table.predict(model, joint).numpy()
    # At rest, dry friction can have any value.
    moving = np.abs(joint.qd) > 3 * model.v_smooth
    joint, torque = joint.rows(moving), torque[moving]
    error = joint.tau - torque
    rows, small = np.argsort(joint.qd), SMALL * float(np.median(np.abs(joint.tau)))
    if len(rows) < MINIMUM_ROWS:
        return
    own = f"{plain_name(type(model).__name__)} at {joint.name}"
    remembers = model.law.memory is not None
    remark, cause = _cause(joint, torque, small, own, unit, remembers=remembers)
    error -= cause
    if remark:
        yield remark
    # Half a step of a coarse sensor is no error, and neighbouring readings are a step apart.
    least = max(small, 1.5 * float(np.diff(np.unique(joint.tau)).min(initial=math.inf)))
    if joint.time is not None:
        size = _of_load(joint, error)
        if not torque_table.reads_load(model) and size > small:
            yield (
                f"{size:.3g} {'N m' if unit == 'rad' else 'N'} (root mean square) of the error of "
                f"{own} follow the load, which the intervals do not cover. Try a law of the load "
                "(load-coulomb, load-slip) or one of your own."
            )
        # Along a motion the torques before and after a mistake agree with each other.
        sound = np.median([joint.tau[:-2], joint.tau[1:-1], joint.tau[2:]], axis=0)
        usual = joint.tau - np.median(joint.tau)
        far = 1 + _beyond(joint.tau[1:-1] - sound, usual, least)
        if len(far):
            yield _listed(joint, far, own, unit)
        return
    share = max(0.5, 3 / math.sqrt(len(rows)))
    left = error[rows] - error[rows].mean()
    common, quantity = float(left[1:] @ left[:-1]), "velocity"
    if joint.load is not None:
        # A law of the load may lack a constant friction, so velocity and load matter together.
        speed, load = np.abs(joint.qd[rows]), joint.load[rows]
        terms = np.sign(joint.qd[rows])[:, None] * np.stack([speed**0, speed, load], -1)
        explained = terms @ np.linalg.lstsq(terms, left, rcond=None)[0]
        if float(explained @ explained) > common:
            common, quantity = float(explained @ explained), "velocity and the load"
    # If neighbours share more than half of the error, it is no chance and no single mistake.
    if float(left @ left) > len(left) * small**2 and common > share * float(left @ left):
        lacks_load = quantity != "velocity" and not torque_table.reads_load(model)
        better = "a law of the load (load-coulomb)" if lacks_load else "neuro-fuzzy models"
        yield (
            f"Most of the error of {own} follows the {quantity}: the law has another shape, which "
            f"the intervals do not cover. Add {better}, or a law of your own."
        )
        return
    far = rows[_beyond(left, left, least)]
    if len(far) > max(LISTED, FEW * len(rows)):
        yield (
            f"{len(far)} of {len(rows)} torques are far off {own}, as with rows recorded while "
            "accelerating; leave these out, or subtract inertia times acceleration."
        )
    elif len(far):
        yield _listed(joint, far, own, unit)


def _of_load(joint: JointTorque, error: Array) -> float:
    """Root mean square of the error that follows the load, beyond chance over blocks; or 0."""
    if joint.load is None:
        return 0.0
    sign, speed = np.sign(joint.qd), np.abs(joint.qd)
    # A load that grows with the speed, as by centrifugal force, is no cause.
    odd = sign[:, None] * np.stack([speed**0, speed, np.sqrt(speed), speed**2], 1)
    given = np.stack([error, sign * joint.load], 1)
    error, cause = (given - odd @ np.linalg.lstsq(odd, given, None)[0]).T
    parts = blocks(joint, min(FOLDS, len(joint)))
    plain, left = (_left_out(error, x, parts) for x in (np.zeros_like(error), cause))
    if not improves(left, plain, DEFAULTS.input_chance):
        return 0.0
    return math.sqrt(float((cause @ error) ** 2 / (cause @ cause)) / len(error))


def _beyond(x: Array, usual: Array, least: float) -> NDArray[np.intp]:
    """Rows of values outside Tukey's outer fences of usual ones, and at least this far out."""
    low, high = np.quantile(usual, (0.25, 0.75))
    reach = max(FENCE * (high - low), least)
    return np.flatnonzero((x < low - reach) | (x > high + reach))


def _listed(joint: JointTorque, far: NDArray[np.intp], own: str, unit: str) -> str:
    """A sentence that names rows that are far off a law."""
    off = ", ".join(f"{joint.tau[r]:.4g} at {joint.qd[r]:.4g} {unit}/s" for r in far[:LISTED])
    more = f" and {len(far) - LISTED} more" * (len(far) > LISTED)
    return (
        f"Torques far off {own}: {off}{more}. Check these rows; if they are mistakes, drop them "
        "and fit again."
    )


def _cause(
    joint: JointTorque, torque: Array, small: float, own: str, unit: str, *, remembers: bool
) -> tuple[str, Array]:
    """A cause that explains more of the error of a law's torque (row,) than chance over blocks.

    Returns:
        A sentence, empty if there is none, and the cause's torque (row,) [N m; N].
    """
    # Torques that reverse with the velocity, (row, term): a coarse law of any shape.
    speed, load = np.abs(joint.qd), [] if joint.load is None else [joint.load]
    odd = np.sign(joint.qd)[:, None] * np.stack([speed**0, speed, np.sqrt(speed), *load], 1)
    parts = blocks(joint, min(FOLDS, len(joint)))
    one, way = np.ones_like(torque), np.sign(joint.qd) * torque
    given = np.stack([joint.tau - torque, one, way, joint.qdd], 1)
    # Without the part that a law of the velocity may explain, whatever its shape.
    error, *causes = (given - odd @ np.linalg.lstsq(odd, given, None)[0]).T
    plain, *left = (_left_out(error, x, parts) for x in (np.zeros_like(error), *causes))
    best = int(np.argmin([float(x.sum()) for x in left]))
    sizes = [float(x @ error) / max(float(x @ x), 1e-300) for x in causes]
    found, chance = sizes[best] * given[:, 1 + best], DEFAULTS.input_chance / len(causes)
    if (
        # Torques of one sign have another cause; a lag of friction resembles a negative inertia.
        float(joint.tau.min() * joint.tau.max()) >= 0.0
        or (best == 2 and sizes[2] < 0.0)
        or float(np.square(found).mean()) <= small**2
        or not improves(left[best], plain, chance)
    ):
        return "", np.zeros_like(error)
    ways, share = ("negative", "positive")[:: 1 if sizes[1] > 0 else -1], abs(sizes[1])
    # Rows of one direction lack the motion before them.
    split = "neuro-fuzzy:slip follows the direction where hold-out blocks support that"
    split = split if remembers else "fit each as a separate joint (column `joint`)"
    texts = (
        f"The torque is {abs(sizes[0]):.3g} {'N m' if unit == 'rad' else 'N'} "
        f"{'above' if sizes[0] > 0 else 'below'} {own} in both directions, as with an offset of "
        "the sensor or a constant load; subtract it and fit again, or add arctan, which has one.",
        f"Friction is {200 * share / (1 + share):.0f} % lower in the {ways[0]} direction than in "
        f"the {ways[1]}, unlike {own}; {split}.",
        f"The error of {own} follows the acceleration, as with an inertia of {sizes[2]:.3g} "
        f"{'kg m²' if unit == 'rad' else 'kg'}; leave out rows recorded while accelerating, or "
        "subtract inertia times acceleration.",
    )
    # In a narrow range of torques, an offset and a direction are alike.
    alike = best < 2 and not improves(left[best], left[1 - best], chance)
    return texts[best] + f" Or, explaining as much: {texts[1 - best]}" * alike, found


def _left_out(error: Array, cause: Array, parts: Sequence[NDArray[np.intp]]) -> torch.Tensor:
    """Mean square of the error (row,) of each block beside a cause sized by the rest, (block,)."""
    square, product = cause**2, cause * error
    sizes = [(product.sum() - product[k].sum()) / max(square.sum() - square[k].sum(), 1e-300)
             for k in parts]  # fmt: skip
    return torch.tensor([
        float(np.square(error[k] - size * cause[k]).mean())
        for k, size in zip(parts, sizes, strict=True)
    ])  # fmt: skip


def _speeds(joint: JointTorque) -> list[float]:
    """Distinct speeds of a joint [rad/s; m/s], increasing."""
    found: list[float] = []
    for speed in np.sort(np.abs(joint.qd)).tolist():
        if speed > (1 + SAME_SPEED) * (found[-1] if found else 0.0):
            found.append(speed)
    return found


def _determined(count: int, candidates: Sequence[Candidate]) -> list[Candidate]:
    """Models whose law has fewer fitted coefficients than this number of speeds.

    Any other passes through the mean torque of every speed, and repeats show only the noise.
    """
    found = []
    for candidate in candidates:
        model = model_by_name(candidate.name)(1)
        # Laws with a memory or a load do not depend on the speed alone.
        more = model.law.memory or torque_table.reads_load(model)
        if more or sum(c.fitted for c in model.law.coefficients) < count:
            found.append(candidate)
    return found


def _choose(candidates: Sequence[Candidate], least: float = 0.0) -> tuple[str, str]:
    """The model to use and the reason; errors of less than `least` [N m; N] are alike.

    A law that needs memory, or a load, has to beat the choice among laws that need less by more
    than chance explains over the blocks, by the rules for networks and for their inputs, because
    peculiarities of one run with few strokes do not recur in the next.
    """
    by_need: dict[tuple[bool, bool], list[Candidate]] = {}  # memory, load
    for candidate in candidates:
        kind = model_by_name(candidate.name)
        need = kind.definition.memory is not None, torque_table.reads_load(kind(1))
        by_need.setdefault(need, []).append(candidate)
    first, *others = sorted(by_need)
    chosen, why = _simplest(by_need[first], least)
    if others and len(by_need[first]) == 1:
        why = "no other needs as little memory or load"
    for need in others:
        more = by_need[need]
        best, reason = _simplest(more, least)
        new, old = torch.from_numpy(np.square([best.errors, chosen.errors]))
        if improves(new, old, DEFAULTS.input_chance if need[1] else DEFAULTS.gain_chance):
            gain = f"hold-out error {_percent(chosen, best)} % smaller"
            chosen, why = best, f"{gain} than that of {plain_name(chosen.name)}"
            why += f"; {reason}" * (len(more) > 1)
        elif best.error < chosen.error:
            gain = f"{plain_name(best.name)} is {_percent(chosen, best)} % smaller"
            why += f"; the hold-out error of {gain}, which the blocks' scatter explains"
    return chosen.name, why


def _percent(more: Candidate, less: Candidate) -> str:
    return f"{100 * (1 - less.error / more.error):.0f}"


def _simplest(candidates: Sequence[Candidate], resolved: float) -> tuple[Candidate, str]:
    """The model with fewest parameters whose error chance may raise above the least, and why."""
    least = min(candidates, key=lambda c: c.error)
    near = [c for c in candidates if c is least or indistinguishable(c, least, resolved)]
    # A dropped network equals its law but for rounding: then the law.
    chosen = min(near, key=lambda c: (c.parameters, ":" in plain_name(c.name), c.error))
    if chosen is not least:
        number = "fewer" if chosen.parameters < least.parameters else "no more"
        return chosen, (
            f"not distinguishable from the least, of {plain_name(least.name)}, with {number} "
            "parameters"
        )
    others = [c for c in candidates if c is not least]
    if not others:
        return least, "the only model"
    second = min(others, key=lambda c: c.error)
    more = 100 * (second.error / least.error - 1)
    return least, f"the hold-out error of {plain_name(second.name)} is {more:.0f} % larger"


def _fit(
    name: str, joint: JointTorque, v_smooth: float, folds: int, options: FitOptions
) -> tuple[torque_table.JointFit, Candidate]:
    """A model fitted to all rows of a joint, and its errors on hold-out blocks."""
    model = model_by_name(name)(1)
    form = model.schedule.form
    # With fewer rows than folds, each row is left out once.
    folds = min(folds, len(joint))
    if model.law.memory is not None:
        fit, left_out = torque_table.fit_memory(name, joint, blocks(joint, folds), v_smooth)
        return fit, Candidate(name, left_out, len(fit.intervals) + fit.rules, True)
    if form not in ("constant", "neurofuzzy"):
        raise ValueError(
            f"{plain_name(name)} is not fitted to tables, which have no acceleration classes; use "
            "its law, or its neuro-fuzzy model."
        )
    torque_table.require_load(name, joint)
    # The law without a network first: a network is kept only if it lowers the error.
    shares = (0.0, *options.prior_shares) if form == "neurofuzzy" else (0.0,)
    errors = np.zeros((len(shares), folds))
    for k, test in enumerate(blocks(joint, folds)):
        # The torque at rest depends on the motion before, which these laws do not know.
        rest = joint.rows(np.setdiff1d(np.arange(len(joint)), test)).moving
        left = joint.rows(test)
        constant = torque_table.fit_joint(name, rest, v_smooth, options)
        for i, share in enumerate(shares):
            found = torque_table.fit_network(constant, rest, share, options) if share else constant
            error = torque_table.predict(found.model, left) - torch.as_tensor(left.tau)
            errors[i, k] = float(error.square().mean().sqrt())
    # Mean squares, so that blocks of equal length count as one table would.
    best = int(np.square(errors).mean(1).argmin())
    found = torque_table.fit_joint(name, joint.moving, v_smooth, options)
    if shares[best]:
        found = torque_table.fit_network(found, joint.moving, shares[best], options)
    error = torque_table.predict(found.model, joint) - torch.as_tensor(joint.tau)
    found = replace(found, residual=float(error.square().mean().sqrt()))
    # A dropped network has no parameters beyond its law's.
    count = int((found.model.schedule.parameter_vector() != 0).sum())
    count += len(found.model.law.coefficients) * (form != "constant")
    return found, Candidate(name, tuple(errors[best].tolist()), count, found.converged)


def score_joint(joint: JointTorque, model: FrictionModel) -> TorqueScore:
    """Error of the torque that a model of one joint predicts at the rows of a joint.

    Rows at rest are not scored if they are in no order, nor is the lead-in of a law with memory,
    because the model was given its torque. A ripple that is out of phase with the rows is logged.
    """
    joint = joint.sliding
    torque, rows = _predicted(model, joint), slice(None)
    if joint.time is not None and model.law.memory is not None:
        # The initial deflection was estimated from the torque of these rows.
        rows = slice(int(np.searchsorted(joint.time, joint.time[0] + torque_table.LEAD_IN)), None)
    if isinstance(model.schedule, Recorded) and "ripple" in model.schedule.followed():
        shift = ripple_shift(model.schedule, joint, torque, blocks(joint, FOLDS))
        if shift:
            logger.warning(
                "%s: the ripple over the position is out of phase with this table, probably by "
                "another encoder zero; add %.4g to its positions, or use slip.", joint.name, shift,
            )  # fmt: skip
    rmse = float(np.sqrt(np.mean((torque - joint.tau)[rows] ** 2)))
    nrmse = rmse / (float(joint.tau[rows].std()) or math.nan)
    return TorqueScore(joint.name, type(model).__name__, rmse, nrmse)


def _predicted(model: FrictionModel, joint: JointTorque) -> Array:
    """Torque at the rows of a joint; inputs over a tenth beyond the range of the fit are logged."""
    if isinstance(schedule := model.schedule, Recorded):
        given, followed = recorded_inputs(joint), {*schedule.followed()} - {"direction", "ripple"}
        for name, (low, high) in zip(TERMS, schedule.ranges[0].tolist(), strict=True):
            if name in followed and name in given:
                least, most = map(float, given[name].aminmax())
                if max(low - least, most - high) > 0.1 * (high - low):
                    logger.warning(
                        "%s: %s from %.4g to %.4g, but %.4g to %.4g in the fit, at whose ends "
                        "friction is held.", joint.name, name, least, most, low, high,
                    )  # fmt: skip
    return torque_table.predict(model, joint).numpy()


class SavedModel(NamedTuple):
    """A model of one joint, from a fit or from a file, with its error on hold-out blocks."""

    joint: str
    unit: Unit
    model: FrictionModel
    left_out: float = math.nan  # root mean square [N m; N]; NaN if it is unknown


def read_models(path: str | Path) -> list[SavedModel]:
    """Models by joint, from a model file or from a folder that `write_torque_fits` wrote.

    From a folder, each joint gets the model that was chosen for it.

    Raises:
        ValueError: it is neither, or damaged.
    """
    path = Path(path)
    if not path.is_dir():
        return _saved(path)
    index = path / RESULTS
    try:
        content = parse_json(index.read_text(encoding="utf-8"))
        chosen = {str(joint): model_name(of["model"]) for joint, of in content["chosen"].items()}
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path} is no folder written by fit-torque: {index.name} is missing or not its own."
        ) from error
    by_name = {
        name: {one.joint: one for one in _saved(path / "models" / f"{name}.json")}
        for name in dict.fromkeys(chosen.values())
    }
    lost = [joint for joint, name in chosen.items() if joint not in by_name[name]]
    if lost:
        raise ValueError(f"{path}: the model files lack {', '.join(lost)}; fit again.")
    return [by_name[name][joint] for joint, name in chosen.items()]


def _saved(path: Path) -> list[SavedModel]:
    model, info = load(path), load_info(path)
    names = info.joint_names or [f"joint{k + 1}" for k in range(model.joints)]
    unit: Unit = "m" if info.unit == "m" else "rad"
    given = info.fit.get("blocks_left_out")
    errors = [given.get(name) if isinstance(given, dict) else None for name in names]
    left_out = [x if isinstance(x, float) else math.nan for x in errors]
    return [SavedModel(name, unit, one, error)
            for name, one, error in zip(names, split(model), left_out, strict=True)]  # fmt: skip


def score_models(models: Sequence[SavedModel], table: TorqueTable) -> pd.DataFrame:
    """Errors of models at the rows of a table, by joint.

    Raises:
        ValueError: if the table's joints are others, or it lacks a load that a model needs.
    """
    _check_joints([one.joint for one in models], table)
    pairs = zip(models, table.joints, strict=True)
    found = pd.DataFrame([score_joint(joint, one.model) for one, joint in pairs]).set_index("joint")
    times = {m.joint: e / m.left_out for m, e in zip(models, found["rmse"], strict=True)}
    if far := [f"{j}: {x:.2g}" for j, x in times.items() if x > DEFAULTS.diagnosis_ratio]:
        logger.warning(
            "errors are more than twice those on blocks left out of the training table (times, at "
            "%s); this table may differ from it in temperature, load, wear or speeds.",
            ", ".join(far),
        )  # fmt: skip
    return found.assign(left_out=[one.left_out for one in models])


def split(model: FrictionModel) -> list[FrictionModel]:
    """Models of one joint each from a model of many joints."""
    state = model.state_dict()
    make: Any = type(model)
    found = []
    for k in range(model.joints):
        one = make(1, v_smooth=model.v_smooth, **model.schedule.options())
        one.load_state_dict({key: value[k : k + 1] for key, value in state.items()})
        found.append(one.requires_grad_(False))
    return found


def _check_joints(names: Sequence[str], table: TorqueTable) -> None:
    if tuple(names) != table.joint_names:
        raise ValueError(
            f"the model has joints {', '.join(names)}, the table {', '.join(table.joint_names)}; "
            "give a table of the same joints in the same order."
        )


def _finite(x: float) -> float | None:
    return x if math.isfinite(x) else None
