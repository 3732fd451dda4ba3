"""Derivatives of an ANFIS layer, in columns that its outputs share; see `factored_jacobian`.

With normalised strengths s_r = prod_i p_i[t_i(r)] and rule outputs f_kr, the output y_k moves with
the log membership of set t of input i by

    Q_kit = sum over the rules r that use the set of s_r f_kr - p_i[t] y_k,

and the log memberships with z = (x - c)/a: by -h, where h = z for Gaussians.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from nfriction.fuzzy.factored_jacobian import trained
from nfriction.fuzzy.layout import to_columns
from nfriction.fuzzy.membership import log_bell
from nfriction.fuzzy.partition import FreePartition

if TYPE_CHECKING:
    from nfriction.fuzzy.anfis import Anfis


def column_count(anfis: Anfis) -> tuple[int, int]:
    """How many columns the consequents share, and how many the sets have for each output."""
    regressors = anfis.rules * anfis.consequents.shape[-1]
    return regressors, (2 if anfis.log_slopes is None else 3) * sum(anfis.terms)


@torch.no_grad()
def regressor_columns(anfis: Anfis, x: Tensor, out: Tensor | None = None) -> Tensor:
    """`Anfis.regressors` with the samples last, (groups, regressors, samples), written to `out`."""
    u = to_columns(x)
    shape = (u.shape[0], column_count(anfis)[0], u.shape[2])
    out = u.new_empty(shape) if out is None else out
    _write_regressors(out, anfis.strength_columns(u), _terms(anfis, u))
    return out


@torch.no_grad()
def jacobian_columns(anfis: Anfis, x: Tensor, out: Tensor | None = None) -> Tensor:
    """The regressors, then for each output Q h, Q h z and, for bells, Q dlog m / dlog b.

    Args:
        x: inputs, shape (samples, groups, inputs).
        out: where to write the result, its shape; fresh memory costs more than the arithmetic.
    Returns:
        Shape (groups, regressors + outputs * (2 or 3) sets, samples).
    """
    u = to_columns(x)
    shared, own = column_count(anfis)
    shape = (u.shape[0], shared + anfis.outputs * own, u.shape[2])
    F = u.new_empty(shape) if out is None else out
    strengths, terms = anfis.strength_columns(u), _terms(anfis, u)
    _write_regressors(F[:, :shared], strengths, terms)
    z, h, by_slope = _premises(anfis, u)
    # Which rules use which set; the strengths' sums over them are the sets' shares.
    uses = _incidence(anfis.terms).to(u)
    shares = uses @ strengths
    sets = F[:, shared:].unflatten(1, (anfis.outputs, own // z.shape[1], z.shape[1]))
    for k in range(anfis.outputs):
        said = torch.bmm(anfis.consequents[:, k], terms).mul_(strengths)
        Q = (uses @ said).addcmul_(shares, said.sum(1, keepdim=True), value=-1.0)
        torch.mul(Q, h, out=sets[:, k, 0])
        torch.mul(sets[:, k, 0], z, out=sets[:, k, 1])
        if by_slope is not None:
            torch.mul(Q, by_slope, out=sets[:, k, 2])
    return F


@torch.no_grad()
def input_jacobian(anfis: Anfis, x: Tensor) -> tuple[Tensor, Tensor]:
    """Outputs and their derivatives by the inputs of their group.

    An input x_i moves the rules' planes f_kr = a_kr . x + b_kr, and the shares p of its sets in the
    strengths s_r = prod_i p_i[t_i(r)], each softmax of log memberships l:

        d y_k / d x_i = sum_r s_r a_kri + sum_r s_r p'_i[t_i(r)] / p_i[t_i(r)] f_kr,
        p' = p (l' - sum p l').

    Args:
        x: inputs, shape (samples, groups, inputs).
    Returns:
        Shapes (groups, outputs, samples) and (groups, outputs, inputs, samples).
    """
    u = to_columns(x).contiguous()
    terms, shares = _terms(anfis, u), anfis.set_shares(u)
    planes = anfis.consequents.transpose(2, 3).flatten(1, 2)

    def blended(factors: list[Tensor]) -> Tensor:
        found = torch.bmm(planes, anfis.strengths_of(factors))
        return found.unflatten(1, (anfis.outputs, terms.shape[1]))

    def evaluated(blend: Tensor) -> Tensor:
        return (blend * terms.unsqueeze(1)).sum(2)

    own = blended(shares)
    by_log = _premises(anfis, u)[1] / -anfis.sets()[1].unsqueeze(-1)
    by_input = []
    for i, slope in enumerate(by_log.split(anfis.terms, 1)):
        mean = (shares[i] * slope).sum(1, keepdim=True)
        moved = [*shares[:i], shares[i] * (slope - mean), *shares[i + 1 :]]
        by_input.append(evaluated(blended(moved)))
    found = torch.stack(by_input, 2)
    return evaluated(own), found + own[:, :, :-1] if anfis.order == 1 else found


@torch.no_grad()
def jacobian_maps(anfis: Anfis) -> dict[str, Tensor]:
    """How `jacobian_columns` combine to the derivatives by each trained parameter.

    Returns:
        For each trained parameter (groups, outputs, columns, entries of a group).
    """
    outputs, (shared, own) = anfis.outputs, column_count(anfis)
    like = anfis.consequents.detach()
    total, sets = shared + outputs * own, sum(anfis.terms)
    centres_and_widths = _partition_jacobian(anfis)
    maps = {}
    for name in trained(anfis):
        if name == "consequents":
            block = like.new_zeros(outputs, total, outputs, shared)
            for k in range(outputs):
                block[k, :shared, k] = torch.eye(shared).to(like)
            maps[name] = block.flatten(2).expand(anfis.groups, -1, -1, -1)
            continue
        rows = (
            torch.diag_embed(like.new_ones(anfis.groups, sets))
            if name == "log_slopes"
            else centres_and_widths[name.removeprefix("partition.")]
        )
        first = 2 * sets if name == "log_slopes" else 0
        maps[name] = like.new_zeros(anfis.groups, outputs, total, rows.shape[-1])
        for k in range(outputs):
            start = shared + k * own + first
            maps[name][:, k, start : start + rows.shape[1]] = rows
    return maps


def _terms(anfis: Anfis, u: Tensor) -> Tensor:
    """What a rule's output is linear in: the inputs and 1, or 1."""
    one = torch.ones_like(u[:, :1])
    return torch.cat([u, one], 1) if anfis.order == 1 else one


def _write_regressors(out: Tensor, strengths: Tensor, terms: Tensor) -> None:
    by_rule = out.unflatten(1, (strengths.shape[1], terms.shape[1]))
    torch.mul(strengths.unsqueeze(2), terms.unsqueeze(1), out=by_rule)


def _premises(anfis: Anfis, u: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
    """z, h = -dlog m/dz and, for bells, dlog m/dlog b, each (groups, sets, samples)."""
    centres, widths = (part.unsqueeze(-1) for part in anfis.sets())
    z = torch.repeat_interleave(u, torch.tensor(anfis.terms, device=u.device), 1)
    z = z.sub_(centres).div_(widths)
    if anfis.log_slopes is None:
        return z, z, None
    slope = torch.exp(anfis.log_slopes).unsqueeze(-1)
    one = torch.ones_like(slope)
    outside = -slope * torch.expm1(log_bell(z, 0.0 * one, one, slope))
    # The same hair above zero as in the membership.
    square = z * z + 1e-37
    return z, 2.0 * outside * z / square, -outside * square.log()


def _incidence(terms: list[int]) -> Tensor:
    """1 where a rule uses a set, shape (sets, rules); the last input's set runs fastest."""
    choice = torch.cartesian_prod(*(torch.arange(n) for n in terms)).reshape(-1, len(terms))
    rows = [torch.nn.functional.one_hot(choice[:, i], n).T for i, n in enumerate(terms)]
    return torch.cat(rows)


def _partition_jacobian(anfis: Anfis) -> dict[str, Tensor]:
    """d (centres, widths) / d parameter over the width, (groups, 2 sets, entries of a group)."""
    if isinstance(anfis.partition, FreePartition):
        # Written out: the first automatic one of a process takes two seconds to load.
        inverse = torch.exp(-anfis.partition.log_widths.detach())
        zero = torch.zeros_like(inverse).diag_embed()
        return {
            "centres": torch.cat([inverse.diag_embed(), zero], 1),
            "log_widths": torch.cat([zero, torch.ones_like(inverse).diag_embed()], 1),
        }
    parameters = dict(anfis.partition.named_parameters())
    detached = {name: value.detach() for name, value in parameters.items()}
    names = [name for name in trained(anfis) if name.startswith("partition.")]
    _, widths = anfis.sets()

    def both(values: dict[str, Tensor]) -> Tensor:
        sets = torch.func.functional_call(anfis.partition, {**detached, **values}, ())
        return torch.cat(sets, 1)

    moving = {name: detached[name] for name in (n.removeprefix("partition.") for n in names)}
    found = torch.func.jacrev(both)(moving)
    # A group's sets depend on its own parameters only.
    scale = torch.cat([widths, widths], 1).unsqueeze(-1)
    return {n: J.diagonal(dim1=0, dim2=2).movedim(-1, 0) / scale for n, J in found.items()}
