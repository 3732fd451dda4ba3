"""Neuro-fuzzy coefficients of one sample in as few operations as they need.

A schedule is written for thousands of samples side by side, with parameters in a form that trains
well. A controller calls it with one sample, where every operation costs its overhead: here all
that is known is computed beforehand, scales are folded into weights, and what remains is the same
function.
"""

import copy
from typing import TypeVar

from torch import Tensor, nn

from nfriction.export.filtered import FilteredController
from nfriction.export.flat_numbers import NumberByNumber
from nfriction.export.flat_tensors import TensorByTensor
from nfriction.friction.coefficients import Schedule
from nfriction.friction.models import FrictionModel
from nfriction.friction.neurofuzzy import NeuroFuzzy


def flattened(model: FrictionModel, *, number_by_number: bool = False) -> FrictionModel:
    """A model whose neuro-fuzzy schedule takes the short way for one sample of shape (joint,).

    Coefficients agree to rounding. Any other model, and one that has not as many sets of velocity
    as of acceleration, is handed back as it is.

    Args:
        model: a friction model.
        number_by_number: for targets that compute with numbers rather than tensors: fewer
            arithmetic operations in place of fewer tensor operations.
    """
    schedule = model.schedule
    if type(schedule) is not NeuroFuzzy or len(set(schedule.terms)) > 1:
        return model
    short = copy.copy(model)
    short._modules = {**model._modules, "schedule": ShortWay(schedule, number_by_number)}
    return short


_Controller = TypeVar("_Controller", bound=nn.Module)


def shortened(controller: _Controller, *, number_by_number: bool = False) -> _Controller:
    """A controller around the flattened model."""
    short = copy.copy(controller)
    own: dict[str, nn.Module] = {}
    if isinstance(controller, FilteredController):
        own["inner"] = shortened(controller.inner, number_by_number=number_by_number)
    else:
        assert isinstance(controller.model, FrictionModel)
        own["model"] = flattened(controller.model, number_by_number=number_by_number)
    short._modules = {**controller._modules, **own}
    return short


class ShortWay(nn.Module):
    """A schedule for batches, its flat form for one sample."""

    def __init__(self, schedule: Schedule, number_by_number: bool) -> None:
        super().__init__()
        assert isinstance(schedule, NeuroFuzzy)
        self.batched = schedule
        kind = NumberByNumber if number_by_number else TensorByTensor
        self.single: nn.Module = kind(schedule)

    def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
        if qd.dim() == 1:
            return self.single(qd, qdd)
        return self.batched(qd, qdd)
