"""Fingerprints of all that a trace may read: compiled code is stale if its fingerprint changes.

Python code reads far more than its arguments: globals, closures, attributes of objects, elements
of arrays. Starting from the traced objects, all of these are followed here by the names that
functions use, and compared by value. An object that cannot be compared (an open file, an object of
a C library) raises an error that names it; then only another trace shows what the code computes.
"""

import builtins
import dis
import enum
import functools
import types
from collections import OrderedDict
from collections.abc import Hashable, Iterable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from nfriction.codegen.scalar import Incomparable


class _Read(NamedTuple):
    """Names in a function's code: globals, attributes and imported modules."""

    names: tuple[str, ...]
    attributes: frozenset[str]
    imports: tuple[str, ...]


# Packages whose functions and classes never change, so they need not be followed.
_CONSTANT = frozenset({
    *("nfriction", "torch", "numpy", "builtins", "math", "cmath", "operator", "_operator", "abc"),
    *("functools", "_functools", "itertools", "collections", "types", "typing", "dataclasses"),
    *("enum", "contextlib", "numbers"),
})  # fmt: skip
# Built-in functions that access objects not visible from names.
_REACHING = frozenset({
    *("open", "input", "eval", "exec", "globals", "locals", "vars", "getattr", "__import__"),
})  # fmt: skip
_ATOMS = frozenset({
    *(type(None), bool, int, str, bytes, type(Ellipsis), type(NotImplemented), range),
    *(torch.dtype, torch.device, torch.Size, np.ufunc, types.CodeType),
})  # fmt: skip
_SEQUENCES = frozenset({list, tuple, set, frozenset})
_MAPPINGS = frozenset({dict, OrderedDict, types.MappingProxyType})
_TENSORS = frozenset({Tensor, nn.Parameter})
# Attributes that determine what objects of these classes compute.
_HOLDING: dict[type, tuple[str, ...]] = {
    types.MethodType: ("__func__", "__self__"),
    functools.partial: ("func", "args", "keywords"),
    staticmethod: ("__func__",),
    classmethod: ("__func__",),
    property: ("fget", "fset"),
}
# Fields of every module; those that determine what it computes are followed separately.
_OF_MODULES = frozenset(vars(nn.Module())) - {"training"}
_HOOKS = ("_forward_hooks", "_forward_pre_hooks")
# Limit on the parts of a fingerprint; following more takes longer than another trace.
_LIMIT = 20_000
_HEAP_TYPE = 1 << 9  # flag of a class that was created by Python code
# Size of an object that has only attributes and a slot for weak references.
_PLAIN_SIZE = type("Plain", (), {}).__basicsize__


def fingerprint(modules: Iterable[nn.Module], *others: Any) -> Hashable:
    """A value that differs if the code traced from these objects may differ.

    Args:
        modules: their floating-point parameters and buffers are inputs of the traced code, so only
            their shapes matter, not their values.
        others: further functions and values that the trace reads.

    Raises:
        Incomparable: if they reach something that cannot be compared; the error names it.
    """
    walk = _Walk(modules)
    try:
        for value in (torch.get_default_dtype(), *modules, *others):
            walk.add(value)
    except RecursionError:
        raise Incomparable("a chain of objects that is too long to follow") from None
    return tuple(walk.parts)


def content(value: Any) -> bytes:
    """Elements of a tensor or an array.

    Raises:
        Incomparable: if its elements cannot be read.
    """
    if not isinstance(value, Tensor):
        if value.dtype.hasobject:
            raise Incomparable("an array of objects")
        return bytes(value.tobytes())
    if value.layout is not torch.strided:
        raise Incomparable(f"a tensor with layout {value.layout}")
    exact = value.float() if value.dtype is torch.bfloat16 else value  # NumPy has none
    try:
        return exact.numpy(force=True).tobytes()
    except RuntimeError:  # within `torch.func`, for example
        raise Incomparable("a tensor without memory of its own") from None


@functools.lru_cache(1024)
def _read_by(code: types.CodeType) -> _Read:
    found: dict[str, set[str]] = {"LOAD_GLOBAL": set(), "IMPORT_NAME": set()}
    for instruction in dis.get_instructions(code):
        if instruction.opname in found:
            found[instruction.opname].add(instruction.argval)
    names, imports, attributes = *found.values(), set(code.co_names)
    for inner in code.co_consts:
        if isinstance(inner, types.CodeType):
            more = _read_by(inner)
            names.update(more.names)
            imports.update(more.imports)
            attributes |= more.attributes
    return _Read(tuple(sorted(names)), frozenset(attributes), tuple(sorted(imports)))


def _is_constant(module: Any) -> bool:
    return isinstance(module, str) and module.partition(".")[0] in _CONSTANT


class _Walk:
    """A walk over everything that can be reached; `parts` describes it in hashable pieces."""

    def __init__(self, modules: Iterable[nn.Module]) -> None:
        self.parts: list[Any] = []
        self.seen: dict[Any, int] = {}
        self.modules: set[int] = set()
        found = list(modules)
        while found:
            module = found.pop()
            self.modules.add(id(module))
            found += [m for m in module._modules.values() if m is not None]

    def add(self, value: Any) -> None:
        kind: type = type(value)
        parts = self.parts
        parts.append(kind)
        if kind in _ATOMS:
            parts.append(value)
        elif kind is float or kind is complex:
            parts.append(repr(value))  # distinguishes signs of zero, and NaN equals itself
        elif kind in _TENSORS or kind is np.ndarray or isinstance(value, np.generic):
            parts += (value.shape, value.dtype, content(value))
        elif self._is_new(id(value)):
            self._compound(kind, value)

    def _is_new(self, *key: Hashable) -> bool:
        """False if the same object was met before, so that cycles end."""
        new = key not in self.seen
        self.parts.append(self.seen.setdefault(key, len(self.seen)))
        return new

    def _compound(self, kind: type, value: Any) -> None:
        if isinstance(value, nn.Module):
            self._module(value)
        elif kind in _SEQUENCES:
            self._length(len(value))
            for item in value:
                self.add(item)
        elif kind in _MAPPINGS:
            self._mapping(value)
        elif kind is types.FunctionType:
            self._function(value)
        elif kind in _HOLDING:
            for name in _HOLDING[kind]:
                self.add(getattr(value, name))
        elif isinstance(value, type):
            self._class(value)
        elif isinstance(value, enum.Enum):
            self._class(kind)
            self._mapping(vars(value))
        elif kind is types.BuiltinFunctionType and _is_constant(_home(value)):
            self.parts.append(value)
        elif kind is types.ModuleType and _is_constant(value.__name__):
            self.parts.append(value.__name__)
        else:
            # An object of a Python class: its class and all of its attributes.
            python = all(k.__flags__ & _HEAP_TYPE for k in kind.__mro__ if k is not object)
            if not python or kind.__basicsize__ > _PLAIN_SIZE or not hasattr(value, "__dict__"):
                raise Incomparable(f"an object of {kind.__module__}.{kind.__qualname__}")
            self._class(kind)
            self._mapping(vars(value))

    def _length(self, length: int) -> None:
        self.parts.append(length)
        if len(self.parts) + length > _LIMIT:
            raise Incomparable(f"more than {_LIMIT} values")

    def _mapping(self, values: Any) -> None:
        self._length(len(values))
        for key, value in values.items():
            self.add(key)
            self.add(value)

    def _module(self, module: nn.Module) -> None:
        own = id(module) in self.modules
        for tensors in (module._parameters, module._buffers):
            for name, tensor in tensors.items():
                self.parts.append(name)
                if tensor is not None and own and tensor.is_floating_point():
                    self.parts += (tensor.shape, tensor.dtype)
                else:
                    self.add(tensor)
        for name, part in module._modules.items():
            self.parts.append(name)
            self.add(part)
        for name in _HOOKS:
            if vars(module).get(name):
                self.add(vars(module)[name])
        ours = _is_constant(type(module).__module__)
        for name, value in vars(module).items():
            # In private containers, modules of the library keep descriptions, which no step reads.
            if name in _OF_MODULES or (ours and name[0] == "_" and isinstance(value, list | dict)):
                continue
            self.parts.append(name)
            self.add(value)
        if not ours:
            self._class(type(module))

    def _function(self, function: types.FunctionType) -> None:
        code = function.__code__
        self.parts.append(code)
        if not _is_constant(function.__globals__.get("__name__")):
            self._named(function, _read_by(code))
        for cell in function.__closure__ or ():
            try:
                self.add(cell.cell_contents)
            except ValueError:
                self.parts.append("an empty cell")
        for values in (function.__defaults__, function.__kwdefaults__, function.__dict__):
            if values:
                self.add(values)

    def _named(self, function: types.FunctionType, read: _Read) -> None:
        """Everything outside a function that it refers to by name."""
        for name in read.imports:
            if not _is_constant(name):
                raise Incomparable(f"`{function.__qualname__}`, which imports `{name or '.'}`")
        for name in read.names:
            if name in function.__globals__:
                self.parts.append(name)
                self._reached(function.__globals__[name], read.attributes)
            elif name in _REACHING and hasattr(builtins, name):
                raise Incomparable(f"`{function.__qualname__}`, which calls `{name}`")

    def _reached(self, value: Any, attributes: frozenset[str]) -> None:
        """Follow a global; if it is a module, all of its names that the function also uses."""
        if not isinstance(value, types.ModuleType) or _is_constant(value.__name__):
            self.add(value)
            return
        self.parts.append(value.__name__)
        if self._is_new(id(value), attributes):
            for name in sorted(attributes & vars(value).keys()):
                self.parts.append(name)
                self._reached(vars(value)[name], attributes)

    def _class(self, kind: type) -> None:
        for base in kind.__mro__:
            self.parts.append(base)
            if not _is_constant(base.__module__):
                for name, value in vars(base).items():
                    # Of the names defined by Python, only functions compute something.
                    given = name.startswith("__") or name == "_abc_impl"
                    if issubclass(base, enum.Enum):
                        given = name.startswith("_") and name != "_member_map_"
                    if not given or isinstance(value, types.FunctionType):
                        self.parts.append(name)
                        self.add(value)


def _home(function: Any) -> str:
    """The module of a function that is not written in Python; empty for a method of an object."""
    owner = function.__self__
    if isinstance(owner, types.ModuleType):
        return owner.__name__
    return "torch" if owner is None else ""
