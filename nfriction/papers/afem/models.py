"""Named models with coefficients by class of acceleration."""

from nfriction.friction import laws
from nfriction.friction.models import NamedModel
from nfriction.papers.afem.adaptive import Adaptive


class AdaptiveModel(NamedModel):
    """A law with constant coefficients for each class of acceleration: low, medium, high.

    Args:
        joints, v_smooth: see `NamedModel`.
        initial: start values in SI, shape (joint, class, coefficient), (joint, coefficient) or
            (coefficient,).
        options: `hysteresis`, `time_constant` and `sample_time`, see `Adaptive`.
    """

    make_schedule = Adaptive


class ANCFM(AdaptiveModel):
    """Viscous friction, one constant for each class of acceleration (TLRIP paper)."""

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
