"""Parameters and buffers of a module as inputs of a traced function."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from nfriction.codegen.arguments import Array, to_array
from nfriction.codegen.graph import Program, trace
from nfriction.codegen.scalar import Level


class Lifted:
    """A module whose floating-point parameters and buffers are inputs named p0, p1, ...

    Integer and boolean buffers stay constants: they index and select, which has to be known when
    code is emitted.

    Args:
        module: whose `forward` is traced.
    """

    def __init__(self, module: nn.Module) -> None:
        self.module = module
        state = self._state()
        self.names = tuple(name for name, t in state.items() if t.is_floating_point())
        self._fixed = {n: t.detach().cpu() for n, t in state.items() if n not in self.names}

    def _state(self) -> dict[str, Tensor]:
        return {**dict(self.module.named_parameters()), **dict(self.module.named_buffers())}

    @property
    def device(self) -> torch.device:
        """Where the module lives; its first tensor tells."""
        return next((t.device for t in self._state().values()), torch.device("cpu"))

    def values(self) -> dict[str, Array]:
        """The present values by their names in the module."""
        state = self._state()
        return {name: to_array(state[name]) for name in self.names}

    def trace(self, inputs: dict[str, Tensor], levels: dict[str, Level]) -> Program:
        """Trace `module(**inputs)`; the program's first inputs are the parameters.

        Args:
            inputs: example tensors by the names of `forward`'s arguments.
            levels: how long each of them lives.
        """
        state = self._state()
        parameters = {f"p{i}": state[name] for i, name in enumerate(self.names)}

        def call(**given: Tensor) -> Any:
            values = {name: given.pop(f"p{i}") for i, name in enumerate(self.names)}
            return torch.func.functional_call(self.module, {**self._fixed, **values}, kwargs=given)

        levels = {**dict.fromkeys(parameters, Level.PARAMETER), **levels}
        return trace(call, {**parameters, **inputs}, levels)


class Method(nn.Module):
    """A module, a bound method of one, or any callable, with named arguments.

    Args:
        function: what to call; its arguments are passed by position in the order given.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__()
        owner = function if isinstance(function, nn.Module) else getattr(function, "__self__", None)
        self.owner = owner if isinstance(owner, nn.Module) else None
        self._function = [function]  # in a list, so that it is not registered a second time

    def forward(self, **inputs: Tensor) -> Any:
        return self._function[0](*inputs.values())
