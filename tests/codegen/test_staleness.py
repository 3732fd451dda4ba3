"""Fingerprints cover everything that a function may read, by value."""

import enum
import functools
import math
from collections import defaultdict, namedtuple

import numpy as np
import pytest
import torch
from torch import nn

from nfriction.codegen import Incomparable, fingerprint

F64 = torch.float64
Pair = namedtuple("Pair", "a b")
KNOBS = {"list": [1.0], "array": np.zeros(5_000)}
RUNNING = iter([1.0])


class Grade(enum.Enum):
    THIN = 1
    THICK = 2
    LISTED = [1.0]  # noqa: RUF012

    def known(self):
        return KNOBS["list"]


class Finish(str, enum.Enum):
    FINE = "fine"


class Tagged(np.ndarray):
    pass


class Slotted:
    __slots__ = ("value",)


class Held:
    def __init__(self, value):
        self.value = value

    def get(self):
        return self.value


class Ring:
    def __init__(self):
        self.me = self


def test_equal_values_have_equal_fingerprints_and_others_differ():
    values = [
        *(0.0, -0.0, 1.0, 1, True, math.nan, "1", b"1", None, [1.0], (1.0,), {1}, {"a": 1.0}),
        *(np.zeros(3), np.zeros((3, 1)), np.zeros(3, dtype=int), np.float64(1.0)),
        *(torch.zeros(2), torch.zeros(2, dtype=F64), torch.ones(2), torch.zeros(()), torch.int64),
        *(Held(1.0), Held(2.0), Grade.THIN, Grade.THICK, torch.tanh, torch.sin, math.sin),
        *(functools.partial(max, 1.0), functools.partial(max, 2.0)),
        *(Held(3.0).get, Held(4.0).get, nn.Linear, Ring(), nn.Tanh(), nn.Sigmoid()),
    ]
    prints = [fingerprint((), value) for value in values]
    assert prints == [fingerprint((), value) for value in values]
    assert len(set(prints)) == len(prints)
    assert fingerprint((), math.nan) == fingerprint((), float("nan"))


def test_parameters_of_a_module_itself_are_inputs():
    module, other = nn.Linear(2, 2), nn.Linear(2, 2)
    assert fingerprint((module,)) == fingerprint((other,))
    # If a function holds them, they are constants of the trace.
    assert fingerprint((), module) != fingerprint((), other)
    assert fingerprint((), lambda: module.weight) != fingerprint((), lambda: other.weight)
    assert fingerprint((module,)) != fingerprint((module.double(),))
    before = fingerprint((other,))
    other.register_forward_hook(lambda *_: None)
    assert fingerprint((other,)) != before


def test_values_read_by_functions_are_covered():
    def inner():
        return [KNOBS["list"] for _ in range(2)]

    def outer(x, scale=KNOBS):
        return inner()

    before = fingerprint((), outer)
    for change, restore in (
        (lambda: KNOBS["list"].append(2.0), lambda: KNOBS["list"].pop()),
        (lambda: KNOBS["array"].__setitem__(2_500, 1.0), lambda: KNOBS["array"].fill(0.0)),
        (lambda: setattr(inner, "memo", 1.0), lambda: delattr(inner, "memo")),
    ):
        change()
        assert fingerprint((), outer) != before
        restore()
        assert fingerprint((), outer) == before
    precise = torch.get_default_dtype()
    try:
        torch.set_default_dtype(F64 if precise is torch.float32 else torch.float32)
        assert fingerprint((), outer) != before
    finally:
        torch.set_default_dtype(precise)


def test_enumeration_members_are_covered_with_their_methods():
    for value in (Grade.THIN, Grade):
        for changed in (KNOBS["list"], Grade.LISTED.value):
            before = fingerprint((), value)
            changed.append(2.0)
            assert fingerprint((), value) != before
            changed.pop()
            assert fingerprint((), value) == before
    assert fingerprint((), Finish.FINE) == fingerprint((), Finish.FINE)


def _opens():
    return open("settings")


def _imports():
    from tests import conftest

    return conftest


def _runs():
    return next(RUNNING)


@pytest.mark.parametrize(
    ("value", "named"),
    [
        (_opens, "`_opens`, which calls `open`"),
        (_imports, "`_imports`, which imports `tests`"),
        (_runs, "list_iterator"),
        (functools.lru_cache(_runs), "lru_cache"),
        (list(range(30_000)), "values"),
        (np.array([[], None], dtype=object), "array of objects"),
        (np.zeros(2).view(Tagged), "Tagged"),
        (np.ma.array([1.0]), "MaskedArray"),
        (torch.eye(2).to_sparse(), "layout"),
        (torch.Generator(), "Generator"),
        (Slotted(), "Slotted"),
        (Pair(1.0, 2.0), "Pair"),
        (defaultdict(int), "defaultdict"),
        ([].append, "builtin_function"),
    ],
)
def test_incomparable_values_are_named(value, named):
    with pytest.raises(Incomparable, match=named):
        fingerprint((), value)
    chain = []
    for _ in range(5_000):
        chain = [chain]
    with pytest.raises(Incomparable, match="too long"):
        fingerprint((), chain)


def test_tensors_of_a_transformation_cannot_be_compared():
    def function(x):
        with pytest.raises(Incomparable, match="memory of its own"):
            fingerprint((), x)
        return x.sum()

    torch.func.vmap(function)(torch.ones(2, 2))
    with pytest.raises(Incomparable, match="memory of its own"):
        fingerprint((), torch.ones(2, device="meta"))
