"""What every target exports: the controller of a model, with its causal filter or without."""

from collections.abc import Sequence

from nfriction.export.filtered import FilteredController
from nfriction.export.unfiltered import Controller, MemoryController, memory_of
from nfriction.friction.models import FrictionModel
from nfriction.io.model_info import ModelInfo
from nfriction.signals import SecondOrderLowPass

AnyController = Controller | MemoryController | FilteredController


def controller_of(
    model: FrictionModel,
    info: ModelInfo | None = None,
    *,
    torque_limit: float | Sequence[float] | None = None,
    with_filter: bool = False,
    cutoff_hz: float = 20.0,
) -> AnyController:
    """The controller that every target exports.

    Args:
        model: a friction model; a frozen copy is taken, in float64 on the CPU.
        info: tells the trained ranges, and the sample time that a filter needs.
        torque_limit: largest |torque| given out [N m], a number or one a joint.
        with_filter: take raw positions, with the causal filter inside.
        cutoff_hz: cut-off of that filter [Hz].

    Raises:
        ValueError: if a range or the limit is malformed, or a filter lacks its sample time.
    """
    kind = MemoryController if memory_of(model) else Controller
    inner = kind(model, info, torque_limit)
    if not with_filter:
        return inner
    sample_time = (info or ModelInfo()).sample_time
    if sample_time is None:
        raise ValueError(
            "a filter needs `ModelInfo.sample_time` [s], got None: none was given, or the model "
            "was fitted to recordings of different ones."
        )
    return FilteredController(inner, SecondOrderLowPass(cutoff_hz, float(sample_time)))
