"""Fit a friction model to recordings: check them, then run the strategy of its coefficients.

A fit has two stages. *Equation error*: the smoothed motion implies the friction torque

    tau_f = tau - M(q) qdd - bias(q, qd),

which is linear in most coefficients, so regression finds them from any start, but biased by the
noise of qdd. *Output error*: simulations from the start of short windows must follow the
measured positions; this refines coefficients and plant without any derivative of the data. A
strategy, one for each kind of coefficients (`fitting.strategy`), determines starting points and
windows: for constant ones of 0.5, 2 and 5 s, each from the end of the previous. The next step is
`nfriction.fitting.shooting.problem`, the cost of the second stage.
"""

import pkgutil
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from nfriction.fitting.options import Eccentricity, EncoderReference, FitOptions, Loss, Method
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.task import Callback, FitTask, prepare_task
from nfriction.friction.models import FrictionModel
from nfriction.plant import Plant
from nfriction.recording import RecordingLike
from nfriction.signals import Motion


def fit(
    model: FrictionModel | str,
    plant: Plant | str | Path,
    recordings: RecordingLike | Iterable[RecordingLike],
    *,
    method: Method = "output_error",
    windows: Sequence[float] = FitOptions.windows,
    fit_plant: bool = True,
    drag: bool | None = None,
    eccentricity: Eccentricity = "off",
    encoder_reference: EncoderReference = "auto",
    start: FitResult | None = None,
    motions: Sequence[Motion] | None = None,
    max_steps: int = 30,
    loss: Loss = "linear",
    fit_delay: bool = False,
    callback: Callback | None = None,
) -> FitResult:
    """Estimate a friction model from recordings.

    Equation error gives constant coefficients; output error over windows of growing length then
    refines them and the plant. Windows so long that they worsen the result of shorter ones are
    skipped, with a warning. Laws with several minima are also started from their grid of initial
    values and from the simpler law that they contain (`Law.nested_law`); the lowest residual wins.
    A neuro-fuzzy model starts at the constant fit of its law and is kept only if it improves the
    error on hold-out windows, each held out in turn, by a factor of 1.1 and more than the scatter;
    a wider plant prior, moved sets and further inputs (`FitResult.inputs`: the direction of
    rotation, the load of the bearings) must improve it, too. An adaptive model also starts at the
    constant fit; `fit_adaptive` has more settings.

    Args:
        model: the model to fit, changed in place (the result has a copy); or its name, such as
            "coulomb-viscous", with v_smooth at most 1/1000 of the slowest joint's largest velocity
            and 3 mrad/s or mm/s; less for a rig that is driven or comes to rest.
        plant: the mechanism as given, its name, or the path of a rig file.
        recordings: one or several, paths of files, or tables with columns time, q1, …; all in one
            convention, by default the plant's.
        method: `"equation_error"` stops after the regression (constant coefficients only).
        windows: lengths of the shooting windows [s], in the order in which they are used.
        fit_plant: adjust inertia and gravity terms, lengths, encoder zeros, gear losses, torque
            constants and a constant torque offset for each drive, within bounds.
        drag: also fit air drag on the links. None fits it for an undriven chain on a fixed pivot: a
            free swing loses as much energy to the air as to its joints, whose coefficients would
            absorb the drag.
        eccentricity: `"on"` also fits the eccentricity of the encoders, `"auto"` if the evidence
            favours it or `start` has it; not with an adaptive model. Off by default, because the
            evidence assumes a correct law, and a sine of the angle may absorb an error of the law.
        encoder_reference: when incremental encoders were set to zero. `"shared"`: before all
            recordings; the offset is part of the plant. `"per_recording"`: at the start of each,
            at rest in a pose held by stiction; each recording's offset is estimated
            (`FitResult.encoder_offsets`), also for a recording to be scored. `"auto"`:
            `"per_recording"` if several recordings of a driven chain all begin at rest with every
            encoder at zero, with a warning.
        start: an earlier fit to start from: for a neuro-fuzzy model of its law, to the same
            recordings; only the plant terms are used from that of another model.
        motions: smoothed motions in joint coordinates, to save smoothing again.
        max_steps: limit of steps at each window length.
        loss: `"linear"` for least squares, or a robust loss by SciPy's names, `"soft_l1"`,
            `"huber"` or `"cauchy"`, for logs with spikes: errors beyond the normal scatter get less
            weight, and `FitResult.outliers` names the samples. Its scale comes from the median
            error of each joint.
        fit_delay: also estimate the delay of torques relative to positions, such as a bus or a
            filter causes; one delay for all (`FitResult.torque_delay`, with an interval).
        callback: `callback(stage, step)` after every step, a name and a `Step`; True stops.

    Returns:
        The fit; read `converged`, `status` and `warnings`.

    Raises:
        TypeError: if model, plant or recordings have another type.
        ValueError: if recordings and plant do not match, a recording is given twice, is too short
            or lacks a torque that the law reads, or an option does not exist.
    """
    options = FitOptions(
        method, windows, fit_plant, drag,
        eccentricity, encoder_reference, max_steps, loss, fit_delay,
    )  # fmt: skip
    task = prepare_task(model, plant, recordings, options, start, motions, callback)
    schedule = task.model.schedule
    if not schedule.fit_strategy:
        raise ValueError(
            f"coefficients of type {type(schedule).__name__} have no fit strategy; set the class "
            'attribute `fit_strategy` to "module:function", see `Schedule`.'
        )
    if method == "equation_error" and schedule.follows_motion:
        raise ValueError('adaptive and neuro-fuzzy models need `method="output_error"`.')
    # By name, so that a schedule outside the core can bring its own strategy.
    strategy: Callable[[FitTask], FitResult] = pkgutil.resolve_name(schedule.fit_strategy)
    found = strategy(task).with_terms_times(task.ratios)
    unmodelled = *task.drift, *task.unmodelled
    found = found.with_own_model().with_warnings(
        task.warnings_beside(found), task.mistakes, unmodelled
    )
    return found.without(task.drift) if task.drift_explained(found) else found
