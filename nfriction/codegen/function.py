"""Compile single functions of tensors."""

from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nfriction.codegen import batch
from nfriction.codegen.graph import FunctionalModule, Method, Program
from nfriction.codegen.scalar import SelfCheckFailed
from nfriction.codegen.transform import hoist, with_jacobian

_CHECK_TOLERANCE = 1e-10
# Number of kernels cached by their computation, with the shapes of their outputs: fits to parts of
# the data or from several starts share them. Six laws need twelve, of about ten megabytes each.
_KEPT = 16
_known: OrderedDict[Hashable, tuple[batch.Kernel, dict[str, tuple[int, ...]]]] = OrderedDict()


class CompiledFunction:
    """A compiled function of tensors, applied to NumPy arrays whose first axis is a batch.

    Args:
        function: a module or a bound method of one (whose parameters remain inputs, read at every
            call), or any callable (tensors in its closure become constants).
        example_inputs: float64 tensors of the right shapes, without a batch dimension.
        jacobian: indices of the inputs by which to differentiate; the exact Jacobian, (elements of
            all outputs, elements of these inputs), is then returned last.

    Raises:
        UnsupportedOperation: if it uses an operation that has no scalar form here.
        SelfCheckFailed: if compiled values differ from eager ones.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        example_inputs: Sequence[Tensor],
        *,
        jacobian: Sequence[int] = (),
    ) -> None:
        self._function = function
        self._jacobian = tuple(jacobian)
        self._module = FunctionalModule(Method(function))
        inputs = {f"x{i}": x for i, x in enumerate(example_inputs)}
        program = self._module.trace(inputs)
        self._inputs = {p.name: p.shape for p in program.inputs if p.name in inputs}
        key = program.digest(), self._jacobian
        if key in _known:
            self.kernel, self._outputs = _known[key]
        else:
            if self._jacobian:
                program = with_jacobian(program, [f"x{i}" for i in self._jacobian])
            self._outputs = {f"y{i}": p.shape for i, p in enumerate(program.outputs)}
            layout = batch.Layout(tuple(self._inputs), tuple(self._outputs))
            self.kernel = batch.Kernel(lambda width: _driver(program, layout, width), layout)
            self.check(example_inputs)
        _known[key] = self.kernel, self._outputs
        _known.move_to_end(key)
        if len(_known) > _KEPT:
            _known.popitem(last=False)

    def __call__(self, *inputs: Any) -> Any:
        """Evaluate row by row: an array (batch, *shape), or a tuple of them if there are several.

        Args:
            *inputs: arrays of shape (batch, *shape of the example); a single row applies to all.

        Raises:
            ValueError: if shapes do not fit.
        """
        if len(inputs) != len(self._inputs):
            raise ValueError(f"expected {len(self._inputs)} inputs, got {len(inputs)}.")
        given = {
            name: batch.rows_of(f"input {name[1:]}", x, shape)
            for (name, shape), x in zip(self._inputs.items(), inputs, strict=True)
        }
        rows = batch.common_rows({name: one.rows for name, one in given.items()})
        p, _ = batch.parameter_rows(self._module, {})
        out = {name: np.empty((rows, *shape)) for name, shape in self._outputs.items()}
        self.kernel(rows, p, given, out)
        return tuple(out.values()) if len(out) > 1 else out["y0"]

    def check(self, example_inputs: Sequence[Tensor]) -> None:
        """Compare with eager torch at the example inputs and near them.

        Raises:
            SelfCheckFailed: if they differ by more than rounding explains.
        """
        generator = torch.Generator().manual_seed(0)
        # The examples themselves may lie at a kink, where either one-sided derivative is correct.
        # Relative to the examples, because functions may grow without bound where signs change.
        for spread in (0.1,) if self._jacobian else (0.0, 0.01, 0.1):
            inputs = [
                x.detach()
                + spread
                * (x.detach().abs() if self._jacobian else 1.0)
                * torch.randn(x.shape, generator=generator, dtype=x.dtype)
                for x in example_inputs
            ]
            with torch.no_grad():
                eager = self._eager([x.to(self._module.device) for x in inputs])
            # Enough rows for the vector code, which most calls use.
            ours = self(*(x.expand(batch.FEW, *x.shape) for x in inputs))
            for a, b in zip(ours if isinstance(ours, tuple) else (ours,), eager, strict=True):
                expected = batch.to_array(b)
                tolerance = _CHECK_TOLERANCE
                if not np.allclose(a[0], expected, tolerance, tolerance, equal_nan=True):
                    raise SelfCheckFailed(
                        f"the compiled function gives {a[0]} where torch gives {expected}; "
                        "please report this, and use the torch module meanwhile."
                    )

    def _eager(self, inputs: list[Tensor]) -> tuple[Tensor, ...]:
        """All outputs, including the Jacobian, in eager torch."""

        def outputs(*given: Tensor) -> Tensor:
            return torch.cat([y.reshape(-1) for y in _tuple(self._function(*given))])

        eager = _tuple(self._function(*inputs))
        if not self._jacobian:
            return eager
        # With plain autograd: `torch.func` imports all of torch._dynamo (2 s).
        blocks = torch.autograd.functional.jacobian(outputs, tuple(inputs))
        flat = [blocks[i].reshape(len(blocks[i]), -1) for i in self._jacobian]
        return (*eager, torch.cat(flat, -1))


def _tuple(found: Any) -> tuple[Tensor, ...]:
    return tuple(found) if isinstance(found, (tuple, list)) else (found,)


def _driver(program: Program, layout: batch.Layout, width: int) -> batch.Driver:
    """A loop over rows."""
    groups, once = hoist(program.graph, [port.nodes for port in program.outputs])
    outputs = dict(zip(layout.outputs, groups, strict=True))
    sizes = {name: len(group) for name, group in outputs.items()}
    sizes |= {p.name: len(p.nodes) for p in program.inputs if p.name in layout.series}
    places = program.places({name: (name, 0) for name in layout.series})
    driver = batch.Driver(layout, width, sizes, once, places)
    driver.function("nf_row", layout.series, outputs)
    with driver.entry():
        for name in layout.series:
            driver.gather(name, sizes[name], driver.value[f"room.{name}"])
        rooms = (f"room.{name}" for name in (*layout.series, *layout.outputs))
        driver.call("nf_row", *rooms)
        for name in layout.outputs:
            driver.scatter(name, sizes[name])
    return driver
