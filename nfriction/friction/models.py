"""The named friction models: laws with constant, adaptive or neuro-fuzzy coefficients."""

from collections.abc import Mapping, Sequence
from typing import Literal

from torch import Tensor

from nfriction.friction import laws
from nfriction.friction.coefficients import Schedule
from nfriction.friction.constant import Constant
from nfriction.friction.laws import Law
from nfriction.friction.model import V_SMOOTH, FrictionModel
from nfriction.friction.neurofuzzy import PRIOR_SD, NeuroFuzzy
from nfriction.papers.afem.adaptive import Adaptive
from nfriction.papers.nffem.adaptive_neurofuzzy import AdaptiveNeuroFuzzy
from nfriction.papers.nffem.rbf_coefficients import RadialBasis


class ConstantModel(FrictionModel):
    """A law with constant coefficients; the named models below are its public forms.

    Args:
        joints: number of joints.
        initial: start values in SI, shape (joint, coefficient) or (coefficient,).
        v_smooth: see `FrictionModel`.
    """

    definition: Law

    def __init__(
        self,
        joints: int,
        initial: Tensor | Sequence | None = None,
        *,
        v_smooth: float = V_SMOOTH,
    ) -> None:
        super().__init__(self.definition, Constant(self.definition, joints, initial), v_smooth)


class NCFM(ConstantModel):
    """Viscous friction `C_p qd`, one constant a joint (second paper, Table I)."""

    definition = laws.VISCOUS


class LFM(ConstantModel):
    """Viscous plus load-dependent Coulomb friction, constants B and C (TLRIP paper, (26)-(29))."""

    definition = laws.LINEAR


class CFM(ConstantModel):
    """Coulomb friction with a constant F_c, and nothing viscous.

    The law of ball bearings whose links swing in air: what grows with velocity is the air's.
    """

    definition = laws.COULOMB


class CVFM(ConstantModel):
    """Coulomb plus viscous friction with constants F_c and F_v, whatever the load.

    The usual law of geared drives, whose dry friction is that of the gear and not of the joint's
    own bearing.
    """

    definition = laws.COULOMB_VISCOUS


class NLFM(ConstantModel):
    """Five constants f_o, f_c, f_v, f_a, f_b a joint (second paper, Table III)."""

    definition = laws.NONLINEAR


class Stribeck(ConstantModel):
    """Generalised Stribeck friction with constants F_c, F_d, F_v, v_s, delta a joint."""

    definition = laws.STRIBECK


class AdaptiveModel(FrictionModel):
    """A law with constant coefficients for each class of acceleration: low, medium, high.

    Args:
        joints: number of joints.
        initial: start values in SI, shape (joint, class, coefficient), (joint, coefficient) or
            (coefficient,).
        v_smooth: see `FrictionModel`.
        hysteresis, time_constant, sample_time: see `Adaptive`.
    """

    definition: Law

    def __init__(
        self,
        joints: int,
        initial: Tensor | Sequence | None = None,
        *,
        v_smooth: float = V_SMOOTH,
        hysteresis: float = 0.2,
        time_constant: float = 2.0,
        sample_time: float = 1e-3,
    ) -> None:
        schedule = Adaptive(
            self.definition,
            joints,
            initial,
            hysteresis=hysteresis,
            time_constant=time_constant,
            sample_time=sample_time,
        )
        super().__init__(self.definition, schedule, v_smooth)


class ANCFM(AdaptiveModel):
    """Viscous friction, its constant one for each class of acceleration (TLRIP paper)."""

    definition = laws.VISCOUS


class ACFM(AdaptiveModel):
    """Coulomb friction, F_c for each class of acceleration."""

    definition = laws.COULOMB


class ACVFM(AdaptiveModel):
    """Coulomb plus viscous friction, F_c and F_v for each class of acceleration."""

    definition = laws.COULOMB_VISCOUS


class ALFM(AdaptiveModel):
    """Viscous plus load-dependent Coulomb friction, B and C for each class (TLRIP paper)."""

    definition = laws.LINEAR


class ANLFM(AdaptiveModel):
    """Five constants f_o, f_c, f_v, f_a, f_b for each class of acceleration (TLRIP paper)."""

    definition = laws.NONLINEAR


class NeuroFuzzyModel(FrictionModel):
    """A law whose coefficients an ANFIS layer with a radial basis head gives.

    Args:
        joints: number of joints.
        initial: constant reference from which training starts, as in `ConstantModel`.
        v_smooth: see `FrictionModel`.
        terms, head_units, acceleration, interpretable, prior_sd: see `NeuroFuzzy`.
        network: `"rbf"` takes the papers' network alone (`RadialBasis`) in place of the ANFIS
            layer with its head; `head_units` are its units, and sets it has none. `"by_class"`
            lets the network deviate from coefficients by class (`AdaptiveNeuroFuzzy`).
        memory: options of its `Adaptive` part.
    """

    definition: Law

    def __init__(
        self,
        joints: int,
        initial: Tensor | Sequence | None = None,
        *,
        v_smooth: float = V_SMOOTH,
        terms: Sequence[int] = (5, 5),
        head_units: int = 10,
        acceleration: Literal["along_motion", "signed"] = "along_motion",
        interpretable: bool = False,
        prior_sd: float = PRIOR_SD,
        network: Literal["anfis", "by_class", "rbf"] = "anfis",
        memory: Mapping[str, float] | None = None,
    ) -> None:
        schedule: Schedule
        if network == "rbf":
            schedule = RadialBasis(
                self.definition, joints, initial, units=head_units, acceleration=acceleration
            )
        elif network in ("anfis", "by_class"):
            kind = NeuroFuzzy if network == "anfis" else AdaptiveNeuroFuzzy
            schedule = kind(
                self.definition,
                joints,
                initial,
                terms=terms,
                head_units=head_units,
                acceleration=acceleration,
                interpretable=interpretable,
                prior_sd=prior_sd,
            )
        else:
            raise ValueError(f'`network` must be "anfis", "by_class" or "rbf", got {network!r}.')
        if isinstance(schedule, AdaptiveNeuroFuzzy) and memory is not None:
            schedule.set_memory(**memory)
        super().__init__(self.definition, schedule, v_smooth)


class NFNCFM(NeuroFuzzyModel):
    """Viscous friction with a neuro-fuzzy coefficient (TLRIP paper)."""

    definition = laws.VISCOUS


class NFCFM(NeuroFuzzyModel):
    """Coulomb friction with a neuro-fuzzy F_c: any curve over velocity that is odd."""

    definition = laws.COULOMB


class NFCVFM(NeuroFuzzyModel):
    """Coulomb plus viscous friction with neuro-fuzzy F_c and F_v."""

    definition = laws.COULOMB_VISCOUS


class NFLFM(NeuroFuzzyModel):
    """Viscous plus load-dependent Coulomb friction with neuro-fuzzy B and C (TLRIP paper)."""

    definition = laws.LINEAR


class NFNLFM(NeuroFuzzyModel):
    """Offset, Coulomb, viscous and arctangent friction, neuro-fuzzy coefficients (TLRIP paper)."""

    definition = laws.NONLINEAR


class NFStribeck(NeuroFuzzyModel):
    """Generalised Stribeck friction with neuro-fuzzy F_c, F_d, F_v, v_s and delta."""

    definition = laws.STRIBECK


NamedModel = type[ConstantModel] | type[AdaptiveModel] | type[NeuroFuzzyModel]

MODELS: dict[str, NamedModel] = {
    model.__name__: model
    for model in (
        NCFM, LFM, NLFM, CFM, CVFM, Stribeck, ANCFM, ALFM, ANLFM, ACFM, ACVFM,
        NFNCFM, NFLFM, NFNLFM, NFCFM, NFCVFM, NFStribeck,
    )
}  # fmt: skip


def model_by_name(name: str) -> NamedModel:
    """The named model's class.

    Raises:
        ValueError: if no model has that name; the message lists the names.
    """
    if name not in MODELS:
        raise ValueError(f"no friction model is called {name!r}; there are {', '.join(MODELS)}.")
    return MODELS[name]
